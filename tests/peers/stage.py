"""A session that a test plays, in the place of the network's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self

from evedrop.live.launch.briefs import ObserverTask, briefs_of
from evedrop.live.network.resending import ReplayBuffer
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import telemetry
from evedrop.live.protocol.brief import AnyBrief, Flow
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.whereabouts import Place
from evedrop.scenario import Scenario
from tests.conftest import LIMIT

WINDOW, BATCH, SLOTS = 12, 4, 50
EXTENT = telemetry.Extent(SLOTS, 300, 2, 3)


def scenario_of(**changes: Any) -> Scenario:
    """A small scenario with one eavesdropper of each strategy."""
    table = {
        "title": "Peers",
        "slots": SLOTS,
        "trials": 3,
        "process": {
            "A": [[1.0, 0.1], [0.0, 1.0]],
            "Q": [[1e-3, 0.0], [0.0, 1e-3]],
            "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
        },
        "encoding": {"scheme": "innovation", "state_probability": 0.5},
        "legitimate": {"link": {"quality": 0.8}},
        "eavesdroppers": {
            "naive": {"strategy": "naive", "link": {"quality": 0.8}},
            "smart": {"strategy": "smart", "link": {"quality": 0.8}},
            "suspicious": {"strategy": "suspicious", "use_state": 0.9, "use_innovation": 0.1, "link": {"quality": 0.8}},
        },
    }
    return Scenario.model_validate({**table, **changes})


def briefs(**changes: Any) -> dict[str, AnyBrief]:
    """Briefs with a small window."""
    made = briefs_of(scenario_of(**changes), "tcp/127.0.0.1:1", ObserverTask(Path("nowhere"), False))
    return {name: replace(brief, flow=Flow(WINDOW, BATCH)) for name, brief in made.items()}


@dataclass
class Stage:
    """What a peer's session would carry: the test fills the inboxes and reads what was put."""

    inboxes: dict[str, SimpleQueue[bytes]] = field(default_factory=dict)
    funnels: dict[str, Callable[[bytes], None]] = field(default_factory=dict)
    put: SimpleQueue[tuple[str, bytes]] = field(default_factory=SimpleQueue)
    kept: dict[str, ReplayBuffer] = field(default_factory=dict)
    commands: SimpleQueue[bytes] = field(default_factory=SimpleQueue)
    """Of the conductor, as `wire.control` makes them."""

    def session(self, brief: AnyBrief) -> FakeSession:
        """In the place of `Session`."""
        return FakeSession(self, RunKeys(brief.run))

    def fill(self, key: str, messages: list[bytes]) -> None:
        """Put messages into an inbox."""
        queue = self.inboxes.setdefault(key, SimpleQueue())
        for message in messages:
            queue.put(message)

    def all(self, key: str) -> list[bytes]:
        """All messages that were put on a key; the others are dropped."""
        found = []
        while not self.put.empty():
            where, payload = self.put.get()
            if where == key:
                found.append(payload)
        return found


class FakeInbox:
    """The part of an inbox that peers use."""

    def __init__(self, queue: SimpleQueue[bytes]) -> None:
        self._queue = queue

    def recv(self) -> bytes:
        """The next message."""
        return self._queue.get(timeout=LIMIT)

    def __iter__(self) -> Iterator[bytes]:
        while not self._queue.empty():
            yield self.recv()


class FakeSession:
    """The part of `Session` that peers use."""

    def __init__(self, stage: Stage, keys: RunKeys) -> None:
        self._stage = stage
        self.keys = keys
        self.place = Place()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stage.put.put(("closed", b""))

    def inbox(self, key: str) -> Any:
        """An inbox whose `recv` never waits for longer than a test may."""
        queue = self._stage.inboxes.setdefault(key, SimpleQueue())

        return FakeInbox(queue)

    def funnel(self, key: str, receive: Callable[[bytes], None]) -> None:
        """As the real one, called by the test."""
        self._stage.funnels[key] = receive

    def outlet(self, key: str) -> Callable[[bytes], None]:
        """Puts into the stage."""
        return lambda payload: self._stage.put.put((key, payload))

    def kept(self, key: str, *how: Any, **more: Any) -> ReplayBuffer:
        """The same, kept to be sent again."""
        self._stage.kept[key] = kept = ReplayBuffer(self.outlet(key), *how, **more)
        return kept

    def ready(self) -> None:
        """Nobody to wait for."""

    def wait_for(self, command: str) -> None:
        """Until the test commands it."""
        while self.command().text("do") != command:
            pass

    def command(self) -> wire.Reader:
        """The next command, which the test gives."""
        return wire.Reader("control", self._stage.commands.get(timeout=LIMIT))

    def commanded(self) -> wire.Reader | None:
        """The next command if the test has given one."""
        return None if self._stage.commands.empty() else self.command()
