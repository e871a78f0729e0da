"""How many slots travel in a message changes nothing: sensor, router and receivers in memory report the same, bit by bit."""

from __future__ import annotations

import itertools
import threading
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, cast

import pytest

from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.network.router import RouterLoop
from evedrop.live.protocol.brief import AnyBrief, Brief, Flow, RouterPart, SensorPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import EndRun, Go, Start
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.notices import Progress
from evedrop.live.protocol.packets import is_barrier
from evedrop.live.protocol.telemetry import is_held, is_leaving
from evedrop.peers.eavesdropper import eavesdrop
from evedrop.peers.legitimate import estimate
from evedrop.peers.sensor import sense
from evedrop.scenario.tables import Scenario
from tests.builders import MARGINAL, listener, part_of, scenario_of
from tests.conftest import LIMIT
from tests.examples import mostly_long
from tests.live.in_memory import FakeSession, Stage

SLOTS = 150
DELAYED = {"quality": 0.8, "duplicate": 0.2, "delay": {"model": "normal", "mean": 0.5, "standard_deviation": 1.5}}
AWAY = range(41, 67)

TABLES: dict[str, dict[str, Any]] = {
    "plain": {},
    "a header": {
        "encoding": {"scheme": "partial-encryption", "encrypted": [0], "state_probability": 0.5},
        "eavesdroppers": {"eve": listener("naive", 0.7)},
    },
    "silence": {
        "encoding": {"scheme": "withholding", "state_probability": 0.6},
        "eavesdroppers": {"eve": listener("naive", 0.7)},
    },
    "late packets": {
        "legitimate": {"window": 3, "link": DELAYED},
        "eavesdroppers": {"eve": {**listener("smart", 0.7), "window": 2, "link": DELAYED}},
    },
    "an absence": {
        "event": [{"at": AWAY.start, "pause": "eve"}, {"at": AWAY.stop, "resume": "eve"}],
        "legitimate": {"window": 3, "link": DELAYED},
    },
    "a betrayed state": {
        "eavesdroppers": {
            "eve": listener("smart", 0.7),
            "told": listener("replay-informed", 0.8, learns_at=53, reads_as="smart"),
        }
    },
}
"""What is special about a scenario → its tables."""


def scenario(case: str) -> Scenario:
    """A scenario of 150 slots and 3 trials."""
    tables = {
        "slots": SLOTS,
        "trials": 3,
        "record_trials": 2,
        "encoding": {"scheme": "innovation", "state_probability": 0.4},
        "legitimate": {"link": {"quality": 0.8}},
        "eavesdroppers": {"eve": listener("smart", 0.7)},
    }
    return scenario_of(MARGINAL, **{**tables, **TABLES[case]})


class Connected(FakeSession):
    """A session whose messages reach those who have subscribed, and the test."""

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """Puts where the key is read, as it is when the message is put."""
        stage = self._stage

        def put(payload: bytes) -> None:
            if key in stage.queues:
                stage.queues[key].put(payload)
            if key in stage.callbacks:
                stage.callbacks[key](payload)
            stage.put.put((key, payload))

        return put


class Run:
    """All processes but the recorder, each in a thread of its own; the test is the recorder and conductor."""

    def __init__(self, of: Scenario, flow: Flow, holds: tuple[int, ...] = ()) -> None:
        made = briefs_of(of, endpoints_at("tcp/127.0.0.1:1"), RecorderTask(Path("nowhere"), False))
        self.briefs: dict[str, AnyBrief] = {name: replace(brief, flow=flow, run="r") for name, brief in made.items()}
        sensor = part_of(self.briefs["sensor"], SensorPart)
        holding = tuple(sorted({*sensor.holds, *holds}))
        self.briefs["sensor"] = replace(self.briefs["sensor"], part=replace(sensor, holds=holding))
        self.receivers, links = tuple(of.receivers), part_of(self.briefs["router"], RouterPart).links
        self.absences = {
            name: [range(away.start, away.stop) for away in links[name].outages] for name in self.receivers
        }
        self.keys, self.stage = RunKeys("r"), Stage()
        self.commands = {name: SimpleQueue[bytes]() for name in ("sensor", "router", *self.receivers)}
        self.heard: defaultdict[str, list[bytes]] = defaultdict(list)
        self.reported = dict.fromkeys((self.keys.journal, *map(self.keys.telemetry, ("sensor", *self.receivers))), 0)
        self.done, self.held = 0, -1

    def session(self, brief: AnyBrief) -> Any:
        """A process's session, with commands of its own."""
        stage = replace(self.stage, commands=self.commands[brief.process])
        return Connected(stage, self.keys, brief)

    def carry_through(self) -> dict[str, list[bytes]]:
        """Key → all messages that were put on it, until all reports are complete."""
        router = RouterLoop(cast(Brief[RouterPart], self.briefs["router"]), self.session(self.briefs["router"]))
        works: list[Callable[[], object]] = [router.carry_on]
        for name in self.receivers:
            self.session(self.briefs[name]).subscribe(self.keys.downlink(name))
            receive: Callable[..., None] = estimate if name == "legitimate" else eavesdrop
            works.append(partial(receive, self.briefs[name], self.session))
        works.append(partial(sense, cast(Brief[SensorPart], self.briefs["sensor"]), self.session))
        threads = [threading.Thread(target=work, daemon=True) for work in works]
        for thread in threads:
            thread.start()
        self.commands["sensor"].put(Start().pack())
        while min(self.reported.values()) < SLOTS:
            try:
                self.take(*self.stage.put.get(timeout=LIMIT))
            except Empty:
                raise AssertionError(f"nothing more came: {self.reported}, held before {self.held}") from None
        for queue in self.commands.values():
            queue.put(EndRun().pack())
        for thread in threads:
            thread.join(LIMIT)
            assert not thread.is_alive()
        return dict(self.heard)

    def take(self, key: str, payload: bytes) -> None:
        """Note a message, and do what the recorder would."""
        self.heard[key].append(payload)
        if key not in self.reported:
            return
        message = Reader(key, payload)
        if is_held(message):
            self.held = message.integer("k")
        elif not is_leaving(message):
            assert message.integer("k") == self.reported[key], key
            self.reported[key] += message.integer("c")
        done = min(self.reported.values())
        if done > self.done:
            self.done = done
            self.stage.callbacks[self.keys.progress("recorder")](Progress(done).pack())
        if self.held == done:
            self.go_on(done)

    def go_on(self, k: int) -> None:
        """Let the run go on after a hold."""
        self.held = -1
        absent = tuple(name for name, away in self.absences.items() if any(k in some for some in away))
        for name in absent:  # nothing comes from it before it is back
            (stop,) = (some.stop for some in self.absences[name] if k in some)
            self.reported[self.keys.telemetry(name)] = stop
        self.commands["router"].put(Go(k).pack())
        self.commands["sensor"].put(Go(k, absent).pack())


def reports(heard: dict[str, list[bytes]]) -> dict[str, list[bytes]]:
    """The messages that the recorder gets."""
    return {key: payloads for key, payloads in heard.items() if "telemetry/" in key or key.endswith("journal")}


def slots_of(payloads: list[bytes]) -> list[int]:
    """How many slots each message has, without barriers."""
    messages = (Reader("m", payload) for payload in payloads)
    return [message.integer("c") for message in messages if not is_barrier(message)]


HOLDS: dict[str, tuple[int, ...]] = {"no holds": (), "holds": (1, 17, 18, 53, 54, 96, 131)}


@pytest.mark.parametrize(
    ("case", "holds"),
    mostly_long(itertools.product(TABLES, HOLDS), zip(TABLES, itertools.cycle(HOLDS), strict=False)),
)
def test_reports_and_journals_do_not_depend_on_the_slots_of_a_message(case: str, holds: str) -> None:
    """Also where batch, window and messages do not divide each other."""
    of = scenario(case)
    absent = len(AWAY) if case == "an absence" else 0
    for window, batch in ((32, 8), (50, 17)):
        alone: dict[str, list[bytes]] = {}
        for most in (1, 2, 7, 64):
            run = Run(of, Flow(window, batch, message=most), HOLDS[holds])
            heard = run.carry_through()
            counts = slots_of(heard[run.keys.uplink])
            assert sum(counts) == SLOTS
            assert max(counts) == min(most, batch)
            for name in run.receivers:
                away = absent if name == "eve" else 0
                assert sum(slots_of(heard[run.keys.downlink(name)])) == SLOTS - away
            alone = alone or reports(heard)
            assert reports(heard).keys() == alone.keys()
            for key, payloads in reports(heard).items():
                assert payloads == alone[key], (key, most)


def test_digests_do_not_depend_on_batches_either() -> None:
    """Those of the reports of all receivers."""
    digests: list[dict[str, dict[Any, Any]]] = []
    for window, batch, most in ((32, 8, 1), (50, 17, 7), (150, 150, 64), (3, 1, 64)):
        run = Run(scenario("late packets"), Flow(window, batch, message=most))
        heard = run.carry_through()
        of_run: dict[str, dict[Any, Any]] = {}
        for name in run.receivers:
            messages = (Reader(name, payload) for payload in heard[run.keys.telemetry(name)])
            of_run[name] = {block: value for message in messages for block, value in message.map("digests").items()}
        digests.append(of_run)
    assert all(of_run == digests[0] for of_run in digests)
    assert all(digests[0].values())
