"""Strategies that read packets by themselves, by their name in a scenario: one file each, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.eavesdroppers.bayesian import Bayesian
from evedrop.model.eavesdroppers.clear_states import ClearStates
from evedrop.model.eavesdroppers.constant import ConstantEstimate
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper
from evedrop.model.eavesdroppers.genie import Genie
from evedrop.model.eavesdroppers.learning_em import LearningEm
from evedrop.model.eavesdroppers.learning_particle import LearningParticle
from evedrop.model.eavesdroppers.likelihood import Likelihood
from evedrop.model.eavesdroppers.naive import Naive
from evedrop.model.eavesdroppers.power_test import PowerTest
from evedrop.model.eavesdroppers.reference import Reference
from evedrop.model.eavesdroppers.remote_class import RemoteClasses
from evedrop.model.eavesdroppers.selective import Selective
from evedrop.model.eavesdroppers.smart import Smart
from evedrop.model.eavesdroppers.suspicious import Suspicious
from evedrop.model.eavesdroppers.tracker import Tracker
from evedrop.model.registry import Registry
from evedrop.model.remote_calls import RemoteCalls

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
