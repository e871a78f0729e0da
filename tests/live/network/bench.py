"""A router process of a real brief with everybody else played by the test, and a whole live run with its briefs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
import zenoh

from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import loopback_endpoints
from evedrop.live.network.session import client_config
from evedrop.live.protocol.brief import AnyBrief, Flow, brief_from
from evedrop.live.protocol.codec import enclosed, payload_of
from evedrop.live.protocol.keys import RunKeys
from evedrop.scenario.tables import Scenario
from evedrop.system.ports import free_port
from tests.builders import MARGINAL, listener, scenario_of
from tests.conftest import LIMIT, wait_until

Message = tuple[str, bytes]


def is_matched(end: zenoh.Publisher | zenoh.Querier) -> bool:
    """Whether any process reads its key, or answers."""
    return bool(end.matching_status.matching)  # type: ignore[attr-defined]  # the stub says bool


def small_network(**changes: Any) -> Scenario:
    """A small scenario: legitimate estimator, a smart, a suspicious and a naive eavesdropper."""
    tables = {
        "slots": 64,
        "trials": 5,
        "seed": 91,
        "encoding": {"scheme": "innovation", "state_probability": 0.4},
        "legitimate": {"link": {"quality": 0.8}},
        "eavesdroppers": {
            "eve": listener("smart", 0.7),
            "mallory": listener("suspicious", 0.6, use_state=0.8, use_innovation=0.2),
            "nadia": listener("naive", 0.9),
        },
    }
    return scenario_of(MARGINAL, **{**tables, **changes})


@dataclass
class Ear:
    """What arrived at one subscription, in order; without its envelope, if it has one."""

    messages: SimpleQueue[Message] = field(default_factory=SimpleQueue)

    def __call__(self, sample: zenoh.Sample) -> None:
        """Take what Zenoh hands over, on its thread."""
        kind = "" if sample.kind == zenoh.SampleKind.PUT else "deleted "
        key, message = str(sample.key_expr), sample.payload.to_bytes()
        payload = payload_of(key, message)
        self.messages.put((kind + key, message if payload is None else payload))

    def hear(self) -> Message:
        """The next message."""
        try:
            return self.messages.get(timeout=LIMIT)
        except Empty:
            raise AssertionError(f"nothing arrived within {LIMIT:.0f} s") from None

    def all(self) -> list[Message]:
        """Everything that has arrived by now."""
        messages = []
        while not self.messages.empty():
            messages.append(self.messages.get())
        return messages


def connect(brief: AnyBrief, **changes: Any) -> zenoh.Session:
    """A session with a brief's credentials, with a router that may not be up yet; changes replace top-level entries."""
    config = client_config(brief)
    config["connect"]["timeout_ms"] = int(1000 * LIMIT)
    return zenoh.open(zenoh.Config.from_json5(json.dumps({**config, **changes})))


class Bench:
    """A router process, and sessions with everybody else's credentials in the test's hands."""

    def __init__(self, scenario: Scenario, folder: Path, stack: ExitStack, protocol: str = "tcp") -> None:
        task = RecorderTask(folder / "results", False)
        listen = f"{protocol}/127.0.0.1:{free_port()}"
        endpoints = loopback_endpoints(listen, None, scenario.relayed)
        made = briefs_of(scenario, endpoints, task, ends_with_stdin=False)
        self.briefs: Mapping[str, AnyBrief] = {
            name: replace(brief, flow=Flow(32, 8, scenario.longest_outage)) for name, brief in made.items()
        }
        self.scenario = scenario
        self.due = 0
        """The next slot, in tests that let one pass after the other."""
        self.keys = RunKeys(self.briefs["router"].run)
        self.log = folder / "router.log"
        self.private = folder / "private"
        self.private.mkdir()
        self.router = self._started("router", folder, stack)
        if scenario.relayed:
            self.relay = self._started("relay", folder, stack)
        names = ("sensor", *scenario.receivers, "recorder")
        self.sessions = {name: stack.enter_context(connect(self.briefs[name])) for name in names}
        self.downlinks = {name: self.listen(name, self.keys.downlink(name)) for name in scenario.receivers}
        self.controls = {name: self.listen(name, self.keys.control(name)) for name in ("sensor", *scenario.receivers)}
        self.progress = {n: self.listen("sensor", self.keys.progress(n)) for n in (*scenario.receivers, "recorder")}
        processes = ("sensor", *scenario.receivers)
        self.telemetry = {name: self.listen("recorder", self.keys.telemetry(name)) for name in processes}
        self.journal = self.listen("recorder", self.keys.journal)
        self.tokens = Ear()
        for name in (*processes, "router"):
            self.sessions["recorder"].liveliness().declare_subscriber(self.keys.alive(name), self.tokens, history=True)
        # That the router knows all subscriptions is seen here: what was declared before on a connection, it knows before.
        assert self.tokens.hear() == (self.keys.alive("router"), b"")
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}
        for name in processes:
            self.settle(name)

    def _started(self, name: str, folder: Path, stack: ExitStack) -> subprocess.Popen[bytes]:
        """The process of a router's brief; ended with the bench."""
        with (folder / f"{name}.log").open("wb") as log:
            process = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", "evedrop", name, str(self.briefs[name].write(folder))],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env={**os.environ, "TMPDIR": str(self.private)},
                )
            )
        stack.callback(process.kill)
        return process

    def listen(self, process: str, key: str) -> Ear:
        """Subscribe with a process's credentials."""
        ear = Ear()
        self.sessions[process].declare_subscriber(key, ear)
        return ear

    def put(self, process: str, key: str, payload: bytes) -> None:
        """Publish with a process's credentials on a key it may write, in the order of all its other puts."""
        if (process, key) not in self._publishers:
            publisher = self.sessions[process].declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
            wait_until(lambda: is_matched(publisher), f"a reader of {key}")
            self._publishers[process, key] = publisher
        self._publishers[process, key].put(enclosed(key, payload))

    def settle(self, process: str) -> None:
        """Return when the router has dealt with everything that a process put and asked for before."""
        key = self.keys.telemetry(process)
        self.put(process, key, b"settled")
        assert self.telemetry[process].hear() == (key, b"settled")

    def packet(self, k: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        """The payloads of slot k: any numbers that tell slots, states and trials apart."""
        n, trials = 2, self.scenario.trials
        return np.arange(n * trials, dtype=float).reshape(n, trials) + 100.0 * (k + 1)


@contextmanager
def bench_of(scenario: Scenario, folder: Path, protocol: str = "tcp") -> Iterator[Bench]:
    """A bench that is gone when the block ends."""
    with ExitStack() as stack:
        yield Bench(scenario, folder, stack, protocol)


def brief_of_eve(**part: Any) -> AnyBrief:
    """The brief of the smart eavesdropper of that scenario, as it is read; part: entries of its part that differ."""
    brief = briefs_of(small_network(), loopback_endpoints(None, None, False), RecorderTask(Path("nowhere"), False))[
        "eve"
    ]
    return brief_from(json.loads(replace(brief, part=replace(brief.part, **part)).text))
