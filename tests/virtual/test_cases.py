"""A case is its seed's, and can be written down."""

from __future__ import annotations

import pytest

from evedrop.errors import UsageError
from evedrop.virtual.cases import case_from, case_of

SEEDS = range(1, 60)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_case_is_read_from_its_text(seed: int) -> None:
    """With all tables and faults."""
    case = case_of(seed)
    assert case_from(case.to_text()) == case


def test_the_text_of_a_case_may_be_its_seed() -> None:
    """As a test names it."""
    assert case_from("7") == case_of(7)


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"seed": 1, "faults": [["melt", "router", 1, null]], "scenario": {}}']
)
def test_what_is_no_case_is_refused(text: str) -> None:
    """In the words of an error of usage."""
    with pytest.raises(UsageError):
        case_from(text)
