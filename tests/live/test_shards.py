"""A run in shards is the run without them: digests, tables, summary, and how it ends."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from evedrop import load_results, montecarlo, run
from evedrop.errors import RunError, UsageError
from evedrop.live.launch.gathering import shards_of
from evedrop.live.launch.shards import OneProgress, _made_one, _ShardsState
from evedrop.results.crash_proof_tables import last_round
from evedrop.results.reading import Results, age_of_metrics
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import ProgressEvent, RunEnded, RunProgress, Started, silent
from tests.builders import digests_of
from tests.conftest import Evedrop, Live, wait_until, with_mark
from tests.examples import mostly_long

TRIALS = 7
ENDLESS = ("--trials", "5", "--slots", "1000000", "--set", "shards=2")
EVENTFUL: dict[str, Any] = {
    "slots": 300,
    "trials": TRIALS,
    "first_trial": 11,
    "record_trials": 4,
    "legitimate__window": 2,
    "legitimate__link": {"quality": 0.8, "delay": {"model": "normal", "mean": 0.5, "standard_deviation": 1.0}},
    "event": [
        {"from": 40, "to": 130, "kill": "smart", "state": "last"},
        {"from": 50, "to": 60, "cut": "naive"},
        {"from": 100, "to": 120, "pause": "suspicious"},
        {"at": 200, "link": "naive", "set": {"quality": 0.4}},
    ],
    "expect": [
        {"metric": "naive.mean_squared_error", "slots": [100, 200], "quantile": 0.5, "above": 0.0},
        {"metric": "legitimate.mean_squared_error", "below": 1e-9},
        {"synchronised": "smart", "by": 290},
        {"link": "naive"},
    ],
}
"""Trials that divide into no equal shards, with everything that may happen to a process and to a packet."""


Ran = Callable[[int], Results]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """The run in this number of shards; in memory for 0."""
    folder = tmp_path_factory.mktemp("shards")

    @cache
    def once(shards: int) -> Results:
        if shards == 0:
            return montecarlo("eavesdroppers", out=folder / "memory", **EVENTFUL)
        return run("eavesdroppers", out=folder / str(shards), shards=shards, **EVENTFUL)

    return once


def in_order(table: pa.Table) -> dict[str, list[Any]]:
    """The columns of a table, its rows by slot or block, receiver and trial: live runs write them as they come."""
    keys = [name for name in ("slot", "block", "peer", "link", "trial") if name in table.column_names]
    plain = table.set_column(
        table.column_names.index(keys[1] if keys[1] in ("peer", "link") else keys[0]),
        "who",
        table["peer" if "peer" in keys else "link"].cast(pa.string()),
    )
    order = ["who" if name in ("peer", "link") else name for name in keys]
    columns: dict[str, list[Any]] = plain.sort_by([(name, "ascending") for name in order]).to_pydict()
    return columns


two_or_three = pytest.mark.parametrize("shards", mostly_long([2, 3], [2]))


@pytest.mark.thorough
@two_or_three
@pytest.mark.parametrize("name", ["trials", "journal", "digests"])
def test_what_is_kept_by_trial_is_the_same_to_the_bit(ran: Ran, name: str, shards: int) -> None:
    """Recorded trials, every packet's fate with its bit mask, and digests do not depend on the number of shards."""
    assert in_order(getattr(ran(shards), name)) == in_order(getattr(ran(1), name))


@two_or_three
def test_the_statistics_of_every_slot_agree(ran: Ran, shards: int) -> None:
    """Counts are equal, and means and standard errors over all trials within rounding."""
    whole, gathered = in_order(ran(1).slots), in_order(ran(shards).slots)
    assert whole.keys() == gathered.keys()
    for name, column in whole.items():
        exact = name in ("slot", "who", "trials", "received_fraction", "used_fraction", "theoretical_trace_covariance")
        if exact or column[0] is None:
            assert gathered[name] == column, name
        else:
            np.testing.assert_allclose(gathered[name], column, rtol=1e-13, err_msg=name)


@two_or_three
def test_the_summary_is_that_of_all_trials(ran: Ran, shards: int) -> None:
    """Metrics, accounts, quantiles, events, verdicts and expectations are those of the whole run."""
    close(dict(ran(shards).summary), dict(ran(1).summary), "summary")
    recorded = {2: 4, 3: 5}[shards]  # each shard records its first trial at least
    assert {verified["recomputed_trials"] for verified in ran(shards).summary["verification"].values()} == {recorded}


def close(value: Any, wanted: Any, where: str) -> None:
    """Check that two parts of summaries are the same, numbers within rounding; but for times, folders, what was verified."""
    if isinstance(wanted, Mapping):
        assert value.keys() == wanted.keys(), where
        for name in wanted.keys() - {"wall_seconds", "slots_per_second", "replay", "verification"}:
            close(value[name], wanted[name], f"{where}.{name}")
    elif isinstance(wanted, list):
        assert len(value) == len(wanted), where
        for i, (item, other) in enumerate(zip(value, wanted, strict=True)):
            close(item, other, f"{where}.{i}")
    elif isinstance(wanted, float):
        assert value == pytest.approx(wanted, rel=1e-12), where
    else:
        assert value == wanted, where


@pytest.mark.long
def test_every_shard_may_have_two_routers(ran: Ran, tmp_path: Path) -> None:
    """At places of its own; the trials are the same."""
    linked = run("eavesdroppers", out=tmp_path / "run", shards=2, network={"routers": 2}, **EVENTFUL)
    assert in_order(linked.digests) == in_order(ran(1).digests)
    for number in (1, 2):
        assert (linked.folder / "logs" / f"shard-{number}" / "relay.log").is_file()


@pytest.mark.parametrize("shards", mostly_long([1, 2, 3], [1, 2]))
def test_digests_are_those_of_memory(ran: Ran, shards: int) -> None:
    """However many processes carry a trial's packets, it is that trial."""
    digests = digests_of(ran(shards))
    assert digests == digests_of(ran(0))
    assert None not in digests.values()


@pytest.mark.thorough
def test_nothing_is_left_of_the_shards_but_their_logs(ran: Ran) -> None:
    """One folder, as of any run, whose scenario says that it was in shards and runs again."""
    folder = ran(2).folder
    left = {path.name for path in folder.iterdir()}
    tables = {f"{name}.parquet" for name in ("slots", "trials", "journal", "digests")}
    assert left == {"scenario.toml", "summary.json", "logs", *tables}
    assert {path.name for path in (folder / "logs").iterdir()} == {"shard-1", "shard-2"}
    assert (folder / "logs" / "shard-2" / "smart.log").is_file()
    assert load(folder).shards == 2
    assert load(folder).trials == TRIALS


def test_shards_are_contiguous_and_as_equal_as_can_be() -> None:
    """Every trial is in one shard, in order, and the recorded ones are in the first."""
    scenario = load("eavesdroppers", {"trials": TRIALS, "first_trial": 11, "record_trials": 4, "shards": 3})
    shards = shards_of(scenario, Path("run"))
    assert [trial for shard in shards for trial in shard.trials] == list(range(11, 18))
    assert sorted(len(shard.trials) for shard in shards) == [2, 2, 3]
    assert [shard.scenario.record_trials for shard in shards] == [2, 2, 1]
    assert len({shard.folder for shard in shards}) == 3


def test_progress_is_that_of_the_slowest() -> None:
    """Nothing is told before all have begun, and never more than all have done."""
    told: list[ProgressEvent] = []
    shards = shards_of(load("eavesdroppers", {"trials": 3, "shards": 2, "slots": 90}), Path("run"))
    progress = OneProgress(shards, told.append)
    first, second = (progress.of(shard) for shard in shards)
    first(Started())
    first(RunProgress(50, 9.0, "slots/s", {"smart": 1.0}))
    assert told == []
    second(Started())
    second(RunProgress(20, 4.0, "slots/s", {"smart": 4.0}))
    assert told == [Started(), RunProgress(20, 4.0, "slots/s", {"smart": 3.0})]
    second(RunEnded(0, "complete"))
    first(RunProgress(70, 9.0, "slots/s", {"smart": 1.0}))
    assert told[-1] == RunProgress(70, 9.0, "slots/s", {"smart": 3.0})


def test_a_shard_that_was_ended_early_has_done_no_more_than_it_said() -> None:
    """Its end adds the last slots to what it has told only if the run was complete."""
    told: list[ProgressEvent] = []
    shards = shards_of(load("eavesdroppers", {"trials": 3, "shards": 2, "slots": 90}), Path("run"))
    progress = OneProgress(shards, told.append)
    first, second = (progress.of(shard) for shard in shards)
    for on_event in (first, second):
        on_event(Started())
        on_event(RunProgress(20, 4.0, "slots/s", {"smart": 4.0}))
    second(RunEnded(130, "interrupted"))
    first(RunProgress(70, 9.0, "slots/s", {"smart": 1.0}))
    assert told[-1] == RunProgress(20, 4.0, "slots/s", {"smart": 3.0})


@pytest.mark.thorough
def test_a_real_time_run_keeps_its_pace_and_an_expectation_that_fails_is_its_status(evedrop: Evedrop) -> None:
    """No shard is done before its slots have passed, and what is expected is judged once, of all trials."""
    done = evedrop(
        *("run", "eavesdroppers", "--view", "off", "--json", "--out", "run", "--slots", "60", "--pace", "0.02"),
        *("--trials", "2", "--set", "shards=2"),
        *("--set", "expect=[{ metric = 'legitimate.mean_squared_error', below = 1e-9 }]"),
    )
    assert done.status == 1, done.err
    assert done.summary["wall_seconds"] >= 59 * 0.02
    assert [expectation["held"] for expectation in done.summary["expectations"]] == [False]


def child(live: Live, shard: int, name: str) -> int:
    """The process id of one process of one shard, which its log tells, as soon as it is there."""

    def child_pid() -> int | None:
        for pid in with_mark(str(live.temporary)):
            try:
                log = os.readlink(f"/proc/{pid}/fd/2")
            except OSError:
                continue
            if log.endswith(f"/shards/{shard}/logs/{name}.log"):
                return pid
        return None

    pid: int = wait_until(child_pid, f"a process {name} of shard {shard}")
    return pid


def whole(live: Live) -> int:
    """Check that the folder of a run cut short is one, its tables as far as its trials came; the rows of slots."""
    results = live.results
    assert not (live.folder / "shards").exists()
    rows: int = results.slots.num_rows
    assert rows == results.journal.num_rows
    trials = results.slots["trials"].to_pylist()
    assert sum(trials) == sum(link["offered"] for link in results.summary["links"].values())
    assert set(trials) <= {2, 3, 5}
    return rows


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param("smart", marks=pytest.mark.long), "sensor"])
def test_a_killed_process_of_a_shard_ends_all(evedrop: Evedrop, name: str) -> None:
    """The shard and the process are named, with the log where it is, and no slot that was scored is lost."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    os.kill(child(live, 2, name), signal.SIGKILL)
    done = live.end()
    assert done.status == 3
    assert f"shard 2 (trials 2 to 4): {name} was ended by signal 9" in done.err
    assert f"logs/shard-2/{name}.log" in done.err
    live.nothing_left()
    assert live.results.summary["ended"] in done.err
    assert (live.folder / "logs" / "shard-2" / f"{name}.log").is_file()
    assert whole(live) > 0
    assert live.results.summary["slots"] > 0


@pytest.mark.long
def test_a_killed_recorder_costs_no_slot_that_is_on_disk(evedrop: Evedrop) -> None:
    """The slots of both shards are in the folder, up to those that the recorder had written when it was killed.

    The summary says that its last metrics were of an earlier slot.
    """
    live = evedrop.live("eavesdroppers", *ENDLESS)
    second = live.folder / "shards" / "2"
    wait_until(lambda: last_round(second).slots > 0, "slots of the second shard on disk")
    wait_until(lambda: "the tables have more" in age_of_metrics(second), "rows that are later than the metrics")
    os.kill(child(live, 2, "recorder"), signal.SIGKILL)
    done = live.end()
    assert done.status == 3
    assert "shard 2 (trials 2 to 4): recorder was ended by signal 9" in done.err
    live.nothing_left()
    results = live.results
    assert results.slots.num_rows == results.journal.num_rows
    assert {3, 5} & set(results.slots["trials"].to_pylist())
    reason = results.summary["ended"].splitlines()[0]
    assert re.search(r"\(the metrics are as of slot \d+ in shard 2; the tables have more\)$", reason)


@pytest.mark.thorough
def test_an_interrupted_run_leaves_one_folder_and_no_process(evedrop: Evedrop) -> None:
    """Ctrl-C ends all shards: exit 130, what was measured is readable, nothing is left."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    live.process.send_signal(signal.SIGINT)
    done = live.end()
    assert done.status == 130, done.err
    live.nothing_left()
    assert live.results.summary["ended"] == "interrupted"
    assert whole(live) > 0


@pytest.mark.long
def test_an_interrupt_before_anything_has_begun_leaves_a_whole_folder_too(evedrop: Evedrop) -> None:
    """With processes that are just being started: empty tables, and a summary that says so."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    wait_until(live.children, "a first process")
    live.process.send_signal(signal.SIGINT)
    assert live.end().status == 130
    live.nothing_left()
    assert live.results.summary["ended"] == "interrupted"
    whole(live)


@pytest.mark.long
def test_of_a_killed_launcher_the_shards_are_left(evedrop: Evedrop) -> None:
    """Nobody makes them one, but each is a results folder of its trials, and the run's says so."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    live.process.kill()
    live.process.communicate()
    wait_until(lambda: not live.left(), "no process left of the run")
    for number, trials in ((1, 2), (2, 3)):
        results = load_results(live.folder / "shards" / str(number))
        assert results.summary["trials"] == trials
        assert results.slots.num_rows == results.summary["slots"] * 4 > 0
    with pytest.raises(UsageError, match="shards/1"):
        load_results(live.folder)


@pytest.mark.thorough
def test_a_run_in_shards_tells_how_it_does_and_is_not_steered(evedrop: Evedrop) -> None:
    """`status` is of all shards; what would change the run in one of them alone is refused with the way out."""
    live = evedrop.live("eavesdroppers", *ENDLESS, "--pace", "0.01")
    controls = [live.folder / "shards" / str(number) / "control.json" for number in (1, 2)]
    wait_until(lambda: all(control.is_file() for control in controls), "shards that can be asked")
    status = evedrop("status", str(live.folder), "--json").summary
    assert status["state"] == "running"
    assert all(status["processes"].values())
    assert status["links"].keys() == {"legitimate", "naive", "suspicious", "smart"}
    for words in (("link", "smart", "cut"), ("pause",), ("resume",), ("step", "3")):
        refused = evedrop(words[0], str(live.folder), *words[1:])
        assert refused.status == 2
        assert "this run is in shards, which cannot be steered" in refused.err
        assert "--set shards=1" in refused.err
    live.process.send_signal(signal.SIGINT)
    assert live.end().status == 130
    assert live.results.summary["events"] == []


def test_what_shards_cannot_do_is_refused(evedrop: Evedrop) -> None:
    """Briefs and a fixed endpoint are of one router; more shards than trials leave one without work."""
    sharded = ("--trials", "4", "--set", "shards=2")
    for words, message in (
        (("brief", "eavesdroppers", *sharded, "--out", "briefs", "--results", "there"), "give --set shards=1"),
        (("run", "eavesdroppers", *sharded, "--view", "off", "--listen", "tcp/127.0.0.1:17461"), "give shards=1"),
        (("run", "eavesdroppers", *sharded, "--view", "off", "--relay", "tcp/127.0.0.1:17461"), "give shards=1"),
        (("run", "eavesdroppers", "--set", "shards=2"), "shards: is 2; expected at most trials, which is 1"),
        (("run", "eavesdroppers", "--set", "shards=0"), "shards: is 0; expected a number at least 1"),
    ):
        done = evedrop(*words)
        assert done.status == 2, done
        assert message in done.err
    assert not (evedrop.folder / "runs").exists()
    assert not (evedrop.folder / "briefs").exists()


def test_a_secret_that_is_gone_leaves_no_folder(tmp_path: Path) -> None:
    """An error that keeps all shards from starting is reported once, and the folder can be used again."""
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(32))
    scenario = load("eavesdroppers", {"trials": 2, "shards": 2, "slots": 10, "secret_file": str(secret)})
    secret.unlink()
    from evedrop.live.launch.launcher import launch

    with pytest.raises(UsageError, match=r"secret_file: .*secret\.bin cannot be read"):
        launch(scenario, tmp_path / "run", "off", None, silent)
    assert not (tmp_path / "run").exists()


@pytest.mark.thorough
def test_shards_that_cannot_be_made_one_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that is full at the end costs nothing: each shard's results are where the message says."""

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("evedrop.live.launch.gathering.summary_of", full)
    with pytest.raises(RunError, match="No space left"):
        run("eavesdroppers", out=tmp_path / "run", trials=2, shards=2, slots=20, expect=[])
    for number in (1, 2):
        assert load_results(tmp_path / "run" / "shards" / str(number)).summary["slots"] == 20


def test_shards_whose_metric_fails_are_no_complete_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It fails when the shards are merged, as the summary says; the run ends with that failure, as one without shards does."""
    failed = SimpleNamespace(ended="the metric distance of an installed package failed", failed_expectations=0)
    monkeypatch.setattr("evedrop.live.launch.gathering.gather", lambda *_: failed)
    with pytest.raises(RunError, match="the metric distance"):
        _made_one(load("eavesdroppers"), tmp_path, [], _ShardsState(), 0.0)


def test_the_trial_to_watch_is_run_without_shards(evedrop: Evedrop) -> None:
    """A single trial has one shard, and the command that shows it says so."""
    done = evedrop(
        "montecarlo",
        "eavesdroppers",
        "--trials",
        "20",
        "--slots",
        "50",
        "--set",
        "shards=2",
        "--out",
        "study",
        "--verbose",
    )
    assert done.status in {0, 1}
    assert "--set shards=1 --first-trial" in done.out
