"""The legitimate estimator: shares the secret, and can read every packet that reaches it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, Brief, LegitimatePart
from evedrop.model.plant import InputAwareEstimator
from evedrop.model.schemes import scheme_of
from evedrop.peers.closed_loop import Consultation
from evedrop.peers.receiver_loop import follow
from evedrop.scenario.conformance.checked import checked_estimator
from evedrop.scenario.conformance.problems import Problem


def estimate(brief: Brief[LegitimatePart], connect: Callable[[AnyBrief], Session] = Session) -> None:
    """Run the legitimate estimator of a brief; connect: opens its session."""
    scheme = scheme_of(brief.model.process, brief.part.scheme)
    estimator = scheme.estimator(brief.stream_keys, brief.batch)
    problem = Problem(brief.model.process, brief.batch)
    receiver, loop = checked_estimator(estimator, brief.part.scheme["scheme"], problem), brief.part.controller
    if loop is not None and loop.plant is not None:
        receiver = InputAwareEstimator(receiver, loop.plant, brief.part.window)
    consult = partial(Consultation, brief, loop, receiver=receiver) if loop is not None else None
    follow(brief, receiver, scheme.needs_acknowledgements, consult, connect)
