"""A recorder that lives is not given up, however long it takes to finish; one that stands still is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from evedrop.live.launch.starter import GRACE_SECONDS
from evedrop.results.crash_proof_tables import last_round
from evedrop.results.folder import UNFINISHED
from evedrop.results.reading import Results
from tests.conftest import Evedrop, Live, wait_until

SLOW = """
import time
import evedrop.live.launch.children as children
import evedrop.live.launch.process_set as process_set
import evedrop.live.launch.starter as starter
import evedrop.live.network.launcher_pipe as heartbeat
import evedrop.results.writer as results
from evedrop.scenario.progress_events import Started

def finish(folder, honest=results.finish):
    time.sleep({finish})
    honest(folder)

def next_event(self, seconds, honest=children.Children.next_event):
    event = honest(self, seconds)
    if isinstance(event, Started):
        children.SILENCE_SECONDS = process_set.SILENCE_SECONDS = {silence}
    return event

results.finish = finish
children.GRACE_SECONDS = children._GONE_SECONDS = starter.GRACE_SECONDS = {grace}
heartbeat._BEAT_SECONDS = 0.1
children.Children.next_event = next_event
"""
"""How long a recorder takes to make Parquet files, after how long a silence in a run its launcher gives it up, and how long
processes that are told to end may take."""


def slow(evedrop: Evedrop, finish: float, silence: float, *arguments: str, grace: float = GRACE_SECONDS) -> Live:
    """A run that finishes slowly."""
    (evedrop.folder / "sitecustomize.py").write_text(SLOW.format(finish=finish, silence=silence, grace=grace))
    environment = {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}
    return evedrop.live("eavesdroppers", "--slots", "300", *arguments, env=environment)


@pytest.mark.long
def test_a_run_that_takes_long_to_finish_is_not_given_up(evedrop: Evedrop) -> None:
    """More than twice as long as a silence may last: the recorder says that it lives, and the run is complete."""
    live = slow(evedrop, 6.5, 3.0)
    done = live.end()
    assert done.status == 0, done.err
    live.nothing_left()
    assert live.results.summary["ended"] == "complete"
    assert live.results.trials.num_rows == 4 * 300


@pytest.mark.long
def test_a_run_that_is_interrupted_while_it_finishes_is_complete(evedrop: Evedrop) -> None:
    """The launcher waits as long as the recorder says that it lives; all slots were done before the signal."""
    live = slow(evedrop, 6.5, 3.0)
    wait_until(lambda: last_round(live.folder).slots == 300, "all slots on disk")
    live.process.send_signal(signal.SIGINT)
    done = live.end()
    assert done.status == 0, done.err
    live.nothing_left()
    assert not (live.folder / UNFINISHED).exists()
    assert live.results.summary["ended"] == "complete"
    assert live.results.trials.num_rows == 4 * 300


@pytest.mark.thorough
def test_a_recorder_that_stands_still_is_named_and_its_rows_are_kept(evedrop: Evedrop) -> None:
    """Stopped, it says nothing; the launcher ends the run and makes tables of what it had written."""
    live = slow(evedrop, 0.0, 2.0, "--slots", "1000000", grace=0.5)
    wait_until(lambda: last_round(live.folder).slots > 0, "slots on disk")
    os.kill(live.child("recorder"), signal.SIGSTOP)
    done = live.end()
    assert done.status == 3
    assert done.err.startswith("evedrop: recorder stopped responding")
    live.nothing_left()
    assert live.results.slots.num_rows == 4 * live.results.summary["slots"] > 0


BUSY = "import time\nwhile True:\n    pass\n"


@pytest.mark.long
def test_a_run_on_a_starved_machine_comes_to_its_end(evedrop: Evedrop) -> None:
    """One processor for all its processes, at the lowest priority, shared with six processes that never rest."""
    loops = [subprocess.Popen(["taskset", "-c", "0", sys.executable, "-c", BUSY]) for _ in range(6)]
    try:
        command = ["taskset", "-c", "0", "nice", "-n", "10", sys.executable, "-m", "evedrop"]
        words = ["run", "eavesdroppers", "--slots", "3000", "--view", "off", "--out", "run"]
        done = subprocess.run(
            [*command, *words], cwd=evedrop.folder, env=evedrop.environment, capture_output=True, text=True, check=False
        )
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
    assert done.returncode == 0, done.stderr
    assert Results.read(evedrop.folder / "run").summary["ended"] == "complete"
