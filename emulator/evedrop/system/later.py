"""Names of a module that are imported when they are first used: those that it imports for type checkers alone.

The list in `if TYPE_CHECKING:` is read from the module's source, so that it stands once.
"""

from __future__ import annotations

import ast
import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


def imported_later(module: str, name: str) -> Any:
    """The object that `name` stands for in a module. Raises AttributeError if the module imports no such name."""
    if name not in _homes(module):
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    return getattr(import_module(_homes(module)[name]), name)


@cache
def _homes(module: str) -> dict[str, str]:
    """Name → the module that it is imported from, of the imports for type checkers."""
    source = Path(str(sys.modules[module].__file__)).read_text(encoding="utf-8")
    blocks = (node for node in ast.parse(source).body if isinstance(node, ast.If))
    statements = (node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom))
    return {alias.name: str(node.module) for node in statements for alias in node.names}
