"""What the messages of a simulated run must be like, whatever happened to it: who sends what, how far ahead, and how often.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from evedrop.live.launch.briefs import flow_of
from evedrop.names import RECORDER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.notes import PutMessage

_HOLDS_SECONDS, _ROUNDED_SECONDS = 0.05, 1e-6
"""That a sensor may take to note that it holds, and by which times differ that are added up in another order."""


def wrong_messages(case: SimulatedCase, put: list[PutMessage], *, disturbed: bool) -> Iterator[str]:
    """What is wrong with the messages of a run; disturbed: whether anything has happened to it."""
    scenario = case.scenario
    if scenario.shards == 1:
        yield from _too_far_ahead(scenario, flow_of(scenario, case.ahead).window, put)
        yield from _forgotten(scenario, put)
        if scenario.pace:
            yield from _too_soon(scenario, put)
    yield from _to_the_absent(scenario, put)
    if not disturbed and not is_late(scenario):
        yield from _sent_again(put, scenario.shards)


def is_late(scenario: Scenario) -> bool:
    """Whether a packet may be under way for so long that it is asked for again."""
    return scenario.pace > 0 and any(scenario.link(name).delay for name in scenario.receivers)


def _too_far_ahead(scenario: Scenario, window: int, put: list[PutMessage]) -> Iterator[str]:
    """The first packet that the sensor sends although a process that it waits for is a window behind."""
    done = dict.fromkeys((*scenario.receivers, RECORDER), 0)
    for message in put:
        kind, _, name = message.key.partition("/")
        if kind == "progress" and message.slots:
            done[name] = max(done[name], message.slots[0])
        elif kind == "uplink" and message.said.startswith("hold "):  # it goes on when all have done the slots before
            done = {name: max(slot, int(message.said.split()[1])) for name, slot in done.items()}
        elif kind == "uplink" and message.slots:
            first, last = message.slots[0], message.slots[-1]
            behind = min(slot for name, slot in done.items() if name == RECORDER or not _is_away(scenario, name, first))
            if last >= behind + window:
                yield f"slot {last} is sent while slot {behind} is not done, in a window of {window}"
                return


def _forgotten(scenario: Scenario, put: list[PutMessage]) -> Iterator[str]:
    """The first slot that the sensor says it sends again, and does not send: a router would wait for it."""
    announced: int | None = None
    for message in put:
        if message.key != "uplink" or message.said == f"hold {scenario.slots}":  # with which a router wakes itself up
            continue
        *words, slots = message.said.split() or [""]
        if words == ["again"]:
            announced = int(slots)
        elif announced is not None:
            first = int(slots.partition("-")[0] or announced)
            if first > announced:
                yield f"slot {announced} is announced to be sent again, and slot {first} is sent"
                return
            announced = None


def _too_soon(scenario: Scenario, put: list[PutMessage]) -> Iterator[str]:
    """The first slot that the sensor sends before it is due: a hold puts off all later slots for as long as it lasts."""
    begun: float | None = None
    held: dict[int, float] = {}
    longer, goes_on, told = 0.0, set[int](), set[int]()
    for message in put:
        command, _, slot = message.said.partition(" ")
        if message.key == f"control/{SENSOR}" and command == "start" and begun is None:
            begun = message.at
        elif message.key == f"control/{SENSOR}" and command == "go" and int(slot) not in goes_on:
            goes_on.add(int(slot))
            longer += max(0.0, message.at - held.get(int(slot), message.at) - _HOLDS_SECONDS)
        elif message.key == "uplink" and command == "hold":
            held.setdefault(int(slot), message.at)
        elif message.key == f"telemetry/{SENSOR}" and message.said.isdecimal() and int(message.said) in held:
            if int(message.said) not in told | goes_on:  # the barrier: before it, the sensor may have been suspended
                told.add(int(message.said))
                held[int(message.said)] = message.at
        elif message.key == "uplink" and begun is not None:
            for first in message.slots[:1]:
                due = begun + first * scenario.pace + longer
                if message.at < due - _ROUNDED_SECONDS:
                    yield f"slot {first} is sent {due - message.at:.3f} s before it is due"
                    return


def _to_the_absent(scenario: Scenario, put: list[PutMessage]) -> Iterator[str]:
    """The first delivery to a receiver that is away."""
    for message in put:
        kind, _, name = message.key.partition("/")
        if kind == "downlink" and any(_is_away(scenario, name, slot) for slot in message.slots):
            yield f"slots {message.said} are delivered to {name}, which is away"
            return


def _is_away(scenario: Scenario, name: str, slot: int) -> bool:
    return any(away.start <= slot < away.stop for away in scenario.timeline.outages[name])


def _sent_again(put: list[PutMessage], shards: int) -> Iterator[str]:
    """The first command that is sent again in a run to which nothing happens."""
    commands = Counter((message.key, message.said) for message in put if message.key.startswith("control/"))
    for (key, said), count in commands.items():
        if said.startswith("again") or count > shards:
            yield f"{said!r} is sent to {key.partition('/')[2]}, {count} times, although nothing happens to the run"
            return
