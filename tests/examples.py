"""How many examples a test looks at in `make test`, and how many in `make test-long`.

Of random examples `make test` looks at fewer, and draws others each time. Of many parameters it looks at the few that
differ in kind.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

USUAL = 100
"""Examples of a test that says nothing of its own, in the profile `full`."""


def register_profiles() -> None:
    """Register the profiles of --hypothesis-profile, and begin with the quick one.

    Neither how long an example takes nor how long it takes to think of one says anything on a machine that others use. Examples
    are new in each run in CI, too, where Hypothesis would repeat the same ones.
    """
    full = settings(derandomize=False, deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=USUAL)
    settings.register_profile("full", full)
    settings.register_profile("quick", full, max_examples=USUAL // 4)
    settings.load_profile("quick")


def examples(many: int) -> int:
    """As many in the profile `full`, and in another profile the same part of them as of the usual number."""
    return max(1, many * settings().max_examples // USUAL)


def mostly_long(every: Iterable[Any], usual: Iterable[Any]) -> list[Any]:
    """Parameters of a test: `make test` looks only at those that are also in `usual`, `make test-long` at all others.

    Raises ValueError if one of `usual` is not there.
    """
    few, values = list(usual), list(every)
    if missing := [value for value in few if value not in values]:
        raise ValueError(f"no parameter is {missing[0]!r}")
    return [
        pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=[] if value in few else pytest.mark.long)
        for value in values
    ]
