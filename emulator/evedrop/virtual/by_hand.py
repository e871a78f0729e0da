"""Somebody who writes briefs beside a run, also with wrong options, breaks some of them, and starts their processes by hand.

Source: docs/hosts.md, processes started by hand.
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.names import ROUTER
from evedrop.scenario.tables import Scenario
from evedrop.system.world import world as here
from evedrop.virtual.disturbance import KILLED, Disturbance
from evedrop.virtual.notes import BY_HAND

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

_PORT = 20_000
_AT, _RELAY_AT = "tls/127.0.0.1:{port}", "tls/127.0.0.1:{relay_port}"
_ONE_ROUTER = "briefs for one router"
_OPTIONS: Mapping[str, Sequence[str]] = {
    "briefs": ("--listen", _AT),
    "unencrypted briefs": ("--listen", "tcp/127.0.0.1:{port}"),
    "briefs for a host": ("--listen", "tcp/0.0.0.0:{port}", "--connect", "tcp/router.lan:{port}", "--insecure"),
    "briefs for an unknown host": (
        *("--listen", "tcp/unknown:{port}", "--connect", "tcp/unknown:{port}", "--insecure"),
    ),
    "files for containers": (),
}
"""What is written → the options for it, in a run with one router; with two, those of the relay are added."""
_WRONG_OPTIONS: Mapping[str, Sequence[str]] = {
    "briefs without encryption": ("--listen", "tcp/0.0.0.0:{port}", "--connect", "tcp/router.lan:{port}"),
    "briefs for everywhere": ("--listen", "tls/0.0.0.0:{port}"),
    "briefs for two protocols": ("--listen", _AT, "--connect", "tcp/router.lan:{port}"),
    "briefs for a sixth version": ("--listen", "tls/[fd00::1]:{port}"),
    "briefs for no endpoint": ("--listen", "nowhere"),
    _ONE_ROUTER: ("--listen", _AT),
    "briefs for a needless relay": ("--listen", _AT, "--relay-connect", _RELAY_AT),
    "briefs for two at one place": ("--listen", _AT, "--relay", _AT),
    "briefs for a mixture": ("--listen", _AT, "--relay", "tcp/127.0.0.1:{relay_port}"),
}
"""The same, for what is refused in any case, or for two routers."""
_CONTAINERS = "files for containers"
_AGAIN = (
    (("{own}", "{folder}"), UsageError.exit_status),
    (("{own}", "{folder}", "--overwrite", "--set", "title=Other"), UsageError.exit_status),
    (("{own}", "{folder}", "--overwrite"), 0),
    (("eavesdroppers", "{folder}", "--overwrite"), 0),
    (("eavesdroppers", "{folder}", "--overwrite", "--set", "slots=9"), 0),
)
"""What is written over files for containers: scenario, folder and options; and the exit status."""
_TOO_LARGE = 2**30 + 1
_WAIT_SECONDS, _POLL_SECONDS = "1", 0.2
LACKS = ("No space left on device", "Input/output error", "not enough memory", "no further process or thread")
_PATIENCE_SECONDS = 10.0
_STARTED, _STARTING_SECONDS = 12, 40.0
"""How many processes are started, one after the other."""
CLOCKS = (-90.0 * 86_400.0, 90.0 * 86_400.0)
"""By how many seconds a clock is wrong, so that no certificate is valid."""
_PATHS = frozenset({"last_word", "modules", "results", "state_file"})
"""Entries with a path: another one would be outside the simulated disk."""
_WRONG: Sequence[Any] = (None, True, -1, 2**70, float("inf"), "", "x", "/nowhere", [], {}, [[1.0]], {"scheme": "x"})
"""What an entry of a brief is replaced with."""
_IS_ENDPOINT, _ENDPOINTS = (
    re.compile("t(cp|ls)/"),
    ("unixsock-stream/x", "unixsock-stream//x", "unixsock-stream//tmp/x"),
)
"""What is an endpoint, and places at which nobody can listen."""
Brief = dict[str, Any]


class ByHand(Disturbance):
    """Somebody does something beside the run, in a folder of its own."""

    harmless = True

    def strike(self, world: SimulatedWorld) -> bool:
        """Let somebody do it, who gives up if the disk does not take it."""

        def act() -> int:
            with suppress(OSError):
                return self._act(world)
            return 1

        world.machine.begin("somebody", act)
        return True

    @abstractmethod
    def _act(self, world: SimulatedWorld) -> int:
        """Do it; returns the exit status. Raises OSError."""


@final
class WriteBriefs(ByHand):
    """`evedrop brief`, and a process that is started with one of the briefs, in which an entry may be wrong."""

    kind, share = "write", 5
    awaited_seconds = 60.0

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """What is written: mostly what somebody could use."""
        del scenario
        return [*[*_OPTIONS] * 3, *_WRONG_OPTIONS]

    def _act(self, world: SimulatedWorld) -> int:
        scenario, folder = world.scenario, world.disk.root / f"by hand {self.after}"
        if scenario is None or folder.exists():
            return 0
        folder.mkdir(0o700)
        written = folder / "written"
        status = world.machine.program([*self._words(scenario, folder), str(written)])
        expected = UsageError.exit_status if self._refused(scenario) else 0
        if status != expected and not any(lack in world.machine.current.printed for lack in LACKS):
            raise AssertionError(f"to write {self.target} ends with status {status}")
        if status == 0 and self.target == _CONTAINERS:
            text = (written / "docker-compose.yml").read_text()
            lacking = [name for name in (ROUTER, *scenario.receivers) if f"{name}:" not in text]
            if lacking:
                raise AssertionError(f"no container is for {', '.join(lacking)}")
            self._write_again(world, written)
        elif status == 0:
            self._start_some(world, {path: json.loads(path.read_text()) for path in sorted(written.glob("*.json"))})
        return 0

    @staticmethod
    def _write_again(world: SimulatedWorld, written: Path) -> None:
        for words, expected in _AGAIN:
            own, folder, *options = (word.format(own=written / "scenario.toml", folder=written) for word in words)
            status = world.machine.program(["brief", own, "--compose", folder, *options])
            if status != expected:
                raise AssertionError(f"files for containers of {own} end with status {status}: {' '.join(options)}")

    def _words(self, scenario: Scenario, folder: Path) -> list[str]:
        from evedrop.results.resolved_scenario import write_resolved  # noqa: PLC0415

        write_resolved(folder, scenario)
        words = ["brief", str(folder / "scenario.toml")]
        if self.target == _CONTAINERS:
            return [*words, "--compose"]
        options = _OPTIONS.get(self.target) or _WRONG_OPTIONS[self.target]
        if scenario.relayed and self.target in _OPTIONS:
            options = [*options, "--relay", options[1].replace("{port}", "{relay_port}")]
            if "--connect" in options:
                options += ["--relay-connect", options[3].replace("{port}", "{relay_port}")]
        port = _PORT + 2 * self.after % _PORT
        words += [option.format(port=port, relay_port=port + 1) for option in options]
        return [*words, "--wait", _WAIT_SECONDS, "--results", str(folder / "results"), "--out"]

    def _refused(self, scenario: Scenario) -> bool:
        if self.target == _CONTAINERS:
            return scenario.shards > 1 or scenario.modules is not None or scenario.process.source == "zenoh"
        wrong = scenario.relayed if self.target == _ONE_ROUTER else self.target in _WRONG_OPTIONS
        return wrong or scenario.shards > 1

    @staticmethod
    def _start_some(world: SimulatedWorld, briefs: Mapping[Path, Brief]) -> None:
        """Start processes with briefs in which an entry is wrong, each kind of entry as often as any other."""
        some = random.Random(here().token(8))  # noqa: S311 - to be repeated, not to be secret
        of_kind: dict[str, list[tuple[Path, list[Any]]]] = {}
        for path, brief in briefs.items():
            for place in _places(brief):
                of_kind.setdefault(str(next(name for name in reversed(place) if name != 0)), []).append((path, place))
        deadline = here().monotonic() + _STARTING_SECONDS
        for _ in range(_STARTED):
            if here().monotonic() > deadline:
                return
            path, place = some.choice(of_kind[some.choice([*of_kind])])
            brief, role, clock, chance = deepcopy(briefs[path]), briefs[path]["role"], 0.0, some.random()
            if chance < 0.03:
                clock = some.choice(CLOCKS)
            elif chance < 0.11:
                _exchange(some, brief, some.choice([*briefs.values()]))
            elif chance < 0.14:
                role = some.choice([*briefs.values()])["role"]
            elif chance > 0.15:
                _break(some, brief, place)
            path.write_text(json.dumps(brief))
            if chance > 0.99:
                os.truncate(path, _TOO_LARGE)
            path.chmod(0o644 if some.random() < 0.03 else 0o600)
            _start(world, role, path, clock)
            path.write_text(json.dumps(briefs[path]))


def _start(world: SimulatedWorld, role: str, path: Path, clock: float) -> None:
    """Start a process with a brief that is wrong, or where a clock is; it ends, and says why."""
    process = world.machine.begin(BY_HAND, lambda: world.machine.program([role, str(path)]))
    process.task.clock = clock
    deadline = here().monotonic() + _PATIENCE_SECONDS
    while process.task.status is None and here().monotonic() < deadline:
        here().sleep(_POLL_SECONDS)
    process.signal(signal.SIGKILL)  # the wrong entry may be how long it waits for others
    ended = process.task.status in {UsageError.exit_status, RunError.exit_status, Interrupted.exit_status, KILLED}
    if not ended or "Traceback" in process.printed:
        raise AssertionError(
            f"{role} ends with status {process.task.status} because of a wrong brief: {process.printed[-500:]}"
        )


def _exchange(some: random.Random, brief: Brief, other: Brief) -> None:
    """Let a brief have the identity of another process, or the key of its identity, or the keys of its random streams."""
    mine, its = brief.get("identity"), other.get("identity")
    if mine is None or its is None or some.random() < 0.3:
        brief["keys"] = other["keys"]
    elif some.random() < 0.5:
        brief["identity"] = its
    else:
        mine["key"] = its["key"]


def _places(table: Any) -> Iterator[list[Any]]:
    """The names that lead to each entry of a brief; the first one of a list stands for all, and a scenario for its entries.

    So do the answers of classes: simulated processes share what they have learned of them.
    """
    for name in [*table] if isinstance(table, dict) else [0] if isinstance(table, list) and table else []:
        yield [name]
        if name not in {"scenario", "classes"}:
            for rest in _places(table[name]):
                yield [name, *rest]


def _break(some: random.Random, brief: Brief, place: Sequence[Any]) -> None:
    """Let an entry of a brief be wrong, lack or be too many."""
    *path, last = place
    table: Any = brief
    for name in path:
        table = table[name]
    if some.random() < 0.15:
        del table[last]
    elif last in _PATHS:
        table[last] = some.choice([value for value in _WRONG if not isinstance(value, str)])
    else:
        table[last] = some.choice(_others(table[last]) if some.random() < 0.8 else _WRONG)


def _others(value: Any) -> Sequence[Any]:
    """Other values of the same type."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int | float):
        return [value + 1, -1, 0, 1e300]
    if isinstance(value, str):
        return ["x", value[1:], *(_ENDPOINTS if _IS_ENDPOINT.match(value) else [])]
    if isinstance(value, list) and value:
        return [value[:-1], [*value, value[-1]]]
    if isinstance(value, dict) and value:
        return [{**value, "unknown": 1}, dict(list(value.items())[1:])]
    return _WRONG
