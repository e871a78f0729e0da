"""An eavesdropper: receives the same packets over its own link, and reads them by its strategy."""

from __future__ import annotations

from collections.abc import Callable

from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, Brief, EavesdropperPart
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.peers.receiver_loop import follow
from evedrop.scenario.conformance.checked import checked_eavesdropper
from evedrop.scenario.conformance.problems import Problem


def eavesdrop(brief: Brief[EavesdropperPart], connect: Callable[[AnyBrief], Session] = Session) -> None:
    """Run the eavesdropper of a brief; connect: opens its session."""
    strategy, parameters = brief.part.strategy, brief.part.parameters
    model, distribution = brief.model, brief.part.noise_distribution
    mu_d, mu_d_of_slots = model.state_probability, model.state_probabilities
    knowledge = Knowledge(model.process, mu_d, parameters, brief.stream_keys, mu_d_of_slots, distribution)
    kind = STRATEGIES.imported(strategy)
    problem = Problem(model.process, brief.batch)
    receiver = checked_eavesdropper(kind(knowledge, brief.batch), brief.process, strategy, parameters, problem)
    follow(brief, receiver, betrayed=kind.betrayed(parameters), connect=connect)
