"""The μ_d at which every eavesdropper is so many times worse, against a grid of errors by another recursion."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from evedrop.errors import UsageError
from evedrop.model.process import Process
from evedrop.model.theory.design import design
from evedrop.model.theory.ratio import Adversary, cheapest, large_enough, largest_ratio
from tests.builders import MICROGRID, UNSTABLE
from tests.examples import mostly_long

SMART = Adversary("smart", 0.95, 1.0, 0.0)
DULL = Adversary("dull", 0.85, 1.0, 0.0)
GENIE = Adversary("genie", 0.9, 1.0, 0.0, reads_leak=True)
NAIVE = Adversary("naive", 0.9, 1.0, 1.0)


def limit(process: Process, hears: float, kept: float, steps: int = 40_000) -> float:
    """The trace of P = hears·0 + (1 − hears)(A P Aᵀ + Q), where innovations that count add `kept`; by plain iteration."""
    A, Q = np.asarray(process.A), np.asarray(process.Q)
    P = np.zeros_like(Q)
    for _ in range(steps):
        P, last = (1.0 - hears) * (A @ P @ A.T + Q) - kept * Q, P
        if np.abs(P - last).max() <= 1e-15 * np.abs(P).max():
            break
        if np.trace(P) > 1e12:
            return math.inf
    return float(np.trace(P))


def ratio(process: Process, mu: float, mu_e: float, mu_d: float) -> float:
    """J_e / J of a smart eavesdropper: a state resets, and the estimator alone also gets the innovation of a heard slot."""
    legitimate = limit(process, mu * mu_d, mu * (1.0 - mu_d))
    smart = limit(process, mu_e * mu_d, 0.0)
    return smart / legitimate


@pytest.mark.thorough
@pytest.mark.parametrize("mu_e", mostly_long([0.95, 0.9, 0.85], [0.9]))
def test_the_cheapest_is_the_largest_of_the_grid(mu_e: float) -> None:
    """No μ_d of a grid above it has the ratio, it has it, and all in the intervals do; a large enough one at every place."""
    smart = Adversary("smart", mu_e, 1.0, 0.0)
    for wanted in (1.5, 2.0, 2.4):
        result = cheapest(UNSTABLE, 0.9, [smart], wanted)
        inside = [any(low < mu_d < high for low, high in result.intervals) for mu_d in np.linspace(0.56, 0.999, 90)]
        truly = [ratio(UNSTABLE, 0.9, mu_e, mu_d) >= wanted for mu_d in np.linspace(0.56, 0.999, 90)]
        assert inside == truly
        there = ratio(UNSTABLE, 0.9, mu_e, result.mu_d)
        assert result.ratios["smart"] == pytest.approx(there, rel=1e-6)
        assert there == pytest.approx(wanted, rel=1e-6) or (there > wanted and result.mu_d == 1.0)
        plain = limit(UNSTABLE, 0.9, 0.0)
        assert result.cost == pytest.approx(
            limit(UNSTABLE, 0.9 * result.mu_d, 0.9 * (1 - result.mu_d)) / plain, rel=1e-6
        )


@pytest.mark.thorough
def test_the_largest_ratio_is_that_of_a_grid() -> None:
    """Over the admissible μ_d, where it is attained; the refusal says how large it is, and where."""
    result = largest_ratio(UNSTABLE, 0.9, [SMART])
    assert result is not None
    grid = np.linspace(0.56, 0.999, 400)
    ratios = [ratio(UNSTABLE, 0.9, 0.95, mu_d) for mu_d in grid]
    assert result.ratio == pytest.approx(max(ratios), rel=1e-4)
    assert result.ratio >= max(ratios) * (1 - 1e-9)
    assert result.mu_d == pytest.approx(grid[int(np.argmax(ratios))], abs=2e-3)
    with pytest.raises(UsageError, match=re.escape(f"the most is {result.ratio:.4g}× at μ_d = {result.mu_d:.4g}")):
        cheapest(UNSTABLE, 0.9, [SMART], 1.01 * result.ratio)


def test_several_eavesdroppers_need_the_ratio_all() -> None:
    """The intervals are those in which each of them has it."""
    each = [large_enough(UNSTABLE, 0.9, [adversary], 2.0) for adversary in (SMART, DULL, GENIE, NAIVE)]
    every = large_enough(UNSTABLE, 0.9, [SMART, DULL, GENIE, NAIVE], 2.0)
    for mu_d in np.linspace(0.5343, 0.9997, 211):
        in_all = all(any(low < mu_d < high for low, high in intervals) for intervals in each)
        assert any(low < mu_d < high for low, high in every) == in_all


def test_a_largest_trace_bounds_the_choice() -> None:
    """Both options at once: the cheapest μ_d with the ratio, or a refusal that says which trace the ratio needs."""
    free = cheapest(UNSTABLE, 0.9, [SMART], 2.0)
    assert cheapest(UNSTABLE, 0.9, [SMART], 2.0, 0.6, 1.0).mu_d == free.mu_d
    with pytest.raises(UsageError, match=f"2× needs a legitimate trace of {free.trace:.4g}"):
        cheapest(UNSTABLE, 0.9, [SMART], 2.0, free.mu_d + 0.01, 0.9 * free.trace)


def test_a_marginal_process_has_the_closed_form() -> None:
    """A = I: J = (1−μ) tr Q/(μ μ_d) and J_e = (1−μ_e μ_d) tr Q/(μ_e μ_d), so the ratio R is at μ_d = (1 − R(1−μ))/μ."""
    result = cheapest(MICROGRID, 0.6, [Adversary("smart", 0.6, 1.0, 0.0)], 1.8)
    assert result.mu_d == pytest.approx((1.0 - 1.8 * 0.4) / 0.6, rel=1e-9)
    assert result.cost == pytest.approx(1.0 / result.mu_d, rel=1e-9)


def test_without_an_admissible_probability_there_is_no_choice() -> None:
    """A legitimate link so bad that even sending every state leaves the error unbounded."""
    assert large_enough(UNSTABLE, 0.3, [SMART], 2.0) == ()
    with pytest.raises(UsageError, match=r"no μ_d gives 2×: none is admissible, .*; improve the legitimate link"):
        cheapest(UNSTABLE, 0.3, [SMART], 2.0)


def test_a_refusal_names_what_each_eavesdropper_has() -> None:
    """Where several cannot have the ratio at once, and where the largest trace leaves no μ_d at all."""
    with pytest.raises(
        UsageError, match=r"no μ_d gives 50× against every eavesdropper; the most is .* \(smart .*×, dull .*×\)"
    ):
        cheapest(UNSTABLE, 0.9, [SMART, DULL], 50.0)
    with pytest.raises(UsageError, match=r"with a legitimate trace below 1e-09; ask for a larger trace"):
        cheapest(UNSTABLE, 0.9, [SMART], 2.0, 1.0, 1e-9)


def test_a_choice_as_json_has_null_for_infinity() -> None:
    """A naive eavesdropper's error is unbounded; the design has the choice beside its other entries."""
    result = cheapest(UNSTABLE, 0.9, [SMART, NAIVE], 2.0)
    assert result.as_dict()["ratios"] == {"smart": pytest.approx(2.0, rel=1e-6), "naive": None}
    assert result.as_dict()["intervals"] == [list(interval) for interval in result.intervals]
    assert design(UNSTABLE, 0.9, 0.6, [SMART, NAIVE], slots=20, min_ratio=2.0).as_dict()["choice"] == result.as_dict()
