"""What every receiver does: take a delivery per slot, step, report."""

from __future__ import annotations

from emulator.brief import Brief
from emulator.model.receiver import Heard, Receiver
from emulator.network.reporting import BeliefReporter
from emulator.network.session import Session
from emulator.network.wire import read_delivery


def follow(brief: Brief, receiver: Receiver) -> None:
    """Run a receiver over all slots of its brief."""
    name, shape = brief.process, (receiver.process.n, brief.trials)
    with Session(brief) as session:
        downlink = session.keys.downlink(name)
        deliveries = session.inbox(downlink)
        put_telemetry = session.outlet(session.keys.telemetry(name))
        reporter = BeliefReporter(brief, put_telemetry, session.outlet(session.keys.progress(name)))
        session.ready()
        belief = receiver.prior()
        for k in range(brief.slots):
            gamma, z = read_delivery(downlink, deliveries.recv().payload.to_bytes(), k, shape)
            belief = receiver.step(k, belief, Heard(gamma, z))
            reporter.add(k, belief)
        session.wait_for("end")
