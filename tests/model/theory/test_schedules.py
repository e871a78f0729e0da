"""Schedules of μ_d: their expectations, and the search for the best."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import differential_evolution

from evedrop.errors import UsageError
from evedrop.model.process import Process
from evedrop.model.theory import schedules
from evedrop.model.theory.covariances import Outcomes, misled_covariances, theoretical_traces
from evedrop.model.theory.ratio import Adversary
from evedrop.model.theory.schedules import BestSchedule, ScheduleDesign, ScheduleProblem, SlotRecursion, best_schedule
from tests.builders import DRIFTING, UNSTABLE
from tests.examples import mostly_long
from tests.model.slot_loop import STABLE

SETTLED = Process(UNSTABLE.A, UNSTABLE.Q, 1e-3 * np.eye(2))
MU, MU_E = 0.9, 0.85
EAVESDROPPERS = {
    "smart": Adversary("smart", MU_E, 1.0, 0.0),
    "naive": Adversary("naive", MU_E, 1.0, 1.0),
    "suspicious": Adversary("suspicious", MU_E, 0.8, 0.3),
    "genie": Adversary("genie", MU_E, 1.0, 0.0, reads_leak=True),
}


def legitimate_at(mu_d: float) -> Outcomes:
    """The legitimate estimator's outcomes."""
    return Outcomes.legitimate(MU, mu_d)


def problem_of(
    process: Process, eavesdropper: str, slots: int, max_trace: float, weight: float = 0.0
) -> ScheduleProblem:
    """The problem that `best_schedule` solves."""
    theirs = SlotRecursion(process, EAVESDROPPERS[eavesdropper].outcomes, slots)
    return ScheduleProblem(SlotRecursion(process, legitimate_at, slots), theirs, slots, max_trace, weight)


def mesh_of(slots: int, levels: int) -> np.ndarray:
    """Every schedule whose μ_d are levels from 0 to 1 from slot 1 on."""
    grid = list(itertools.product(np.linspace(0.0, 1.0, levels), repeat=slots - 1))
    return np.column_stack([np.ones(len(grid)), np.array(grid)])


@pytest.mark.parametrize("eavesdropper", EAVESDROPPERS)
@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING, STABLE])
def test_a_constant_schedule_has_the_expectations_of_the_scheme(process: Process, eavesdropper: str) -> None:
    """With the same μ_d in all slots the traces are those of theory, for legitimate estimator and eavesdropper."""
    at = EAVESDROPPERS[eavesdropper].outcomes
    mu_d = np.array([[0.3] * 12, [0.9] * 12])
    for outcomes_at in (legitimate_at, at):
        traces = SlotRecursion(process, outcomes_at, 12).traces(mu_d)
        for row, value in zip(traces, (0.3, 0.9), strict=True):
            assert np.allclose(row, theoretical_traces(process, outcomes_at(value), 12), rtol=1e-9)


@pytest.mark.parametrize("eavesdropper", ["legitimate", "smart", "naive"])
def test_expectations_are_those_of_all_courses(eavesdropper: str) -> None:
    """E P_k under a schedule that changes is the mean over all losses and packet types, each with its probability."""
    mu_d, mu = (1.0, 0.2, 0.7, 0.4), MU if eavesdropper == "legitimate" else MU_E
    A, Q, slots = UNSTABLE.A, UNSTABLE.Q, len(mu_d)
    misled = misled_covariances(UNSTABLE, slots)
    expected = np.zeros(slots)
    for course in itertools.product(itertools.product((True, False), repeat=2), repeat=slots):
        chance, P = 1.0, UNSTABLE.initial_covariance
        for k, (heard, state) in enumerate(course):
            chance *= (mu if heard else 1 - mu) * (mu_d[k] if state else 1 - mu_d[k])
            predicted = A @ P @ A.T + Q if k else P
            if not heard:
                P = predicted
            elif state:
                P = np.zeros_like(P)
            else:
                P = {"legitimate": predicted - Q, "smart": predicted, "naive": misled[k]}[eavesdropper]
            expected[k] += (
                chance / 4.0 ** (slots - 1 - k) * np.trace(P)
            )  # as often as there are courses of the later slots
    outcomes_at = legitimate_at if eavesdropper == "legitimate" else EAVESDROPPERS[eavesdropper].outcomes
    trace = SlotRecursion(UNSTABLE, outcomes_at, slots).traces(np.array([mu_d]))[0]
    assert np.allclose(trace, expected, rtol=1e-12)


@pytest.mark.parametrize("eavesdropper", EAVESDROPPERS)
@pytest.mark.parametrize(
    ("process", "max_trace", "weight"),
    [
        pytest.param(SETTLED, 0.0015, 0.0, marks=pytest.mark.long),
        (SETTLED, 0.002, 0.6),
        pytest.param(STABLE, 0.03, 0.5, marks=pytest.mark.long),
    ],
)
def test_the_program_finds_the_best_of_the_grid(
    process: Process, eavesdropper: str, max_trace: float, weight: float
) -> None:
    """With room for all candidates it is the best of every schedule on the grid, and says so."""
    problem = problem_of(process, eavesdropper, 5, max_trace, weight)
    sums = problem.sums(mesh_of(5, 5))
    result = best_schedule(
        process, MU, EAVESDROPPERS[eavesdropper].outcomes, 5, max_trace, weight, levels=5, capacity=10_000
    )
    assert result.exact
    assert result.grid.value == pytest.approx(sums.max(), rel=1e-9)
    assert max(result.grid.legitimate) <= max_trace * (1 + 1e-9)


@pytest.mark.parametrize("eavesdropper", EAVESDROPPERS)
@pytest.mark.parametrize(
    ("process", "max_trace"),
    [
        pytest.param(SETTLED, 0.0015, marks=pytest.mark.long),
        (UNSTABLE, 0.5),
        pytest.param(STABLE, 0.05, marks=pytest.mark.long),
    ],
)
def test_the_best_schedule_is_as_good_as_brute_force(process: Process, max_trace: float, eavesdropper: str) -> None:
    """No schedule on a fine mesh of all does better."""
    problem = problem_of(process, eavesdropper, 4, max_trace)
    best = best_schedule(process, MU, EAVESDROPPERS[eavesdropper].outcomes, 4, max_trace).best
    assert best.value >= problem.sums(mesh_of(4, 41)).max() * (1 - 1e-6)
    assert max(best.legitimate) <= max_trace * (1 + 1e-9)
    assert best.mu_d[0] == 1.0
    assert best.value == pytest.approx(sum(best.eavesdropper))


_NOISE = np.array([[1e-2, 2e-3], [2e-3, 5e-3]])
DOUBLE = Process(np.array([[1.0, 0.1], [0.0, 1.0]]), _NOISE, _NOISE)


def evolved(problem: ScheduleProblem) -> float:
    """The largest sum that differential evolution finds, which knows nothing of the problem but its sums."""
    free = replace(problem, max_trace=math.inf)

    def loss(columns: np.ndarray) -> np.ndarray:
        mu_d = np.column_stack([np.ones(columns.shape[1]), columns.T])
        excess = np.maximum(problem.legitimate.traces(mu_d) / problem.max_trace - 1.0, 0.0).sum(axis=1)
        losses: np.ndarray = -free.sums(mu_d) * (1.0 - (excess > 1e-9)) + 1e3 * excess
        return losses

    solve: Any = differential_evolution
    result = solve(
        loss,
        [(0.0, 1.0)] * (problem.slots - 1),
        maxiter=400,
        popsize=12,
        tol=1e-10,
        seed=7,
        vectorized=True,
        updating="deferred",
        polish=False,
    )
    return -float(result.fun)


@pytest.mark.parametrize(
    ("process", "max_trace", "mu", "mu_e"),
    [
        pytest.param(DOUBLE, 0.012, 0.85, 0.95, marks=pytest.mark.long, id="double"),
        pytest.param(DOUBLE, 0.03, 0.7, 0.9, marks=pytest.mark.long, id="double, loose"),
        pytest.param(SETTLED, 0.002, 0.9, 0.85, id="settled"),
        pytest.param(UNSTABLE, 0.5, 0.9, 0.95, marks=pytest.mark.long, id="unstable"),
        pytest.param(STABLE, 0.07, 0.8, 0.8, marks=pytest.mark.long, id="stable"),
        pytest.param(Process(np.array([[1.05]]), np.eye(1), np.eye(1)), 1.5, 0.8, 0.9, id="scalar"),
    ],
)
@pytest.mark.parametrize("eavesdropper", mostly_long(["naive", "suspicious"], ["naive"]))
def test_an_independent_solver_finds_nothing_better(
    process: Process, max_trace: float, mu: float, mu_e: float, eavesdropper: str
) -> None:
    """Against misled eavesdroppers, whose sum has many local maxima, over seven slots."""
    adversary = replace(EAVESDROPPERS[eavesdropper], mu_e=mu_e)
    legitimate = SlotRecursion(process, lambda mu_d: Outcomes.legitimate(mu, mu_d), 7)
    problem = ScheduleProblem(legitimate, SlotRecursion(process, adversary.outcomes, 7), 7, max_trace, 0.0)
    best = best_schedule(process, mu, adversary.outcomes, 7, max_trace).best
    assert best.value >= evolved(problem) * (1 - 1e-5)
    assert max(best.legitimate) <= max_trace * (1 + 1e-9)


def test_a_single_packet_with_the_state_may_be_best() -> None:
    """A maximum far from every schedule that changes of one or two μ_d lead to: 2.6 % above what they find."""
    naive = Adversary("naive", 0.95, 1.0, 1.0)
    best = best_schedule(DOUBLE, 0.85, naive.outcomes, 7, 0.012).best
    assert best.value >= 0.61173
    assert best.mu_d[3] == pytest.approx(0.814, abs=1e-3)


def test_changes_of_two_neighbours_find_what_changes_of_one_do_not() -> None:
    """A case in which no single μ_d can be changed for the better at a sum that is a hundredth below brute force."""
    naive = Adversary("naive", 0.9, 1.0, 1.0)
    legitimate = SlotRecursion(SETTLED, lambda mu_d: Outcomes.legitimate(0.8, mu_d), 5)
    problem = ScheduleProblem(legitimate, SlotRecursion(SETTLED, naive.outcomes, 5), 5, 0.0015, 0.0)
    best = best_schedule(SETTLED, 0.8, naive.outcomes, 5, 0.0015).best
    assert best.value >= problem.sums(mesh_of(5, 21)).max()


@pytest.mark.thorough
@pytest.mark.parametrize("eavesdropper", ["smart", "naive"])
def test_no_change_of_one_slot_improves_it(eavesdropper: str) -> None:
    """Every other value of a single μ_d either violates Ω or loses."""
    slots = 9
    best = best_schedule(SETTLED, MU, EAVESDROPPERS[eavesdropper].outcomes, slots, 0.004, levels=5, capacity=20).best
    problem = problem_of(SETTLED, eavesdropper, slots, 0.004)
    for k in range(1, slots):
        tried = np.repeat(np.array([best.mu_d]), 101, axis=0)
        tried[:, k] = np.linspace(0.0, 1.0, 101)
        assert problem.sums(tried).max() <= best.value * (1 + 1e-4)


@pytest.mark.long
def test_it_is_better_to_recover_than_to_be_kept_at_the_bound() -> None:
    """Against smart, in a long run: no states until the legitimate error reaches Ω, then a state, and again none."""
    result = best_schedule(SETTLED, MU, EAVESDROPPERS["smart"].outcomes, 16, 0.005, levels=5, capacity=50)
    assert result.best.mu_d[1:5] == (0.0,) * 4
    kept = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.1720277, *[0.547] * 10]])
    problem = problem_of(SETTLED, "smart", 16, 0.005)
    assert result.best.value > 1.035 * float(problem.sums(kept)[0]) > 0.0
    assert result.best.mu_d[6:9] == (1.0, 0.0, 0.0)
    assert result.best.value > 1.7 * result.constant.value
    assert len(set(result.constant.mu_d[1:])) == 1
    assert max(result.constant.legitimate) <= 0.005 * (1 + 1e-9)
    assert not result.exact


def test_where_no_states_exceed_the_bound_all_slots_have_as_few_as_keep_it() -> None:
    """Where only a state in a slot without one keeps Ω, μ_d is raised in all slots at once, until the largest error is Ω."""
    problem = problem_of(SETTLED, "smart", 16, 0.005)
    nothing = np.array([1.0] + [0.0] * 15)
    assert not math.isfinite(problem.sum_of(nothing))
    mu_d = schedules._repaired(problem, nothing)
    assert len({*mu_d[1:]}) == 1
    assert problem.legitimate.traces(mu_d[None]).max() == pytest.approx(0.005, rel=1e-9)


def test_a_design_as_json() -> None:
    """The schedules against each eavesdropper; who is left out is there only if somebody is."""
    design = best_schedule(STABLE, MU, EAVESDROPPERS["smart"].outcomes, 3, levels=3)
    assert list(design.as_dict()) == ["best", "constant", "grid", "exact"]
    assert ScheduleDesign({"smart": design}, {}).as_dict() == {"eavesdroppers": {"smart": design.as_dict()}}
    assert ScheduleDesign({}, {"wise": "bayesian"}).as_dict()["left_out"] == {"wise": "bayesian"}


@pytest.mark.thorough
def test_blocks_share_their_probability() -> None:
    """With blocks of three slots μ_d changes at slots 1, 4 and 7 alone; one block is the best constant."""

    def of_blocks(block: int) -> BestSchedule:
        return best_schedule(SETTLED, MU, EAVESDROPPERS["smart"].outcomes, 9, 0.005, block=block, levels=5, capacity=50)

    thirds, whole = of_blocks(3), of_blocks(8)
    mu_d = thirds.best.mu_d
    assert [mu_d[k] for k in (2, 3, 5, 6, 8)] == [mu_d[k] for k in (1, 1, 4, 4, 7)]
    assert len(set(mu_d[1:])) > 1
    assert whole.best.value == pytest.approx(whole.constant.value, rel=1e-6)
    assert whole.best.value <= thirds.best.value <= of_blocks(1).best.value


def test_the_weight_of_the_user_raises_the_probabilities() -> None:
    """Without Ω: at weight 1 every packet is the state, at 0 none; between them the sum is that of the weights."""
    at = EAVESDROPPERS["smart"].outcomes
    assert best_schedule(STABLE, MU, at, 6, weight=1.0).best.mu_d == (1.0,) * 6
    assert best_schedule(STABLE, MU, at, 6).best.mu_d == (1.0,) + (0.0,) * 5
    best = best_schedule(STABLE, MU, at, 6, weight=0.6).best
    assert best.value == pytest.approx(0.4 * sum(best.eavesdropper) - 0.6 * sum(best.legitimate))


def test_a_trace_that_no_schedule_keeps_is_refused() -> None:
    """With the least trace that one does, in which slot; that one is then kept."""
    at = EAVESDROPPERS["smart"].outcomes
    with pytest.raises(UsageError, match=r"at or below 0\.1 .* it is 0\.2 in slot 0; ask for"):
        best_schedule(UNSTABLE, MU, at, 6, 0.1)
    assert best_schedule(UNSTABLE, MU, at, 6, 0.2).best.legitimate[0] == pytest.approx(0.2)
