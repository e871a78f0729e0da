"""Strategies that read packets by themselves, by their name in a scenario: one file each, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping

from emulator.model.answers import Answers
from emulator.model.eavesdroppers.bayesian import Bayesian
from emulator.model.eavesdroppers.constant import Constant
from emulator.model.eavesdroppers.eavesdropper import Eavesdropper
from emulator.model.eavesdroppers.genie import Genie
from emulator.model.eavesdroppers.likelihood import Likelihood
from emulator.model.eavesdroppers.naive import Naive
from emulator.model.eavesdroppers.reference import Reference
from emulator.model.eavesdroppers.selective import Selective
from emulator.model.eavesdroppers.smart import Smart
from emulator.model.eavesdroppers.stand_in import StandIns
from emulator.model.eavesdroppers.suspicious import Suspicious
from emulator.model.eavesdroppers.tracker import Tracker
from emulator.model.registry import Registry

GROUP = "evedrop.eavesdroppers"
RESERVED = ("strategy", "link", "links", "window")
"""Entries that the table of every eavesdropper has."""

_BUILT_IN: Mapping[str, type[Eavesdropper]] = {
    "naive": Naive,
    "suspicious": Suspicious,
    "smart": Smart,
    "constant": Constant,
    "likelihood": Likelihood,
    "bayesian": Bayesian,
    "genie": Genie,
    "reference": Reference,
    "selective": Selective,
    "tracker": Tracker,
}
ANSWERS = Answers()
"""What the classes of eavesdroppers that are not built in have said of themselves, in this process."""
READERS: Registry[Eavesdropper] = Registry(
    "eavesdropper",
    Eavesdropper,  # type: ignore[type-abstract]
    GROUP,
    _BUILT_IN,
    (*RESERVED, "reads_as"),
    StandIns(ANSWERS, "READERS"),
)
