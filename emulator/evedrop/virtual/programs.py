"""A program of the simulated world that publishes the states of a run, and what the run may make of them.

Source: docs/programs.md.
"""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Iterator, Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import zenoh

from evedrop.errors import ScenarioError
from evedrop.results.folder import STATES
from evedrop.scenario.loading import Scenario
from evedrop.system.files import lines_in
from evedrop.system.world import world as here
from evedrop.virtual.notes import BY_HAND
from evedrop.virtual.processes import LAUNCHER

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

_KEY, _PLACE = "robot/pose", "tcp/127.0.0.1:17450"
_NAMES = ("x", "v")
_ONE_IN = 12
"""How many scenarios there are for each whose states are given."""
_WITHOUT, _MISTAKEN = 0.2, 0.3
"""The fraction of their runs without a program, which have the same states in the scenario, and of programs with a mistake."""
_OFFSETS = (4, 12)
_PAUSE_SECONDS, _LATER_SECONDS = 0.02, 0.5
"""The mean time between two states, and that once there were many more than there are slots."""
_PLENTY = 3
_FLOOD = 101_000
"""More states than a sensor keeps and takes meanwhile."""
_NO_FLOOD = 0.9
"""The fraction of programs with a mistake whose mistake is no flood: one takes as long to play as forty runs."""
_NO_STATE = "no state came"
MISTAKES: Mapping[str, str] = {
    "no listener": "cannot connect within 30 s to",
    "silence": _NO_STATE,
    "a flood": "sends faster than the run",
    "no text": "expected JSON such as",
    "no JSON": "expected JSON such as",
    "a lacking state": "without v; expected",
    "too many states": "expected 2 numbers",
    "no number": "expected a finite number",
    "a large number": "expected a finite number",
    "a large message": "bytes; expected at most",
    "too few bytes": "or more, for numbers at 4, 12",
}
"""What a program does wrong → part of what the run prints."""
_OF_BYTES = frozenset({"no listener", "silence", "no number", "a large number", "a large message", "too few bytes"})
"""What a program may do wrong that sends bytes instead of text."""
FORMS = ("object", "list", "bytes")


@final
@dataclass(frozen=True)
class DrawnProgram:
    """A program that publishes the states of a run, one after the other."""

    listens: bool
    """Whether the sensor connects to it; otherwise it connects to the sensor."""
    form: str
    """What its messages are: an object, a list, or bytes."""
    mistake: str = ""
    """One of `MISTAKES`, or nothing."""
    right: int = 0
    """How many states it publishes before its mistake."""

    def __str__(self) -> str:
        where = "at which the sensor connects" if self.listens else "at the sensor"
        wrong = f", and {self.mistake} after {self.right} states" if self.mistake else ""
        return f"a program {where} publishes each state as {self.form}{wrong}"

    def as_list(self) -> list[Any]:
        """All that it has."""
        return [*astuple(self)]

    def smaller(self) -> Iterator[DrawnProgram | None]:
        """Plainer ones, the plainest first; None: the scenario has the states itself."""
        yield None
        yield DrawnProgram(self.listens, "list")
        if self.right:
            yield DrawnProgram(self.listens, self.form, self.mistake)

    @property
    def refused(self) -> str | None:
        """A text that the failing run prints; None if it need not fail."""
        return MISTAKES[self.mistake] if self.mistake else None

    @property
    def tolerated(self) -> bool:
        """Whether the run may complete all the same: a short one may have its states before too many wait."""
        return self.mistake == "a flood"

    def seconds(self, scenario: Scenario) -> float:
        """For how much longer a run may take because of it."""
        patience = 30.0 + max(5.0, scenario.longest_outage) if self.mistake else 0.0
        return 2.0 * _LATER_SECONDS * scenario.slots + 2.0 + patience

    def scenario(self, scenario: Scenario) -> Scenario:
        """A scenario with given states, so that a live run takes them from this program."""
        tables = scenario.as_tables()
        process = {name: value for name, value in tables["process"].items() if name != "state_values"}
        place = {"connect": _PLACE} if self.listens else {"listen": _PLACE}
        offsets = {"offsets": [*_OFFSETS]} if self.form == "bytes" else {}
        return Scenario(
            {**tables, "process": {**process, "source": "zenoh", "zenoh": {"key": _KEY, **place, **offsets}}}
        )

    def begin(self, world: SimulatedWorld, scenario: Scenario) -> None:
        """Begin it; scenario: with the states."""
        if self.mistake != "no listener":
            world.machine.begin(f"program {BY_HAND}", lambda: self._publish(world, scenario))

    def _publish(self, world: SimulatedWorld, scenario: Scenario) -> int:
        place = {"endpoints": [_PLACE]}
        settings = {"mode": "router", "listen": place} if self.listens else {"mode": "client", "connect": place}
        sent = 0
        while (session := _opened(settings)) is None:
            if world.process(LAUNCHER) is None:
                return 0
        with session:
            publisher = session.declare_publisher(_KEY)
            while self.mistake == "a flood" and not publisher.matching_status.matching:
                if world.process(LAUNCHER) is None:
                    return 0
                here().sleep(_PAUSE_SECONDS)
            while world.process(LAUNCHER) is not None:
                wrong = self.mistake if sent >= self.right else ""
                for key, payload in self._messages(scenario, sent, wrong):
                    session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
                session.delete(_KEY)  # is no state
                sent += _FLOOD if wrong == "a flood" and sent == self.right else 1
                mean = _PAUSE_SECONDS if sent < _PLENTY * scenario.slots else _LATER_SECONDS
                here().sleep(2.0 * mean * here().token(1)[0] / 256.0)
        return 0

    def _messages(self, scenario: Scenario, number: int, wrong: str) -> Iterator[tuple[str, bytes]]:
        """The keys and messages of one state; wrong: the mistake in them."""
        x, v = state(scenario, number)
        if wrong == "a flood" and number == self.right:
            yield from ((_KEY, self._message(state(scenario, later))) for later in range(number, number + _FLOOD))
        elif wrong == "no number":
            yield _KEY, self._message([x, float("nan")])
        elif wrong == "a large number":
            yield _KEY, self._message([x, 1e101])
        elif wrong in _PAYLOADS:
            yield _KEY, _PAYLOADS[wrong]
        elif wrong != "silence":
            yield _KEY, self._message([x, v])

    def _message(self, values: list[float]) -> bytes:
        if self.form == "bytes":
            return b"head" + struct.pack("<2d", *values)
        return json.dumps(dict(zip(_NAMES, values, strict=True)) if self.form == "object" else values).encode()


_PAYLOADS: Mapping[str, bytes] = {
    "no text": b"\xff\xfe",
    "no JSON": b"x" * 100,
    "a lacking state": b'{"x": 1.0}',
    "too many states": b"[1.0, 2.0, 3.0]",
    "a large message": bytes(2**20 + 1),
    "too few bytes": b"1234",
}


def _opened(settings: Mapping[str, Any]) -> Any:
    """A session; None if there is nobody to connect with, after a pause."""
    try:
        return here().zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError:
        here().sleep(_PAUSE_SECONDS)
        return None


def state(scenario: Scenario, number: int) -> list[float]:
    """A state of a program: those of the scenario, and then larger ones."""
    values = scenario.process.state_values or []
    return [value + number // len(values) for value in values[number % len(values)]]


def with_states(number: int, scenario: Scenario) -> Scenario:
    """A drawn scenario, which has given states for some numbers, if they fit."""
    some = random.Random(f"states {number}")  # noqa: S311 - to be repeated, not to be secret
    if some.random() * _ONE_IN >= 1.0 or scenario.shards > 1:
        return scenario
    values = [[round(some.gauss(0.0, 1.0), 3) for _ in _NAMES] for _ in range(scenario.slots)]
    given = {"source": "file", "states": [*_NAMES], "state_values": values}
    tables = {name: table for name, table in scenario.as_tables().items() if name != "pace"}
    try:
        return Scenario({**tables, "process": {**tables["process"], **given}})
    except ScenarioError:  # its states must be simulated
        return scenario


def drawn_program(seed: int, scenario: Scenario) -> DrawnProgram | None:
    """The program of a seed's run; None if its states are not given, or the scenario has them."""
    some = random.Random(f"program {seed}")  # noqa: S311 - to be repeated, not to be secret
    if scenario.process.source != "file" or some.random() < _WITHOUT:
        return None
    form, mistake = some.choice(FORMS), ""
    if some.random() < _MISTAKEN:
        rare = {"a flood"} if some.random() < _NO_FLOOD else set[str]()
        mistake = some.choice(
            [name for name in MISTAKES if name not in rare and (form != "bytes" or name in _OF_BYTES)]
        )
        form = "bytes" if mistake == "too few bytes" else form
    listens = mistake == "no listener" or some.random() < 0.5
    late = mistake not in {"", "a flood"} and some.random() < 0.5
    return DrawnProgram(listens, form, mistake, some.randrange(scenario.slots) if late else 0)


def taken_states(folder: Path, scenario: Scenario, *, disturbed: bool) -> tuple[Scenario, int, list[str]]:
    """The scenario with the states that a run has taken, their number, and what is wrong with them.

    Without disturbance these are states that the program has published one after the other; otherwise some may be left out.
    """
    # A full disk may have cut the last line short.
    lines = lines_in(folder / STATES)[1:] if (folder / STATES).is_file() else []
    taken = [[float(word) for word in line.split(b",")] for line in lines]
    published = [state(scenario, number) for number in range(len(taken) + _PLENTY * 500)]
    wrong, at = list[str](), -1
    for slot, row in enumerate(taken):
        later = next((number for number in range(at + 1, len(published)) if published[number] == row), None)
        if later is None or (slot and not disturbed and later != at + 1):
            wrong.append(f"the state of slot {slot} is {row}, and the program has not published it then")
            break
        at = later
    rest = (scenario.process.state_values or [])[len(taken) :]
    tables = scenario.as_tables()
    return Scenario({**tables, "process": {**tables["process"], "state_values": [*taken, *rest]}}), len(taken), wrong
