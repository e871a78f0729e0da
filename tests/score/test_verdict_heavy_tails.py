"""Infinite variance: flagged where theory says so, judged by medians there, with tests that are wrong no more than they say."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from evedrop.cli.api import montecarlo
from evedrop.model.process import Floats
from evedrop.score.after_start import ERROR_RATE
from evedrop.score.secrecy import SignTest, SignTestOf, sign_of_mean, sign_of_median
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from tests.conftest import Evedrop
from tests.examples import mostly_long

TRIES = 4000


def closed_form(rho: float, p_r: float) -> bool:
    """Whether (1 − p_r) ρ⁴ ≥ 1."""
    return (1.0 - p_r) * rho**4 >= 1.0


@pytest.mark.parametrize("mu_d", [0.56, 0.7, 0.8115, 0.8117, 0.9, 1.0])
def test_infinite_variance_is_flagged_where_theory_says(mu_d: float, tmp_path: Path) -> None:
    """In the paper's example up to μ_d = 0.8116 for μ = 0.9; for each link its own; never for a misled receiver."""
    plan = Plan(Mode.COVARIANCE_ONLY, workers=1)
    summary = montecarlo(
        "numerical", slots=40, trials=20, encoding__state_probability=mu_d, plan=plan, out=tmp_path / "run"
    ).summary
    quality = {"legitimate": 0.9, "smart": 0.85, "equal": 0.9, "better": 0.95, "much-better": 0.99}
    for name, mu in quality.items():
        assert summary["peers"][name]["infinite_variance"] == closed_form(1.3877986573692194, mu * mu_d), name
    assert summary["peers"]["naive"]["infinite_variance"] == (mu_d == 1.0 and closed_form(1.3877986573692194, 0.85))
    assert summary["peers"]["legitimate"]["infinite_variance"] == (mu_d < 0.8116)
    for name, verdict in summary["secrecy"].items():
        heavy = any(summary["peers"][name_]["infinite_variance"] for name_ in ("legitimate", name))
        assert verdict["judged_by"] == ("median" if heavy else "mean")


def test_a_marginally_stable_process_has_no_heavy_tails(tmp_path: Path) -> None:
    """ρ = 1: no receiver's variance is infinite, so all verdicts use means."""
    summary = montecarlo("eavesdroppers", slots=40, trials=20, out=tmp_path / "run").summary
    assert not any(peer["infinite_variance"] for peer in summary["peers"].values())
    assert {verdict["judged_by"] for verdict in summary["secrecy"].values()} == {"mean"}


@pytest.mark.long
def test_the_report_says_so(evedrop: Evedrop) -> None:
    """In words, with the quantiles it goes by; and not where the variance is finite."""
    done = evedrop("montecarlo", "numerical", "--trials", "40", "--out", "run", "--verbose")
    assert done.status == 0
    lines = [line for line in done.out.splitlines() if "has infinite variance" in line]
    assert [line.partition(":")[0] for line in lines] == ["legitimate", "smart", "equal", "better", "much-better"]
    assert all("in the median" in line and "in nine of ten" in line for line in lines)
    assert "(judged by medians, because the variance is infinite)" in done.out
    done = evedrop("montecarlo", "eavesdroppers", "--slots", "40", "--trials", "40", "--out", "other", "--verbose")
    assert "infinite" not in done.out


def misses(test: SignTestOf, samples: Floats, truth: float) -> tuple[float, float]:
    """How often the samples, by row, are found to be above their true value, and below it."""
    tests = [test(row - truth) for row in samples]
    return float(np.mean([sign.above <= ERROR_RATE for sign in tests])), float(
        np.mean([sign.below <= ERROR_RATE for sign in tests])
    )


HIGHEST = 0.01 + 4.5 * math.sqrt(0.01 * 0.99 / TRIES)
"""Of TRIES tests at 1 %, the fraction that may be wrong, at 4.5 standard errors."""


@pytest.mark.parametrize("count", mostly_long([2, 10, 60, 500], [10]))
def test_signs_of_means_are_right(count: int) -> None:
    """Either test of a normal is wrong in one of a hundred, at any number of trials."""
    samples = np.random.default_rng(8).normal(3.0, 2.0, (TRIES, count))
    for miss in misses(sign_of_mean, samples, 3.0):
        assert abs(miss - 0.01) <= HIGHEST - 0.01


@pytest.mark.parametrize("count", [7, 8, 60, 500])
def test_signs_of_medians_are_right_whatever_the_tails(count: int) -> None:
    """Of a Cauchy distribution, which has not even a mean: at most one in a hundred is wrong, and not far fewer."""
    samples = 1.0 + np.random.default_rng(9).standard_cauchy((TRIES, count))
    for miss in misses(sign_of_median, samples, 1.0):
        assert miss <= HIGHEST
        assert miss >= 0.002  # counts come in steps; a test that is never wrong says nothing


@pytest.mark.parametrize("count", [1, 2, 6])
def test_too_few_trials_tell_nothing(count: int) -> None:
    """Of six trials all are above the median once in 64: nothing is known at 1 %."""
    assert sign_of_median(1.0 + np.arange(float(count))).above > ERROR_RATE
    if count == 1:
        assert sign_of_mean(np.ones(1)) == SignTest(1.0, 1.0)


def test_samples_without_spread_are_certain() -> None:
    """All above 0, all below, or all 0."""
    assert sign_of_mean(np.full(3, 2.0)) == SignTest(0.0, 1.0)
    assert sign_of_mean(np.full(3, -2.0)) == SignTest(1.0, 0.0)
    assert sign_of_mean(np.zeros(3)) == sign_of_median(np.zeros(3)) == SignTest(1.0, 1.0)


def test_a_mean_would_mislead_where_medians_do_not() -> None:
    """Errors with tail index 1: the mean's test is wrong far too often, the median's does not."""
    random = np.random.default_rng(10)
    samples = random.pareto(1.1, (TRIES, 200))
    mean, median = 1.0 / 0.1, 2.0 ** (1 / 1.1) - 1.0
    assert misses(sign_of_mean, samples, mean)[1] > 0.2
    assert max(misses(sign_of_median, samples, median)) <= HIGHEST
