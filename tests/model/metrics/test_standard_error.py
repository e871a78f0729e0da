"""Standard errors, z and rare events: of every metric, against the recorded trials, and calibrated over many studies."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kurtosis, norm, skew
from scipy.stats import t as student

from evedrop.cli.api import montecarlo, run
from evedrop.cli.report import print_summary
from evedrop.model.metrics.built_in import UsedFraction
from evedrop.model.metrics.metric import MeanMetric, ScoredSlots
from evedrop.model.metrics.standard_error import ratio_error, standard_error, z_of
from evedrop.model.metrics.text import estimate
from evedrop.model.process import Floats
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import expectations_of
from evedrop.score.scorekeeper import RunOutcome
from evedrop.score.summary import RARE_FRACTION, Summary
from evedrop.score.sums import Tally
from evedrop.show.report.closing import receivers_table
from evedrop.simulate.montecarlo import Merger, Plan
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import carry_out, tasks_of
from tests.builders import scalar_tables
from tests.cli.terminal import Terminal
from tests.examples import mostly_long

ALONE = Plan(workers=1)


def of_trials(results: Results, receiver: str, value: Callable[[dict[str, Any]], float]) -> Floats:
    """The mean over slots of a value of the recorded rows, for every trial, (R,)."""
    sums = np.zeros(results.summary["trials"])
    for row in results.trials.to_pylist():
        if row["peer"] == receiver:
            sums[row["trial"] - results.summary["first_trial"]] += value(row)
    means: Floats = sums / results.summary["slots"]
    return means


def textbook(means: Floats) -> float:
    """The standard error of a mean of independent numbers."""
    return math.sqrt(sum((mean - means.mean()) ** 2 for mean in means) / (len(means) - 1) / len(means))


def textbook_z(means: Floats, expected: float) -> float:
    """Hall's transformation of the t statistic, read as Student's t with the degrees of freedom of the variance's own error."""
    t, a = (means.mean() - expected) / textbook(means), skew(means) / math.sqrt(len(means))
    statistic = t + a * t**2 / 3 + a**2 * t**3 / 27 + a / 6
    freedom = min(len(means) - 1, 2 * len(means) / (max(kurtosis(means), 0.0) + 2))
    return float(norm.ppf(student.cdf(statistic, freedom)))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Seven trials in memory, all recorded."""
    folder = tmp_path_factory.mktemp("recorded")
    return montecarlo("eavesdroppers", slots=300, trials=7, record_trials=7, out=folder, plan=ALONE, expect=[])


@pytest.mark.parametrize("receiver", ["legitimate", "naive", "suspicious", "smart"])
def test_standard_errors_are_those_of_the_trials_means(recorded: Results, receiver: str) -> None:
    """Of every metric that is estimated, from the rows of the recorded trials; z is the distance from theory in them."""
    peer = recorded.summary["peers"][receiver]
    values: dict[str, Callable[[dict[str, Any]], float]] = {
        "mean_squared_error": lambda row: float(row["squared_error"]),
        "mean_trace_covariance": lambda row: float(row["trace_covariance"]),
        "received_fraction": lambda row: float(row["action"] != "dropped"),
        "used_fraction": lambda row: float(row["action"] not in ("dropped", "discarded")),
    }
    expected = {name: of_trials(recorded, receiver, value) for name, value in values.items()}
    assert list(peer["standard_errors"]) == list(expected)
    for name, means in expected.items():
        assert peer[name] == pytest.approx(means.mean(), rel=1e-12), name
        assert peer["standard_errors"][name] == pytest.approx(textbook(means), rel=1e-9), name
    z = textbook_z(expected["mean_squared_error"], peer["theoretical_trace_covariance"])
    if peer["rare_events"]["fraction"] > RARE_FRACTION:
        assert peer["z"] == {"mean_squared_error": None}
    else:
        assert peer["z"] == {"mean_squared_error": pytest.approx(z, rel=1e-6)}
    assert (receiver == "naive") == (peer["rare_events"]["fraction"] <= RARE_FRACTION)


def test_late_packets_count_in_the_trials_too() -> None:
    """A packet that comes late is received in its trial: the mean of the trials is the metric."""
    scenario = load("late", {"slots": 200, "trials": 6, "expect": []})
    run_tally = merged(scenario).run_tally
    for name, tally in run_tally.tallies.items():
        for metric in ("received_fraction", "used_fraction"):
            means = tally.of_trials(metric)
            assert means is not None
            assert means.mean() == pytest.approx(tally.metric(metric), rel=1e-12), (name, metric)
    assert any(tally.late for tally in run_tally.tallies.values())


@pytest.mark.long
def test_a_live_run_has_the_standard_errors_of_memory(recorded: Results, tmp_path: Path) -> None:
    """In shards too, and to the bit for the reported covariance, whether all trials are recorded or not."""
    some: dict[str, Any] = {"slots": 300, "trials": 7, "expect": [], "view": "off"}
    live = run("eavesdroppers", record_trials=7, shards=2, out=tmp_path / "live", **some)
    others = run("eavesdroppers", record_trials=1, out=tmp_path / "others", **some)
    for name, peer in recorded.summary["peers"].items():
        same, unrecorded = (results.summary["peers"][name] for results in (live, others))
        assert same["standard_errors"] == pytest.approx(peer["standard_errors"], rel=1e-9)
        assert same["z"].keys() == peer["z"].keys()
        for metric, z in peer["z"].items():
            assert same["z"][metric] == (None if z is None else pytest.approx(z, rel=1e-6))
        assert same["rare_events"] == peer["rare_events"]
        assert unrecorded["standard_errors"] == pytest.approx(peer["standard_errors"], rel=1e-9)
        for peers in (same, unrecorded):
            reported = peers["standard_errors"]["mean_trace_covariance"]
            assert reported == peer["standard_errors"]["mean_trace_covariance"]
            assert reported is not None


def test_workers_do_not_change_standard_errors() -> None:
    """Two tasks of several blocks and one of all give the same bits."""
    scenario = load("eavesdroppers", {"slots": 20, "trials": 1100, "expect": []})
    single, three = (summary_of_study(scenario, workers) for workers in (1, 3))
    assert single.peers == three.peers


def test_one_trial_has_no_standard_error() -> None:
    """Its slots depend on each other, so it has no z either."""
    summary = summary_of_study(load("eavesdroppers", {"slots": 50, "trials": 1, "expect": []}))
    for peer in summary.peers.values():
        assert set(peer.standard_errors.values()) | set(peer.z.values()) == {None}


def test_rounding_has_no_z() -> None:
    """Over a perfect link the legitimate error is only rounding, however far that is above 0; the ratio is infinite."""
    changes = {"legitimate.link.quality": 1.0, "slots": 100, "trials": 50, "expect": []}
    summary = summary_of_study(load("eavesdroppers", changes))
    legitimate = summary.peers["legitimate"]
    assert 0.0 < legitimate.metrics["mean_squared_error"] < 1e-25  # type: ignore[operator]
    assert legitimate.z == {"mean_squared_error": None}
    assert summary.secrecy["naive"].ratio is None
    verdict = summary.secrecy["naive"].verdict
    assert verdict is not None
    assert verdict.times == "∞ ×"


def test_infinite_variance_leaves_only_counts_a_standard_error() -> None:
    """The error and the reported covariance have none, and no z."""
    peer = summary_of_study(load("numerical", {"trials": 20, "expect": []})).peers["smart"]
    assert peer.infinite_variance
    assert {name for name, error in peer.standard_errors.items() if error is None} == {
        "mean_squared_error",
        "mean_trace_covariance",
    }
    assert peer.z == {"mean_squared_error": None}


def test_a_covariance_only_study_has_the_z_of_its_own_metric() -> None:
    """The mean actual trace is compared with theory; there is no squared error."""
    scenario = load("eavesdroppers", {"slots": 50, "trials": 20, "expect": []})
    peer = summary_of_study(scenario, mode=Mode.COVARIANCE_ONLY).peers["naive"]
    error, z = peer.standard_errors["mean_actual_trace_covariance"], peer.z["mean_actual_trace_covariance"]
    metric, expected = peer.metric("mean_actual_trace_covariance"), peer.metric("theoretical_trace_covariance")
    assert None not in (error, z, metric, expected)
    assert z * (metric - expected) > 0.0  # type: ignore[operator]
    assert peer.standard_errors["mean_squared_error"] is peer.z["mean_squared_error"] is None
    assert peer.standard_errors["mean_trace_covariance"] is not None


def test_trials_that_were_cut_short_have_no_standard_errors() -> None:
    """Where they reached different slots; before the first slot there are none either."""
    tally = Tally(9, 3)
    assert tally.standard_error("mean_squared_error") is None
    tally.done, tally.offered = 4, 4 * 3
    tally.window_errors[0] = 1.0, 2.0, 4.0
    assert tally.standard_error("mean_squared_error") == pytest.approx(
        np.std([0.25, 0.5, 1.0], ddof=1) / math.sqrt(3.0)
    )
    tally.offered += 1
    assert tally.standard_error("mean_squared_error") is None


def test_a_metric_that_is_not_known_trial_by_trial_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mean that is kept for all trials together, and tallies that say nothing about trials."""

    class KeptFraction(MeanMetric):
        by_trial = False

        @staticmethod
        def values(slots: ScoredSlots) -> Floats:
            return slots.error

    tally = Tally(9, 3, done=4, offered=12)
    monkeypatch.setattr("evedrop.score.sums.metric", lambda _: KeptFraction)
    assert tally.of_trials("kept") is None
    monkeypatch.setattr("evedrop.score.sums.metric", lambda _: UsedFraction)
    assert tally.of_trials("used") is not None
    monkeypatch.setattr(UsedFraction, "trial_sums", None)
    assert tally.of_trials("used") is None


@pytest.mark.parametrize("kept_by_trial", [True, False])
def test_trials_that_were_cut_short_count_by_their_slots(kept_by_trial: bool) -> None:
    """A metric that is 2 in every slot is 2, whatever slots the trials have."""

    class Two(MeanMetric):
        by_trial = kept_by_trial

        @staticmethod
        def values(slots: ScoredSlots) -> Floats:
            twos = np.full_like(slots.error, 2.0)
            return twos if kept_by_trial else twos.sum(axis=1, keepdims=True)

    parts = []
    for slots, trials in ((3, 2), (30, 5), (0, 4)):
        tally = Two.tally(trials)
        one = np.ones(slots)
        tally.add(ScoredSlots(0, np.ones((slots, trials)), np.zeros((slots, trials), np.uint8), one, one))
        parts.append(tally)
    whole = type(parts[0]).merged(parts)
    assert whole.value == 2.0
    assert whole.of_trials is None
    assert (parts[0].of_trials is not None) is kept_by_trial
    assert parts[2].value is None


def test_a_summary_of_an_older_version_can_be_read(recorded: Results) -> None:
    """Its receivers have no standard errors."""
    text = json.loads(json.dumps(recorded.summary))
    for peer in text["peers"].values():
        for name in ("standard_errors", "z", "rare_events"):
            del peer[name]
    peer = Summary.read(text).peers["smart"]
    assert (peer.standard_errors, peer.z, peer.rare_events) == ({}, {}, None)
    assert peer.metrics == recorded.typed_summary.peers["smart"].metrics
    assert len(receivers_table(Summary.read(text)).rows) == 4


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.012345, 0.00041, "0.0123 ± 0.0004"),
        (0.0123, 0.00096, "0.012 ± 0.001"),
        (3453.02, 401.1, "3453 ± 401"),
        (7.5, 0.22, "7.5 ± 0.2"),
        (0.9000123, 0.000073, "0.90001 ± 0.00007"),
        (0.00040389, 0.0000115, "4.0e-4 ± 1e-5"),
        (2.6e7, 5.7e6, "2.6e7 ± 6e6"),
        (-1e6, 2e8, "-1e6 ± 2e8"),
        (0.0, 1e-9, "0e0 ± 1e-9"),
        (0.25, None, "0.25"),
        (0.25, 0.0, "0.25"),
        (math.inf, 1.0, "inf"),
        (2.0, math.inf, "2 ± ∞"),
        (2.0, math.nan, "2"),
        (None, None, "–"),
    ],
)
def test_an_estimate_has_the_digits_of_its_error(value: float | None, error: float | None, text: str) -> None:
    """A digit of the error, and the estimate to its place; small and large ones with exponents."""
    assert estimate(value, error) == text


@given(
    st.floats(-1e300, 1e300),
    st.floats(0.0, allow_infinity=False) | st.floats(1e-17, 1e-5),
    st.booleans(),
)
def test_an_estimate_is_never_wide(value: float, error: float, relative: bool) -> None:
    """However small or large its error is, a table keeps its shape, and the metric has its significant digits."""
    error = error * abs(value) if relative else error
    text = estimate(value, error)
    shown, _, after = text.partition(" ± ")
    assert len(shown) <= 16
    assert len(after) <= 8
    assert float(shown) == pytest.approx(value, abs=max(error, 5e-4 * abs(value) if not after else 5e-8 * abs(value)))


def test_trials_with_equal_losses_have_no_error_of_rounding(tmp_path: Path) -> None:
    """A trace from its beginning is the same in every trial: the table shows its fraction without an error of 1e-17."""
    outcomes = "1" * 106 + "0" * 19
    loss: dict[str, Any] = {"legitimate.link": {"loss": {"model": "trace", "outcomes": outcomes}}}
    done = montecarlo("eavesdroppers", slots=125, trials=30, out=tmp_path / "x", plan=ALONE, expect=[], **loss)
    errors = done.summary["peers"]["legitimate"]["standard_errors"]
    assert estimate(0.848, errors["received_fraction"]) == estimate(0.848, 1.1e-17) == "0.848"


def test_a_standard_error_needs_finite_trials() -> None:
    """Two of them at least; z needs an error above 0."""
    assert standard_error(None) is standard_error(np.ones(1)) is None
    assert standard_error(np.array([1.0, math.inf])) is standard_error(np.array([1e200, -1e200])) is None
    assert standard_error(np.array([1.0, 3.0])) == 1.0
    some = np.array([1.0, 3.0])
    assert z_of(np.ones(4), 2.0) is z_of(some, None) is z_of(None, 2.0) is z_of(some, math.inf) is None
    assert z_of(np.array([1.0, math.inf]), 2.0) is None
    assert z_of(some, 2.0) == pytest.approx(0.0, abs=1e-12)


def test_trials_that_are_all_equal_have_no_z_score() -> None:
    """Although the mean of as many equal numbers is rounded, and theory's expectation is rounded in another way."""
    for trials in (3, 100, 1500):
        for value in (0.1, 0.3, 1.7, math.pi):
            assert standard_error(np.full(trials, value)) == 0.0
            assert z_of(np.full(trials, value), value * (1.0 + 2e-16)) is None


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_z_score_is_that_of_the_textbook(sign: float) -> None:
    """For skewed trials and for others, on both sides; it has the sign of the distance however far the mean is off."""
    random = np.random.default_rng(5)
    for means in (sign * random.exponential(size=300), random.normal(size=50)):
        for expected in (means.mean() - 0.2, means.mean() - 0.01, means.mean() + 0.1):
            assert z_of(means, expected) == pytest.approx(textbook_z(means, expected), rel=1e-9)
    far = z_of(random.normal(size=2000), sign * 1e6)
    assert far is not None
    assert math.isfinite(far)
    assert far * sign < -30.0


def test_the_error_of_a_ratio_is_that_of_leaving_trials_out() -> None:
    """The jackknife agrees to a per cent; the numerator and the denominator are of the same trials."""
    random = np.random.default_rng(4)
    under = random.exponential(size=400) + 1.0
    over = 3.0 * under + random.normal(size=400)
    left = (over.sum() - over) / (under.sum() - under)
    jackknife = math.sqrt(399 / 400 * ((left - left.mean()) ** 2).sum())
    assert ratio_error(over, under) == pytest.approx(jackknife, rel=0.01)
    assert ratio_error(over, 0.0 * under) is None
    assert ratio_error(over[:1], under[:1]) is None


def report_of(summary: Summary, capsys: pytest.CaptureFixture[str]) -> str:
    """The closing report of a summary."""
    print_summary(summary, "folder", verbose=True)
    return capsys.readouterr().out


def test_the_report_says_where_rare_events_carry_the_error(capsys: pytest.CaptureFixture[str]) -> None:
    """A first packet that is lost once in a thousand trials: a sentence in 40 trials, none in 20,000, none in one."""
    tables = scalar_tables(0.5, 1e-9, encoding={"scheme": "plain"}, legitimate={"link": {"quality": 0.999}}, slots=5)
    few, many, single = (
        summary_of_study(Scenario.read({**tables, "trials": trials, "seed": 2})) for trials in (40, 20_001, 1)
    )
    rare = few.peers["legitimate"].rare_events
    assert rare is not None
    assert rare.fraction > 0.9
    assert rare.trials == 20_000
    message = (
        "more than 99 % of its expected error is carried by events that are expected fewer than 20 times in 40 trials"
    )
    assert message in report_of(few, capsys)
    print_summary(few, "folder")
    assert "1 of the means above is uncertain; --verbose says why" in capsys.readouterr().out
    quantiles = dict.fromkeys(("0.05", "0.5", "0.95"), 1.0)
    twice = replace(few.peers["legitimate"], infinite_variance=True, error_quantiles=quantiles)
    print_summary(replace(few, peers={**few.peers, "legitimate": twice}), "folder")
    assert "1 of the means above is uncertain" in capsys.readouterr().out, "two doubts about one mean"
    assert many.peers["legitimate"].rare_events is not None
    assert many.peers["legitimate"].rare_events.fraction < RARE_FRACTION
    for summary in (many, single):
        assert "is carried by events" not in report_of(summary, capsys)


def test_the_report_has_the_standard_errors_of_a_loop(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Of both estimators and of the application; a summary of an older version has none, and is reported all the same."""
    results = montecarlo("heated-room", slots=300, trials=5, out=tmp_path / "run", plan=ALONE, expect=[])
    text = report_of(results.typed_summary, capsys)
    lines = [line for line in text.splitlines() if line.startswith(("controller", "the room", "fraction of"))]
    assert [line.count(" ± ") for line in lines] == [2, 2, 3]
    older = json.loads(json.dumps(results.summary))
    for name in ("controller", "comfort"):
        del older[name]["standard_errors"]
    lines = [
        line for line in report_of(Summary.read(older), capsys).splitlines() if line.startswith(("contr", "the room"))
    ]
    assert [line.count(" ± ") for line in lines] == [0, 0]


@pytest.mark.thorough
def test_the_ratio_of_a_verdict_has_a_standard_error(recorded: Results, tmp_path: Path) -> None:
    """That of the trials' pairs of means in the second half; none for one trial, nor where an error has infinite variance."""
    legitimate, other = (
        of_trials(recorded, name, lambda row: float(row["squared_error"]) if row["slot"] >= 151 else 0.0)
        for name in ("legitimate", "smart")
    )
    ratio, error = other.mean() / legitimate.mean(), ratio_error(other, legitimate)
    secrecy = recorded.summary["secrecy"]["smart"]
    assert secrecy["ratio_from"] == 151
    assert (secrecy["ratio"], secrecy["ratio_standard_error"]) == (pytest.approx(ratio), pytest.approx(error))
    for scenario, trials in (("eavesdroppers", 1), ("numerical", 5)):
        alone = montecarlo(scenario, slots=50, trials=trials, out=tmp_path / scenario, plan=ALONE, expect=[])
        assert " ± " not in alone.summary["secrecy"]["smart"]["sentence"]


def test_rare_events_are_those_of_theory(recorded: Results) -> None:
    """For a link with a memory and a genie, too; unknown without a closed form and for late packets."""
    for name, scenario in (
        ("legitimate", "bursts"),
        ("genie", "bayesian"),
        ("bayesian", "bayesian"),
        ("legitimate", "late"),
    ):
        rare = summary_of_study(load(scenario, {"slots": 30, "trials": 3, "expect": []})).peers[name].rare_events
        assert (rare is None) == (name == "bayesian" or scenario == "late")
    for name, expected in expectations_of(load(recorded.folder)).items():
        streaks = expected.streaks(300)
        assert streaks is not None
        assert recorded.summary["peers"][name]["rare_events"] == {
            "fraction": streaks.fraction(7),
            "trials": streaks.trials_for(RARE_FRACTION),
        }


def test_the_closing_table_fits_80_columns(recorded: Results, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the standard error and z of the error; in a wide terminal every metric has its standard error."""
    shown = {}
    for width in (80, 140):
        terminal = Terminal()
        monkeypatch.setattr(sys, "stdout", terminal)
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setenv("TERM", "dumb")
        print_summary(recorded.typed_summary, "folder")
        rows = [
            line
            for line in terminal.getvalue().splitlines()
            if line.split()[:1] and line.split()[0] in recorded.summary["peers"]
        ]
        shown[width] = "\n".join(rows[:4])
    assert max(map(len, shown[80].splitlines())) <= 80
    assert "…" not in shown[80]
    assert shown[80].count(" ± ") == 4
    assert shown[140].count(" ± ") == 4 * 4


def merged(scenario: Scenario, workers: int = 1, mode: Mode = Mode.EXACT) -> Merger:
    """The trials of a scenario, in as many tasks as for this many workers."""
    merger = Merger(scenario, mode)
    for task in tasks_of(scenario, mode, workers):
        merger.add_batch(carry_out(task, lambda _: None, lambda: False))
    return merger


def summary_of_study(scenario: Scenario, workers: int = 1, mode: Mode = Mode.EXACT) -> Summary:
    """The summary of a study, in memory."""
    return merged(scenario, workers, mode).summary(RunOutcome(1.0))


STUDY_TRIALS = 200


def z_of_studies(count: int) -> Floats:
    """Z of the legitimate and of a smart receiver's error in independent studies, (count, 2)."""
    tables = scalar_tables(
        0.7,
        1.0,
        eavesdroppers={"smart": {"strategy": "smart", "link": {"quality": 0.8}}},
        slots=30,
        trials=STUDY_TRIALS,
    )
    scores = []
    for study in range(count):
        peers = summary_of_study(Scenario.read({**tables, "first_trial": study * STUDY_TRIALS})).peers
        scores.append([peers[name].z["mean_squared_error"] for name in ("legitimate", "smart")])
    return np.array(scores)


def check_calibration(z: Floats) -> None:
    """Beyond 1.96 in 5 % of the studies: within the interval that contains a binomial count but once in a thousand."""
    from scipy.stats import binom

    for scores in z.T:
        outside = int(np.count_nonzero(np.abs(scores) > 1.96))
        low, high = binom.interval(0.999, len(scores), 0.05)
        assert low <= outside <= high, outside


@pytest.mark.parametrize("studies", mostly_long([50, 200, 1000], [50]))
def test_z_is_calibrated(studies: int) -> None:
    """Over many small studies of a process with light tails."""
    check_calibration(z_of_studies(studies))
