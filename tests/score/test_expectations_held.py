"""What was expected of a run: found as plain numpy finds it in the tables, alike live and in memory, and seen again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.cli.api import montecarlo, run
from evedrop.model.metrics.metric import ScoredSlots
from evedrop.model.receiver import Action
from evedrop.results.reading import Results
from evedrop.scenario.loading import load, with_event
from evedrop.scenario.theory import theoretical_traces_of
from evedrop.score.expectations_held import Evidence
from evedrop.score.leak import HeardBitsStream
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.score.secrecy import Claim
from evedrop.score.summary import Judged, LinkSummary, PeerSummary, SecrecySummary
from evedrop.score.sums import Tally
from evedrop.score.watched_tally import SYNCHRONISED, WatchedQuantity, WatchedTally
from evedrop.simulate.montecarlo import Merger, Plan
from evedrop.simulate.simulation import Mode, Simulation
from evedrop.simulate.trials import _empty_block, _score, carry_out, tasks_of
from tests.conftest import Evedrop

SLOTS, TRIALS, FIRST = 90, 12, 30
METRICS = ("mean_squared_error", "received_fraction", "used_fraction")
ON_SUSPICIOUS: list[dict[str, Any]] = [
    {"metric": f"suspicious.{metric}", **what, "above": 0.0}
    for metric in METRICS
    for what in ({}, {"slots": [FIRST, 70]}, {"quantile": 0.9}, {"slots": [FIRST, 70], "quantile": 0.9})
]
OTHERS: list[dict[str, Any]] = [
    {"metric": "naive.mean_trace_covariance", "slots": [FIRST, 70], "above": 0.0},
    {"metric": "naive.theoretical_trace_covariance", "slots": [FIRST, 70], "above": 0.0},
    {"metric": "links.naive.lost", "above": 0},
    {"metric": "links.naive.lost_by.cut", "above": 0},
    {"link": "naive"},
    {"secrecy": "relative", "against": "naive"},
    {"secrecy": "perfect", "against": "smart"},
    {"synchronised": "suspicious", "by": 80},
    {"synchronised": "suspicious", "by": 80, "since": FIRST},
    {"synchronised": "suspicious", "by": 0},
]
OPTIONS: dict[str, Any] = {"slots": SLOTS, "trials": TRIALS, "record_trials": TRIALS, "expect": ON_SUSPICIOUS + OTHERS}

Runs = Callable[[str], Results]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """The same run live and in memory, once for all tests."""

    @cache
    def runs(where: str) -> Results:
        ways: dict[str, Callable[..., Results]] = {"live": run, "memory": montecarlo}
        return ways[where]("eavesdroppers", out=tmp_path_factory.mktemp(where), **OPTIONS)

    return runs


def of_trials(results: Results, receiver: str) -> dict[str, Any]:
    """Columns of the receiver's rows, (slots, trials)."""
    rows = [row for row in results.trials.to_pylist() if row["peer"] == receiver]
    return {name: np.array([row[name] for row in rows]).reshape(SLOTS, TRIALS) for name in ("action", "squared_error")}


@pytest.mark.long
def test_live_and_memory_agree_on_every_expectation(made: Runs) -> None:
    """To the last bit, except for sums over all slots, and for the reported trace, which a live run sums over trials."""
    live, memory = (made(where).summary["expectations"] for where in ("live", "memory"))
    assert len(live) == len(OPTIONS["expect"])
    for expectation, other in zip(live, memory, strict=True):
        exact = (
            "slots" in expectation["text"] or "quantile" in expectation["text"]
        ) and "mean_trace" not in expectation["text"]
        exact = exact or not isinstance(expectation["value"], float)
        assert expectation["value"] == (other["value"] if exact else pytest.approx(other["value"], rel=1e-12))
        assert {key: expectation[key] for key in ("text", "held", "wanted")} == {
            key: other[key] for key in ("text", "held", "wanted")
        }
        assert ("replay" in expectation) == ("replay" in other) == (expectation["held"] is False)


def test_metrics_of_ranges_and_quantiles_are_those_of_the_table(made: Runs) -> None:
    """Mean over slots and trials, and quantile over trials of a trial's mean, by numpy from every recorded trial."""
    table = of_trials(made("memory"), "suspicious")
    received = table["action"] != "dropped"
    columns = {
        "mean_squared_error": table["squared_error"],
        "received_fraction": received,
        "used_fraction": received & (table["action"] != "discarded"),
    }
    for expect, expectation in zip(ON_SUSPICIOUS, made("memory").summary["expectations"], strict=False):
        means = columns[expect["metric"].split(".")[1]][slice(*expect.get("slots", (0, SLOTS)))].mean(axis=0)
        value = np.quantile(means, expect["quantile"]) if "quantile" in expect else means.mean()
        assert expectation["value"] == pytest.approx(value, rel=1e-12), expectation["text"]
        assert expectation["held"] is True


@pytest.mark.thorough
def test_other_expectations_are_those_of_tables_and_summary(made: Runs) -> None:
    """Traces over a range, a link's account, secrecy by theory and run, and the slot by which all were synchronised."""
    results = made("live")
    expectations = {expectation["text"]: expectation for expectation in results.summary["expectations"]}
    rows = [row for row in results.slots.to_pylist() if row["peer"] == "naive" and FIRST <= row["slot"] < 70]
    for metric in ("mean_trace_covariance", "theoretical_trace_covariance"):
        value = np.mean([row[metric] for row in rows])
        assert expectations[f"naive.{metric} over slots {FIRST} to 69 above 0"]["value"] == pytest.approx(
            value, rel=1e-12
        )
    assert expectations["links.naive.lost above 0"]["value"] == results.summary["links"]["naive"]["lost"]
    cut = expectations["links.naive.lost_by.cut above 0"]
    assert (cut["value"], cut["held"]) == (0, False)
    unknown = Judged(**{**cut, "value": None, "held": None})
    assert unknown.sentence.endswith(": FAILED, the run has no value for it")
    perfect = expectations["perfect secrecy against smart promised by theory and shown by the run"]
    assert (perfect["held"], perfect["value"]) == (False, "theory denies it, the run shows that it fails")
    states = np.isin(of_trials(results, "suspicious")["action"], ("state", "misled"))
    for since, text in ((0, ""), (FIRST, f", since slot {FIRST}")):
        expectation = expectations[f"suspicious synchronised by slot 80{text}"]
        assert expectation["value"] == since + states[since:].argmax(axis=0).max()
        assert expectation["held"] is (expectation["value"] <= 80)
    late = expectations["suspicious synchronised by slot 0"]
    assert late["value"] > 0
    assert late["held"] is False


@pytest.mark.long
def test_expectations_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    """Two blocks and a part: the same to the last bit."""
    options = {**OPTIONS, "trials": 1037, "record_trials": 1}
    runs = [
        montecarlo("eavesdroppers", out=tmp_path / f"{workers}", plan=Plan(workers=workers), **options)
        for workers in (1, 3)
    ]
    alone, spread = (
        [
            {key: value for key, value in expectation.items() if key != "replay"}
            for expectation in made.summary["expectations"]
        ]
        for made in runs
    )
    assert alone == spread


@given(cuts=st.sets(st.integers(1, 39)), blocks=st.sets(st.integers(1, 6)))
def test_what_is_watched_does_not_depend_on_how_it_is_cut(cuts: set[int], blocks: set[int]) -> None:
    """Slots in chunks and trials in blocks: the bits are those of one piece."""
    draw = np.random.default_rng(1)
    error, action = draw.lognormal(size=(40, 7)), draw.integers(0, 4, (40, 7)).astype(np.uint8)
    watches = [WatchedQuantity(metric, *span) for metric in METRICS for span in ((0, 40), (7, 21))]
    steps = [WatchedQuantity(SYNCHRONISED, 0, 40), WatchedQuantity(SYNCHRONISED, 11, 40)]

    def watched(trials: slice, ends: list[int]) -> WatchedTally:
        whole_tally = WatchedTally([*watches, *steps], error[:, trials].shape[1])
        for first, end in zip([0, *ends], [*ends, 40], strict=True):
            nothing = np.zeros(end - first)
            whole_tally.add_slots(
                ScoredSlots(first, error[first:end, trials], action[first:end, trials], nothing, nothing)
            )
        return whole_tally

    edges = [0, *sorted(blocks), 7]
    parts = WatchedTally.merged([watched(slice(*ends), sorted(cuts)) for ends in pairwise(edges)])
    whole = watched(slice(0, 7), [])
    for watch in watches:
        values, expected = parts.tally(watch).of_trials, whole.tally(watch).of_trials
        assert values is not None
        assert expected is not None
        assert values.tolist() == expected.tolist()
        assert parts.tally(watch).value == whole.tally(watch).value
    for watch in steps:
        firsts = [next(k for k in range(watch.first, 40) if action[k, r] == Action.STATE) for r in range(7)]
        assert parts.tally(watch).value == whole.tally(watch).value == max(firsts)


def test_a_trial_that_never_is_synchronised_is_found_as_nothing(tmp_path: Path) -> None:
    """Null, not held, and the report says so; a run that ended too early to tell is neither."""
    expect = [{"synchronised": "legitimate", "by": 3}]
    results = montecarlo(
        "eavesdroppers", slots=9, trials=5, legitimate__link__quality=0.0, expect=expect, out=tmp_path / "a"
    )
    (expectation,) = results.summary["expectations"]
    assert (expectation["held"], expectation["value"], expectation["wanted"]) == (False, None, "by slot 3")
    assert Judged(**expectation).sentence == "expected legitimate synchronised by slot 3: FAILED, found none"
    ranged = {"metric": "smart.used_fraction", "slots": [3, 9], "below": 1}
    whole = {"metric": "smart.used_fraction", "below": 1}
    secret = {"secrecy": "relative", "against": "smart"}
    scenario = load("eavesdroppers", {"slots": 9, "expect": [*expect, ranged, whole, secret]})
    short = {name: Tally(9, 1) for name in scenario.receivers}
    open_ = SecrecySummary(Claim.UNDECIDED, Claim.UNDECIDED, True, 1, True, "mean", "")
    peers = dict.fromkeys(scenario.receivers, PeerSummary({"used_fraction": 0.5}, None, False, None))
    judged = Evidence(scenario, peers, {}, short, {"smart": open_}).judged("evedrop run x")
    assert [judgement.held for judgement in judged] == [None] * 4
    assert [judgement.value for judgement in judged[:3]] == [None, None, 0.5]
    assert judged[2].sentence == ("expected smart.used_fraction below 1: FAILED, the run was cut short, found 0.5")
    assert not any("replay" in judgement.as_dict() for judgement in judged)


@pytest.mark.parametrize(
    ("shown", "promised", "value", "held"),
    [
        (Claim.HELD, True, "theory promises it, the run shows it", True),
        (Claim.UNDECIDED, True, "theory promises it, the run has too few trials to tell", False),
        (Claim.FAILED, True, "theory promises it, the run shows that it fails", False),
        (Claim.HELD, False, "theory denies it, the run shows it", False),
        (Claim.HELD, None, "no theory covers these links, the run shows it", False),
    ],
)
def test_secrecy_is_held_where_theory_and_run_agree(
    shown: Claim, promised: bool | None, value: str, held: bool
) -> None:
    """Of both kinds; whatever the other kind's verdict is."""
    for kind in ("relative", "perfect"):
        scenario = load("eavesdroppers", {"expect": [{"secrecy": kind, "against": "smart"}]})
        other: dict[str, Any] = {"relative": Claim.HELD, "perfect": Claim.HELD}
        claims: dict[str, Any] = {"relative_by_theory": True, "perfect_by_theory": True, f"{kind}_by_theory": promised}
        verdict = SecrecySummary(**{**other, kind: shown}, **claims, relative_from=None, judged_by="mean", sentence="")
        (judged,) = Evidence(scenario, {}, {}, {}, {"smart": verdict}).judged(None)
        assert (judged.value, judged.held) == (value, held)


@pytest.mark.parametrize(
    ("account", "value", "held"),
    [
        ({}, None, None),
        ({"rate": 0.8, "within_interval": True}, 0.8, True),
        ({"rate": 0.2, "within_interval": False}, 0.2, False),
    ],
)
def test_a_link_must_be_within_its_interval(account: dict[str, Any], value: float | None, held: bool | None) -> None:
    """As its account says; an account that does not say leaves it open."""
    scenario = load("eavesdroppers", {"expect": [{"link": "smart"}]})
    (judged,) = Evidence(scenario, {}, {"smart": LinkSummary(9, 9, 0, 0, 0, **account)}, {}, {}).judged(None)
    assert (judged.value, judged.held) == (value, held)


@pytest.mark.long
@pytest.mark.parametrize("command", ["run", "montecarlo"])
def test_the_printed_command_shows_the_failure_again(evedrop: Evedrop, command: str) -> None:
    """From the results folder, whose name has a blank in it, and with everything that was changed for the run: exit 1."""
    view = ("--view", "off") if command == "run" else ()
    done = evedrop(
        command, "eavesdroppers", "--slots", "40", "--trials", "10", "--seed", "3", "--first-trial", "5", *view,
        "--set", "expect.0={metric = 'smart.mean_squared_error', slots = [9, 40], quantile = 0.9, above = 9.0}",
        "--set", "expect.1={synchronised = 'suspicious', by = 0}", "--out", "a run",
    )  # fmt: skip
    assert (done.status, done.err) == (1, "")
    first = Results.read(evedrop.folder / "a run").summary["expectations"]
    assert [expectation["held"] for expectation in first] == [False, False]
    assert "2 of 2 expectations FAILED" in done.out
    lines = [line.strip() for line in done.out.splitlines()]
    for expectation in first:
        assert lines[lines.index(Judged(**expectation).sentence) + 1] == f"see it again: {expectation['replay']}"
    words = shlex.split(first[0]["replay"])
    assert words[:2] == ["evedrop", command]
    again = evedrop(*words[1:], *view, "--json", "--out", "again")
    assert again.status == 1
    for expectation, other in zip(first, json.loads(again.out)["expectations"], strict=True):
        assert (expectation["text"], expectation["value"], expectation["held"]) == (
            other["text"],
            other["value"],
            other["held"],
        )


def test_one_trial_of_a_study_can_be_watched_whatever_was_expected(evedrop: Evedrop) -> None:
    """The most surprising trial's command leaves out expectations that one trial cannot meet."""
    expect = "expect.0={metric = 'smart.mean_squared_error', quantile = 0.9, above = 0.0}"
    done = evedrop(
        "montecarlo", "eavesdroppers", "--slots", "40", "--trials", "30", "--set", expect, "--out", "study", "--verbose"
    )
    assert (done.status, done.err) == (0, "")
    line = next(line for line in done.out.splitlines() if "watch it live: " in line)
    again = evedrop("check", "study", *shlex.split(line.partition("run study ")[2])[2:4])
    assert again.status == 0


def test_a_change_by_the_operator_restarts_the_wait_for_a_synchronised_receiver() -> None:
    """As the same event in the file does: the first state from its slot on counts, and the run goes on."""
    scenario = load("eavesdroppers", {"slots": 60, "trials": 3, "expect": [{"synchronised": "legitimate", "by": 50}]})
    changed = with_event(scenario, {"link": "legitimate", "set": {"quality": 0.8}}, 30)
    (task,) = tasks_of(changed, Mode.EXACT, 1)
    expected = theoretical_traces_of(scenario)
    block, keeper = _empty_block(scenario, task, 0, expected, HeardBitsStream(scenario))
    for chunk in Simulation(changed, range(3), stops=[30]).chunks():
        if chunk.first == 30:
            keeper.amend(changed)
        assert chunk.slots is not None
        _score(block, keeper, slice(0, 3), chunk, chunk.slots)
    (steered,) = summary_of(changed, keeper.run_tally, dict.fromkeys(changed.digested), RunOutcome(1.0)).expectations
    whole = Merger.of(changed, Mode.EXACT, [carry_out(task, lambda _: None, lambda: False)])
    (in_file,) = whole.summary(RunOutcome(1.0)).expectations
    assert (steered.held, steered.value) == (in_file.held, in_file.value)
    assert isinstance(steered.value, int)
    assert steered.value >= 30


def test_a_receiver_is_to_be_synchronised_after_its_last_event() -> None:
    """Without `since`, the slots before its last event up to `by` do not count."""
    expect = [{"synchronised": "legitimate", "by": by} for by in (9, 25)]
    events = [{"from": 10, "to": 20, "kill": "legitimate"}]
    results = montecarlo(
        "eavesdroppers", trials=1, slots=40, eavesdroppers={}, encoding={"scheme": "plain"},
        legitimate__link={"quality": 1.0}, event=events, expect=expect,
    )  # fmt: skip
    assert [judged["value"] for judged in results.summary["expectations"]] == [0, 20]
