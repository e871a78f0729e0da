"""The controller: computes the plant's inputs from the legitimate estimate, or the true state, of a slot."""

from __future__ import annotations

from collections.abc import Callable

from evedrop.live.network.process_session import InOrder
from evedrop.live.network.reporting import DecisionReporter
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, Brief, ControllerPart, decoded
from evedrop.live.protocol.commands import EndRun
from evedrop.live.protocol.telemetry import decided, read_known
from evedrop.model.slot.cores import ControllerCore
from evedrop.names import CONTROLLER
from evedrop.peers.closed_loop import kept_decisive


def steer(brief: Brief[ControllerPart], connect: Callable[[AnyBrief], Session] = Session) -> None:
    """Run the controller of a brief; connect: opens its session."""
    part, process = brief.part, brief.model.process
    assignment = part.assignment
    disturbances = decoded(part.disturbances, brief.slots)
    controller = ControllerCore(part.strategy, assignment, disturbances, brief.trials)
    on_truth = part.acts_on == "truth"
    with connect(brief) as session:
        key, name = (session.keys.state, "x") if on_truth else (session.keys.estimate, "x_hat")
        messages = InOrder(session.subscribe(key), key, brief.flow.longest_outage)
        put = kept_decisive(session, session.keys.input, brief, assignment.period)
        # The recorder joins slots without the controller's reports, so all kept reports are sent again.
        kept = brief.flow.window + 1 + assignment.period
        telemetry = session.replaying_publisher(session.keys.telemetry(CONTROLLER), kept, back=kept)
        reporter = DecisionReporter(brief, telemetry, assignment.plant.inputs, assignment.period)
        session.ready()
        for k in range(0, brief.slots, assignment.period):
            session.status.slot = k
            x = read_known(messages.take(k), name, k, (process.n, brief.trials))
            made = controller.decide(k, x)
            put(k, decided(k, made.u, made.failed))
            reporter.add_decision(k, *made)
        session.wait_for(EndRun)
