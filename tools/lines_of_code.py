"""Prints how many lines of code the program has: emulator/evedrop and peers, without blank lines, comments and docstrings.

    python tools/lines_of_code.py

Links are not followed, so that what stands behind them counts once.
"""

from __future__ import annotations

import ast
import io
import os
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = (ROOT / "emulator" / "evedrop", ROOT / "peers")
_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING, tokenize.ENDMARKER,
}  # fmt: skip


def files() -> Iterator[Path]:
    """The program's Python files."""
    for source in SOURCES:
        for folder, _, names in os.walk(source):
            yield from (Path(folder, name) for name in names if name.endswith(".py"))


def code_lines(text: str) -> int:
    """How many lines of a file have code: a string that is a statement, such as a docstring, is none."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def main() -> None:
    """Print the sum."""
    counts = [code_lines(path.read_text(encoding="utf-8")) for path in files()]
    print(f"{sum(counts):,} lines of code in {len(counts)} files of emulator/evedrop and peers")


if __name__ == "__main__":
    main()
