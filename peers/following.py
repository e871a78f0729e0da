"""The work of every receiver: take one delivery in each slot, update the estimate, report."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import final

import numpy as np

from evedrop.live.network.process_session import ProcessSession, Received
from evedrop.live.network.reporting import BeliefReporter
from evedrop.live.network.resending import GapDetector
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, Brief
from evedrop.live.protocol.brief_parts import ReceiverPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import End
from evedrop.live.protocol.packets import acknowledgement, is_barrier, read_acknowledgement, read_delivery
from evedrop.live.protocol.telemetry import leaving
from evedrop.model.receiver import Belief, Receiver
from evedrop.model.slot.intermittent_receiver import Follower
from evedrop.model.slot.transit import Arrival
from evedrop.peers.closed_loop import Consultation


def follow(
    brief: Brief[ReceiverPart],
    receiver: Receiver,
    acknowledges: bool = False,
    consult: Callable[[ProcessSession], Consultation] | None = None,
    connect: Callable[[AnyBrief], ProcessSession] = Session,
) -> None:
    """Run a receiver over all slots of its brief, except those in which it is away.

    It may acknowledge packets, and send its estimate to a controller. Deliveries that it already had are acknowledged
    again, and otherwise ignored. connect: opens its session.
    """
    name, shape, window = brief.process, (receiver.process.n, brief.trials), brief.part.window
    outages = {start: (stop, keeps) for start, stop, keeps in brief.part.outages}
    follower = Follower(receiver, window, brief.first)
    if brief.first:
        _remember(brief, follower, outages)
    with connect(brief) as session:
        downlink = session.keys.downlink(name)
        deliveries = session.inbox(downlink)
        put_telemetry = session.kept(session.keys.telemetry(name), brief.flow.window + 1)
        cuts = [slot for start, (stop, _) in outages.items() for slot in (start, stop)]
        put_progress = session.kept(session.keys.progress(name), 0)
        answers = ReceiverReplies(brief, session, acknowledges, None if consult is None else consult(session))
        reporter = BeliefReporter(brief, put_telemetry, put_progress, cuts, brief.first, window > 0)
        due = GapDetector(downlink, brief.flow.longest_outage)
        session.ready()
        k = brief.first
        while k < brief.slots:
            session.place.slot = k
            message = Reader(downlink, deliveries.recv())
            found = message.integer("k")
            if is_barrier(message):
                if found != k:
                    due.missed(k, found)
                    continue
                if k in outages:
                    # Before the report that the conductor waits for, which may then end this process at once.
                    _save(brief, follower.belief)
                    put_telemetry(k, leaving(k, follower.belief))
                reporter.flush(k)
                if outages.get(k, (0, False))[0] >= brief.slots:
                    break
                continue
            if k in outages and found >= k:  # back from a pause
                stop, _ = outages[k]
                follower.miss(range(k, stop))
                reporter.skip(stop)
                k = stop
            if found != k:
                if found < k:
                    answers.had(found, message)
                due.missed(k, found)
                continue
            arrival = read_delivery(message, k, shape, brief.model.header, window)
            answers.before(k, arrival)
            belief = follower.take(k, arrival)
            answers.after(k, belief)
            reporter.add(k, belief, (follower.late, follower.late_used))
            k += 1
        answers.over(deliveries, downlink)
        session.wait_for(End)


@final
class ReceiverReplies:
    """A receiver's messages to processes other than the observer: acknowledgements, and its estimate to a controller."""

    def __init__(
        self, brief: AnyBrief, session: ProcessSession, acknowledges: bool, consultation: Consultation | None
    ) -> None:
        self._trials = brief.trials
        self._acknowledge = session.outlet(session.keys.acknowledged) if acknowledges else None
        self._consultation = consultation

    def had(self, k: int, delivery: Reader) -> None:
        """Handle a delivery of slot k that has arrived again: the first acknowledgement may have been lost."""
        if self._acknowledge is not None:
            self._acknowledge(_acknowledged(delivery, k, self._trials))

    def before(self, k: int, arrival: Arrival) -> None:
        """Handle slot k's delivery before the receiver takes it."""
        if self._acknowledge is not None:
            self._acknowledge(acknowledgement(k, arrival.heard.gamma))
        if self._consultation is not None:
            self._consultation.before(k)

    def after(self, k: int, belief: Belief) -> None:
        """Handle slot k's belief after the receiver has taken the delivery."""
        if self._consultation is not None:
            self._consultation.after(k, belief)

    def over(self, deliveries: Received, key: str) -> None:
        """After the last slot, acknowledge deliveries that still arrive, on a thread of its own that ends with the session."""
        if self._acknowledge is not None:
            threading.Thread(target=self._go_on, args=(deliveries, key), name="acknowledges", daemon=True).start()

    def _go_on(self, deliveries: Received, key: str) -> None:
        for delivery in deliveries:
            message = Reader(key, delivery)
            if not is_barrier(message):
                self.had(message.integer("k"), message)


def _acknowledged(delivery: Reader, k: int, trials: int) -> bytes:
    """The acknowledgement of a delivery: both messages have γ in the same field."""
    return acknowledgement(k, read_acknowledgement(delivery, k, trials))


def _save(brief: Brief[ReceiverPart], belief: Belief) -> None:
    """Save a belief for this process if it is restarted; does nothing if the brief names no state file."""
    if brief.part.state_file is None:
        return
    path = Path(brief.part.state_file)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        np.savez(file, belief.x_hat, belief.P, belief.action, *belief.memory)


def _remember(brief: Brief[ReceiverPart], follower: Follower, outages: dict[int, tuple[int, bool]]) -> None:
    """Restore the belief that this process had when it was ended, if it keeps its state over this outage."""
    start, keeps = next((start, keeps) for start, (stop, keeps) in outages.items() if stop == brief.first)
    if not keeps or brief.part.state_file is None:
        return
    with np.load(brief.part.state_file) as saved:
        x_hat, P, action, *memory = (saved[f"arr_{i}"] for i in range(len(saved.files)))
        follower.belief = Belief(x_hat, P, action, tuple(memory))
    follower.miss(range(start, brief.first))
