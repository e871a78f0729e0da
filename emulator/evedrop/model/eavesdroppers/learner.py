"""The base class of eavesdroppers that learn: they know the mechanism of the scheme, but neither the process nor μ_d.

Source: docs/mathematics.md, eavesdroppers that learn.
"""

from __future__ import annotations

from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.learning.known import known
from evedrop.model.learning.learner_posterior import bounded
from evedrop.model.process import Floats
from evedrop.model.streams import Batch


class Learner(PacketReader):
    """Learns A, Q, μ_d and Σ_k from its own packets; its parameter `knows` names those that it is told."""

    only_against = (
        ("innovation", "plain"),
        "learns from packets each of which is the state or an innovation, and others would mislead it",
    )
    inverts_noise = True  # if it knows Q
    costly = True

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self.known = known(knowledge.process, knowledge.state_probability, knowledge.parameters["knows"])

    def in_proportion(self, x_hat: Floats, P: Floats, largest: Floats) -> tuple[Floats, Floats]:
        """Mean and covariance, smaller where an estimate of A has put them out of all proportion to the largest packets."""
        return (x_hat, P) if "A" in self.known.names else bounded(x_hat, P, largest)
