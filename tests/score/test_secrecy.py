"""Verdicts on secrecy, from errors made up for the purpose."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evedrop.model.process import Floats, Process
from evedrop.model.slot.link import LinkSchedule
from evedrop.model.slot.link_distribution import distribution_of
from evedrop.model.theory.covariances import Outcomes
from evedrop.scenario.estimates import warnings_of
from evedrop.scenario.loading import load
from evedrop.scenario.theory import Expectation, expectations_of
from evedrop.score.rare_events import rare_events_of
from evedrop.score.scorekeeper import verdicts
from evedrop.score.secrecy import Claim, SignTest, _missing, rejected, secrecy, sign_of_mean
from evedrop.score.summary import SecrecySummary
from evedrop.score.sums import WINDOWS, Tally, window_means, window_of
from tests.score.test_verdict_calibration import tally_of

STABLE = Process(np.diag([1.0, 0.9]), np.eye(2) * 1e-3, np.eye(2))
SLOTS, TRIALS = 81, 60


def tally(levels: Floats, done: int = SLOTS, slots: int = SLOTS) -> Tally:
    """A receiver whose mean squared error is levels (WINDOWS, R) in each window of each trial."""
    made = Tally(slots, levels.shape[1])
    lengths = np.bincount(window_of(np.arange(1, slots), slots), minlength=WINDOWS)
    made.window_errors = levels * lengths[:, None]
    made.done, made.offered = done, done * made.trials
    made.error = float(made.window_errors.sum())
    return made


def around(level: float | Floats, spread: float = 0.1, trials: int = TRIALS) -> Floats:
    """Errors around a level, of each window alike or one for each."""
    noise = np.random.default_rng(4).uniform(1 - spread, 1 + spread, (WINDOWS, trials))
    return np.broadcast_to(np.asarray(level, float).reshape(-1, 1), (WINDOWS, trials)) * noise


def expectation(link: dict[str, Any], mu_d: float, uses: tuple[float, float] | None = None) -> Expectation:
    """What theory expects of the legitimate estimator, or of an eavesdropper with P(b|0) and P(b|1), behind a link."""

    def outcomes_at(quality: float) -> Outcomes:
        return Outcomes.legitimate(quality, mu_d) if uses is None else Outcomes.eavesdropper(quality, mu_d, *uses)

    return Expectation(STABLE, distribution_of(LinkSchedule({"loss": link})), outcomes_at)


def good(quality: float) -> dict[str, Any]:
    """The paper's link."""
    return {"model": "bernoulli", "quality": quality}


BURSTS = {"model": "gilbert-elliott", "p": 0.01, "r": 0.1}
ROTE = {"model": "trace", "outcomes": "110", "random_start": True}


def entry(legitimate: tuple[Tally, Expectation], eavesdropper: tuple[str, Tally, Expectation]) -> SecrecySummary:
    """The summary's entry."""
    return secrecy(legitimate, eavesdropper)[0]


def judged(legitimate: Tally, other: Tally, mu_e: float = 0.5, use_innovation: float = 0.0) -> SecrecySummary:
    """The verdict when theory knows a good legitimate link and an eavesdropper with these probabilities."""
    expected = expectation(good(0.9), 0.5), expectation(good(mu_e), 0.5, (1.0, use_innovation))
    return entry((legitimate, expected[0]), ("eve", other, expected[1]))


def test_relative_secrecy_held_where_every_window_is_above() -> None:
    """A larger error in every window, beyond doubt."""
    verdict = judged(tally(around(0.03)), tally(around(0.06)))
    assert verdict.relative == Claim.HELD
    assert verdict.ratio == pytest.approx(2.0, rel=0.05)
    assert "its error was larger in every window" in verdict.sentence


def test_relative_secrecy_failed_where_one_window_is_below() -> None:
    """One window in which the eavesdropper is better, beyond doubt, is enough."""
    levels = np.full(WINDOWS, 0.06)
    levels[3] = 0.015
    verdict = judged(tally(around(0.03)), tally(around(levels)))
    assert verdict.relative == Claim.FAILED
    assert "its error was not larger in slots " in verdict.sentence


def test_a_window_that_is_only_slightly_unlikely_does_not_fail_the_claim() -> None:
    """Windows share the error rate: below 0 at 1 % in one window of eight is not a failure, and at 1 % / 8 it is."""
    p_values = dict.fromkeys(range(WINDOWS), 0.5)
    assert rejected({**p_values, 3: 0.005}) == []
    assert rejected({**p_values, 3: 0.00124}) == [3]


@pytest.mark.parametrize(
    ("p_values", "numbers"),
    [
        ([0.002, 0.003, 0.009], [0, 1, 2]),
        ([0.009, 0.003, 0.006], [1]),  # 0.006 is above 1 % / 2, and what follows it is not looked at
        ([0.0034, 0.5, 0.5], []),
        ([0.011], []),
        ([], []),
    ],
)
def test_holm_rejects_step_by_step(p_values: list[float], numbers: list[int]) -> None:
    """The smallest against 1 % / 3, the next against 1 % / 2, the last against 1 %."""
    assert rejected(dict(enumerate(p_values))) == numbers


@pytest.mark.parametrize("scale", [1.0, 1e-200, 1e200])
def test_the_sign_of_a_mean_does_not_depend_on_the_scale(scale: float) -> None:
    """Squares of large numbers overflow, and those of small ones vanish."""
    samples = np.array([-1.0] * 99 + [1e5])
    expected = sign_of_mean(samples)
    assert 0.1 < expected.above < 0.9
    found = sign_of_mean(scale * samples)
    assert (found.above, found.below) == pytest.approx((expected.above, expected.below))
    assert sign_of_mean(np.full(9, scale)) == SignTest(0.0, 1.0)


def test_an_unclear_window_leaves_the_verdict_open() -> None:
    """A window whose difference may be either way is neither held nor failed."""
    levels = np.full(WINDOWS, 0.002)
    levels[3] = 0.001
    other = around(levels, spread=0.9)
    assert judged(tally(around(0.001, 0.9)[::-1]), tally(other)).relative == Claim.UNDECIDED


def test_rare_events_that_theory_expects_of_the_user_leave_held_open() -> None:
    """Trials without the loss of the first packet, which carries the legitimate error, are no evidence of secrecy."""
    process = Process(np.array([[1.0]]), np.array([[1.0]]), np.array([[1e6]]))
    distribution = distribution_of(LinkSchedule({"loss": good(0.99)}))
    ours = Expectation(process, distribution, lambda quality: Outcomes.legitimate(quality, 0.02))
    theirs = Expectation(
        process,
        distribution_of(LinkSchedule({"loss": good(1.0)})),
        lambda quality: Outcomes.eavesdropper(quality, 0.02, 1.0, 0.0),
    )
    legitimate, other = tally(around(0.1, trials=200)), tally(around(20.0, trials=200))
    result = entry((legitimate, ours), ("eve", other, theirs))
    assert result.relative == Claim.UNDECIDED
    assert "200 trials are too few to decide: theory expects a larger error of legitimate" in result.sentence
    assert re.search(r"; [0-9,]+ trials would contain them, and montecarlo --rare estimates its mean;", result.sentence)
    # The same the other way round: an eavesdropper whose rare events are missing has not broken the secret.
    result = entry((other, theirs), ("eve", legitimate, ours))
    assert result.relative == Claim.UNDECIDED
    assert "theory expects a larger error of eve" in result.sentence


@pytest.mark.parametrize("trials", [200, 20_000])
def test_without_a_closed_form_an_event_that_no_trial_met_may_still_be_there(trials: int) -> None:
    """With a probability of 4.6/R, and an error like that of a receiver without packets, or of the heaviest trial."""
    process = Process(np.array([[1.0]]), np.array([[1.0]]), np.array([[1e3]]))
    unknown = Expectation(process, distribution_of(LinkSchedule({"loss": good(0.99)})), None)
    quiet, loud = tally(around(0.1, trials=trials)), tally(around(5.0, trials=trials))
    verdicts = entry((quiet, unknown), ("eve", loud, unknown)), entry((loud, unknown), ("eve", quiet, unknown))
    enough = trials > 200
    assert [verdict.relative for verdict in verdicts] == (
        [Claim.HELD, Claim.FAILED] if enough else [Claim.UNDECIDED] * 2
    )
    for name, verdict in zip(("legitimate", "eve"), verdicts, strict=True):
        assert (
            f": too few trials lose the first packet of {name}, of 2,000 enough would;" in verdict.sentence
        ) != enough


def test_the_number_of_trials_that_is_asked_for_is_enough() -> None:
    """20 losses of the first packet are expected in it, and not in one trial less."""
    unknown = Expectation(STABLE, distribution_of(LinkSchedule({"loss": good(0.81)})), None)
    assert "of 106 enough would" in _missing("eve", tally(around(1.0, trials=105)), unknown)
    assert "enough would" not in _missing("eve", tally(around(1.0, trials=106)), unknown)


@pytest.mark.parametrize(
    ("first_loss", "relative"), [(0.5, Claim.HELD), (0.0, Claim.HELD), (math.nan, Claim.UNDECIDED)]
)
def test_a_recorded_link_is_judged_by_its_own_fraction_of_losses(first_loss: float, relative: Claim) -> None:
    """Enough trials lose the first packet of an unstable process; where nobody knows how many, none are enough."""
    process = Process(np.array([[1.5]]), np.array([[1.0]]), np.array([[1.0]]))
    recorded = Expectation(process, None, None, recorded_loss=first_loss)
    known = expectation(good(0.9), 0.5)
    result = entry((tally(around(0.1)), recorded), ("eve", tally(around(50.0)), known))
    assert result.relative == relative
    never = "no theory bounds the error of legitimate in them, however many trials there are;"
    assert (never in result.sentence) == math.isnan(first_loss)


def test_the_first_loss_of_a_recording() -> None:
    """A start at random loses as many first packets as the recording has losses; a link that also delays is not known."""
    trace = {"model": "trace", "outcomes": "0111", "random_start": True}
    losses = {
        0.25: {"loss": trace},
        0.125: {"quality": 0.875},
        math.nan: {"loss": trace, "delay": {"model": "constant", "value": 1.0}},
    }
    for expected, link in losses.items():
        scenario = load("vehicle", {"legitimate": {"link": link}})
        first = expectations_of(scenario)["legitimate"].first_loss
        assert first == pytest.approx(expected, nan_ok=True)


def test_a_late_first_packet_is_not_lost() -> None:
    """It counts if it comes within the window, unless the receiver is down; one that comes later is as good as lost."""
    link = {"quality": 0.875, "delay": {"model": "constant", "value": 1.0}}
    down = [{"from": 0, "to": 2, "kill": "legitimate"}]
    timely = {"quality": 0.875}
    for expected, table, event in (
        (0.125, {"link": link, "window": 1}, []),
        (1.0, {"link": link}, []),
        (1.0, {"link": timely, "window": 1}, down),
    ):
        scenario = load("vehicle", {"legitimate": table, "event": event})
        assert expectations_of(scenario)["legitimate"].first_loss == pytest.approx(expected)


def test_a_replayed_recording_is_in_the_verdict_and_warned_of() -> None:
    """Intervals of trials with the same losses hold for these; a random start has neither, nor a single trial."""
    trace = {"model": "trace", "outcomes": "0111" * 100}
    for random_start, trials, replayed in ((False, 30, True), (True, 30, False), (False, 1, False)):
        link = {"loss": {**trace, "random_start": random_start}}
        scenario = load("vehicle", {"slots": 100, "trials": trials, "legitimate": {"link": link}})
        *_, verdict = verdicts(scenario, tally_of(scenario).tallies, expectations_of(scenario))
        assert verdict is not None
        assert (", given this recording of losses" in verdict.sentence) == replayed
        warned = "the first 100 of 400 recorded outcomes" in " ".join(warnings_of(scenario))
        assert warned == replayed
        assert ("400 recorded" in " ".join(warnings_of(scenario, several=True))) == (not random_start)


def test_a_pattern_is_no_recording() -> None:
    """Nothing says that the verdict holds for recorded losses alone."""
    link = {"loss": {"model": "pattern", "outcomes": "0111" * 100}}
    scenario = load("vehicle", {"slots": 100, "trials": 30, "legitimate": {"link": link}})
    *_, verdict = verdicts(scenario, tally_of(scenario).tallies, expectations_of(scenario))
    assert verdict is not None
    assert "recording" not in verdict.sentence
    assert "recorded outcomes" not in " ".join(warnings_of(scenario))


def test_a_recording_on_the_link_of_an_eavesdropper_is_in_its_own_verdict() -> None:
    """And not in those on others."""
    link = {"loss": {"model": "trace", "outcomes": "0111" * 100}}
    scenario = load("vehicle", {"slots": 100, "trials": 30, "eavesdroppers.smart.link": link})
    _, each, _ = verdicts(scenario, tally_of(scenario).tallies, expectations_of(scenario))
    replaying = {compared.eavesdropper for compared in each if compared.replayed}
    assert replaying == {"smart"}


def test_one_trial_decides_nothing() -> None:
    """However far apart the errors are."""
    verdict = judged(tally(around(0.001, trials=1)), tally(around(9.0, trials=1)))
    assert verdict.relative == Claim.UNDECIDED
    assert verdict.sentence == "eve: theory promises relative secrecy"


def test_a_run_cut_short_decides_nothing() -> None:
    """Windows of a run that was interrupted are not whole."""
    verdict = judged(tally(around(0.001), done=40), tally(around(0.002), done=40))
    assert (verdict.relative, verdict.relative_by_theory) == (Claim.UNDECIDED, True)
    assert verdict.sentence == "eve: the run was cut short; theory promises relative secrecy"


def test_a_run_of_one_slot_needs_slots_and_not_trials() -> None:
    """The first slot is in no window, so that no number of trials could decide."""
    assert "eve: the run has too few slots;" in judged(tally(around(1.0), 1, 1), tally(around(2.0), 1, 1)).sentence


def test_a_run_that_measured_nothing_says_so() -> None:
    """An interrupt before the first slot is neither an infinite advantage nor a verdict."""
    verdict = judged(tally(around(0.0), done=0), tally(around(0.0), done=0))
    assert verdict.sentence == "eve: nothing was measured; theory promises relative secrecy"
    assert verdict.relative == Claim.UNDECIDED


@pytest.mark.parametrize("slots", [1, 2, 5, 8])
def test_fewer_slots_than_windows_are_judged_by_those_there_are(slots: int) -> None:
    """Windows without slots are left out; without any window there is no verdict."""
    legitimate, other = (tally(around(level), slots, slots) for level in (10.0, 20.0))
    means = window_means(legitimate)
    assert np.isnan(means).any(axis=1).sum() == WINDOWS - min(WINDOWS, slots - 1)
    expected = Claim.HELD if slots > 1 else Claim.UNDECIDED
    assert judged(legitimate, other).relative == expected


@pytest.mark.parametrize("slots", [1, 2, 5, 8, 9, 10, 100, 1001])
def test_windows_cover_the_slots_from_one_on_evenly(slots: int) -> None:
    """Every slot k ≥ 1 is in one window, in order, and lengths differ by one slot at most."""
    windows = window_of(np.arange(slots), slots)
    assert windows[0] == -1
    assert list(windows[1:]) == sorted(windows[1:])
    lengths = np.bincount(windows[1:], minlength=WINDOWS)
    assert lengths.sum() == slots - 1
    assert len(lengths) == WINDOWS
    assert lengths.max() - lengths.min() <= 1


@pytest.mark.parametrize(
    ("levels", "verdict"),
    [
        (np.linspace(1.0, 9.0, WINDOWS), Claim.HELD),
        (np.linspace(9.0, 1.0, WINDOWS), Claim.FAILED),
    ],
    ids=["grows", "falls"],
)
def test_perfect_secrecy_asks_for_growth(levels: Floats, verdict: Claim) -> None:
    """Where theory says that the eavesdropper's error has no bound, the run must show it growing."""
    result = judged(tally(around(1e-5)), tally(around(levels)), use_innovation=1.0)
    assert result.perfect_by_theory
    assert result.perfect == verdict


def test_perfect_secrecy_asks_for_a_bounded_legitimate_error() -> None:
    """Growth is worth nothing when the legitimate error is beyond its own bound."""
    levels = np.linspace(1.0, 9.0, WINDOWS)
    assert judged(tally(around(5.0)), tally(around(levels)), use_innovation=1.0).perfect == Claim.FAILED


def test_perfect_secrecy_is_not_claimed_where_theory_denies_it() -> None:
    """A smart eavesdropper of a marginally stable process is bounded, whatever a run shows."""
    result = judged(tally(around(0.001)), tally(around(np.linspace(1.0, 9.0, WINDOWS))))
    assert (result.perfect_by_theory, result.perfect) == (False, Claim.FAILED)


def test_theory_of_relative_secrecy_needs_a_worse_eavesdropper() -> None:
    """An eavesdropper with a perfect link is better off than a legitimate estimator with a poor one, and theory says so."""
    legitimate, other = tally(around(0.001)), tally(around(0.002))
    expected = expectation(good(0.3), 0.9), expectation(good(1.0), 0.9, (1.0, 0.0))
    assert not entry((legitimate, expected[0]), ("eve", other, expected[1])).relative_by_theory
    assert judged(legitimate, other).relative_by_theory


def test_theory_of_secrecy_knows_bursts() -> None:
    """Behind a link that loses in bursts the claims of theory are those of its chain."""
    legitimate, other = tally(around(1e-5)), tally(around(np.linspace(1.0, 9.0, WINDOWS)))
    smart, naive = expectation(BURSTS, 0.5, (1.0, 0.0)), expectation(BURSTS, 0.5, (1.0, 1.0))
    result = entry((legitimate, expectation(BURSTS, 0.5)), ("eve", other, smart))
    assert (result.relative_by_theory, result.perfect_by_theory, result.perfect) == (True, False, Claim.FAILED)
    result = entry((legitimate, expectation(BURSTS, 0.5)), ("eve", other, naive))
    assert (result.relative_by_theory, result.perfect_by_theory, result.perfect) == (True, True, Claim.HELD)


@pytest.mark.parametrize("links", [(ROTE, good(0.5)), (good(0.9), ROTE), (ROTE, ROTE)])
def test_where_there_is_no_theory_the_run_alone_is_judged(links: tuple[dict[str, Any], dict[str, Any]]) -> None:
    """Neither claim of theory is made, and the sentence says so; what the run shows is said all the same."""
    legitimate, other = tally(around(1e-5)), tally(around(np.linspace(1.0, 9.0, WINDOWS)))
    expected = expectation(links[0], 0.5), expectation(links[1], 0.5, (1.0, 0.0))
    result = entry((legitimate, expected[0]), ("eve", other, expected[1]))
    assert (result.relative_by_theory, result.perfect_by_theory) == (None, None)
    assert (result.relative, result.perfect) == (Claim.HELD, Claim.HELD)
    assert result.sentence.endswith("no theory covers these links")
    bounded = "stayed bounded" if links[0] == good(0.9) else "did not"
    assert f"its error grew while the legitimate one {bounded};" in result.sentence
    nothing = entry((tally(around(0.0), done=0), expected[0]), ("eve", tally(around(0.0), done=0), expected[1]))
    assert nothing.sentence == "eve: nothing was measured; no theory covers these links"


def test_an_error_without_a_known_bound_must_not_grow() -> None:
    """If both errors grow, the legitimate error may be unbounded, too; with a known bound it may grow up to that."""
    legitimate, other = tally(around(np.linspace(1e-5, 2e-5, WINDOWS))), tally(around(np.linspace(1.0, 9.0, WINDOWS)))
    unknown = expectation(ROTE, 0.5), expectation(good(0.5), 0.5, (1.0, 1.0))
    result = entry((legitimate, unknown[0]), ("eve", other, unknown[1]))
    assert (result.relative, result.perfect) == (Claim.HELD, Claim.UNDECIDED)
    assert "its error was larger in every window" in result.sentence
    assert judged(legitimate, other, use_innovation=1.0).perfect == Claim.HELD


def test_an_error_that_approaches_its_limit_from_above_is_within_its_bound() -> None:
    """It may be as large as theory expects in the last windows of the run."""
    settling = Process(np.eye(1), np.eye(1) * 1e-5, np.eye(1) * 100.0)
    link = distribution_of(LinkSchedule({"loss": good(0.8)}))
    ours = Expectation(settling, link, lambda quality: Outcomes.legitimate(quality, 0.1))
    theirs = Expectation(settling, link, lambda quality: Outcomes.eavesdropper(quality, 0.1, 1.0, 1.0))
    by_slot = ours.traces(SLOTS)
    means = np.bincount(window_of(np.arange(1, SLOTS), SLOTS), by_slot[1:]) / np.bincount(
        window_of(np.arange(1, SLOTS), SLOTS)
    )
    assert means[-1] > 1.5 * ours.limit
    other = tally(around(np.linspace(1.0, 9.0, WINDOWS)))
    for factor, verdict in ((1.0, Claim.HELD), (2.0, Claim.FAILED)):
        result = entry((tally(around(factor * means)), ours), ("eve", other, theirs))
        assert result.perfect_by_theory
        assert result.perfect == verdict


def test_the_limit_of_a_mere_model_bounds_no_error_of_a_run() -> None:
    """The legitimate error must then not grow, and may be larger than the model has it."""
    other = tally(around(np.linspace(1.0, 9.0, WINDOWS)))
    ours, theirs = (replace(expectation(good(0.9), 0.5, uses), of_model=True) for uses in (None, (1.0, 1.0)))
    for levels, verdict in ((0.5, Claim.HELD), (np.linspace(0.1, 0.9, WINDOWS), Claim.UNDECIDED)):
        assert entry((tally(around(levels)), ours), ("eve", other, theirs)).perfect == verdict


def test_a_bound_from_below_can_promise_and_cannot_deny() -> None:
    """Without a closed form, the genie is a bound: secrecy that holds against the genie holds; otherwise it is left open."""
    legitimate, other = tally(around(1e-5)), tally(around(np.linspace(1.0, 9.0, WINDOWS)))

    def judged_(process: Process, mu: float, mu_e: float) -> SecrecySummary:
        ours = Expectation(
            process,
            distribution_of(LinkSchedule({"loss": good(mu)})),
            lambda quality: Outcomes.legitimate(quality, 0.6),
        )
        chain = distribution_of(LinkSchedule({"loss": good(mu_e)}))
        theirs = Expectation(process, chain, None, lambda quality: Outcomes.genie(quality, 0.6))
        assert np.isnan(theirs.traces(3)).all()
        return entry((legitimate, ours), ("eve", other, theirs))

    unstable = Process(np.array([[1.0, 0.3], [0.5, 1.001]]), np.eye(2) * 1e-3, np.eye(2))
    for process, mu_e, relative, perfect in (
        (STABLE, 0.9, True, None), (STABLE, 1.0, None, None), (unstable, 0.8, True, True), (unstable, 0.9, True, None),
    ):  # fmt: skip
        verdict = judged_(process, 0.9, mu_e)
        assert (verdict.relative_by_theory, verdict.perfect_by_theory) == (relative, perfect)
        assert verdict.judged_by == ("median" if process is unstable else "mean")
        promise = (
            "perfect secrecy" if perfect else "relative secrecy" if relative else "relative secrecy from slot 7 on"
        )
        assert verdict.sentence.endswith(f"theory promises {promise}")
    nothing = Expectation(STABLE, distribution_of(LinkSchedule({"loss": good(0.9)})), None)
    verdict = entry((legitimate, expectation(good(0.9), 0.5)), ("eve", other, nothing))
    assert verdict.sentence.endswith("no closed form of its error is known")


def test_rounding_on_a_perfect_link_is_no_failure() -> None:
    """With μ = 1 the legitimate bound is exactly 0; what rounding leaves of the error does not break perfect secrecy."""
    growing = around(np.geomspace(1.0, 1e6, WINDOWS))
    legitimate, other = tally(around(1e-20)), tally(growing)
    perfect = Expectation(
        STABLE, distribution_of(LinkSchedule({"loss": good(1.0)})), lambda quality: Outcomes.legitimate(quality, 0.5)
    )
    misled = expectation(good(0.5), 0.5, (1.0, 1.0))
    assert entry((legitimate, perfect), ("eve", other, misled)).perfect == Claim.HELD


@pytest.mark.parametrize("slots", [SLOTS, 5])
@pytest.mark.parametrize("levels", [(0.0, 0.0), (1e-28, 3e-28)])
def test_errors_that_are_both_rounding_are_equal(slots: int, levels: tuple[float, float]) -> None:
    """Their ratio means nothing; that of an error to one of rounding is infinite."""
    perfect = expectation(good(1.0), 0.5), expectation(good(1.0), 0.5, (1.0, 1.0))
    ours, theirs = (tally(around(level), done=slots, slots=slots) for level in levels)
    result, compared = secrecy((ours, perfect[0]), ("eve", theirs, perfect[1]))
    assert result.ratio == 1.0
    assert compared.after_start.ratio == 1.0
    larger = tally(around(1.0), done=slots, slots=slots)
    _, compared = secrecy((ours, perfect[0]), ("eve", larger, perfect[1]))
    assert math.isinf(compared.after_start.ratio)


def test_one_slot_proves_nothing() -> None:
    """Theory claims relative secrecy for slots k ≥ 1, and a run of one slot has none."""
    tally_ = Tally(1, 3)
    tally_.done, tally_.offered, tally_.error = 1, 3, 1.0
    result = entry((tally_, expectation(good(0.9), 0.5)), ("eve", tally_, expectation(good(0.9), 0.5, (1.0, 0.0))))
    assert result.relative_by_theory is False


def test_equal_receivers_are_computed_once() -> None:
    """Theory of many equal eavesdroppers takes no longer than that of a single one; those that differ have their own."""
    first, second, other = (expectation(good(mu_e), 0.5, (1.0, 0.25)) for mu_e in (0.5, 0.5, 0.6))
    assert first.alike == second.alike
    assert first.alike != other.alike
    unstable = Expectation(Process(np.eye(2) * 1.1, STABLE.Q, STABLE.initial_covariance), first.link, first.outcomes_at)
    assert first.alike != unstable.alike
    bursty = expectation(BURSTS, 0.5)
    assert bursty.alike != bursty.alike  # no key says that two such links are equal
    rare = [rare_events_of(expected, tally(around(1.0))) for expected in (first, second, other)]
    assert rare[0] is rare[1]
    streaks = other.streaks(SLOTS)
    assert rare[2] is not None
    assert streaks is not None
    assert rare[2].fraction == streaks.fraction(TRIALS)
