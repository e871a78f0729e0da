"""Strategies that read packets by themselves, by their name in a scenario, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.eavesdroppers.bayesian import Bayesian, Genie
from evedrop.model.eavesdroppers.code_readers import ClearStates, Reference
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper
from evedrop.model.eavesdroppers.fixed_rules import ConstantEstimate, Naive, Selective, Smart, Suspicious
from evedrop.model.eavesdroppers.learning_em import LearningEm
from evedrop.model.eavesdroppers.learning_particle import LearningParticle
from evedrop.model.eavesdroppers.remote_class import RemoteCalls, RemoteClasses
from evedrop.model.eavesdroppers.tracker import Tracker
from evedrop.model.eavesdroppers.type_tests import Likelihood, PowerTest
from evedrop.model.registry import Registry

GROUP = "evedrop.eavesdroppers"
RESERVED = ("strategy", "link", "links", "window")
"""Entries in the table of every eavesdropper."""

_BUILT_IN: Mapping[str, type[Eavesdropper]] = {
    "naive": Naive,
    "suspicious": Suspicious,
    "smart": Smart,
    "constant": ConstantEstimate,
    "likelihood": Likelihood,
    "bayesian": Bayesian,
    "genie": Genie,
    "clear-states": ClearStates,
    "power-test": PowerTest,
    "reference": Reference,
    "selective": Selective,
    "tracker": Tracker,
    "learning-em": LearningEm,
    "learning-particle": LearningParticle,
}
REMOTE_CALLS = RemoteCalls()
"""The calls of eavesdropper classes that are not built in, from this process."""
READERS: Registry[Eavesdropper] = Registry(
    "eavesdropper",
    Eavesdropper,  # type: ignore[type-abstract]
    GROUP,
    _BUILT_IN,
    (*RESERVED, "reads_as"),
    RemoteClasses(REMOTE_CALLS, "READERS"),
)
