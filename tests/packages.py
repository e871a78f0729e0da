"""An installed package, in a temporary folder: its modules, and the metadata by which Evedrop finds its classes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path


def install(
    folder: Path, modules: Mapping[str, str], entries: Mapping[str, Mapping[str, str]], name: str = "package"
) -> None:
    """Write a package into a folder that is, or will be, on the path of Python.

    modules: file → code; entries: group of entry points → name → what it refers to; name: of the package.
    """
    folder.mkdir(exist_ok=True)
    for file, code in modules.items():
        (folder / file).write_text(code, encoding="utf-8")
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = [
        line for group, named in entries.items() for line in (f"[{group}]", *(f"{k} = {v}" for k, v in named.items()))
    ]
    (about / "entry_points.txt").write_text("\n".join([*lines, ""]))
