"""Names in the code: one public class for each name."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for folder in ("emulator", "peers") for path in (ROOT / folder).rglob("*.py"))


CLASS = re.compile(r"^class ([^\W_]\w*)", re.MULTILINE)
"""A public class, or a line of a text that looks like one."""


@cache
def texts() -> dict[Path, str]:
    """Every module of the package; links to folders are followed once."""
    found = [path for path in SOURCES if ROOT / "emulator" / "evedrop" / "peers" not in path.parents]
    assert len(found) > 200
    return {path: path.read_text(encoding="utf-8") for path in found}


def classes_of(text: str) -> list[ast.ClassDef]:
    """All classes of a module, those within others and within functions too."""
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ClassDef)]


def test_no_two_public_classes_have_one_name() -> None:
    """A reader who meets a class's name knows which class it is. Only modules that may be at fault are parsed."""
    places = defaultdict(list)
    for path, text in texts().items():
        for name in CLASS.findall(text):
            places[name].append(path)
    assert len(places) > 500
    twice = {name: where for name, where in places.items() if len(where) > 1}
    real = {
        name: [
            str(path)
            for path in where
            if any(one.name == name and not one.col_offset for one in classes_of(texts()[path]))
        ]
        for name, where in twice.items()
    }
    assert {name: where for name, where in real.items() if len(where) > 1} == {}


def test_classes_say_that_they_are_final_by_the_decorator() -> None:
    """`@final` is checked by mypy; a sentence in a docstring is not. Only modules with such words are parsed."""
    said = re.compile(r"(?:^|[.;] )Final(?:\.|;)")
    tests = {path: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py")}
    for path, text in (texts() | tests).items():
        for node in classes_of(text) if re.search("Final[.;]", text) else []:
            assert not said.search(ast.get_docstring(node) or ""), f"{path}: {node.name}"


def test_no_two_test_files_have_the_same_name() -> None:
    """Pytest imports test files by their names alone, and collects only the first of two."""
    folders = defaultdict(list)
    for folder in ("tests", "docs/examples"):
        for path in (ROOT / folder).rglob("test_*.py"):
            folders[path.name].append(str(path.parent))
    assert {name: where for name, where in folders.items() if len(where) > 1} == {}
