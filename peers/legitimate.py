"""The legitimate estimator: holds the secret, and reads every packet that reaches it."""

from __future__ import annotations

from emulator.brief import Brief
from emulator.model.schemes import SCHEMES
from peers.following import follow


def estimate(brief: Brief) -> None:
    """Run the legitimate estimator of a brief."""
    scheme = SCHEMES[brief.part["scheme"]](brief.model.process, brief.model.state_probability)
    follow(brief, scheme.estimator(brief.stream_keys, brief.batch))
