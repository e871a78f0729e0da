"""Cases that once broke a promise keep all of them."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.virtual.simulated import play, read_case

REGRESSIONS = tomllib.loads(Path(__file__).with_name("regressions.toml").read_text("utf-8"))["regression"]


@pytest.mark.parametrize(
    "regression",
    [
        pytest.param(one, id=one["why"], marks=pytest.mark.campaign if number else ())
        for number, one in enumerate(REGRESSIONS)
    ],
)
def test_a_case_that_broke_a_promise_keeps_it(regression: dict[str, Any]) -> None:
    """Every entry of regressions.toml."""
    assert play(read_case(str(regression["case"]))).misses == ()
