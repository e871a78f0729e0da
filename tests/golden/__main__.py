"""Write golden pages again: `python -m tests.golden COMMAND…`, or all without a command. It runs the tests that they name."""

from __future__ import annotations

import os
import sys

import pytest

from tests.golden.pages import HERE, WRITE, read_page, write_page


def main(commands: list[str]) -> int:
    """Run the tests of pages, which write their sections; a section without a test is gone."""
    pages = commands or sorted(path.stem for path in HERE.glob("*.txt"))
    tests = sorted({test for page in pages for test in read_page(page)})
    for page in pages:
        write_page(page, {})
    os.environ[WRITE] = "write"
    return pytest.main(["-q", "-p", "no:randomly", *tests])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
