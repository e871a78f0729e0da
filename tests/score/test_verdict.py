"""The verdict of a run: its glyph, word and sentence, and the comparison after the start on which it rests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.process import Floats
from evedrop.scenario.loading import load
from evedrop.scenario.theory import expectations_of
from evedrop.score.after_start import AfterStart, BatchMeans, DistanceTally, _limits, leading_states
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import verdicts
from evedrop.score.secrecy import MeanErrors, _larger, sign_of_mean
from evedrop.score.sums import WINDOWS
from evedrop.score.verdict import Compared, SecrecyOutcome, times_text, verdict_of, verdict_on, verdict_so_far
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import TrialBlock, TrialsTask, carry_out
from tests.score.test_verdict_calibration import tally_of


def batches(errors: Floats) -> BatchMeans:
    """The batches of errors, (c,), which are squared distances as well."""
    made = BatchMeans()
    made.add(errors, errors)
    return made


def correlated(draw: np.random.Generator, slots: int, memory: float) -> Floats:
    """Squared errors of a stationary process of the first order, (slots,)."""
    noise, state = draw.normal(size=slots), 0.0
    states = np.empty(slots)
    for k in range(slots):
        state = memory * state + noise[k]
        states[k] = state
    return np.asarray(states**2)


@pytest.mark.parametrize(
    ("ratio", "interval", "text"),
    [
        (17.0, (13.2, 21.8), "17 × [13, 22]"),
        (1.04, (1.013, 1.07), "1.04 × [1.01, 1.07]"),
        (1.003, (1.0024, 1.0036), "1.003 × [1.002, 1.01]"),
        (0.97, (0.941, 0.9987), "0.970 × [0.94, 0.999]"),
        (1.2, (1.04, 1.4), "1.2 × [1.04, 1.4]"),
        (1.0, (0.7, 1.3), "1 × [0.7, 1.3]"),
        (1.0, (1.0, 1.0), "1 × [1, 1]"),
        (2.0, (0.5, np.inf), "2 × [0.5, ∞]"),
        (1.04, None, "1 ×"),
    ],
)
def test_an_interval_shows_on_which_side_of_1_it_is(
    ratio: float, interval: tuple[float, float] | None, text: str
) -> None:
    """Its limits are rounded outwards near 1."""
    assert times_text(ratio, interval) == text


@given(cuts=st.sets(st.integers(1, 999), max_size=20))
def test_batches_do_not_depend_on_how_slots_are_cut(cuts: set[int]) -> None:
    """The same bits, however many slots a call has."""
    errors = np.random.default_rng(1).lognormal(size=1000)
    whole, parts = batches(errors), BatchMeans()
    for part in np.split(errors, sorted(cuts)):
        parts.add(part, part)
    assert (parts.length, parts.later.tolist()) == (whole.length, whole.later.tolist())
    assert whole.length == 32
    np.testing.assert_allclose(whole.later[0, 0], errors[16 * 32 : 17 * 32].mean())


@pytest.mark.parametrize(("times", "larger"), [(20.0, True), (1.0, False), (0.1, False)])
def test_a_single_trial_is_compared_by_batches(times: float, larger: bool) -> None:
    """Far larger, as large and smaller errors are told apart in one trial of a few thousand slots."""
    draw = np.random.default_rng(4)
    ours, theirs = correlated(draw, 20_000, 0.5), times * correlated(draw, 20_000, 0.5)
    values = AfterStart.of_batches(batches(ours), batches(theirs))
    assert values.larger is larger
    assert values.ratio == pytest.approx(times, rel=0.2)
    assert values.interval is not None
    assert values.interval[0] < values.ratio < values.interval[1]
    assert values.in_one_trial


def test_a_short_trial_does_not_decide() -> None:
    """A batch needs some slots, and a comparison some batches."""
    draw = np.random.default_rng(4)
    values = AfterStart.of_batches(batches(draw.lognormal(size=100)), batches(50 * draw.lognormal(size=100)))
    assert (values.larger, values.why_open) == (None, "the run has too few slots")
    nothing = AfterStart.of_batches(BatchMeans(), BatchMeans())
    assert np.isnan(nothing.ratio)


def test_a_run_of_one_slot_does_not_decide() -> None:
    """Neither of several trials, whose errors are all 0 there, nor of one."""
    for trials in (1, 20):
        scenario = load("vehicle", {"slots": 1, "trials": trials})
        *_, verdict = verdicts(scenario, tally_of(scenario).tallies, expectations_of(scenario))
        assert verdict is not None
        assert verdict.outcome == SecrecyOutcome.OPEN
        assert verdict.reason.startswith("the run has too few slots")


def test_a_trial_without_states_has_a_verdict_without_distances() -> None:
    """As in a covariance-only study."""
    draw, unknown = np.random.default_rng(4), np.full(5000, np.nan)
    ours, theirs = BatchMeans(), BatchMeans()
    ours.add(draw.lognormal(size=5000), unknown)
    theirs.add(20.0 * draw.lognormal(size=5000), unknown)
    values = AfterStart.of_batches(ours, theirs)
    assert (values.larger, values.distances) == (True, None)
    assert "eve has " in verdict_on(Compared("eve", values)).sentence


def test_the_interval_of_several_trials_has_no_bound_below_zero() -> None:
    """It is that of the logarithm: with few trials an error that scatters widely is not said to be perhaps 0 times as large."""
    scenario = load("vehicle", {"slots": 400, "trials": 8})
    _, each, _ = verdicts(scenario, tally_of(scenario).tallies, expectations_of(scenario))
    compared = [entry.after_start for entry in each]
    intervals = [(values.ratio, *values.interval) for values in compared if values.interval is not None]
    assert len(intervals) == 3
    for ratio, low, high in intervals:
        assert 0.0 < low < ratio < high
        assert low * high == pytest.approx(ratio**2)


def test_errors_of_rounding_are_equal() -> None:
    """Two receivers that both know the state: neither is better by the noise of its arithmetic."""
    draw = np.random.default_rng(4)
    ours, theirs = (batches(1e-30 * draw.lognormal(size=5000)) for _ in range(2))
    values = AfterStart.of_batches(ours, theirs, noise=1.0)
    assert (values.ratio, values.larger) == (1.0, False)
    known = AfterStart.of_batches(ours, batches(np.ones(5000)), noise=1.0)
    assert (known.ratio, known.larger) == (np.inf, True)


def test_logarithms_do_not_decide_against_the_ratio_of_the_means() -> None:
    """An estimator that is right but in a few bursts, which make up its whole mean error; and the same of an eavesdropper."""
    draw = np.random.default_rng(4)
    bursts, always = np.zeros(4096), draw.lognormal(size=4096)
    bursts[3000:3100] = 1000.0
    for ours, theirs, ratio in ((bursts, always, 0.03), (always, bursts, 30.0)):
        values = AfterStart.of_batches(batches(ours), batches(theirs), noise=1.0)
        assert values.larger is None
        assert values.ratio == pytest.approx(ratio, rel=0.2)


@pytest.mark.parametrize("memory", [0.0, 0.9, 0.99])
def test_equal_errors_are_rarely_called_different(memory: float) -> None:
    """Two receivers with the same distribution of errors, correlated over up to a hundred slots: a few times in a hundred."""
    draw, wrong = np.random.default_rng(7), 0
    for _ in range(200):
        ours, theirs = (batches(correlated(draw, 4096, memory)) for _ in range(2))
        wrong += AfterStart.of_batches(ours, theirs).larger is True
    assert wrong <= 9  # of 200: at 2 % one in a hundred studies has more


def test_correlated_batches_count_for_less() -> None:
    """Limits from 16 samples whose neighbours have a correlation of 1/2 are √3 times as far apart as Student's."""
    samples = np.array([3.0, 2.0, 1.0, 0.0, -1.0, -2.0, -1.0, 0.0, 1.0, 0.0, -1.0, -2.0, -1.0, 0.0, 1.0, 2.0])
    around = samples - samples.mean()
    correlation = (around[1:] @ around[:-1]) / (around @ around)
    assert 0.4 < correlation < 0.8
    low, high = _limits(samples)
    student = stats.t.ppf(0.99, 15) * samples.std(ddof=1) / 4.0
    assert (high - low) / 2.0 == pytest.approx(student * np.sqrt((1.0 + correlation) / (1.0 - correlation)))


def test_the_start_of_several_trials_does_not_count() -> None:
    """An eavesdropper that was far off in the first half and is as good as the estimator in the second knows as much."""
    draw = np.random.default_rng(5)
    ours, theirs = draw.uniform(0.9, 1.1, (2, WINDOWS, 200))
    theirs[: WINDOWS // 2] += 1000.0
    assert _larger(MeanErrors(ours, theirs), sign_of_mean) is False
    theirs[WINDOWS // 2 :] += 0.25
    assert _larger(MeanErrors(ours, theirs), sign_of_mean) is True
    doubtful = ours + draw.normal(scale=3.0, size=ours.shape)
    assert _larger(MeanErrors(ours, doubtful), sign_of_mean) is None


def test_half_a_median_decides_where_tails_are_heavy() -> None:
    """A mean that one trial in a hundred carries says nothing by Student's t; signs say enough."""
    draw = np.random.default_rng(3)
    theirs = np.tile(np.exp(4.0 * np.abs(draw.normal(size=60)) + 1.0), (WINDOWS, 1))
    ours = np.full((WINDOWS, 60), 0.1) * draw.uniform(0.5, 1.5, size=60)
    means = MeanErrors(ours, theirs, most_ours=np.full((WINDOWS, 1), 0.2), most_theirs=theirs.max() + 0 * ours)
    assert sign_of_mean(theirs[0] - ours[0]).above > 0.005
    assert _larger(means, sign_of_mean) is True


def compared(name: str, ratio: float, larger: bool | None, grows: bool = False, denied: bool = False) -> Compared:
    """An eavesdropper at a distance of √ratio metres, the estimator at one metre."""
    return Compared(name, AfterStart(ratio, None, larger, (1.0, ratio**0.5), "3 trials are too few"), grows, denied)


def test_the_eavesdropper_that_knows_most_decides() -> None:
    """One that is broken before one that is open, and that before any that is kept; of these the one with the least error."""
    far, near = compared("naive", 400.0, True, grows=True), compared("smart", 25.0, True)
    open_, broken = compared("lucky", 1.5, None), compared("jammer", 1.0, False)
    verdict = verdict_of([far, near], "m")
    assert verdict is not None
    assert verdict.sentence == (
        "✓ secret: the estimator is 1 m off, the best eavesdropper (smart) 5 m: 25 × the squared error"
    )
    for several, outcome, name in (
        ([far], SecrecyOutcome.PERFECT, "naive"), ([far, near, open_], SecrecyOutcome.OPEN, "lucky"),
        ([far, near, open_, broken], SecrecyOutcome.BROKEN, "jammer"),
    ):  # fmt: skip
        verdict = verdict_of(several)
        assert verdict is not None
        assert (verdict.outcome, verdict.eavesdropper) == (outcome, name)
        assert verdict.sentence.startswith(f"{outcome.glyph} {outcome.value}: ")
    assert verdict_of([]) is None
    further = verdict_of([near, compared("slow", 900.0, None)])
    assert further is not None
    assert "the estimator is 1 off, slow 30: 900 ×" in further.sentence  # undecided, and not the best


@pytest.mark.parametrize(
    ("ratio", "larger", "denied", "sentence"),
    [
        (0.5, False, False, "✗ not secret: eve knows more than the estimator; the estimator is 1 off, eve 0.71: 0.5 ×"),
        (1.0, False, False, "✗ not secret: eve knows as much as the estimator; the estimator is 1 off, eve 1: 1 ×"),
        (1.0, None, True, "✗ not secret: by theory, eve knows as much as the estimator in the long run; "
                          "here the estimator is 1 off, eve 1: 1 ×"),
        (4.0, None, False, "? cannot tell yet: 3 trials are too few; the estimator is 1 off, eve 2: 4 ×"),
        (1e7, True, False, "✓ secret: the estimator is 1 off, eve 3,200: 1e7 ×"),
        (np.nan, None, False, "? cannot tell yet: 3 trials are too few"),
    ],
)  # fmt: skip
def test_every_outcome_has_its_sentence(ratio: float, larger: bool | None, denied: bool, sentence: str) -> None:
    """Glyph, word, reason, distances and ratio."""
    assert (
        verdict_on(compared("eve", ratio, larger, denied=denied)).sentence.removesuffix(" the squared error")
        == sentence
    )


def test_a_single_trial_does_not_show_what_theory_denies() -> None:
    """It may lack the rare events that make up most of the legitimate error."""
    after_start = AfterStart(4.0, None, True, (1.0, 2.0), in_one_trial=True)
    assert Compared("eve", after_start).outcome is SecrecyOutcome.RELATIVE
    verdict = verdict_on(Compared("eve", after_start, denied=True))
    assert verdict.sentence.startswith(
        "✗ not secret: by theory, eve knows as much as the estimator in the long run; here "
    )
    several = replace(after_start, in_one_trial=False)
    assert Compared("eve", several, denied=True).outcome is SecrecyOutcome.RELATIVE


def test_a_distance_counts_the_first_states_of_one_unit() -> None:
    """Two coordinates in metres, and not the speeds that follow."""
    assert [leading_states(units, 4) for units in (("m", "m", "m/s", "m/s"), ("m",) * 4, ())] == [2, 4, 4]
    tally, x, x_hat = DistanceTally(2, 4, 1), np.zeros((4, 4, 1)), np.zeros((4, 4, 1))
    x_hat[:2], x_hat[2:, :, 0] = 100.0, [3.0, 4.0, 50.0, 60.0]
    errors = np.sum((x - x_hat) ** 2, axis=1)
    tally.add_slots(0, errors, errors[:, 0], x, x_hat)
    assert tally.distance(later=True) == 5.0
    assert tally.distance(later=False) == pytest.approx(np.sqrt((2 * 20_000 + 2 * 25) / 4))
    unknown = DistanceTally(2, 4, 1)
    unknown.add_slots(0, np.ones((4, 1)), np.ones(4))
    assert unknown.distance(later=True) is unknown.distance(later=False) is None


@pytest.mark.parametrize(("slots", "chunks"), [(1, ()), (2, ()), (3, ()), (10, ()), (11, ()), (90, (2, 3, 1))])
def test_distances_and_ratio_are_of_the_same_slots(slots: int, chunks: tuple[int, ...]) -> None:
    """Where all states have one unit, one follows from the other; also if trials were cut short, after so many chunks."""
    scenario = load("heated-room", {"slots": slots, "trials": 6, "expect": []})
    whole = tally_of(scenario)
    if chunks:
        tables, parts = scenario.model_dump(mode="json"), list[TrialBlock]()
        for number, chunk in enumerate(chunks):
            asked = [False] * (chunk - 1) + [True]
            task = TrialsTask(tables, 2 * number, 2 * number + 2, Mode.EXACT)
            parts += carry_out(task, lambda _: None, iter(asked).__next__).blocks
        whole = RunTally.merged([part.run_tally for part in parts])
    _, each, _ = verdicts(scenario, whole.tallies, expectations_of(scenario))
    for compared_ in each:
        distances = compared_.after_start.distances
        assert distances is not None
        if distances[0] > 0.0:
            assert (distances[1] / distances[0]) ** 2 == pytest.approx(compared_.after_start.ratio)


def test_a_single_trial_has_a_verdict_and_its_batches_are_those_of_the_view() -> None:
    """A run and the view, which sees the same slots, give the same verdict at the end."""
    scenario = load("vehicle", {"slots": 3000, "trials": 1})
    tallies = tally_of(scenario).tallies
    eves = [(name, tally.distance.batches) for name, tally in tallies.items() if tally.distance is not None]
    (_, ours), *theirs = [(name, each) for name, each in eves if each is not None]
    verdict = verdict_so_far(ours, theirs, "m")
    assert verdict is not None
    assert verdict.outcome == SecrecyOutcome.RELATIVE
    assert verdict.reason.endswith("in this trial")
    assert "sensor's estimate" not in verdict.reason
    of_estimate = verdict_so_far(ours, theirs, "m", of_estimate=True)
    assert of_estimate is not None
    assert " off the sensor's estimate, the best eavesdropper (smart) " in of_estimate.reason
