"""The count of lines of code that `make lint` prints."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

ROOT = Path(__file__).parents[1]
_SPEC = spec_from_file_location("lines_of_code", ROOT / "tools" / "lines_of_code.py")
assert _SPEC is not None
assert _SPEC.loader is not None
lines_of_code = module_from_spec(_SPEC)
_SPEC.loader.exec_module(lines_of_code)

TEXT = '''"""A module.

With two lines more.
"""

# a comment
VALUE = 1  # and another one
"""The value's docstring."""
WORDS = """
two
"""


def f(
    x: int,
) -> int:
    """A docstring."""

    return x
'''


def test_blank_lines_comments_and_docstrings_are_no_code() -> None:
    """One line with a comment at its end, a string of three lines, and a function of four."""
    assert lines_of_code.code_lines(TEXT) == 1 + 3 + 4


def test_no_file_counts_twice() -> None:
    """`peers` is also there behind a link of the package."""
    files = [path.resolve() for path in lines_of_code.files()]
    assert ROOT.joinpath("peers", "sensor.py").resolve() in files
    assert len(files) == len(set(files))
