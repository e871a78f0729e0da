"""The names that authors of schemes, eavesdroppers, loss models, delay models, controllers, applications and events import.

A plug-in needs nothing else of Evedrop. Whatever is here keeps its name and its meaning within a major version.

Source: docs/your-own.md.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from evedrop.kernels import elementary
from evedrop.model import update
from evedrop.model.controllers.controller import Controller
from evedrop.model.delays.constant import ConstantDelay
from evedrop.model.delays.delay import DelayModel
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge, PacketReader, PacketTaker
from evedrop.model.eavesdroppers.naive import Naive
from evedrop.model.links.bernoulli import Bernoulli
from evedrop.model.links.checks import probability_mistakes
from evedrop.model.links.link import Chain, Fate, LossModel, fates_of
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Belief, Codes, Flags, Receiver, Reception, prior, trace_of
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.schemes.plain import Plain, PlainEncoder, PlainEstimator
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, Scheme, Shared
from evedrop.model.theory.covariances import Outcomes, OutcomesAt
from evedrop.names import ProcessAction
from evedrop.streams import Batch, BlockReader

if TYPE_CHECKING:
    from evedrop.scenario.application import (
        Application,
        ApplicationTally,
        ControlledPlant,
        Panel,
        PanelCurve,
        PanelFeed,
    )
    from evedrop.scenario.events.effects import Jamming, Leave, LinkCut, LinkHealed, LinkSettings, Nothing, Return
    from evedrop.scenario.events.event import Act, EventKind
    from evedrop.scenario.table import Table

__all__ = [
    "Act",
    "Action",
    "Application",
    "ApplicationTally",
    "Batch",
    "Belief",
    "Bernoulli",
    "BlockReader",
    "Chain",
    "Codes",
    "ConstantDelay",
    "ControlledPlant",
    "Controller",
    "DelayModel",
    "Eavesdropper",
    "Encoder",
    "EventKind",
    "Fate",
    "Flags",
    "Floats",
    "Innovation",
    "Jamming",
    "Knowledge",
    "Leave",
    "LinkCut",
    "LinkHealed",
    "LinkSettings",
    "LossModel",
    "Naive",
    "NoInnovations",
    "Nothing",
    "Outcomes",
    "OutcomesAt",
    "Packet",
    "PacketReader",
    "PacketTaker",
    "Panel",
    "PanelCurve",
    "PanelFeed",
    "Plain",
    "PlainEncoder",
    "PlainEstimator",
    "Process",
    "ProcessAction",
    "Receiver",
    "Reception",
    "Return",
    "Scheme",
    "Shared",
    "Table",
    "elementary",
    "fates_of",
    "prior",
    "probability_mistakes",
    "trace_of",
    "update",
]

_LATER = (
    dict.fromkeys(
        ("Application", "ApplicationTally", "ControlledPlant", "Panel", "PanelCurve", "PanelFeed"),
        "evedrop.scenario.application",
    )
    | dict.fromkeys(("Act", "EventKind"), "evedrop.scenario.events.event")
    | dict.fromkeys(
        ("Jamming", "Leave", "LinkCut", "LinkHealed", "LinkSettings", "Nothing", "Return"),
        "evedrop.scenario.events.effects",
    )
    | {"Table": "evedrop.scenario.table"}
)
"""Imported when used: pydantic, which checks tables, would slow down a receiver that uses a class of its own."""


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LATER[name]), name)
