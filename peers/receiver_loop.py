"""The work of every receiver: take a delivery, update the estimate, report."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import final

import numpy as np

from evedrop.errors import MalformedMessage
from evedrop.live.network.process_session import GapDetector, Pending
from evedrop.live.network.reporting import BeliefReporter
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, Brief, ReceiverPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import EndRun
from evedrop.live.protocol.packets import acknowledgement, is_barrier, read_delivery
from evedrop.live.protocol.telemetry import leaving
from evedrop.model.receiver import Belief, Flags, Receiver
from evedrop.model.slot.cores import ReceiverCore
from evedrop.peers.closed_loop import Consultation
from evedrop.system.world import world


def follow(
    brief: Brief[ReceiverPart],
    receiver: Receiver,
    acknowledges: bool = False,
    consult: Callable[[Session], Consultation] | None = None,
    connect: Callable[[AnyBrief], Session] = Session,
    betrayed: int | None = None,
) -> None:
    """Run a receiver over all slots of its brief, except those in which it is away.

    It may acknowledge packets, and send its estimate to a controller. Deliveries that it already had are acknowledged
    again, and otherwise ignored. connect: opens its session; betrayed: the slot whose state it is told.
    """
    core = _core_of(brief, receiver)
    with connect(brief) as session:
        replies = ReceiverReplies(brief, session, acknowledges, None if consult is None else consult(session))
        loop = ReceiverLoop(brief, core, replies, session, betrayed)
        session.ready()
        loop.carry_on()
        replies.acknowledge_after_end(loop.deliveries)
        session.wait_for(EndRun)


@final
class ReceiverLoop:
    """A receiver's work on a session that is being opened."""

    def __init__(
        self,
        brief: Brief[ReceiverPart],
        core: ReceiverCore,
        replies: ReceiverReplies,
        session: Session,
        betrayed: int | None,
    ) -> None:
        name, key = brief.process, session.keys.downlink(brief.process)
        self._brief, self._core, self._replies, self._status = brief, core, replies, session.status
        self._betrayed = betrayed
        self._outages = _outages_of(brief)
        self.deliveries = Pending(session.subscribe(key), key)
        self._put_telemetry = session.replaying_publisher(session.keys.telemetry(name), brief.flow.window + 1)
        cuts = [slot for start, (stop, _) in self._outages.items() for slot in (start, stop)]
        put_progress = session.replaying_publisher(session.keys.progress(name), 0)
        self._reporter = BeliefReporter(brief, self._put_telemetry, put_progress, cuts)
        self._due = GapDetector(key, brief.flow.longest_outage)
        self._k = brief.first

    def carry_on(self) -> None:
        """Take all deliveries until the run is over, or until this process is away to its end."""
        while self._k < self._brief.slots:
            self._status.slot = self._k
            message = self.deliveries.peek()
            slot = message.integer("k")
            if is_barrier(message):
                self.deliveries.drop()
                if slot == self._k:
                    self._hold()
                    if self._outages.get(slot, (0, False))[0] >= self._brief.slots:
                        break
                else:
                    self._due.missed(self._k, slot)
                continue
            if self._k in self._outages and slot >= self._k:  # back from a pause
                self._return()
            if slot == self._k:
                self._take()
                continue
            self.deliveries.drop()
            if slot < self._k:
                self._replies.acknowledge_again(slot, message)
            self._due.missed(self._k, slot)

    def _hold(self) -> None:
        """Report all slots before this one; if this process is away from now on, its belief, too."""
        if self._k in self._outages:
            # Before the report that the conductor waits for, which may then end this process at once.
            _save(self._brief, self._core.belief)
            self._put_telemetry(self._k, leaving(self._k, self._core.belief))
        self._reporter.flush(self._k)

    def _return(self) -> None:
        stop, _ = self._outages[self._k]
        self._core.miss(range(self._k, stop))
        self._k = stop

    def _take(self) -> None:
        """Take the next delivery, which begins with this slot."""
        brief, k = self._brief, self._k
        shape = len(brief.model.A), brief.trials
        # An answer is awaited to every slot; a report ends at the end of its batch; an absence begins at a barrier.
        most = 1 if self._replies.awaited else min(brief.flow.batch - k % brief.flow.batch, brief.slots - k)
        message = self.deliveries.drop()
        arrivals = read_delivery(message, k, shape, brief.model.header, brief.part.window, most)
        slots = range(k, k + len(arrivals.gamma))
        if self._betrayed is not None and self._betrayed in slots and self._betrayed - k not in arrivals.truth:
            raise message.malformed("no truth", f"truth, the state of slot {self._betrayed}, which is betrayed")
        self._replies.before(k, arrivals.gamma[0])
        followed = self._core.take_slots(slots, arrivals)
        self._replies.after(k, self._core.belief)
        self._reporter.add_slots(followed)
        self._k = slots.stop


@final
class ReceiverReplies:
    """A receiver's messages to processes other than the recorder: acknowledgements, and its estimate to a controller."""

    def __init__(
        self, brief: AnyBrief, session: Session, acknowledges: bool, consultation: Consultation | None
    ) -> None:
        self._trials = brief.trials
        self._acknowledge = session.publisher(session.keys.acknowledged) if acknowledges else None
        self._consultation = consultation

    def acknowledge_again(self, k: int, delivery: Reader) -> None:
        """Handle a delivery of slot k that has arrived again: the first acknowledgement may have been lost."""
        if self._acknowledge is not None:
            self._acknowledge(acknowledgement(k, delivery.flags("gamma", (1, self._trials))[0]))

    @property
    def awaited(self) -> bool:
        """Whether another process waits for an answer to every delivery, so that each is taken by itself."""
        return self._acknowledge is not None or self._consultation is not None

    def before(self, k: int, gamma: Flags) -> None:
        """Handle slot k's delivery before the receiver takes it; gamma: γ (R,)."""
        if self._acknowledge is not None:
            self._acknowledge(acknowledgement(k, gamma))
        if self._consultation is not None:
            self._consultation.before(k)

    def after(self, k: int, belief: Belief) -> None:
        """Handle slot k's belief after the receiver has taken the delivery."""
        if self._consultation is not None:
            self._consultation.after(k, belief)

    def acknowledge_after_end(self, deliveries: Iterable[Reader]) -> None:
        """After the last slot, acknowledge deliveries that still arrive, on a thread of its own that ends with the session."""
        if self._acknowledge is not None:
            world().thread(self._go_on, deliveries, name="acknowledges").start()

    def _go_on(self, deliveries: Iterable[Reader]) -> None:
        for message in deliveries:
            with suppress(MalformedMessage):  # its slots are over: nobody waits for this process to refuse it
                if not is_barrier(message):
                    self.acknowledge_again(message.integer("k"), message)


def _save(brief: Brief[ReceiverPart], belief: Belief) -> None:
    """Save a belief for this process if it is restarted; does nothing if the brief names no state file.

    The file is complete at any moment: the barrier may come again, and this process may be ended then.
    """
    if brief.part.state_file is None:
        return
    path = Path(brief.part.state_file)
    unfinished = path.with_name(f"{path.name}.new")
    with world().disk.writer(unfinished) as file:
        np.savez(file, belief.x_hat, belief.P, belief.action, *belief.memory)
    world().disk.replace(unfinished, path)


def _outages_of(brief: Brief[ReceiverPart]) -> dict[int, tuple[int, bool]]:
    """First slot of each absence → the slot after it, and whether this process keeps its state."""
    return {start: (stop, keeps) for start, stop, keeps in brief.part.outages}


def _core_of(brief: Brief[ReceiverPart], receiver: Receiver) -> ReceiverCore:
    """The receiver at its first slot, with the belief that it had when it was ended, if it keeps its state over this absence."""
    core = ReceiverCore(receiver, brief.part.window, brief.first)
    if not brief.first:
        return core
    outages = _outages_of(brief)
    start, keeps = next((start, keeps) for start, (stop, keeps) in outages.items() if stop == brief.first)
    if keeps and brief.part.state_file is not None:
        with np.load(brief.part.state_file) as saved:
            x_hat, P, action, *memory = (saved[f"arr_{i}"] for i in range(len(saved.files)))
            core.belief = Belief(x_hat, P, action, tuple(memory))
        core.miss(range(start, brief.first))
    return core
