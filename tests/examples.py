"""How many random examples a test looks at: fewer in `make test`, which draws others each time, than in `make test-long`."""

from __future__ import annotations

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
