"""The files of a wire's folder that other packages look for. Imports neither Zenoh nor Rerun."""

from __future__ import annotations

from pathlib import Path

WIRE_FILE = "wire.toml"
"""The complete wire file in a wire's folder."""


def is_wire(folder: Path) -> bool:
    """Whether a results folder is that of a wire."""
    return (folder / WIRE_FILE).is_file()
