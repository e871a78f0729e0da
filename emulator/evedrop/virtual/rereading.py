"""Messages of a run that are read again with a wrong field: their readers must say so, or may not notice it, but never fail.

A run ends with the first message that breaks the protocol. Read again, each message can be wrong in many ways.

Source: docs/protocol.md, messages and envelope.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, cast, final

from evedrop.errors import Contradiction, Gap, MalformedMessage, Refusal
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.protocol.codec import Reader, enclosed, named_in, payload_of
from evedrop.live.protocol.commands import Bounds, read_command
from evedrop.live.protocol.keys import RunKeys, reader_of, writer_of
from evedrop.live.protocol.notices import EndReport, RefusalNotice
from evedrop.live.protocol.packets import is_barrier, read_delivery
from evedrop.live.recorder.direction import status_in
from evedrop.live.recorder.intake import Intake
from evedrop.names import LEGITIMATE, RECORDER
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally
from evedrop.system.world import world as here
from evedrop.virtual.broken_messages import broken
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.notes import key_within
from evedrop.virtual.processes import LAUNCHER

if TYPE_CHECKING:
    from evedrop.live.recorder.steering import Steering
    from evedrop.virtual.run import SimulatedWorld

_MOST = 60
"""How many messages to the recorder, and to all others, are read again."""
_TIMES = 60
"""How often those to the recorder, and to all others, are read, each time with one wrong."""
_NAMED = (MalformedMessage, Gap, Contradiction, Refusal)
"""The errors that name the sender of a wrong message."""
_AT, _RELAY_AT = "tcp/127.0.0.1:1", "tcp/127.0.0.1:2"
_POLL_SECONDS = 1.0
_OF_RECORDER = frozenset({"telemetry", "journal"})


@final
class RereadMessages(Disturbance):
    """Somebody keeps the first messages of a run, and reads them as its processes do, each time with one of them wrong."""

    kind, share = "reread the messages of", 8
    only_target, harmless, early = "run", True, True

    def strike(self, world: SimulatedWorld) -> bool:
        """Keep them, and read them after the run."""
        of_recorder, of_others = list[bytes](), list[bytes]()

        def hear(process: str, message: bytes) -> None:
            kind = _within(message).partition("/")[0]
            heard = of_recorder if process == RECORDER else of_others
            kinds = _OF_RECORDER if process == RECORDER else _READERS
            if kind in kinds and len(heard) < _MOST:
                heard.append(message)

        def read() -> int:
            while world.process(LAUNCHER) is not None:
                here().sleep(_POLL_SECONDS)
            if world.scenario is not None and world.scenario.shards == 1:
                _MessageReader(world.scenario, world.ahead, of_recorder, of_others).read()
            return 0

        world.zenoh.listeners.append(hear)
        world.machine.begin("reader", read)
        return True


@final
class _Departures:
    """In place of a recorder's `Steering`: remembers which receivers have left."""

    def __init__(self) -> None:
        self._left: dict[str, int] = {}

    def held(self, slot: int) -> None:
        """The sensor holds."""

    def left(self, name: str, slot: int) -> None:
        """A receiver leaves before a slot."""
        self._left[name] = slot

    def has_left(self, name: str, slot: int) -> bool:
        """Whether it has left before that slot."""
        return self._left.get(name) == slot


@final
class _MessageReader:
    """Reads the messages of a run again."""

    def __init__(
        self, scenario: Scenario, ahead: int, of_recorder: Sequence[bytes], of_others: Sequence[bytes]
    ) -> None:
        self._scenario, self._of_recorder, self._of_others = scenario, of_recorder, of_others
        self._random = random.Random(here().token(8))  # noqa: S311 - to be repeated, not to be secret
        if of_recorder:
            keys = RunKeys(_reader(of_recorder[0]).key.split("/")[1])
            notice = RefusalNotice.of(keys.downlink(LEGITIMATE), "wrong").pack()
            self._of_recorder = [*of_recorder, enclosed(keys.telemetry(LEGITIMATE), notice)]
        endpoints = endpoints_at(_AT, relay=_RELAY_AT if scenario.relayed else None)
        briefs = briefs_of(scenario, endpoints, RecorderTask(Path("nowhere"), recording=False), ahead=ahead)
        self._brief = cast("Brief[RecorderPart]", briefs[RECORDER])

    def read(self) -> None:
        """Read them, each time with one of them wrong. Raises any error of a reader that names no sender."""
        alike = _alike(self._of_recorder)
        for _ in range(_TIMES if self._of_recorder else 0):
            at, messages = self._any_of(alike), [*self._of_recorder]
            messages[at] = broken(self._random, messages[at], harmless=True)
            with suppress(*_NAMED):
                self._record(messages)
        alike = _alike(self._of_others)
        for _ in range(_TIMES if self._of_others else 0):
            message = self._of_others[self._any_of(alike)]
            with suppress(*_NAMED):
                read = _READERS[_within(message).partition("/")[0]]
                read(
                    self._scenario, self._brief, _reader(message), _reader(broken(self._random, message, harmless=True))
                )

    def _any_of(self, alike: Sequence[Sequence[int]]) -> int:
        """The place of any message, of each key with some fields as often as of any other."""
        return self._random.choice(self._random.choice(alike))

    def _record(self, messages: Sequence[bytes]) -> None:
        """Take messages as a recorder does."""
        scenario, steering = self._scenario, cast("Steering", _Departures())
        intake = Intake(self._brief, scenario, RunTally.from_scenario(scenario, scenario.trials))
        for payload in messages:
            message = _reader(payload)
            source = writer_of(message.key)
            if status_in(message, source, scenario.slots) is None and EndReport.read(message) is None:
                intake.take(source, message, steering)


def _alike(messages: Sequence[bytes]) -> Sequence[Sequence[int]]:
    """The places of the messages with the same key and fields."""
    at: dict[tuple[str, ...], list[int]] = {}
    for place, message in enumerate(messages):
        at.setdefault((_within(message), *map(str, _reader(message).fields)), []).append(place)
    return [*at.values()]


def _within(message: bytes) -> str:
    """The key of a message, within its run."""
    return key_within(named_in(message) or "")


def _reader(message: bytes) -> Reader:
    key = str(named_in(message))
    return Reader(key, payload_of(key, message) or b"")


def _read_control(scenario: Scenario, brief: Brief[RecorderPart], right: Reader, wrong: Reader) -> None:
    del brief, right
    read_command(wrong, Bounds(scenario.slots, scenario.receivers))


def _read_downlink(scenario: Scenario, brief: Brief[RecorderPart], right: Reader, wrong: Reader) -> None:
    if is_barrier(right):
        return
    shape, window = (brief.model.process.n, scenario.trials), scenario.window(reader_of(right.key))
    read_delivery(wrong, right.integer("k"), shape, brief.model.header, window, brief.flow.message)


_READERS: Mapping[str, Callable[[Scenario, Brief[RecorderPart], Reader, Reader], None]] = {
    "control": _read_control,
    "downlink": _read_downlink,
}
"""Kind of key → reads a message with something wrong; gets the run's scenario, its recorder's brief, and the right message."""
