import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from evedrop.errors import UsageError
from evedrop.model.process import Process
from evedrop.model.theory.covariances import Outcomes, limit_trace, stability_bound
from evedrop.model.theory.design import (
    best_difference,
    best_ratio,
    design,
    least_state_probability,
    perfect_secrecy,
    relative_secrecy,
)
from evedrop.model.theory.ratio import Adversary, adversary_bound, traces_of
from tests.builders import MICROGRID, UNSTABLE
from tests.examples import examples, mostly_long

LOW = 0.534206


def smart(mu_e: float) -> Adversary:
    """A smart eavesdropper behind a link of quality μ_e."""
    return Adversary("smart", mu_e, 1.0, 0.0)


NAIVE = Adversary("naive", 0.9, 1.0, 1.0)


def J(process: Process, mu: float, mu_d: float) -> float:
    """The legitimate limiting trace."""
    return limit_trace(process, Outcomes.legitimate(mu, mu_d))


@pytest.mark.parametrize(
    ("mu_e", "bound", "relative", "difference", "ratio"),
    [
        (0.85, 0.565630, (LOW, 1.0), None, None),
        (0.90, 0.534206, (LOW, 1.0), None, None),
        (0.95, 0.506090, (0.54153, 0.93882), 0.55709, 0.6297),
        (0.99, 0.485642, (0.54790, 0.89331), 0.57447, 0.6445),
    ],
)
def test_numerical_illustration(
    mu_e: float, bound: float, relative: tuple[float, float], difference: float | None, ratio: float | None
) -> None:
    """The four eavesdroppers of the numerical illustration, to 1e-4 and the bounds to 1e-6."""
    result = design(UNSTABLE, 0.9, 0.6, [smart(mu_e)], slots=80)
    against = result.eavesdroppers["smart"]
    assert result.rho == pytest.approx(1.387799, abs=1e-6)
    assert result.bound == pytest.approx(LOW, abs=1e-6)
    assert against.bound == pytest.approx(bound, abs=1e-6)
    assert len(against.relative) == 1
    assert against.relative[0] == pytest.approx(relative, abs=1e-4)
    assert against.best_difference == (None if difference is None else pytest.approx(difference, abs=1e-4))
    assert against.best_ratio == (None if ratio is None else pytest.approx(ratio, abs=1e-4))
    assert against.perfect == (pytest.approx((LOW, 0.565630), abs=1e-6) if mu_e == 0.85 else None)


def test_the_errors_at_a_choice_are_those_of_theory() -> None:
    """Of the legitimate estimator and of each eavesdropper; infinite where an error is unbounded."""
    traces = design(UNSTABLE, 0.9, 0.6, [smart(0.99), NAIVE], 100).traces_at(0.55)
    assert traces["legitimate"] == J(UNSTABLE, 0.9, 0.55)
    assert traces["smart"] == limit_trace(UNSTABLE, smart(0.99).outcomes(0.55))
    assert traces["naive"] == np.inf


@pytest.mark.thorough
def test_optima_are_no_worse_than_any_other_choice() -> None:
    """A plain search over a grid finds no larger J_r, nor J_r/J, than the optima."""
    for mu_e in (0.95, 0.99, 1.0):
        grid = np.linspace(LOW + 1e-4, 1.0, 2000)
        ours = np.array([J(UNSTABLE, 0.9, mu_d) for mu_d in grid])
        theirs = np.array([limit_trace(UNSTABLE, smart(mu_e).outcomes(mu_d)) for mu_d in grid])
        for best, gains in (
            (best_difference(UNSTABLE, 0.9, smart(mu_e)), theirs - ours),
            (best_ratio(UNSTABLE, 0.9, smart(mu_e)), theirs / ours),
        ):
            assert best == pytest.approx(grid[gains.argmax()], abs=2 * (grid[1] - grid[0]))


qualities = st.floats(0.3, 1.0)


def bound_of(growth: float, mu: float) -> float:
    """Where the legitimate error begins to be bounded, for ρ = growth; everywhere over a lossless link."""
    return 0.0 if mu == 1.0 else (1.0 - growth**-2) / mu


@given(st.floats(1.0, 1.3), st.floats(-0.5, 0.5), qualities, qualities, st.floats(0.02, 0.98))
@example(1.2, 0.1, 1.0, 0.8, 0.5)
@example(1.2, 0.1, 1.0, 0.8, 0.05)
@settings(deadline=None, max_examples=examples(40))
def test_relative_secrecy_is_the_sign_of_the_difference(
    growth: float, coupling: float, mu: float, mu_e: float, at: float
) -> None:
    """A μ_d lies in an interval of relative secrecy exactly when J is bounded and J < J_e there."""
    process = Process(np.array([[growth, coupling], [0.0, 0.9]]), np.diag([1.0, 0.5]), np.eye(2))
    low = bound_of(growth, mu)
    intervals = relative_secrecy(process, mu, smart(mu_e))
    if low >= 1.0:
        assert intervals == ()
        return
    mu_d = low + at * (1.0 - low)
    ours, theirs = J(process, mu, mu_d), limit_trace(process, smart(mu_e).outcomes(mu_d))
    if math.isfinite(theirs) and abs(theirs - ours) <= 1e-6 * ours:
        return
    assert any(lo < mu_d < hi for lo, hi in intervals) == (ours < theirs)
    if mu_e <= mu:
        assert len(intervals) == 1
        assert intervals[0] == pytest.approx((low, 1.0))


@given(st.floats(1.0, 1.3), qualities, qualities)
@example(1.2, 1.0, 0.8)
@example(1.2, 1.0, 1.0)
@settings(deadline=None, max_examples=examples(30))
def test_perfect_secrecy_is_where_one_is_bounded_and_the_other_not(growth: float, mu: float, mu_e: float) -> None:
    """Just inside the interval J is finite and J_e infinite; beyond its upper end J_e is finite."""
    process = Process(np.diag([growth, 0.7]), np.eye(2), np.eye(2))
    interval = perfect_secrecy(process, mu, smart(mu_e))
    if interval is None:
        assert mu_e >= mu or bound_of(growth, mu) >= 1.0 or growth < 1.0 + 1e-6
        return
    low, high = interval
    middle = 0.5 * (low + high)
    assert math.isfinite(J(process, mu, middle))
    assert math.isinf(limit_trace(process, smart(mu_e).outcomes(middle)))
    if high < 1.0:
        assert math.isfinite(limit_trace(process, smart(mu_e).outcomes(high + 1e-6)))


def test_a_misled_receiver_is_kept_out_perfectly() -> None:
    """Naive and suspicious are unbounded on the whole admissible range; a suspicious one never misled is as smart."""
    for adversary in (NAIVE, Adversary("suspicious", 0.95, 0.8, 0.3)):
        eavesdropper = design(UNSTABLE, 0.9, 0.6, [adversary], slots=80).eavesdroppers[adversary.name]
        assert eavesdropper.perfect == pytest.approx((LOW, 1.0), abs=1e-6)
        (interval,) = eavesdropper.relative
        assert interval == pytest.approx((LOW, 1.0), abs=1e-6)
        assert eavesdropper.best_difference is None
        assert math.isinf(eavesdropper.trace)
    careful = Adversary("suspicious", 0.95, 0.9, 0.0)
    assert adversary_bound(UNSTABLE, careful) == pytest.approx(stability_bound(UNSTABLE, 0.95 * 0.9))
    assert math.isinf(adversary_bound(UNSTABLE, Adversary("weak", 0.4, 1.0, 1.0)))


def test_secrecy_in_every_slot_can_fail_early() -> None:
    """For a better eavesdropper the paper's "for all k" fails first; for one no better it holds from k = 1."""
    for mu_e, last in ((0.95, 86), (0.99, 58)):
        best = best_difference(UNSTABLE, 0.9, smart(mu_e))
        assert best is not None
        result = design(UNSTABLE, 0.9, best, [smart(mu_e)], slots=400).eavesdroppers["smart"]
        assert result.violated == ((1, last),)
        assert result.relative_from == last + 1
    equal = design(UNSTABLE, 0.9, 0.6, [smart(0.9)], slots=400).eavesdroppers["smart"]
    assert equal.violated == ()
    assert equal.relative_from == 1
    beaten = design(UNSTABLE, 0.9, 0.99, [smart(0.99)], slots=400).eavesdroppers["smart"]
    assert beaten.relative_from is None
    assert beaten.difference < 0.0


@given(st.floats(1.0, 1.3), st.floats(0.5, 0.99), st.floats(1.001, 1e6))
@settings(deadline=None, max_examples=examples(40))
def test_least_state_probability_keeps_the_trace(growth: float, mu: float, factor: float) -> None:
    """At μ_d_min the trace is Ω."""
    process = Process(np.diag([growth, 0.7]), np.eye(2), np.eye(2))
    max_trace = J(process, mu, 1.0) * factor
    if math.isinf(max_trace):
        return
    least = least_state_probability(process, mu, max_trace)
    assert J(process, mu, least) == pytest.approx(max_trace, rel=1e-5)


def test_trace_that_cannot_be_kept_is_refused() -> None:
    """Ω at or below J(1), or no admissible μ_d at all, is one clear line."""
    at_one = J(UNSTABLE, 0.9, 1.0)
    for max_trace in (at_one, 0.5 * at_one, 0.0, -1.0):
        with pytest.raises(UsageError, match=r"no μ_d keeps the legitimate trace below .* it is 0.000228372; ask for"):
            least_state_probability(UNSTABLE, 0.9, max_trace)
    with pytest.raises(UsageError, match="it is unbounded; ask for a larger trace, or improve the legitimate link"):
        design(UNSTABLE, 0.4, 0.6, [smart(0.9)], slots=80, max_trace=1.0)


def test_lossless_link() -> None:
    """With μ = 1 nothing costs: J ≡ 0 for every μ_d, and everybody else is kept out relatively, for small μ_d perfectly."""
    result = design(UNSTABLE, 1.0, 0.6, [smart(0.9), NAIVE], slots=80, max_trace=1e-6)
    assert result.trace == result.plain_trace == 0.0
    assert result.cost == 1.0
    assert result.minimum == result.bound == 0.0
    assert J(UNSTABLE, 1.0, 0.01) == 0.0
    against = result.eavesdroppers["smart"]
    assert against.relative == ((0.0, 1.0),)
    assert against.perfect == (0.0, against.bound)
    assert against.bound == pytest.approx(0.534206, abs=1e-6)
    assert against.best_ratio is None


@pytest.mark.parametrize("others", [[], [NAIVE]])
def test_the_choice_over_a_lossless_link_is_perfect_where_that_is_possible(others: list[Adversary]) -> None:
    """It costs nothing: the largest μ_d at which every eavesdropper's error is unbounded; of a stable process, any."""
    chosen = design(UNSTABLE, 1.0, 0.6, [smart(0.9), *others], slots=80).suggestion
    assert chosen is not None
    assert chosen.mu_d == pytest.approx(0.534206, abs=1e-6)
    assert math.isinf(limit_trace(UNSTABLE, smart(0.9).outcomes(chosen.mu_d)))
    assert (chosen.trace, chosen.cost) == (0.0, 1.0)
    stable = design(Process(np.array([[0.7]]), np.eye(1), np.eye(1)), 1.0, 0.6, [smart(0.9)], slots=80).suggestion
    assert stable is not None
    assert stable.mu_d == 1.0
    within = design(UNSTABLE, 1.0, 0.6, [smart(0.9)], slots=80, max_trace=1.0).suggestion
    assert within is not None
    (interval,) = within.intervals
    assert interval == pytest.approx((0.0, 0.534206), abs=1e-6)


def test_deaf_eavesdropper() -> None:
    """With μ_e = 0 no μ_d bounds its error, even of a marginally stable process."""
    for process in (UNSTABLE, MICROGRID):
        result = design(process, 0.9, 0.6, [smart(0.0)], slots=80)
        against = result.eavesdroppers["smart"]
        assert math.isinf(against.bound)
        assert against.perfect == (result.bound, 1.0)
        assert against.as_dict()["bound"] is None


def test_marginally_stable_process() -> None:
    """For ρ = 1 every μ_d > 0 is admissible, secrecy from smart is never perfect, and the ends have closed forms."""
    result = design(MICROGRID, 0.6, 0.5, [smart(0.6)], slots=80)
    assert result.admissible == (0.0, 1.0)
    assert result.eavesdroppers["smart"].perfect is None
    assert result.eavesdroppers["smart"].relative == ((0.0, 1.0),)
    assert result.cost == pytest.approx(2.0)
    (interval,) = relative_secrecy(MICROGRID, 0.6, smart(0.9))
    assert interval == pytest.approx((0.0, 1 / 0.9 - (1 / 0.6 - 1)), abs=1e-9)


@pytest.mark.parametrize("angle", mostly_long([0.1, 0.7, 2.0], [0.7]))
@pytest.mark.thorough
def test_rounded_eigenvalues_count_as_marginal(angle: float) -> None:
    """A rotation, and a double eigenvalue in a rotated basis, are marginally stable however their eigenvalues round."""
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    for A in (turn, turn @ np.array([[1.0, 0.1], [0.0, 1.0]]) @ turn.T):
        process = Process(A, np.eye(2), np.eye(2))
        result = design(process, 0.9, 0.5, [smart(0.5), smart(0.0), NAIVE], slots=80)
        assert result.bound == 0.0
        assert result.eavesdroppers["naive"].trace == math.inf
        assert perfect_secrecy(process, 0.9, smart(0.5)) is None
        assert math.isinf(result.eavesdroppers["smart"].trace)


def test_no_admissible_choice_is_said() -> None:
    """Below μ = 1 − ρ⁻² the design has no admissible μ_d, says why, and does not crash."""
    result = design(UNSTABLE, 0.4, 0.6, [smart(0.9), smart(0.3)], slots=80)
    assert result.admissible is None
    assert result.remark is not None
    assert "no μ_d is admissible" in result.remark
    assert "0.480785" in result.remark
    against = result.eavesdroppers["smart"]
    assert (against.perfect, against.relative, against.best_difference, against.best_ratio) == (None, (), None, None)
    assert math.isnan(against.difference)
    assert design(UNSTABLE, 0.9, 0.6, [], slots=80).remark is None


def test_dictionary_is_strict_json() -> None:
    """The JSON has exactly the promised keys, and null, never Infinity, for what is unbounded."""
    result = design(UNSTABLE, 0.9, 0.5, [smart(0.85), NAIVE], slots=80)
    data = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert set(data) == {"rho", "legitimate", "eavesdroppers"}
    assert set(data["legitimate"]) == {"bound", "trace"}
    assert data["legitimate"]["trace"] is None
    for against in data["eavesdroppers"].values():
        assert set(against) == {
            "bound",
            "perfect",
            "relative",
            "best_difference",
            "best_ratio",
            "ratio",
            "largest_ratio",
            "trace",
        }
    assert data["eavesdroppers"]["smart"]["perfect"] == pytest.approx([LOW, 0.565630], abs=1e-6)
    asked = design(UNSTABLE, 0.9, 0.6, [], slots=80, max_trace=0.01).as_dict()
    assert asked["legitimate"]["minimum"] == pytest.approx(0.540427, abs=1e-6)


def test_a_genie_is_designed_for_by_its_leak() -> None:
    """Known from its outcomes at μ_d = 1/2: it has the bound of smart, and uses the leak at every μ_d."""
    genie = Adversary.with_outcomes("genie", 0.8, Outcomes.genie(1.0, 0.5))
    assert (genie.use_state, genie.use_innovation, genie.reads_leak) == (1.0, 0.0, True)
    assert genie.outcomes(0.3) == Outcomes.genie(0.8, 0.3)
    taker = Adversary.with_outcomes("taker", 0.8, Outcomes.eavesdropper(1.0, 0.5, 0.9, 0.2))
    assert (taker.use_state, taker.use_innovation) == pytest.approx((0.9, 0.2))
    assert not taker.reads_leak
    assert taker.outcomes(0.3) == Outcomes.eavesdropper(0.8, 0.3, taker.use_state, taker.use_innovation)


def test_eavesdroppers_without_a_closed_form_are_named() -> None:
    """They cannot be designed for; what is known of a genie holds for them."""
    result = design(UNSTABLE, 0.9, 0.6, [], slots=80)
    assert result.omission is None
    assert "left_out" not in result.as_dict()
    other = replace(result, left_out={"eve": "bayesian", "mallory": "likelihood"})
    assert other.omission == (
        "left out: eve (bayesian), mallory (likelihood): no closed form of its error is known; a guarantee against a genie "
        "holds against every eavesdropper"
    )
    assert other.as_dict()["left_out"] == {"eve": "bayesian", "mallory": "likelihood"}


def test_a_link_just_above_the_bound_leaves_just_one_interval() -> None:
    """The first points above it are unbounded to rounding: they are no advantage, and the interval begins right after them."""
    mu = (1.0 - UNSTABLE.spectral_radius**-2) * (1.0 + 1e-5)
    ((low, high),) = relative_secrecy(UNSTABLE, mu, smart(0.4))
    assert high == 1.0
    assert low == pytest.approx(stability_bound(UNSTABLE, mu), abs=1e-6)
    assert 0.99 < low < 1.0


def test_the_best_may_be_to_send_all_states() -> None:
    """Of a stable process, against an eavesdropper that hears little: J_e hardly depends on μ_d, and J falls as μ_d rises."""
    process = Process(np.array([[0.7]]), np.eye(1), np.eye(1))
    deaf, nearly = smart(0.0), smart(0.05)
    assert (
        best_difference(process, 0.9, deaf) == best_ratio(process, 0.9, deaf) == best_ratio(process, 0.9, nearly) == 1.0
    )
    for mu_d in np.linspace(0.01, 0.99, 50):
        ours, theirs = traces_of(process, 0.9, nearly, float(mu_d))
        best_ours, best_theirs = traces_of(process, 0.9, nearly, 1.0)
        assert theirs / ours < best_theirs / best_ours
