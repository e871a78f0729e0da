"""Prints how many words README and the pages of docs/ have, and fails if they have more than the limit.

    python tools/site/words.py

A word has a letter or a digit: bars of tables and signs by themselves are none. Commands and their output are counted, golden
bytes and generated pages are not.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIMIT = 60_000
_BYTES = re.compile(r"^```golden .*?^```", re.DOTALL | re.MULTILINE)
_WORD = re.compile(r"(?<!\S)\S*\w\S*")


def words(root: Path = ROOT) -> dict[str, int]:
    """Page → its words, the longest page first."""
    pages = [root / "README.md", *(root / "docs").rglob("*.md")]
    counted = {
        page.relative_to(root).as_posix(): len(_WORD.findall(_BYTES.sub("", page.read_text(encoding="utf-8"))))
        for page in pages
    }
    return dict(sorted(counted.items(), key=lambda item: (-item[1], item[0])))


def table(counted: Mapping[str, int]) -> str:
    """A line for each page, and one for the total."""
    lines = [f"{count:7,}  {page}" for page, count in counted.items()]
    return "\n".join([*lines, f"{sum(counted.values()):7,}  in all, of at most {LIMIT:,}"])


def main() -> int:
    """Print the table; 1 if there are too many words."""
    counted = words()
    print(table(counted))  # noqa: T201
    return int(sum(counted.values()) > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
