"""The names that authors of schemes, eavesdroppers, loss models, delay models and controllers import.

A plug-in needs nothing else of Evedrop. Whatever is here keeps its name and its meaning within a major version.

Source: docs/your-own.md.
"""

from __future__ import annotations

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
from evedrop.streams import Batch, BlockReader

__all__ = [
    "Action",
    "Batch",
    "Belief",
    "Bernoulli",
    "BlockReader",
    "Chain",
    "Codes",
    "ConstantDelay",
    "Controller",
    "DelayModel",
    "Eavesdropper",
    "Encoder",
    "Fate",
    "Flags",
    "Floats",
    "Innovation",
    "Knowledge",
    "LossModel",
    "Naive",
    "NoInnovations",
    "Outcomes",
    "OutcomesAt",
    "Packet",
    "PacketReader",
    "PacketTaker",
    "Plain",
    "PlainEncoder",
    "PlainEstimator",
    "Process",
    "Receiver",
    "Reception",
    "Scheme",
    "Shared",
    "elementary",
    "fates_of",
    "prior",
    "probability_mistakes",
    "trace_of",
    "update",
]
