"""The sensor: simulates the process, fills a packet per slot by the scheme, and never runs ahead of its listeners."""

from __future__ import annotations

import time
from queue import SimpleQueue

from emulator.brief import Brief
from emulator.model.process import Trajectory
from emulator.model.schemes import SCHEMES
from emulator.network.access import OBSERVER, SENSOR
from emulator.network.reporting import TruthReporter
from emulator.network.session import Session
from emulator.network.wire import read_progress, uplink


class Window:
    """How far the sensor may go: `window` slots beyond the slowest of those who report progress. Final."""

    def __init__(self, session: Session, followers: tuple[str, ...], window: int) -> None:
        self._window = window
        self._done = dict.fromkeys(followers, 0)
        self._limit = window
        self._news: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
        self._keys = {name: session.keys.progress(name) for name in followers}
        for name, key in self._keys.items():
            session.funnel(key, lambda payload, name=name: self._news.put((name, payload)))  # type: ignore[misc]

    def wait(self, k: int) -> None:
        """Return when slot k may be sent."""
        while k >= self._limit:
            name, payload = self._news.get()
            self._done[name] = max(self._done[name], read_progress(self._keys[name], payload))
            self._limit = min(self._done.values()) + self._window


def sense(brief: Brief) -> None:
    """Run the sensor of a brief."""
    process, keys = brief.model.process, brief.stream_keys
    scheme = SCHEMES[brief.part["scheme"]](process, brief.model.state_probability)
    encoder = scheme.encoder(keys, brief.batch)
    trajectory = Trajectory(process, keys["process"], brief.batch)
    pace = float(brief.part["pace"])
    with Session(brief) as session:
        window = Window(session, (*brief.part["receivers"], OBSERVER), brief.flow.window)
        send = session.outlet(session.keys.uplink)
        reporter = TruthReporter(brief, session.outlet(session.keys.telemetry(SENSOR)))
        session.ready()
        session.wait_for("start")
        start = time.monotonic()
        for k in range(brief.slots):
            window.wait(k)
            if pace:
                time.sleep(max(0.0, start + k * pace - time.monotonic()))
            x = trajectory.advance()
            packet = encoder.encode(k, x, trajectory.predicted)
            send(uplink(k, packet.z))
            reporter.add(k, x, packet.nu)
        session.wait_for("end")
