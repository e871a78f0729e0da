"""The typed summary: what was written is read with types, and written again to the byte; nothing else is read."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from evedrop.cli.api import montecarlo
from evedrop.errors import UsageError
from evedrop.model.metrics import METRICS, metric
from evedrop.results.reading import Results
from evedrop.results.summary_file import summary_text, write_summary
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import ConnectionOutage
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.score.summary import Summary
from evedrop.simulate.montecarlo import Merger, Plan
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import tasks_of
from evedrop.simulate.workers import in_this_process
from tests.examples import mostly_long


@pytest.mark.parametrize(
    ("scenario", "mode"),
    mostly_long(
        [
            *(
                (name, Mode.EXACT)
                for name in ("acknowledged", "driving-away", "heated-room", "late", "microgrid", "vehicle")
            ),
            ("numerical", Mode.COVARIANCE_ONLY),
        ],
        [("acknowledged", Mode.EXACT), ("heated-room", Mode.EXACT), ("numerical", Mode.COVARIANCE_ONLY)],
    ),
)
def test_a_summary_that_was_read_is_written_to_the_byte(tmp_path: Path, scenario: str, mode: Mode) -> None:
    """With filter, controller, applications, events, detection, delays, and the metric of one mode."""
    changes: dict[str, Any] = (
        {"event": [{"at": 3, "link": "legitimate", "set": {"quality": 0.5}}]} if scenario == "late" else {}
    )
    plan = Plan(mode, workers=1)
    results = montecarlo(scenario, slots=50, trials=12, out=tmp_path / "run", plan=plan, expect=[], **changes)
    text = (tmp_path / "run" / "summary.json").read_text(encoding="utf-8")
    summary = results.typed_summary
    assert summary_text(summary) == text
    metrics = [name for name in METRICS if metric(name).only_in_mode in {None, mode.value}]
    others = ["error_quantiles", "standard_errors", "z", "infinite_variance", "rare_events", "digest"]
    order = [*metrics[:5], *others, *metrics[5:]]
    assert [list(peer) for peer in results.summary["peers"].values()] == [order] * len(summary.peers)
    outages = [ConnectionOutage("smart", 3, None, 0.5), ConnectionOutage("router", 4, 9, 1.0, shard=2)]
    write_summary(tmp_path / "run", replace(summary, outages=outages))
    again = Results.read(tmp_path / "run")
    assert again.typed_summary.outages == outages
    assert list(again.summary["outages"][1]) == ["process", "slot", "until", "seconds", "shard"]
    assert "shard" not in again.summary["outages"][0]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """A small run."""
    expect = [{"metric": "smart.mean_squared_error", "below": 0.0}]
    return montecarlo("eavesdroppers", slots=9, trials=2, out=tmp_path_factory.mktemp("run"), expect=expect)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("trials",), "two"),
        (("ended",), None),
        (("ended",), ""),
        (("verdict", "outcome"), "perhaps"),
        (("peers", "smart", "digest"), 5),
        (("peers", "smart", "used_fraction"), "many"),
        (("links", "smart", "lost"), [1]),
        (("secrecy", "smart"), "held"),
        (("events",), [{"slot": "x", "event": "cut", "by": "scenario"}]),
        (("expectations", 0, "held"), "perhaps"),
        (("detection",), {"alarms": 1}),
    ],
)
def test_an_entry_of_another_type_is_named(results: Results, place: tuple[str | int, ...], value: Any) -> None:
    """By its place, in one line."""
    changed: Any = copy.deepcopy(dict(results.summary))
    inner = changed
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = value
    with pytest.raises(UsageError, match="is not a run summary of this version") as caught:
        _ = Results(results.folder, changed).typed_summary
    assert str(place[-1]) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("missing", ["slots_per_second", "peers", "expectations"])
def test_a_missing_entry_is_named(results: Results, missing: str) -> None:
    """As one that a summary of an older version lacks."""
    changed = {name: value for name, value in results.summary.items() if name != missing}
    with pytest.raises(UsageError, match=f"is not a run summary of this version .'{missing}'|KeyError.'{missing}'"):
        _ = Results(results.folder, changed).typed_summary


def test_infinite_numbers_are_numbers(results: Results) -> None:
    """In the file they are strings, because JSON lacks them."""
    changed: Any = copy.deepcopy(dict(results.summary))
    changed["peers"]["smart"]["mean_squared_error"] = "inf"
    assert Summary.read(changed).peers["smart"].metric("mean_squared_error") == float("inf")


@pytest.mark.parametrize("name", ["bursts", "late"])
def test_theory_promises_the_same_however_soon_a_run_is_interrupted(name: str) -> None:
    """Even before its first slot, where theory promises secrecy only from some slot on."""
    scenario = load(name, {"trials": 2, "slots": 500, "event": [], "expect": []})
    whole = Merger(scenario, Mode.EXACT)
    for result in in_this_process(tasks_of(scenario, Mode.EXACT, 1), lambda _: None, lambda: False):
        whole.add_batch(result)
    ending = RunOutcome(0.0, "interrupted")
    nothing = summary_of(scenario, RunTally.nothing(scenario, 2), dict.fromkeys(scenario.digested), ending)
    for eavesdropper, verdict in whole.summary(RunOutcome(1.0)).secrecy.items():
        early = nothing.secrecy[eavesdropper]
        assert early.sentence.endswith(verdict.sentence.rpartition("; ")[2])
        assert early.relative_from == verdict.relative_from
        assert early.relative_by_theory == verdict.relative_by_theory
