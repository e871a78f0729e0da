"""Loss models of links by their name in a scenario, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evedrop.model.links.distance import Distance
from evedrop.model.links.loss_model import Bernoulli, LossModel, Pooled
from evedrop.model.links.markov import GilbertElliott, Markov
from evedrop.model.links.trace import Pattern, RecordedLoss
from evedrop.model.registry import Registry

POOLED = "pooled"
"""The `model` of what `pooled_spec` gives; a scenario cannot name it."""
_BUILT_IN: Mapping[str, type[LossModel]] = {
    "bernoulli": Bernoulli,
    "distance": Distance,
    "gilbert-elliott": GilbertElliott,
    "markov": Markov,
    "pattern": Pattern,
    "trace": RecordedLoss,
}
LOSS_MODELS: Registry[LossModel] = Registry("loss model", LossModel, "evedrop.links", _BUILT_IN, ("model",))  # type: ignore[type-abstract]


def loss_of(spec: Mapping[str, Any]) -> LossModel:
    """The loss model that a scenario describes: `{"model": …, …parameters}`, or what `pooled_spec` gives."""
    if spec["model"] == POOLED:
        return Pooled([loss_of(link) for link in spec["links"]])
    parameters = {name: value for name, value in spec.items() if name != "model"}
    return LOSS_MODELS[spec["model"]](**parameters)


def pooled_spec(specs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The description of several links that end at one receiver; specs: the description of each one's loss model."""
    return {"model": POOLED, "links": list(specs)}


def single_specs(spec: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    """The descriptions of the loss models that have a name: of every link where several are pooled, otherwise the one given."""
    return spec["links"] if spec["model"] == POOLED else [spec]
