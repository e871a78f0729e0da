"""The names that authors of schemes, eavesdroppers, links, events, metrics, panels, applications and commands import.

A plug-in needs nothing else of Evedrop. Every name here keeps its meaning within a major version.

Source: docs/your-own/overview.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from evedrop.cli.command import Command
from evedrop.errors import EvedropError, UsageError
from evedrop.model import update
from evedrop.model.checks import probability_mistakes
from evedrop.model.delays import ConstantDelay, DelayModel
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge, PacketReader, PacketTaker
from evedrop.model.eavesdroppers.fixed_rules import Naive
from evedrop.model.kernels import elementary
from evedrop.model.links import loss_of
from evedrop.model.links.chain import Chain
from evedrop.model.links.loss_model import Bernoulli, Fate, LossModel, fates_of
from evedrop.model.metrics.metric import MeanMetric, Metric, MetricColumn, MetricTally, ScoredSlots
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Belief, Beliefs, Codes, Flags, Receiver, Reception, prior, trace_of
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.schemes.plain import Plain, PlainEncoder, PlainEstimator
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, PacketBlock, Scheme, Shared
from evedrop.model.streams import Batch, BlockReader
from evedrop.model.theory.closed_forms import ClosedForm, ReceiverConditions
from evedrop.model.theory.covariances import Outcomes, OutcomesAt
from evedrop.names import ProcessAction
from evedrop.system.later import imported_later

if TYPE_CHECKING:
    from evedrop.scenario.application import (
        Application,
        ApplicationTally,
        ControlledPlant,
        DrawnFlow,
        DrawnLevel,
        Panel,
        PanelCurve,
        PanelFeed,
        PowerFeed,
        Sketch,
    )
    from evedrop.scenario.events.event import (
        Act,
        EventKind,
        Jamming,
        Leave,
        LinkCut,
        LinkHealed,
        LinkSettings,
        Nothing,
        Return,
        Spoofing,
    )
    from evedrop.scenario.table import Table
    from evedrop.show.view.column import Column, scalars
    from evedrop.show.view.panels.curves import curves_view, line_style, recent_slots, whole_run
    from evedrop.show.view.panels.panel import PlacedView, ViewPanel
    from evedrop.show.view.scene import PeerSlots, Scene, SceneSlots, Shown

__all__ = [
    "Act",
    "Action",
    "Application",
    "ApplicationTally",
    "Batch",
    "Belief",
    "Beliefs",
    "Bernoulli",
    "BlockReader",
    "Chain",
    "ClosedForm",
    "Codes",
    "Column",
    "Command",
    "ConstantDelay",
    "ControlledPlant",
    "DelayModel",
    "DrawnFlow",
    "DrawnLevel",
    "Eavesdropper",
    "Encoder",
    "EvedropError",
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
    "MeanMetric",
    "Metric",
    "MetricColumn",
    "MetricTally",
    "Naive",
    "NoInnovations",
    "Nothing",
    "Outcomes",
    "OutcomesAt",
    "Packet",
    "PacketBlock",
    "PacketReader",
    "PacketTaker",
    "Panel",
    "PanelCurve",
    "PanelFeed",
    "PeerSlots",
    "PlacedView",
    "Plain",
    "PlainEncoder",
    "PlainEstimator",
    "PowerFeed",
    "Process",
    "ProcessAction",
    "Receiver",
    "ReceiverConditions",
    "Reception",
    "Return",
    "Scene",
    "SceneSlots",
    "Scheme",
    "ScoredSlots",
    "Shared",
    "Shown",
    "Sketch",
    "Spoofing",
    "Table",
    "UsageError",
    "ViewPanel",
    "curves_view",
    "elementary",
    "fates_of",
    "line_style",
    "loss_of",
    "prior",
    "probability_mistakes",
    "recent_slots",
    "scalars",
    "trace_of",
    "update",
    "whole_run",
]


def __getattr__(name: str) -> Any:
    """Import what stands under TYPE_CHECKING when it is first used.

    These modules import Pydantic and Rerun, which are slow to load, and a receiver whose class is not built in needs neither.
    """
    return imported_later(__name__, name)
