"""A run whose processes are started one by one, as on several machines: each can be killed and started again."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from evedrop import montecarlo
from evedrop.live.launch.briefs import write_briefs
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.launch.starter import StartedProcess, Starter, process_starter
from evedrop.live.network.endpoint import Endpoint
from evedrop.live.protocol.brief import read_brief
from evedrop.names import RECORDER
from evedrop.results.reading import Results
from evedrop.scenario.tables import Scenario
from tests.conftest import wait_until

LONG = 90.0


@dataclass
class ByHand:
    """A run, the processes that were started of it, and what they say."""

    scenario: Scenario
    folder: Path
    endpoint: str
    entered: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Process → the words before its command line, such as those that enter a network namespace."""
    insecure: bool = False
    """Whether it may be unencrypted although others could listen."""
    relay: str | None = None
    """Where the second router listens, if there is one."""
    paused: bool = False
    """Whether it is held before slot 0, until a command lets it go on."""
    processes: dict[str, StartedProcess] = field(default_factory=dict)
    until_gone: ExitStack = field(default_factory=ExitStack)
    """Is closed when the processes are gone."""
    _servers: list[Starter] = field(default_factory=list)
    _done: list[int] = field(default_factory=list)
    _elsewhere: bool = False

    def write(self, **endpoints: str) -> None:
        """Write the briefs; endpoints: process → where it finds the router, if that is elsewhere."""
        self._elsewhere = bool(endpoints)
        router_endpoints = endpoints_at(self.endpoint, insecure=self.insecure, relay=self.relay)
        folders = (self.results, self.folder / "briefs")
        for path in write_briefs(self.scenario, router_endpoints, *folders, int(LONG), paused=self.paused):
            if path.stem in endpoints:
                brief = json.loads(path.read_text())
                path.write_text(json.dumps({**brief, "router": endpoints[path.stem]}))

    @property
    def results(self) -> Path:
        """Its results folder."""
        return self.folder / "run"

    @property
    def names(self) -> tuple[str, ...]:
        """All processes."""
        relay = () if self.relay is None else ("relay",)
        return ("router", *relay, "sensor", *self.scenario.digested, "recorder")

    def start(self, *names: str) -> None:
        """Start these processes, or all; the router first if others find it through a proxy, which lets them in without it."""
        if not names and self._elsewhere:
            self.start("router")
            wait_until(self._listens, "a router that listens", LONG)
            names = self.names[1:]
        for name in names or self.names:
            path = self.folder / "briefs" / f"{name}.json"
            with self.log(name).open("ab") as log:
                process = self.processes[name] = self._started(read_brief(path).role, path, log)
            if name != RECORDER and process.stdout is not None:
                process.stdout.close()  # a router that is started by hand tells nothing there
        if "recorder" in (names or self.names):
            threading.Thread(target=self._listen, daemon=True).start()

    def _started(self, role: str, path: Path, log: IO[bytes]) -> StartedProcess:
        environment = {**os.environ, "TMPDIR": str(self.folder)}
        enter = self.entered.get(path.stem)
        if enter is None:
            if not self._servers:
                self._servers.append(self.until_gone.enter_context(process_starter()))
            return self._servers[0](role, path, log, environment)
        return subprocess.Popen(
            [*enter, sys.executable, "-m", "evedrop", role, str(path)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if role == RECORDER else log,
            stderr=log,
            env=environment,
        )

    def _listen(self) -> None:
        lines = self.processes["recorder"].stdout
        assert lines is not None
        with lines:
            for line in lines:
                event = json.loads(line)
                self._done.append(event.get("done", 0))
                if event["event"] == "ended":
                    break
            lines.read()  # the table, for people

    def _listens(self) -> bool:
        place = Endpoint.of(self.endpoint).nearby
        with suppress(OSError), socket.create_connection((place.host, place.port)):
            return True
        return False

    def log(self, name: str) -> Path:
        """What a process wrote."""
        return self.folder / f"{name}.log"

    def done(self) -> int:
        """How many slots the recorder says are joined."""
        return max(self._done, default=0)

    def running(self, more_than: int = 0) -> None:
        """Wait until more than this number of slots is joined."""
        recorder = self.processes["recorder"]
        wait_until(lambda: self.done() > more_than or recorder.poll() is not None, "a run under way", LONG)
        assert recorder.poll() is None, self.log("recorder").read_text()

    def kill(self, name: str) -> None:
        """Kill -9."""
        close(self.processes[name])

    def statuses(self, limit: float = LONG) -> dict[str, int]:
        """Process → its exit status, once all have ended."""
        wait_until(
            lambda: all(process.poll() is not None for process in self.processes.values()), "the end of all", limit
        )
        return {name: process.wait() for name, process in self.processes.items()}

    @property
    def summary(self) -> Mapping[str, Any]:
        """The summary of the results."""
        return Results.read(self.results).summary


@contextmanager
def by_hand(scenario: Scenario, folder: Path, endpoint: str, **given: Any) -> Iterator[ByHand]:
    """A run in a folder, whose processes are gone when the block ends; given: fields of `ByHand`."""
    run = ByHand(scenario, folder, endpoint, **given)
    try:
        yield run
    finally:
        for process in run.processes.values():
            close(process)
        run.until_gone.close()


def close(process: StartedProcess) -> None:
    """Kill -9."""
    process.kill()
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def as_if_undisturbed(summary: Mapping[str, Any], scenario: Scenario, folder: Path) -> None:
    """Check that a disturbed run has the digests, and the account of every link, of the same run in memory."""
    expected = montecarlo(scenario, trials=scenario.trials, out=folder).summary
    assert summary["ended"] == "complete"
    assert summary["slots"] == scenario.slots
    for name, link in summary["links"].items():
        assert link["unexplained"] == 0
        assert link == expected["links"][name]
        assert summary["peers"][name]["digest"] == expected["peers"][name]["digest"]
    if expected["controller"] is not None:
        assert summary["controller"]["digest"] == expected["controller"]["digest"]
