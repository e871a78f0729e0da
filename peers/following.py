"""What every receiver does: take a delivery per slot, step, report."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from emulator.brief import Brief
from emulator.model.follower import Follower
from emulator.model.receiver import Belief, Receiver
from emulator.network.reporting import BeliefReporter
from emulator.network.session import Session
from emulator.network.wire import Reader, acknowledgement, is_hold, leaving, read_delivery
from peers.loop import Consultation


def follow(
    brief: Brief,
    receiver: Receiver,
    acknowledges: bool = False,
    consult: Callable[[Session], Consultation] | None = None,
) -> None:
    """Run a receiver over all slots of its brief, but for those in which it is away.

    It may acknowledge what it receives, and be consulted by a controller.
    """
    name, shape, window = brief.process, (receiver.process.n, brief.trials), brief.part["window"]
    outages = {start: (stop, keeps) for start, stop, keeps in brief.part["outages"]}
    follower = Follower(receiver, window, brief.first)
    if brief.first:
        _remember(brief, follower, outages)
    with Session(brief) as session:
        downlink = session.keys.downlink(name)
        deliveries = session.inbox(downlink)
        put_telemetry = session.outlet(session.keys.telemetry(name))
        cuts = [slot for start, (stop, _) in outages.items() for slot in (start, stop)]
        put_progress = session.outlet(session.keys.progress(name))
        put_acknowledgement = session.outlet(session.keys.acknowledged) if acknowledges else None
        consultation = consult(session) if consult is not None else None
        reporter = BeliefReporter(brief, put_telemetry, put_progress, cuts, brief.first, window > 0)
        session.ready()
        k = brief.first
        while k < brief.slots:
            message = Reader(downlink, deliveries.recv().payload.to_bytes())
            if is_hold(message):
                if message.slot(k) in outages:
                    # Before the report that the conductor waits for: it may end this process at once.
                    _save(brief, follower.belief)
                    put_telemetry(leaving(k, follower.belief))
                reporter.flush(k)
                if outages.get(k, (0, False))[0] >= brief.slots:
                    break
                continue
            if k in outages:  # back from a pause
                stop, _ = outages[k]
                follower.miss(range(k, stop))
                reporter.skip(stop)
                k = stop
            arrival = read_delivery(message, k, shape, brief.model.header)
            if put_acknowledgement is not None:
                put_acknowledgement(acknowledgement(k, arrival.heard.gamma))
            if consultation is not None:
                consultation.before(k)
            belief = follower.take(k, arrival)
            if consultation is not None:
                consultation.after(k, belief)
            reporter.add(k, belief, (follower.late, follower.late_used))
            k += 1
        session.wait_for("end")


def _save(brief: Brief, belief: Belief) -> None:
    """Put a belief where this process will find it if it is started again; nobody does who has not named a place."""
    if "state_file" not in brief.part:
        return
    path = Path(brief.part["state_file"])
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        np.savez(file, belief.x_hat, belief.P, belief.action, *belief.memory)


def _remember(brief: Brief, follower: Follower, outages: dict[int, tuple[int, bool]]) -> None:
    """Take up what this process knew when it was ended, if it keeps its state over this outage."""
    start, keeps = next((start, keeps) for start, (stop, keeps) in outages.items() if stop == brief.first)
    if not keeps:
        return
    with np.load(brief.part["state_file"]) as saved:
        x_hat, P, action, *memory = (saved[f"arr_{i}"] for i in range(len(saved.files)))
        follower.belief = Belief(x_hat, P, action, tuple(memory))
    follower.miss(range(start, brief.first))
