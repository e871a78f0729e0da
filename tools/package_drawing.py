"""Draws the packages in docs/architecture.md from the imports, or checks that the drawing is up to date.

    python tools/package_drawing.py            # writes the drawing
    python tools/package_drawing.py --check    # exits with 1 if it is out of date

The order comes from the layers contract in pyproject.toml, the arrows from the imports themselves.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- packages: drawn by tools/package_drawing.py -->", "<!-- end of the drawing -->"
PACKAGE = "evedrop"


def layers() -> list[list[str]]:
    """The packages of each layer, from the top down, as the contract lists them; without loose modules."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    contract = next(contract for contract in settings["contracts"] if contract["name"] == "Packages")
    return [[package.strip() for package in layer.split("|")] for layer in contract["layers"] if ":" not in layer]


def arrows(packages: list[str]) -> set[tuple[str, str]]:
    """Pairs of packages, the first of which imports the second."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    pairs = set()
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            pair = package_of(module), package_of(imported)
            if pair[0] != pair[1] and all(package in packages for package in pair):
                pairs.add(pair)
    return pairs


def package_of(module: str) -> str:
    """The package that a module is in; empty for `evedrop` itself."""
    return module.removeprefix(PACKAGE).lstrip(".").partition(".")[0]


def direct(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The pairs that no chain of other pairs implies."""
    below: dict[str, set[str]] = {}
    for upper, lower in pairs:
        below.setdefault(upper, set()).add(lower)

    def reaches(start: str, goal: str) -> bool:
        return goal in below.get(start, ()) or any(reaches(package, goal) for package in below.get(start, ()))

    return {
        (upper, lower)
        for upper, lower in pairs
        if not any(reaches(package, lower) for package in below[upper] - {lower})
    }


def drawing() -> str:
    """The packages as a Mermaid diagram: a line for each layer, then the arrows."""
    listed = layers()
    packages = [package for layer in listed for package in layer]
    lines = [
        "```mermaid",
        '%%{init: {"flowchart": {"nodeSpacing": 24, "rankSpacing": 18, "padding": 6}}}%%',
        "flowchart TD",
        *("  " + "; ".join(f"{package}[{package}]" for package in layer) for layer in listed),
        *(f"  {upper} --> {lower}" for upper, lower in sorted(direct(arrows(packages)))),
        "```",
    ]
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Write the drawing into the page, or check the one that is there; the exit status."""
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    drawn = f"{before}{BEGIN}\n{drawing()}\n{END}{after}"
    if "--check" not in arguments:
        PAGE.write_text(drawn, encoding="utf-8")
    elif drawn != text:
        sys.stderr.write(
            f"{PAGE.relative_to(ROOT)}: the drawing is out of date; run: python tools/package_drawing.py\n"
        )
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
