"""The sensor: simulates the process, sends one packet in each slot by the scheme, and stays within the window."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from functools import partial
from typing import final

from evedrop.errors import RunError
from evedrop.live.network.clock import SYSTEM_CLOCK, Clock
from evedrop.live.network.mailbox import Mailbox
from evedrop.live.network.process_session import ProcessSession
from evedrop.live.network.reporting import TruthReporter
from evedrop.live.network.resending import GapDetector, ReplayBuffer
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, Brief
from evedrop.live.protocol.brief_parts import SensorPart
from evedrop.live.protocol.codec import Reader, read_progress
from evedrop.live.protocol.commands import End, Go, Hold, Start
from evedrop.live.protocol.packets import PacketExtras, barrier, read_acknowledgement, resend, uplink
from evedrop.live.protocol.telemetry import held
from evedrop.model.numeric.detection import CusumBatch
from evedrop.model.process import Trajectory
from evedrop.model.receiver import Flags
from evedrop.model.schemes import scheme_of
from evedrop.model.schemes.scheme import Encoder, Packet, Scheme
from evedrop.names import OBSERVER, SENSOR
from evedrop.peers.closed_loop import Actuator

_PROGRESS_BYTES = 16 * 2**20  # for one follower: far more than are ever under way
_LOOK_SECONDS = 0.05  # how soon a request to hold is noticed


@final
class Window:
    """The sensor's flow control: it may be `window` slots ahead of the slowest process that reports progress.

    sent: the sensor's sent messages, which are forgotten as these processes progress.
    """

    def __init__(
        self,
        session: ProcessSession,
        followers: tuple[str, ...],
        window: int,
        sent: ReplayBuffer,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._window, self._sent, self._place = window, sent, session.place
        self._done = dict.fromkeys(followers, 0)
        self._absent: Collection[str] = ()
        self._limit = window
        self._keys = {name: session.keys.progress(name) for name in followers}
        self._news = Mailbox(self._keys, _PROGRESS_BYTES, clock)
        for name, key in self._keys.items():
            session.funnel(key, partial(self._news.put, name))

    @property
    def followers(self) -> tuple[str, ...]:
        """The processes that report progress."""
        return tuple(self._done)

    def wait(self, k: int) -> None:
        """Wait until slot k may be sent."""
        while k >= self._limit:
            with self._place.waiting(
                *(self._keys[name] for name in self._followed if self._done[name] + self._window <= k)
            ):
                name, payload = self._news.get()
            if isinstance(payload, bytes):
                self._done[name] = max(self._done[name], read_progress(self._keys[name], payload, k))
            self._measure()

    def go_on(self, k: int, absent: Collection[str]) -> None:
        """All processes have done all slots below k; do not wait for the absent ones from now on."""
        self._done = {name: max(done, k) for name, done in self._done.items()}
        self._absent = absent
        self._measure()

    @property
    def _followed(self) -> list[str]:
        """The processes that the sensor waits for."""
        return [name for name in self._done if name not in self._absent]

    def _measure(self) -> None:
        done = min(self._done[name] for name in self._followed)
        self._limit = done + self._window
        self._sent.forget(done)


@final
class Barriers:
    """The barriers at which the sensor stops until it is told to go on: those in the brief, and on the conductor's command."""

    def __init__(
        self,
        brief: Brief[SensorPart],
        session: ProcessSession,
        window: Window,
        scheme: Scheme,
        actuator: Actuator | None,
    ) -> None:
        self._session, self._window = session, window
        self._barriers = set(brief.part.holds)
        self._telemetry = session.kept(session.keys.telemetry(SENSOR), brief.flow.window + 1)
        watches = brief.part.chart is not None
        inputs, measures = (0, False) if actuator is None else (actuator.inputs, actuator.measures)
        self.reporter = TruthReporter(brief, self._telemetry, scheme.may_be_silent, watches, inputs, measures)

    def wanted(self, k: int) -> bool:
        """Whether to stop before slot k."""
        while (command := self._session.commanded(self._window.followers)) is not None:
            if isinstance(command, Hold):
                self._barriers.add(k)
        return k in self._barriers

    def wait_at(self, k: int) -> None:
        """Report all slots below k, and wait for the conductor's `go`."""
        self.reporter.flush(k)
        self._telemetry(k, held(k))
        # The command may arrive more than once, and may belong to an earlier barrier.
        with self._session.place.waiting(self._session.keys.control(SENSOR)):
            while not isinstance(go := self._session.command(self._window.followers), Go) or go.slot != k:
                pass
        self._window.go_on(k, go.absent or ())
        self._barriers = {slot for slot in self._barriers if slot > k}
        if go.until is not None:
            self._barriers.add(go.until)


@final
class Acknowledgements:
    """Waits for the acknowledgements of each slot before the next is sent, and watches for attacks on them."""

    def __init__(self, brief: Brief[SensorPart], session: ProcessSession, encoder: Encoder) -> None:
        self._encoder, self._trials = encoder, brief.trials
        self._key = session.keys.acknowledgements
        self._inbox = session.inbox(self._key)
        self._due = GapDetector(self._key, brief.flow.longest_outage)
        chart = brief.part.chart
        self._watch = CusumBatch(chart, brief.trials) if chart is not None else None

    def wait(self, k: int, packet: Packet) -> Flags | None:
        """Wait for the acknowledgements of slot k; returns where they raise an alarm, (R,), or None if they are not watched."""
        message = self._due.take(lambda: Reader(self._key, self._inbox.recv()), k)
        acknowledged = read_acknowledgement(message, k, self._trials)
        self._encoder.acknowledged(k, acknowledged)
        return self._watch.take(acknowledged, packet.sent) if self._watch is not None else None


def sense(brief: Brief[SensorPart], connect: Callable[[AnyBrief], ProcessSession] = Session) -> None:
    """Run the sensor of a brief; connect: opens its session."""
    process, keys, part = brief.model.process, brief.stream_keys, brief.part
    scheme = scheme_of(process, part.scheme)
    encoder = scheme.encoder(keys, brief.batch)
    initial = scheme.initial_state(keys, brief.batch)
    noise = None if part.plant is None else part.plant.plant.noise
    trajectory = Trajectory(process, keys["process"], brief.batch, initial, noise)
    betrayed, pace = set(part.leaks.values()), part.pace
    with connect(brief) as session:
        send = session.kept(session.keys.uplink, head=resend, back=part.history)
        window = Window(session, (*part.receivers, OBSERVER), brief.flow.window, send)
        back = Acknowledgements(brief, session, encoder) if scheme.needs_acknowledgements else None
        actuator = Actuator(brief, part.plant, session) if part.plant is not None else None
        barriers = Barriers(brief, session, window, scheme, actuator)
        session.ready()
        session.wait_for(Start)
        start = time.monotonic()
        for k in range(brief.slots):
            session.place.slot = k
            window.wait(k)
            # With a pace, a hold may be requested at any moment before the slot is due; each slot has at most one barrier.
            while not (wanted := barriers.wanted(k)) and pace and (left := start + k * pace - time.monotonic()) > 0.0:
                time.sleep(min(left, _LOOK_SECONDS))
            if wanted:
                send(k, barrier(k))
                began = time.monotonic()
                barriers.wait_at(k)
                start += time.monotonic() - began
                time.sleep(max(0.0, start + k * pace - time.monotonic()) if pace else 0.0)
            true = trajectory.advance(None if actuator is None else actuator.pushed(k))
            x, predicted = true, trajectory.predicted
            if actuator is not None:
                x, predicted = actuator.transmitted(k, true, trajectory)
            packet = encoder.encode(k, x, predicted)
            if packet.z.shape != x.shape:
                found, name = packet.z.shape, part.scheme["scheme"]
                raise RunError(
                    f"slot {k}: encode of the scheme {name} gave z of shape {found}; expected {x.shape}; correct the class"
                )
            beside = PacketExtras(packet.header, packet.sent, x if k in betrayed else None)
            send(k, uplink(k, packet.z, **beside.given))
            alarms = back.wait(k, packet) if back is not None else None
            steered = actuator.wait(k, true) if actuator is not None else None
            barriers.reporter.add(k, x, packet.nu, packet.sent, alarms, steered, true)
        session.wait_for(End)
