"""The page of screens: the first tab of the view in two sizes, and what commands print on terminals of six widths.

docs/screens has them; tests/docs/pictures.py and tests/docs/screens.py make them.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

SCREENS = Path(__file__).parents[2] / "docs" / "screens"
_HEAD = """# Screens

Evedrop on screens and terminals of different sizes. The scenes follow the theme of this page. `make docs` makes the dark scenes
and the terminals again, and fails if one has changed; `make pictures` draws all scenes, the light ones in a browser.

## The view
"""
_TERMINAL = """## The terminal

Ten commands on terminals of six widths, without colours. Text that differs from run to run is `…`.
"""


_SCENES = {
    "vehicle": "A patrolling vehicle and three eavesdroppers",
    "acknowledged": "A jammer that blocks critical acknowledgements",
    "hijacked": "A hijacked sensor",
    "microgrid": "A house for a day",
    "nine": "Nine receivers",
    "wire": "A wire between programs",
}


_PAPER = """## On paper

The reports, printed by Chromium where `make docs` finds it: """ + ", ".join(
    f'<a href="screens/report-{kind}.pdf">{kind}</a>'
    for kind in ("run", "study", "sweep", "comparison", "tests", "wire")
)


def screens_page() -> str:
    """The page in Markdown."""
    parts = [_HEAD]
    for name, title in _SCENES.items():
        parts.append(f"### {title}\n")
        for path in sorted(SCREENS.glob(f"{name}-*.png")):
            size, _, theme = path.stem.removeprefix(f"{name}-").partition("-")
            if not theme:
                parts.append(f"![{title}, {size.replace('x', ' × ')} pixels](screens/{path.name})\n")
    parts.append(_TERMINAL)
    for path in sorted(SCREENS.glob("*.txt"), key=lambda path: int(path.stem)):
        _, _, text = path.read_text(encoding="utf-8").partition("\n\n")
        block = f"```text\n{text.rstrip()}\n```\n"
        parts.append(f'??? note "{path.stem} columns"\n\n{textwrap.indent(block, "    ")}')
    return "\n".join([*parts, _PAPER])
