"""Watermark and quickest detection, against independent computations and against the closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.integrity.loop import Source, spread, stationary
from evedrop.model.integrity.monitor import Monitor, MonitorPlan, assumed
from evedrop.model.integrity.theory import WatermarkTheory, loop_of, watermark_cost
from evedrop.model.plant import Plant
from evedrop.model.slot.cores import PlantCore
from evedrop.model.streams import Batch
from tests.builders import stream_keys
from tests.model.integrity_loop import ALWAYS, ONE, PLANAR, REPLACED, SCALAR, simulated

PARSIMONIOUS = ("parsimonious", {"watch_from": 0.05, "alarm_from": 0.999, "attack_rate": 1e-3})
LOOP, WIDE = loop_of(SCALAR), loop_of(PLANAR)
SIGMA = np.array([[0.3, 0.1], [0.1, 0.2]])


@pytest.mark.parametrize(
    ("sigma", "divergence", "ratio", "delay"),
    [(0.1, 0.200, 40.0, 42.3), (0.3, 0.697, 11.5, 14.5), (1.0, 2.79, 2.9, 5.1)],
)
def test_divergence_and_delay_are_those_of_the_scalar_example(
    sigma: float, divergence: float, ratio: float, delay: float
) -> None:
    """D and h/D to the digits that are known; the mean delay from G = 0 within 4 standard errors of both means."""
    attack = SENSOR_ATTACKS["replace"].of(REPLACED[1], LOOP, sigma * ONE)
    theory = WatermarkTheory.of(LOOP, attack, sigma * ONE)
    assert theory.divergence == pytest.approx(divergence, rel=3e-3)
    assert POLICIES["always"].of({"threshold": 8.0}).expected_delay(theory.divergence) == pytest.approx(ratio, rel=2e-2)
    assert theory.cost == pytest.approx(1.201 * sigma, rel=1e-3)
    delays = simulated(sigma * ONE, 250, 2000, REPLACED, [(1, 250)]).first_alarms(8.0)
    assert np.isfinite(delays).all()
    error = delays.std() / np.sqrt(2000)
    assert abs(delays.mean() - delay) < 4.0 * 1.3 * error  # theirs is a mean, too, of 4000 trials


def test_without_watermark_the_scalar_attack_stays_unseen() -> None:
    """D = 0.002, and hardly any of 400 trials has an alarm within 500 slots."""
    none = 0.0 * ONE
    attack = SENSOR_ATTACKS["replace"].of(REPLACED[1], LOOP, none)
    assert WatermarkTheory.of(LOOP, attack, none).divergence == pytest.approx(0.002, abs=2e-4)
    assert np.isfinite(simulated(none, 501, 400, REPLACED, [(1, 501)]).first_alarms(8.0)).mean() < 0.03


def test_distributions_of_two_dimensions_are_those_of_textbook_equations() -> None:
    """K, Σ_g, L and BᵀΠB + U by scipy; y's covariance, and S under both attacks, from the joint recursion written out."""
    process, plant = PLANAR.process, PLANAR.plant
    A, B, C, W, V = process.A, plant.input_matrix, plant.output_matrix, plant.noise, plant.measurement_noise
    assert C is not None
    assert V is not None
    P = solve_discrete_are(A.T, C.T, W, V)
    Sg = C @ P @ C.T + V
    K = P @ C.T @ np.linalg.inv(Sg)
    Pi = solve_discrete_are(A, B, np.diag(PLANAR.state_weights), np.diag(PLANAR.input_weights))
    M = B.T @ Pi @ B + np.diag(PLANAR.input_weights)
    L = np.linalg.solve(M, B.T @ Pi @ A)
    for mine, theirs in ((WIDE.K, K), (WIDE.innovation, Sg), (WIDE.L, L), (WIDE.weight, M)):
        assert np.allclose(mine, theirs, rtol=1e-8, atol=1e-10)
    assert watermark_cost(WIDE, SIGMA) == pytest.approx(float(np.trace(M @ SIGMA)))
    # The loop with its true state: ζ = (x, x̂), x⁺ = A x − B L x̂ + B e + w, x̂⁺ = (1 − K C)((A − B L) x̂ + B e) + K (C x⁺ + v).
    keep, closed = np.eye(2) - K @ C, A - B @ L
    F = np.block([[A, -B @ L], [K @ C @ A, keep @ closed - K @ C @ B @ L]])
    by_e, by_w, by_v = np.vstack([B, B]), np.vstack([np.eye(2), K @ C]), np.vstack([np.zeros((2, 2)), K])
    N = by_e @ SIGMA @ by_e.T + by_w @ W @ by_w.T + by_v @ V @ by_v.T
    X = solve_discrete_lyapunov(F, N)
    assert np.allclose(WIDE.measurement(SIGMA), C @ X[:2, :2] @ C.T + V, rtol=1e-8)
    A_a = np.array([[0.8, 0.1], [0.0, 0.6]])
    attack = SENSOR_ATTACKS["replace"].of({"matrix": A_a.tolist()}, WIDE, SIGMA)
    Z = attack.source(WIDE, SIGMA)
    assert np.allclose(solve_discrete_lyapunov(Z.F, Z.noise), WIDE.measurement(SIGMA))
    fed = np.block([[A_a, np.zeros((2, 2))], [K @ A_a, keep @ closed]])
    G = np.block([[np.eye(2), np.zeros((2, 2))], [K, keep @ B]])
    noise = np.block([[Z.noise, np.zeros((2, 2))], [np.zeros((2, 2)), SIGMA]])
    joint = solve_discrete_lyapunov(fed, G @ noise @ G.T)
    seen = np.hstack([A_a, -C @ closed])
    assert np.allclose(WIDE.deceived(Z, SIGMA), seen @ joint @ seen.T + Z.noise, rtol=1e-8)


def test_the_detector_knows_the_distribution_of_what_it_sees() -> None:
    """Innovations are standard normal without attack; under either attack their covariance is T + G Σ_e Gᵀ, in two dimensions."""
    replaced: tuple[str, dict[str, Any]] = ("replace", {"matrix": [[0.8, 0.1], [0.0, 0.6]]})
    unseen = ("always", {"threshold": 1e300})
    plain = simulated(SIGMA, 40, 4000, policy=unseen, assignment=PLANAR)
    assert np.allclose(np.cov(plain.epsilon[-1]), np.eye(2), atol=0.08)
    assert np.allclose(np.cov(plain.epsilon[1]), np.eye(2), atol=0.08)
    for name, entries in (replaced, ("replay", {"recorded": 60})):
        attack = SENSOR_ATTACKS[name].of(entries, WIDE, SIGMA)
        plan = MonitorPlan.of(WIDE, SIGMA, unseen, (name, entries))
        expected = assumed(WIDE, attack, SIGMA) + spread(plan.shift, SIGMA)
        run = simulated(SIGMA, 120, 4000, (name, entries), [(60, 120)], unseen, PLANAR)
        assert np.allclose(np.cov(run.epsilon[-1]), expected, rtol=0.1, atol=0.1)


def test_log_likelihood_ratios_have_their_means() -> None:
    """E exp(llr) = 1 without attack, which bounds false alarms; the mean is D under attack."""
    plan = MonitorPlan.of(LOOP, 0.3 * ONE, ALWAYS, REPLACED)
    e = np.sqrt(0.3) * np.random.default_rng(1).standard_normal((1, 200_000))
    epsilon = np.random.default_rng(2).standard_normal((1, 200_000))
    ratios = np.exp(plan.marked.llr(epsilon, plan.shift @ e))
    assert abs(ratios.mean() - 1.0) < 4.0 * ratios.std() / np.sqrt(len(ratios))
    run = simulated(0.3 * ONE, 80, 3000, REPLACED, [(1, 80)], ("always", {"threshold": 1e300}))
    shift = plan.shift[0, 0] * run.watermark[78]
    llr = plan.marked.llr(run.epsilon[79], shift)
    attack = SENSOR_ATTACKS["replace"].of(REPLACED[1], LOOP, 0.3 * ONE)
    D = WatermarkTheory.of(LOOP, attack, 0.3 * ONE).divergence
    assert abs(llr.mean() - D) < 4.0 * llr.std() / np.sqrt(3000)


def test_false_alarms_are_as_rare_as_promised() -> None:
    """With h = 3 at most e⁻³ of the slots begin one, and there are some."""
    policy = POLICIES["always"].of({"threshold": 3.0})
    alarms = simulated(0.3 * ONE, 10, 3000, policy=("always", {"threshold": 3.0})).first_alarms(3.0)
    bound = policy.false_alarms(10)
    assert bound == pytest.approx(10.0 * np.exp(-3.0))
    assert 0.0 < np.isfinite(alarms).mean() < bound
    assert policy.false_alarms(1000) == 1.0
    assert policy.expected_delay(0.0) is None


def test_a_watermark_costs_what_theory_says() -> None:
    """The regulator's cost with it minus that without it is tr[(BᵀΠB + U) Σ_e], from the same noise."""
    quiet = ("always", {"threshold": 1e300})
    runs = [simulated(sigma * ONE, 200, 300, policy=quiet) for sigma in (0.0, 0.3)]
    more = (runs[1].cost - runs[0].cost)[50:].mean(axis=0)
    assert abs(more.mean() - 0.3603) < 4.0 * more.std() / np.sqrt(300)


def test_a_replay_is_seen_only_with_a_watermark() -> None:
    """Against a replay D is 0 without a watermark; with one nearly every trial has an alarm, and the recording is repeated."""
    replay = ("replay", {"recorded": 30})
    attack = SENSOR_ATTACKS["replay"].of(replay[1], LOOP, 0.0 * ONE)
    assert WatermarkTheory.of(LOOP, attack, 0.0 * ONE).divergence == pytest.approx(0.0, abs=1e-12)
    assert not np.isfinite(simulated(0.0 * ONE, 200, 200, replay, [(40, 200)]).first_alarms(8.0)).any()
    assert np.isfinite(simulated(0.5 * ONE, 200, 200, replay, [(40, 200)]).first_alarms(8.0)).mean() > 0.95
    feed = SENSOR_ATTACKS["replay"].read({"recorded": 3}).feed(b"", Batch(20, 1))
    heard = [float(feed(k, np.array([[float(k)]]), 5 <= k < 12)[0, 0]) for k in range(14)]
    assert heard == [0, 1, 2, 3, 4, 2, 3, 4, 2, 3, 4, 2, 12, 13]


@pytest.mark.parametrize("recorded", [1, 2, 3, 5])
def test_a_slot_of_any_replay_repeats_what_the_filter_got_so_many_slots_before(recorded: int) -> None:
    """Also if that is in an earlier attack, which has just ended, and if one follows another at once."""
    spans = ((5, 8), (9, 10), (10, 14), (16, 17))
    spoofing = MonitorPlan.of(LOOP, 0.3 * ONE, ALWAYS, ("replay", {"recorded": recorded}), spans).spoofing(
        b"", Batch(20, 1)
    )
    assert spoofing is not None
    heard: list[float] = []
    for k in range(20):
        expected = heard[k - recorded] if any(start <= k < stop for start, stop in spans) else float(k)
        heard.append(float(spoofing(k, np.array([[float(k)]]))[0, 0]))
        assert heard[k] == expected


@pytest.mark.parametrize("k", [0, 1])
def test_replaced_measurements_are_stationary_from_slot_0_on(k: int) -> None:
    """The values z of 4000 trials have the variance 0.1 / (1 − 0.8²) to 6 standard errors; the noise w_a alone has 0.1."""
    feed = SENSOR_ATTACKS["replace"].read({"matrix": [[0.8]], "noise": [[0.1]]}).feed(b"k" * 32, Batch(20, 4000))
    z = [feed(slot, np.zeros((1, 4000)), True) for slot in range(k + 1)][k]
    expected = 0.1 / (1.0 - 0.8**2)
    assert float(np.mean(z**2)) == pytest.approx(expected, abs=6.0 * expected * np.sqrt(2.0 / 4000))


def test_the_parsimonious_policy_is_the_posterior_of_an_attack() -> None:
    """Bayes' rule slot by slot; marks only between the thresholds; it stays as it is after the alarm."""
    policy = POLICIES["parsimonious"].of(PARSIMONIOUS[1])
    llr = np.array([[0.3, -1.0], [5.0, -2.0], [9.0, 1000.0], [-3.0, -3.0]])
    p, mine = np.zeros(2), np.zeros(2)
    for row in llr:
        before = p + (1.0 - p) * 1e-3
        attacked = before * np.exp(np.minimum(row, 700.0))
        p = np.where(p >= 0.999, p, attacked / (attacked + 1.0 - before))
        mine = policy.step(mine, row)
        assert np.allclose(mine, p, rtol=1e-12)
    assert policy.marks(np.array([0.0, 0.049, 0.05, 0.9, 0.999, 1.0])).tolist() == [
        False,
        False,
        True,
        True,
        False,
        False,
    ]
    assert policy.expected_delay(1.0) is None
    assert policy.false_alarms(10) is None


def test_the_parsimonious_policy_saves_watermark_and_still_detects() -> None:
    """It marks few slots without an attack, most from the attack to the alarm, and none afterwards."""
    run = simulated(0.3 * ONE, 400, 300, REPLACED, [(150, 400)], PARSIMONIOUS)
    marked, alarms = run.watermark[:, 0] != 0.0, run.first_alarms(0.999)
    assert marked[:150].mean() < 0.2
    assert (alarms >= 150).all()
    assert np.isfinite(alarms).all()
    for r in range(300):
        assert not marked[int(alarms[r]) :, r].any()


@pytest.mark.parametrize("name", POLICIES)
def test_the_statistic_stays_as_it_is_after_an_alarm(name: str) -> None:
    """For any later evidence, and there is no further watermark; below the threshold the watermark continues."""
    policy = POLICIES[name].of(POLICIES[name].parameters)
    alarm = policy.threshold
    statistic = np.array([alarm, alarm, 0.5 * alarm])
    after = policy.step(statistic, np.array([-5.0, 0.1, -0.1]))
    assert after[:2].tolist() == [alarm, alarm]
    assert 0.0 < after[2] != statistic[2]
    assert policy.marks(statistic).tolist() == [False, False, True]


def test_a_trial_is_the_same_alone() -> None:
    """Statistic and watermark of the first trials do not depend on how many others there are."""
    few, many = (simulated(SIGMA, 30, trials, assignment=PLANAR) for trials in (2, 50))
    assert np.array_equal(few.statistic, many.statistic[:, :2])
    assert np.array_equal(few.watermark, many.watermark[..., :2])


def test_a_clipped_watermark_counts_as_far_as_it_enters() -> None:
    """The detector gets the part of it that the plant's limits leave."""
    inf, none = np.array([np.inf]), np.zeros((1, 0))
    plant = Plant(ONE, none, ONE, np.zeros(1), np.array([-1.0]), np.array([1.0]), -inf, inf)
    entered = plant.entering(np.array([[0.5, 0.9, 2.0]]), np.array([[0.25, 0.4, -0.5]]))
    assert np.allclose(entered, [[0.25, 0.1, 0.0]])


def test_a_plan_without_attack_is_designed_for_a_replay() -> None:
    """It feeds the filter with what was measured, and assumes the distribution of a replay."""
    plan = MonitorPlan.of(LOOP, 0.3 * ONE, ALWAYS, None)
    replay = MonitorPlan.of(LOOP, 0.3 * ONE, ALWAYS, ("replay", {"recorded": 5}))
    key = stream_keys(1, ("watermark",))["watermark"]
    assert plan.spoofing(key, Batch(4, 1)) is None
    assert np.array_equal(plan.marked.precision, replay.marked.precision)
    monitor = Monitor(plan, key, Batch(4, 3))
    monitor.take(0, np.full((1, 3), 9.0), None)
    assert monitor.statistic.tolist() == [0.0] * 3


def test_evidence_is_weighed_by_the_distribution_of_its_own_slot() -> None:
    """CUSUM and posterior after slots with a watermark and without, by the formula of each; the two distributions differ."""
    entered, epsilon = np.array([[0.4, -0.7, 0.2]]), np.array([[1.3, -0.4, 2.2]])
    parsimonious = ("parsimonious", {"watch_from": 0.05, "alarm_from": 0.999, "attack_rate": 1e-3})
    for policy, marked in ((ALWAYS, True), (parsimonious, False)):
        plan = MonitorPlan.of(LOOP, 0.3 * ONE, policy, REPLACED)
        monitor = Monitor(plan, stream_keys(1, ("watermark",))["watermark"], Batch(4, 3))
        monitor.take(0, epsilon, None)
        assert monitor.watermark.all() == marked
        monitor.take(1, epsilon, entered)
        T = float(1.0 / (plan.marked if marked else plan.unmarked).precision[0, 0])
        moved = epsilon[0] + float(plan.shift[0, 0]) * entered[0]
        llr = 0.5 * (epsilon[0] ** 2 - moved**2 / T - np.log(T))
        assert np.allclose(monitor.statistic, plan.made_policy.step(np.zeros(3), llr), rtol=1e-12)
        assert monitor.statistic.any()
        assert abs(plan.marked.precision - plan.unmarked.precision).min() > 1e-4


def test_a_plant_without_inputs_has_nothing_to_mark() -> None:
    """A watermark that is added to it never enters."""
    states = PlantCore(SCALAR.process, bytes(32), Batch(4, 1))
    states.add_watermark(ONE)
    assert states.entered is None


def test_attacks_come_back_from_plain_numbers() -> None:
    """`read` makes of `plain` an attack with the same data."""
    for name, entries in (REPLACED, ("replay", {"recorded": 7})):
        attack = SENSOR_ATTACKS[name].of(entries, LOOP, 0.3 * ONE)
        assert SENSOR_ATTACKS[name].read(attack.plain).plain == attack.plain
    given = SENSOR_ATTACKS["replace"].of({"matrix": [[0.5]], "noise": [[0.2]]}, LOOP, ONE)
    assert given.plain == {"matrix": [[0.5]], "noise": [[0.2]]}


@pytest.mark.parametrize(
    ("name", "given", "entry", "words"),
    [
        ("replace", {"matrix": [[0.5, 0.1]]}, "matrix", "1 × 1"),
        ("replace", {"matrix": [[0.5]], "noise": [[0.1], [0.2]]}, "noise", "1 × 1"),
        ("replace", {"matrix": [[1.0]]}, "matrix", "less than 1"),
        ("replace", {"matrix": [[0.5]], "noise": [[-0.1]]}, "noise", "eigenvalues of 0 or more"),
        ("replay", {"recorded": 11}, "recorded", "slot 10"),
    ],
)
def test_impossible_attacks_are_refused(name: str, given: dict[str, Any], entry: str, words: str) -> None:
    """Each with the entry and what is expected; possible ones are not."""
    ((place, message),) = SENSOR_ATTACKS[name].objections(given, LOOP, 10)
    assert place == entry
    assert words in message
    for able in ({"matrix": [[0.5]]}, {"matrix": [[0.5]], "noise": [[0.1]]}):
        assert SENSOR_ATTACKS["replace"].objections(able, LOOP, 10) == []
    assert SENSOR_ATTACKS["replay"].objections({"recorded": 10}, LOOP, 10) == []


@pytest.mark.parametrize(
    ("name", "given", "entry"),
    [
        ("always", {"threshold": 0.0}, "threshold"),
        ("parsimonious", {**PARSIMONIOUS[1], "alarm_from": 1.0}, "alarm_from"),
        ("parsimonious", {**PARSIMONIOUS[1], "attack_rate": 0.0}, "attack_rate"),
        ("parsimonious", {**PARSIMONIOUS[1], "watch_from": 1.0}, "watch_from"),
        ("parsimonious", {**PARSIMONIOUS[1], "watch_from": 0.9995}, "watch_from"),
    ],
)
def test_wrong_parameters_of_a_policy_are_found(name: str, given: dict[str, float], entry: str) -> None:
    """One mistake each; the parameters that are given as examples have none."""
    assert [key for key, _ in POLICIES[name].mistakes(given)] == [entry]
    assert POLICIES[name].mistakes(POLICIES[name].parameters) == []


def test_stationary_covariances_do_not_depend_on_units() -> None:
    """1 / (1 − f²) for each part of its own, whatever the other's size."""
    X = stationary(np.diag([0.1, 0.999]), np.diag([1e20, 1e-20]))
    assert np.diag(X) == pytest.approx([1e20 / 0.99, 1e-20 / (1.0 - 0.999**2)], rel=1e-10)


def test_what_has_no_stationary_distribution_is_refused() -> None:
    """A source that grows, slowly or fast, and a z that cannot have the covariance of y."""
    for factor in (1.0, 1e200):
        with pytest.raises(ValueError, match="stationary"):
            stationary(factor * ONE, ONE)
    with pytest.raises(ValueError, match="stationary"):
        LOOP.deceived(Source(1.5 * ONE, ONE, ONE), ONE)
    with pytest.raises(ValueError, match="covariance of y"):
        SENSOR_ATTACKS["replace"].of({"matrix": [[0.0, 3.0], [0.0, 0.0]]}, WIDE, SIGMA)
