"""An eavesdropper: receives the same packets over its own link, and reads them by its strategy."""

from __future__ import annotations

from evedrop.live.protocol.brief import Brief
from evedrop.live.protocol.brief_parts import EavesdropperPart
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.peers.following import follow


def eavesdrop(brief: Brief[EavesdropperPart]) -> None:
    """Run the eavesdropper of a brief."""
    knowledge = Knowledge(brief.model.process, brief.model.state_probability, brief.part.parameters, brief.stream_keys)
    follow(brief, STRATEGIES.imported(brief.part.strategy)(knowledge, brief.batch))
