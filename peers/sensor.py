"""The sensor: makes or takes the states, sends one packet in each slot by the scheme, and stays within the window."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection
from functools import partial
from queue import Empty
from typing import final

from evedrop.errors import RunError
from evedrop.live.network.process_session import InOrder, Mailbox, ReplayBuffer
from evedrop.live.network.program import ProgramStates
from evedrop.live.network.reporting import TruthReporter
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, Brief, ProgramPart, SensorPart, decoded
from evedrop.live.protocol.commands import EndRun, Go, Hold, Start
from evedrop.live.protocol.notices import Progress
from evedrop.live.protocol.packets import barrier, packets_of, read_acknowledgement, resend, uplink
from evedrop.live.protocol.telemetry import held
from evedrop.model.detection import CusumBatch
from evedrop.model.integrity.monitor import Monitor
from evedrop.model.local_filter import LocalFilter
from evedrop.model.schemes import scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.cores import GivenStates, PlantCore, SensorCore, recorded
from evedrop.model.slot.link import NEVER
from evedrop.model.slot.records import SensorSlots
from evedrop.names import RECORDER, SENSOR
from evedrop.peers.closed_loop import Steered
from evedrop.scenario.conformance.checked import checked_encoder
from evedrop.scenario.conformance.problems import Problem
from evedrop.system.world import world

_PROGRESS_BYTES = 16 * 2**20  # for one follower: far more than are ever under way
_SETTLE_SECONDS = 2.0
_POLL_SECONDS = 0.05  # how soon a request to hold is noticed


@final
class Window:
    """The sensor's flow control: it may be `window` slots ahead of the slowest process that reports progress.

    sent: the sensor's sent messages, which are forgotten as these processes progress.
    """

    def __init__(self, session: Session, followers: tuple[str, ...], window: int, sent: ReplayBuffer) -> None:
        self._window, self._sent, self._status = window, sent, session.status
        self._done = dict.fromkeys(followers, 0)
        self._absent: Collection[str] = ()
        self.limit = window
        """The first slot that may not be sent yet."""
        self._keys = {name: session.keys.progress(name) for name in followers}
        self._mailbox = Mailbox(self._keys, _PROGRESS_BYTES)
        for name, key in self._keys.items():
            session.subscribe_with(key, partial(self._mailbox.put, name))

    @property
    def followers(self) -> tuple[str, ...]:
        """The processes that report progress."""
        return tuple(self._done)

    def wait(self, k: int) -> None:
        """Wait until slot k may be sent."""
        while k >= self.limit:
            with self._status.waiting(
                *(self._keys[name] for name in self._followed if self._done[name] + self._window <= k)
            ):
                name, payload = self._mailbox.get()
            self._take(name, payload, k)

    def settle(self, k: int, seconds: float) -> None:
        """Wait until all slots below k are done, for some seconds at most."""
        deadline = world().monotonic() + seconds
        with contextlib.suppress(Empty):
            while min(self._done[name] for name in self._followed) < k:
                self._take(*self._mailbox.get(max(0.0, deadline - world().monotonic())), k)

    def _take(self, name: str, payload: bytes | bool, k: int) -> None:
        """Take a progress message; all slots of it are below k or k itself."""
        if isinstance(payload, bytes):
            self._done[name] = max(self._done[name], Progress.read(self._keys[name], payload, k).k)
        self._measure()

    def go_on(self, k: int, absent: Collection[str]) -> None:
        """All receivers have done all slots below k; do not wait for the absent ones from now on.

        The recorder need not have the controller's reports of these slots: the controller keeps those of a window. What it has
        told of its progress counts at once, or else the next messages would have fewer slots than the window allows.
        """
        self._done = {name: done if name == RECORDER else max(done, k) for name, done in self._done.items()}
        self._absent = absent
        self._measure()
        self.settle(k, 0.0)

    @property
    def _followed(self) -> list[str]:
        """The processes that the sensor waits for."""
        return [name for name in self._done if name not in self._absent]

    def _measure(self) -> None:
        done = min(self._done[name] for name in self._followed)
        self.limit = done + self._window
        self._sent.forget(done)


@final
class Barriers:
    """The barriers at which the sensor stops until it is told to continue: those in the brief, and on the conductor's command.

    flush: reports all slots below one.
    """

    def __init__(
        self,
        brief: Brief[SensorPart],
        session: Session,
        window: Window,
        telemetry: Callable[[int, bytes], None],
        flush: Callable[[], None],
    ) -> None:
        self._session, self._window = session, window
        self._telemetry, self._flush = telemetry, flush
        self._barriers = set(brief.part.holds)

    def after(self, k: int) -> int:
        """The first slot after slot k before which to stop."""
        return min((slot for slot in self._barriers if slot > k), default=NEVER)

    def wanted(self, k: int) -> bool:
        """Whether to stop before slot k."""
        while (command := self._session.commanded(self._window.followers)) is not None:
            if isinstance(command, Hold):
                self._barriers.add(k)
        return k in self._barriers

    def wait_at(self, k: int) -> None:
        """Report all slots below k, and wait for the conductor's `go`."""
        self._flush()
        self._telemetry(k, held(k))
        # The command may arrive more than once, and may belong to an earlier barrier.
        with self._session.status.waiting(self._session.keys.control(SENSOR)):
            while not isinstance(go := self._session.command(self._window.followers), Go) or go.slot != k:
                pass
        self._window.go_on(k, go.absent or ())
        self._barriers = {slot for slot in self._barriers if slot > k}
        if go.until is not None:
            self._barriers.add(go.until)


@final
class SensorLoop:
    """The sensor's work on a session that is being opened.

    It makes many slots at once, and sends them in one message; one at a time where each is due at a certain time, or where the
    next depends on an answer to it.
    """

    def __init__(
        self,
        brief: Brief[SensorPart],
        scheme: Scheme,
        core: SensorCore,
        session: Session,
        program: ProgramStates | None = None,
    ) -> None:
        """program: from which the core takes the states, if from any."""
        part = brief.part
        self._program = program
        self._brief, self._session, self._core = brief, session, core
        self._send = session.replaying_publisher(session.keys.uplink, head=resend, back=part.history)
        self._window = Window(session, (*part.receivers, RECORDER), brief.flow.window, self._send)
        self._back = None
        """The acknowledgements, each awaited before the next slot is sent, if the scheme needs them."""
        if scheme.needs_acknowledgements:
            key = session.keys.acknowledgements
            self._back = InOrder(session.subscribe(key), key, brief.flow.longest_outage)
        self._steered = None
        if part.plant is not None and part.controller is not None:
            self._steered = Steered(brief, part.plant.inputs, part.controller, session)
        telemetry = session.replaying_publisher(session.keys.telemetry(SENSOR), brief.flow.window + 1)
        self._reporter = TruthReporter(brief, telemetry)
        self._barriers = Barriers(brief, session, self._window, telemetry, self._reporter.flush)
        self._betrayed = set(part.leaks.values())
        self._answered = self._back is not None or self._steered is not None
        self._most = 1 if part.pace or self._answered or program is not None else brief.flow.message
        self._start = 0.0

    def carry_on(self) -> None:
        """Send all slots."""
        self._start = world().monotonic()
        k = 0
        while k < self._brief.slots:
            self._wait(k)
            slots = range(k, self._end_of_message(k))
            try:
                made = self._core.send(slots)
            except RunError:  # the program gave no state: its states so far should be in the results
                self._window.settle(k - k % self._brief.flow.batch, _SETTLE_SECONDS)
                raise
            if self._program is not None:
                self._start += self._program.waited  # so that later slots are not in a hurry
            truth = made.slots.x if k in self._betrayed else None
            self._send(slots[-1], uplink(packets_of(k, made.packets, truth)), k)
            self._reporter.add_slots(self._answers(made.slots) if self._answered else made.slots)
            k = slots.stop

    def _end_of_message(self, k: int) -> int:
        """The slot after those that the next message carries: a report ends, the run is held, or a state is betrayed."""
        batch = self._brief.flow.batch
        ends = [k + self._most, k - k % batch + batch, self._brief.slots, self._window.limit, self._barriers.after(k)]
        ends += [end for slot in self._betrayed for end in (slot, slot + 1) if end > k]
        return min(ends)

    def _answers(self, slots: SensorSlots) -> SensorSlots:
        """Wait for the answers to a single slot, and apply them; returns the slot with alarms and inputs."""
        k = slots.first
        if self._back is not None:
            sent = None if slots.sent is None else slots.sent[0]
            acknowledged = read_acknowledgement(self._back.take(k), k, self._brief.trials)
            alarms = self._core.acknowledged(k, acknowledged, sent)
            slots = slots.changed(alarms=None if alarms is None else alarms[None])
        if self._steered is not None:
            u, failed = self._steered.wait(k, slots.states[0])
            if self._steered.decides(k):
                self._core.set_inputs(u)
            slots = slots.changed(u=u[None], failed=failed[None])
        return slots

    def _wait(self, k: int) -> None:
        """Wait until slot k may be sent and is due; at a barrier before it, report all slots and wait for the conductor."""
        self._session.status.slot = k
        self._window.wait(k)
        pace = self._brief.part.pace
        # With a pace, a hold may be requested at any moment before the slot is due; each slot has at most one barrier.
        while not (wanted := self._barriers.wanted(k)) and pace and (left := self._left(k)) > 0.0:
            world().sleep(min(left, _POLL_SECONDS))
        if wanted:
            self._send(k, barrier(k))
            began = world().monotonic()
            self._barriers.wait_at(k)
            self._start += world().monotonic() - began
            world().sleep(max(0.0, self._left(k)) if pace else 0.0)

    def _left(self, k: int) -> float:
        """The seconds until slot k is due."""
        return self._start + k * self._brief.part.pace - world().monotonic()


def _core_of(brief: Brief[SensorPart], scheme: Scheme, program: ProgramStates | None) -> SensorCore:
    process, keys, plant = brief.model.process, brief.stream_keys, brief.part.plant
    disturbances = None if brief.part.disturbances is None else decoded(brief.part.disturbances, brief.slots)
    initial = scheme.initial_state(keys, brief.batch)
    local, monitor, spoofing = None, None, None
    plan = brief.part.monitor
    if plan is not None:
        monitor = Monitor(plan, keys.get("watermark", b""), brief.batch)
        spoofing = plan.spoofing(keys.get("spoofing", b""), brief.batch)
    if plant is not None and brief.part.filters:
        local = LocalFilter(process, plant, keys.get("measurement", b""), brief.batch, spoofing)
    given = None
    if program is not None:
        given = GivenStates(process, program.take, brief.trials)
    elif brief.part.states is not None:
        given = GivenStates(process, recorded(decoded(brief.part.states, brief.slots)), brief.trials)
    chart = brief.part.chart
    encoder = scheme.encoder(keys, brief.batch)
    return SensorCore(
        checked_encoder(encoder, brief.part.scheme["scheme"], scheme, Problem(process, brief.batch)),
        PlantCore(process, keys["process"], brief.batch, initial, plant, disturbances, given),
        local,
        None if chart is None else CusumBatch(chart, brief.trials),
        monitor,
    )


def sense(
    brief: Brief[SensorPart],
    connect: Callable[[AnyBrief], Session] = Session,
    listen: Callable[[ProgramPart, bool, float], ProgramStates] = ProgramStates,
) -> None:
    """Run the sensor of a brief.

    connect: opens its session. listen: takes the states of a program, if the brief names one.
    """
    scheme = scheme_of(brief.model.process, brief.part.scheme)
    entry = brief.part.program
    patience = brief.flow.longest_outage
    source = None if entry is None else listen(entry, bool(brief.part.pace), patience)
    with source or contextlib.nullcontext() as program, connect(brief) as session:
        loop = SensorLoop(brief, scheme, _core_of(brief, scheme, program), session, program)
        session.ready()
        session.wait_for(Start)
        loop.carry_on()
        session.wait_for(EndRun)
