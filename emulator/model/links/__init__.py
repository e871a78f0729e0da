"""Loss models of links by their name in a scenario: one file each."""

from __future__ import annotations

from collections.abc import Mapping

from emulator.model.links.bernoulli import Bernoulli
from emulator.model.links.link import LossModel

LOSS_MODELS: Mapping[str, type[LossModel]] = {"bernoulli": Bernoulli}
