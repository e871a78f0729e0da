"""Draws the floor plan in docs/architecture.md from the imports, or checks that it is up to date.

    python tools/floor_plan.py            # writes the plan
    python tools/floor_plan.py --check    # exits with 1 if it is out of date

The floors come from the layers contract in pyproject.toml, the arrows from the imports themselves.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- floor plan: made by tools/floor_plan.py -->", "<!-- end of the floor plan -->"
PACKAGE = "evedrop"


def floors() -> list[list[str]]:
    """The rooms of each floor, from the top floor down, as the contract lists them."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    contract = next(one for one in settings["contracts"] if one["name"] == "Floors")
    return [[room.strip() for room in layer.split("|")] for layer in contract["layers"]]


def arrows(rooms: list[str]) -> set[tuple[str, str]]:
    """Pairs of rooms, the first of which imports the second."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    found = set()
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            pair = room_of(module), room_of(imported)
            if pair[0] != pair[1] and all(room in rooms for room in pair):
                found.add(pair)
    return found


def room_of(module: str) -> str:
    """The room that a module is in; empty for the package itself."""
    return module.removeprefix(PACKAGE).lstrip(".").partition(".")[0]


def direct(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The pairs that no chain of other pairs implies."""
    below: dict[str, set[str]] = {}
    for upper, lower in pairs:
        below.setdefault(upper, set()).add(lower)

    def reaches(start: str, goal: str) -> bool:
        return goal in below.get(start, ()) or any(reaches(room, goal) for room in below.get(start, ()))

    return {
        (upper, lower) for upper, lower in pairs if not any(reaches(room, lower) for room in below[upper] - {lower})
    }


def plan() -> str:
    """The floor plan as a Mermaid diagram."""
    listed = floors()
    rooms = [room for floor in listed for room in floor]
    lines = ["```mermaid", "flowchart TD"]
    for number, floor in enumerate(listed):
        lines.append(f'  subgraph floor{len(listed) - number}[" "]')
        lines += [f"    {node(room)}[{room}]" for room in floor]
        lines.append("  end")
    lines += [f"  {node(upper)} --> {node(lower)}" for upper, lower in sorted(direct(arrows(rooms)))]
    return "\n".join([*lines, "```"])


def node(room: str) -> str:
    """The name of a room's node in the diagram."""
    return f"room_{room.strip('_')}"


def main(arguments: list[str]) -> int:
    """Write the plan into the page, or check the one that is there; the exit status."""
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    drawn = f"{before}{BEGIN}\n{plan()}\n{END}{after}"
    if "--check" not in arguments:
        PAGE.write_text(drawn, encoding="utf-8")
    elif drawn != text:
        sys.stderr.write(f"{PAGE.relative_to(ROOT)}: the floor plan is out of date; run: python tools/floor_plan.py\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
