"""Delay models of links by their name in a scenario: one file each, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.model.delays.constant import ConstantDelay
from evedrop.model.delays.delay import DelayModel
from evedrop.model.delays.normal import Normal
from evedrop.model.delays.pareto import Pareto
from evedrop.model.delays.trace import RecordedDelay
from evedrop.model.registry import Registry

_BUILT_IN: Mapping[str, type[DelayModel]] = {
    "constant": ConstantDelay,
    "normal": Normal,
    "pareto": Pareto,
    "trace": RecordedDelay,
}
DELAY_MODELS: Registry[DelayModel] = Registry("delay model", DelayModel, "evedrop.delays", _BUILT_IN, ("model", "unit"))  # type: ignore[type-abstract]


def delay_of(spec: Mapping[str, Any]) -> DelayModel:
    """The delay model that a link's specification describes: `{"model": …, …parameters}`, lengths in slots."""
    parameters = {name: value for name, value in spec.items() if name != "model"}
    return DELAY_MODELS[spec["model"]](**parameters)
