"""The page of screens: what commands print on terminals of six widths, as docs/screens has it."""

from __future__ import annotations

from pathlib import Path

SCREENS = Path(__file__).parents[2] / "docs" / "screens"
_HEAD = """# Screens

Evedrop as it is seen on terminals and screens of different sizes. `make docs` makes all of them again,
and fails if one has changed.

## The terminal

Ten commands on terminals of six widths, without colours. Text that differs from run to run is `…`.
"""


def screens_page() -> str:
    """The page in Markdown."""
    parts = [_HEAD]
    for path in sorted(SCREENS.glob("*.txt"), key=lambda path: int(path.stem)):
        _, _, text = path.read_text(encoding="utf-8").partition("\n\n")
        parts.append(f"### {path.stem} columns\n\n```text\n{text.rstrip()}\n```\n")
    return "\n".join(parts)
