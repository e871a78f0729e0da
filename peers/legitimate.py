"""The legitimate estimator: holds the secret, and reads every packet that reaches it."""

from __future__ import annotations

from emulator.brief import Brief
from emulator.model.schemes import scheme_of
from peers.following import follow


def estimate(brief: Brief) -> None:
    """Run the legitimate estimator of a brief."""
    scheme = scheme_of(brief.model.process, brief.part["scheme"])
    follow(brief, scheme.estimator(brief.stream_keys, brief.batch), scheme.needs_acknowledgements)
