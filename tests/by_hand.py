"""A run whose processes are started one by one, as on several machines: each can be killed and started again."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from evedrop import montecarlo
from evedrop.live.launch.briefs import write_briefs
from evedrop.live.launch.ports import places_at
from evedrop.live.network.endpoint import Endpoint
from evedrop.live.protocol.brief import read_brief
from evedrop.results.writer import load_results
from evedrop.scenario import Scenario
from tests.conftest import wait_until

LONG = 90.0


@dataclass
class ByHand:
    """Final."""

    scenario: Scenario
    folder: Path
    endpoint: str
    entered: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Process → the words before its command line, such as those that enter a network namespace."""
    insecure: bool = False
    """Whether it may be in clear although others could listen."""
    relay: str | None = None
    """Where the second router listens, if there is one."""
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    _done: list[int] = field(default_factory=list)
    _elsewhere: bool = False

    def write(self, **endpoints: str) -> None:
        """Write the briefs; endpoints: process → where it finds the router, if that is elsewhere."""
        self._elsewhere = bool(endpoints)
        places = places_at(self.endpoint, insecure=self.insecure, relay=self.relay)
        for path in write_briefs(self.scenario, places, self.folder / "run", self.folder / "briefs", int(LONG)):
            if path.stem in endpoints:
                brief = json.loads(path.read_text())
                path.write_text(json.dumps({**brief, "router": endpoints[path.stem]}))

    @property
    def names(self) -> tuple[str, ...]:
        """All processes."""
        relay = () if self.relay is None else ("relay",)
        return ("router", *relay, "sensor", *self.scenario.digested, "observer")

    def start(self, *names: str) -> None:
        """Start these processes, or all; the router first if others find it through a proxy, which lets them in without it."""
        if not names and self._elsewhere:
            self.start("router")
            wait_until(self._listens, "a router that listens", LONG)
            names = self.names[1:]
        for name in names or self.names:
            path = self.folder / "briefs" / f"{name}.json"
            command = [sys.executable, "-m", "evedrop", read_brief(path).role, str(path)]
            with self.log(name).open("ab") as log:
                self.processes[name] = subprocess.Popen(
                    [*self.entered.get(name, ()), *command],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE if name == "observer" else log,
                    stderr=log,
                    env={**os.environ, "TMPDIR": str(self.folder)},
                )
        if "observer" in (names or self.names):
            threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        lines = self.processes["observer"].stdout
        assert lines is not None
        with lines:
            for line in lines:
                news = json.loads(line)
                self._done.append(news.get("done", 0))
                if news["event"] == "ended":
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
        """How many slots the observer says are joined."""
        return max(self._done, default=0)

    def running(self, more_than: int = 0) -> None:
        """Wait until more than so many slots are joined."""
        observer = self.processes["observer"]
        wait_until(lambda: self.done() > more_than or observer.poll() is not None, "a run under way", LONG)
        assert observer.poll() is None, self.log("observer").read_text()

    def kill(self, name: str) -> None:
        """Kill -9."""
        self.processes[name].kill()
        self.processes[name].wait()

    def statuses(self, limit: float = LONG) -> dict[str, int]:
        """Process → its exit status, once all have ended."""
        wait_until(lambda: all(one.poll() is not None for one in self.processes.values()), "the end of all", limit)
        return {name: one.returncode for name, one in self.processes.items()}

    @property
    def summary(self) -> Mapping[str, Any]:
        """Of the results."""
        return load_results(self.folder / "run").summary


@contextmanager
def by_hand(scenario: Scenario, folder: Path, endpoint: str, **given: Any) -> Iterator[ByHand]:
    """A run in a folder, whose processes are gone when the block ends; given: fields of `ByHand`."""
    run = ByHand(scenario, folder, endpoint, **given)
    try:
        yield run
    finally:
        for process in run.processes.values():
            process.kill()
            process.wait()


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
