"""Names in the code: one public class for each name."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for folder in ("emulator", "peers") for path in (ROOT / folder).rglob("*.py"))


@cache
def trees() -> list[tuple[Path, ast.Module]]:
    """Every module of the package, parsed; links to folders are followed once."""
    found = [path for path in SOURCES if ROOT / "emulator" / "peers" not in path.parents]
    assert len(found) > 200
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in found]


def test_no_two_public_classes_have_one_name() -> None:
    """A reader who meets a class's name knows which class it is."""
    places = defaultdict(list)
    for path, tree in trees():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(str(path.relative_to(ROOT)))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_classes_say_that_they_are_final_by_the_decorator() -> None:
    """`@final` is checked by mypy; a sentence in a docstring is not."""
    said = re.compile(r"(?:^|[.;] )Final(?:\.|;)")
    tests = [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in (ROOT / "tests").rglob("*.py")]
    for path, tree in [*trees(), *tests]:
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                assert not said.search(ast.get_docstring(node) or ""), f"{path}: {node.name}"
