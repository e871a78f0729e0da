"""Scenarios as tests, several at a time: each in a process of its own, which ends with the starting process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import asdict, replace
from pathlib import Path
from typing import final

from evedrop.errors import Interrupted
from evedrop.live.network.launcher_pipe import when_launcher_is_gone
from evedrop.studies.scenario_tests import Finding, Manner, Outcome, carry_out
from evedrop.system.processes import SUSPENDED_SECONDS, SuspensionWatch, continue_when_parent_dies, kill, wait_for
from evedrop.system.signals import stop_on_signals

_POLL_SECONDS = 0.1
_END_SECONDS = 60.0
"""For the processes to end their runs, which takes seconds, and to write the results so far."""
_WORK = "from evedrop.studies.scenario_test_jobs import work; work()"


def results(scenarios: Sequence[str], manner: Manner, jobs: int) -> Iterator[Finding]:
    """Carry out the scenarios as tests; yields the results in order. Raises Interrupted on Ctrl-C; then no process is left."""
    if jobs == 1:
        with stop_on_signals() as stop:
            for scenario in scenarios:
                if stop.is_set():
                    raise _interrupted(manner)
                yield carry_out(scenario, manner)
        return
    crew = _Crew(replace(manner, workers=1))
    with stop_on_signals() as stop, ThreadPoolExecutor(jobs) as threads:
        waiting = [threads.submit(crew.carry_out, scenario) for scenario in scenarios]
        try:
            for future in waiting:
                while not wait([future], _POLL_SECONDS).done:
                    if stop.is_set():
                        raise _interrupted(manner)
                    crew.kill_suspended()
                yield future.result()
        finally:
            crew.end(waiting)


def _interrupted(manner: Manner) -> Interrupted:
    error = Interrupted.with_results(manner.folder)
    error.resumable = manner.resumable
    return error


@final
class _Crew:
    """The running processes."""

    def __init__(self, manner: Manner) -> None:
        self._manner = manner
        self._running: dict[int, subprocess.Popen[str]] = {}
        self._over = False
        self._watch = SuspensionWatch()
        self._suspended = set[int]()
        """Ids of processes that were killed because they stayed suspended."""

    def carry_out(self, scenario: str) -> Finding:
        """Carry out one scenario in a process that a Ctrl-C in the terminal does not reach: this process passes it on."""
        task = json.dumps([scenario, asdict(self._manner)], default=str)
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _WORK, task],
            stdin=subprocess.PIPE,  # closes when this process is gone
            stdout=subprocess.PIPE,
            encoding="ascii",  # JSON
            start_new_session=True,
        )
        with process:
            self._running[process.pid] = process
            if self._over:
                process.terminate()
            assert process.stdout is not None  # noqa: S101 - it was started with a pipe
            output = process.stdout.read()
            status = process.wait()
            del self._running[process.pid]
        if not output:
            how = f"ended with status {status}"
            if process.pid in self._suspended:
                how = f"was suspended for {SUSPENDED_SECONDS:g} s (SIGSTOP)"
            return Finding(scenario, Outcome.BROKEN, 0.0, (f"its process {how}",))
        entries = json.loads(output)
        places = {name: None if entries[name] is None else Path(entries[name]) for name in ("folder", "report")}
        return Finding(
            **{**entries, **places, "outcome": Outcome(entries["outcome"]), "reasons": (*entries["reasons"],)}
        )

    def kill_suspended(self) -> None:
        """Kill a process that stays suspended."""
        if (pid := self._watch.suspended_for_good(tuple(self._running))) is not None:
            self._suspended.add(pid)
            self._running[pid].kill()

    def end(self, waiting: Sequence[Future[Finding]]) -> None:
        """Start no further processes, and end the running ones, also suspended ones; kill those that do not end."""
        for future in waiting:
            future.cancel()
        self._over = True
        for process in tuple(self._running.values()):
            process.send_signal(signal.SIGCONT)
            process.terminate()
        wait_for(tuple(self._running.values()), _END_SECONDS)
        kill(*tuple(self._running.values()))


def work() -> None:
    """Run one process: carry out the scenario in its argument, and write the result to standard output."""
    continue_when_parent_dies()
    when_launcher_is_gone(lambda: os.kill(os.getpid(), signal.SIGTERM))
    scenario, manner = json.loads(sys.argv[1])
    out = None if manner["out"] is None else Path(manner["out"])
    try:
        tested = carry_out(scenario, Manner(**{**manner, "out": out}))
    except Interrupted as error:
        sys.exit(error.exit_status)
    sys.stdout.write(json.dumps({**asdict(tested), "outcome": tested.outcome.value}, default=str))
