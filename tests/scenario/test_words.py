"""The text of scenario files that are written: people can read it, and it says what was given."""

from __future__ import annotations

import tomllib
from typing import Any

from hypothesis import example, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from evedrop.scenario.words import dotted, toml_text

ROWS = """\
title = "[ 1,"
levels = [0.5, 1e-05, -3]

[process]
A = [
    [1.0, 0.1],
    [0.0, 1.0],
]
states = ["x, [1]", "y"]
"""

_texts = st.text(alphabet=st.sampled_from('ab ,[]"\\\n1=#{}'), max_size=6)
_items = st.one_of(st.integers(-9, 10**6), st.floats(allow_nan=False), st.booleans(), _texts)
_values = st.recursive(
    _items,
    lambda inner: st.lists(inner, max_size=40) | st.dictionaries(st.sampled_from(["a", "b c", "d"]), inner, max_size=3),
    max_leaves=60,
)


def test_a_row_has_a_line() -> None:
    """Matrices by rows, lists of numbers and of words; a text that looks like a list stays as it is."""
    assert toml_text(tomllib.loads(ROWS)) == ROWS
    numbers = [(-1.0) ** k * 1.2345e-05**k for k in range(-40, 40)]
    long = toml_text({"schedule": numbers})
    assert 10 < long.count("\n") < 30
    assert max(map(len, long.splitlines())) <= 121
    assert tomllib.loads(long) == {"schedule": numbers}


@hypothesis_settings(deadline=None)
@given(st.dictionaries(st.sampled_from(["x", "y", "z"]), _values, max_size=3))
@example({"x": ["a" * 100, " b,  c" * 9, 'd"\\', "\n["] * 9})
@example({"x": [{"a": [1, 2]}, 3, ["]", "["]]})
def test_reading_gives_the_same_tables(tables: dict[str, Any]) -> None:
    """It does so for any text, and for any nesting of lists and tables."""
    assert tomllib.loads(toml_text(tables)) == tables


def test_a_key_with_a_dot_is_one_already() -> None:
    """Names may contain what stands for the dot in a keyword."""
    assert dotted({"a.b__c.d": 1, "a__b": 2}) == {"a.b__c.d": 1, "a.b": 2}
