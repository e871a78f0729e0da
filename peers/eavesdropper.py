"""An eavesdropper: hears the same packets over its own link, and reads them by its strategy."""

from __future__ import annotations

from emulator.brief import Brief
from emulator.model.eavesdroppers import STRATEGIES
from emulator.model.eavesdroppers.eavesdropper import Knowledge
from peers.following import follow


def eavesdrop(brief: Brief) -> None:
    """Run the eavesdropper of a brief."""
    knowledge = Knowledge(
        brief.model.process, brief.model.state_probability, brief.part["parameters"], brief.stream_keys
    )
    follow(brief, STRATEGIES.imported(brief.part["strategy"])(knowledge, brief.batch))
