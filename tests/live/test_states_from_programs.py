"""Live runs whose states come from a program: a real one, which knows nothing of Evedrop."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import zenoh

from evedrop.cli.api import montecarlo, run
from evedrop.errors import RunError
from evedrop.live.launch.starter import preloaded
from evedrop.live.network.program import ProgramStates
from evedrop.live.protocol.brief import ProgramPart
from evedrop.results.diff import difference
from evedrop.results.reading import Results
from evedrop.scenario.recordings.disturbance_file import table_text
from evedrop.scenario.tables import Scenario
from evedrop.simulate.montecarlo import Plan
from evedrop.system.ports import free_port
from tests.builders import MARGINAL, digests_of, listener, process_table, scenario_of
from tests.conftest import wait_until

PLAYER = Path(__file__).parents[2] / "docs" / "examples" / "csv_player.py"
ROWS = np.random.default_rng(5).standard_normal((80, 2)).cumsum(axis=0).tolist()


def given(slots: int, process: dict[str, Any], **more: Any) -> Scenario:
    """A scenario whose states are given, with a reference and two eavesdroppers."""
    own = {**process_table(MARGINAL), "states": ["x", "v"], "reference": [0.1, -0.7]}
    tables = {
        "slots": slots,
        "trials": 2,
        "longest_outage": 5.0,
        "process": {**own, **process},
        "encoding": {"scheme": "innovation", "state_probability": 0.4},
        "legitimate": {"link": {"quality": 0.8}},
        "eavesdroppers": {name: listener(name, 0.8) for name in ("smart", "naive")},
    }
    return scenario_of(MARGINAL, **{**tables, **more})


def program(**entries: Any) -> dict[str, Any]:
    """The entries of a process whose states a program publishes at a free port, which the sensor listens on."""
    return {"source": "zenoh", "zenoh": {"key": "robot/pose", "listen": f"tcp/127.0.0.1:{free_port()}", **entries}}


@contextmanager
def playing(folder: Path, source: dict[str, Any], lines: list[str], every: float = 0.0) -> Iterator[None]:
    """Play lines of a CSV file to the sensor, in a process."""
    path = folder / "pose.csv"
    path.write_text("".join(f"{line}\n" for line in ["x [m],v", *lines]))
    where = ["--connect", source["zenoh"]["listen"]]
    command = [sys.executable, str(PLAYER), str(path), "robot/pose", *where, "--every", str(every)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as player:
        try:
            yield
        finally:
            player.kill()


def lines_of(rows: list[list[float]]) -> list[str]:
    """Rows as lines of a file."""
    return table_text(["x", "v"], None, rows).splitlines()[1:]


def rows_of(results: Results) -> list[dict[str, Any]]:
    """The rows of recorded trials, by slot and receiver."""
    return sorted(results.trials.to_pylist(), key=lambda row: (row["slot"], row["peer"]))


@pytest.fixture(scope="module", autouse=True)
def servers() -> Iterator[None]:
    """One set of fork servers for all runs."""
    with preloaded():
        yield


@pytest.mark.thorough
def test_a_run_over_a_program_can_be_repeated(tmp_path: Path) -> None:
    """At the program's own pace, each message is a slot: the digests are those of its file, and of the recorded run."""
    source = program()
    with playing(tmp_path, source, lines_of(ROWS)):
        live = run(given(60, source), out=tmp_path / "live")
    assert live.summary["ended"] == "complete"
    of_file = given(60, {"source": "file", "state_values": ROWS})
    memory = montecarlo(of_file, trials=2, out=tmp_path / "memory", plan=Plan(workers=1))
    again = montecarlo(tmp_path / "live", trials=2, out=tmp_path / "again", plan=Plan(workers=1))
    assert digests_of(live) == digests_of(memory) == digests_of(again)
    assert difference(live, again).same
    assert live.summary["peers"]["naive"]["theoretical_trace_covariance"] is None
    assert (tmp_path / "live" / "states.csv").read_text() == (tmp_path / "again" / "states.csv").read_text()


@pytest.mark.long
def test_a_paced_run_takes_the_newest_state(tmp_path: Path) -> None:
    """Of a program that sends faster than slots go by: never a state twice, never an older one; and the run can be repeated."""
    source = program()
    rows = [[float(k), -float(k)] for k in range(4000)]
    with playing(tmp_path, source, lines_of(rows), every=0.002):
        live = run(given(20, source, pace=0.02), out=tmp_path / "live")
    assert live.summary["ended"] == "complete"
    taken = np.loadtxt(tmp_path / "live" / "states.csv", delimiter=",", skiprows=1)[:, 0]
    assert len(taken) == 20
    assert np.all(np.diff(taken) > 0.5)
    assert taken[-1] > 40.0
    again = montecarlo(tmp_path / "live", trials=2, out=tmp_path / "again", plan=Plan(workers=1))
    assert difference(live, again).same


def test_states_are_taken_from_messages_as_they_come() -> None:
    """The newest for a paced run, which leaves older ones out; otherwise each in its turn, and not too many."""
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    samples: list[zenoh.Sample] = []
    with zenoh.open(
        zenoh.Config.from_json5(json.dumps({"mode": "peer", "listen": {"endpoints": []}, "scouting": quiet}))
    ) as session:
        session.declare_subscriber("robot/*", samples.append)
        for k in range(3):
            session.put("robot/pose", f"[{k}, 0]")
        session.put("robot/other", "[7, 0]")
        session.delete("robot/pose")
        wait_until(lambda: len(samples) == 5, "all messages arrive")
    entry = ProgramPart("robot/pose", ["x", "v"], [0.0, 0.0], listen="tcp/127.0.0.1:0")
    for newest, expected in ((True, [2.0]), (False, [0.0, 1.0, 2.0])):
        with ProgramStates(entry, newest, 5.0) as states:
            for sample in samples:
                states.hear(sample)
            assert [states.take(range(k, k + 1))[0, 0] for k in range(len(expected))] == expected
            for _ in range(100_001):
                states.hear(samples[0])
            if not newest:
                with pytest.raises(RunError, match="more than 100000 states wait at slot 3"):
                    states.take(range(3, 4))


@dataclass
class Large:
    """A sample of one MiB. A test measures how many of them are kept."""

    payload: zenoh.ZBytes
    key_expr: str = "robot/pose"
    kind: ClassVar[zenoh.SampleKind] = zenoh.SampleKind.PUT


def test_waiting_states_have_a_bounded_size() -> None:
    """Large messages are refused in time, whatever their number; those that were taken, or left out, do not count."""
    entry = ProgramPart("robot/pose", ["x", "v"], [0.0, 0.0], listen="tcp/127.0.0.1:0")
    sample = Large(zenoh.ZBytes(b"[1, 0]".ljust(2**20)))
    for newest in (True, False):
        with ProgramStates(entry, newest, 5.0) as states:
            for k in range(300):
                states.hear(sample)  # type: ignore[arg-type]
                assert states.take(range(k, k + 1))[0, 0] == 1.0
            tracemalloc.start()
            for _ in range(400):
                states.hear(sample)  # type: ignore[arg-type]
            most = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert most < (3 if newest else 260) * 2**20
            with (
                nullcontext() if newest else pytest.raises(RunError, match="more than 268435456 bytes wait at slot 300")
            ):
                states.take(range(300, 301))


def test_a_silent_program_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """With key, endpoint, slot and how long it was silent."""
    monkeypatch.setattr("evedrop.live.network.program.LEAST_SECONDS", 0.0)
    entry = ProgramPart("robot/pose", ["x", "v"], [0.0, 0.0], listen="tcp/127.0.0.1:0")
    with ProgramStates(entry, False, 0.01) as states:
        with pytest.raises(RunError, match=r"robot/pose at tcp/127.0.0.1:0: no state came for 0 s; check that"):
            states.take(range(1))
        with pytest.raises(RunError, match="no state came after that of slot 6 for 0 s"):
            states.take(range(7, 8))


@pytest.mark.long
def test_a_message_that_is_no_state_ends_the_run(tmp_path: Path) -> None:
    """The message names key, endpoint, slot and value; the slots so far can be repeated."""
    source = program()
    lines = [*lines_of(ROWS[:30]), "nan,1.0", *lines_of(ROWS[30:])]
    with playing(tmp_path, source, lines), pytest.raises(RunError) as caught:
        run(given(60, source), out=tmp_path / "live")
    where = source["zenoh"]["listen"]
    assert f"robot/pose at {where}: the message of slot 30 has x = nan; expected a finite number" in str(caught.value)
    states = (tmp_path / "live" / "states.csv").read_text().splitlines()
    assert states[0] == "x,v"
    assert len(states) == 31
    kept: dict[str, Any] = {"process__source": "file", "slots": 30}
    again = montecarlo(tmp_path / "live", trials=2, out=tmp_path / "again", plan=Plan(workers=1), **kept)
    live = Results.read(tmp_path / "live")
    assert (live.summary["slots"], live.trials.num_rows) == (30, 90)
    assert rows_of(again) == rows_of(live)


@pytest.mark.long
def test_a_program_that_dies_ends_the_run(tmp_path: Path) -> None:
    """So does one that never starts: the sensor names the slot."""
    source = program()
    with playing(tmp_path, source, lines_of(ROWS[:30])), pytest.raises(RunError, match="after that of slot 29 for 5 s"):
        run(given(60, source), out=tmp_path / "died")
    with pytest.raises(RunError, match=r"robot/pose at .*: no state came for 5 s; check that its program runs"):
        run(given(60, program()), out=tmp_path / "absent")
