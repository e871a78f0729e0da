"""The view's input: the scene before the first slot, then slots in columns. Does not use Rerun."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.links.way import Way
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags
from evedrop.model.record import Record, RecordColumn, column
from evedrop.scenario.application import Panel, Sketch
from evedrop.show.view.palette import Colour, identities

TRUTH_NAME = "Truth"
"""The part of a path for the true state where receivers' names, which have no capital letters, are those of their estimates."""


@dataclass(frozen=True)
class Shown:
    """One receiver, for labels."""

    name: str
    """Process name, such as "legitimate" or "smart"."""
    role: str
    """"legitimate" or "eavesdropper"."""
    strategy: str
    """The scheme's name for the legitimate estimator, the strategy's for an eavesdropper."""
    quality: float | None
    """Probability that its link delivers a packet; None if it is unknown, because the loss model is not built in."""

    @property
    def world_title(self) -> str:
        """The title of the world as it believes it."""
        if self.role == "legitimate":
            return "The estimator believes"
        return f"{self.name} believes" if self.name == self.strategy else f"{self.name} ({self.strategy}) believes"


@dataclass(frozen=True)
class AckScene:
    """The acknowledgements of a run, and the attack on them."""

    attack: str
    """The name of the attack, or "none"."""
    attacker: str | None
    """The eavesdropper that the attack serves; None if the scenario names none."""


@dataclass(frozen=True)
class AttackSpan:
    """An attack that lasts."""

    text: str
    """Such as "measurements are replaced"; empty for a cut."""
    first: int
    stop: int
    """The slot after the last one."""
    receiver: str | None = None
    """The receiver whose link is cut; None for another attack."""


@dataclass(frozen=True)
class Scene:
    """Everything that the view needs before the first slot."""

    title: str
    run: str
    """The run's name, which identifies the recording: recordings of the same run are shown as one."""
    slots: int
    trials: int
    n: int
    """Number of states."""
    pace: float
    """Seconds per slot; 0: as fast as possible."""
    receivers: tuple[Shown, ...]
    """The legitimate estimator first."""
    noise: float
    """Trace of Q: the squared error of one step."""
    states: tuple[str, ...] = ()
    """Labels of the states, such as "SOC (%)"; none, or one for each."""
    moving: tuple[str, ...] = ()
    """Labels of a closed loop's disturbances, then inputs, such as "P_load (kW)"."""
    units: tuple[str, ...] = ()
    """Units of the states, such as "m"; none, or one for each."""
    ways: Mapping[str, tuple[Way, Way]] = field(default_factory=dict)
    """Receiver → the ways of sender and receiver on the ground, for links whose losses depend on them."""
    panels: tuple[Panel, ...] = ()
    """The panels of applications."""
    drawing: Sketch | None = None
    """What an application draws in place of the curve of what happens."""
    acknowledgements: AckScene | None = None
    """None without acknowledgements."""
    spans: tuple[AttackSpan, ...] = ()
    """The attacks that last, in order of their first slots."""
    growth: float = 0.0
    """Powers of ten by which the error of an estimate without packets grows over the run, of an unstable process."""
    slot_seconds: float | None = None
    """What a slot lasts in the scenario; None if it is a number only."""
    of_estimate: bool = False
    """Whether the sensor measures, so that errors are against the estimate that it sends."""

    @property
    def compared_with(self) -> str:
        """What estimates are compared with, in words."""
        return "sensor's estimate" if self.of_estimate else "truth"

    @property
    def what_happens(self) -> str:
        """The title of the view of what estimates are compared with."""
        return "What the sensor estimates" if self.of_estimate else "What happens"

    @property
    def unit(self) -> str:
        """The unit of the first state, in which distances are given; empty without units."""
        return self.units[0] if self.units else ""

    @cached_property
    def colours(self) -> Mapping[str, Colour]:
        """Receiver → its colour: green for the legitimate estimator, that of its strategy for an eavesdropper."""
        return identities({shown.name: shown.strategy for shown in self.receivers})


@dataclass(frozen=True, eq=False)
class PeerSlots(Record):
    """One receiver over c consecutive slots: the first recorded trial, and means over all trials."""

    x_hat: Floats = column("c n", "estimates in the first recorded trial")
    P: Floats = column("c n n", "covariances that it reports in the first recorded trial")
    action: Codes = column("c", "`Action` in the first recorded trial", "u1")
    squared_error: Floats = column("c", "|x − x̂|², mean over trials")
    standard_error: Floats = column("c", "the standard error of this mean; NaN for one trial")
    trace: Floats = column("c", "tr P that it reports, mean over trials")
    theoretical_trace: Floats = column("c", "trace of the actual error covariance by theory; NaN where there is none")


@dataclass(frozen=True)
class Moved:
    """Disturbances and inputs of a closed loop over c consecutive slots, in the first recorded trial."""

    values: Floats
    """The values of `Scene.moving`, (c, q + m)."""
    curves: Mapping[str, Floats] = field(default_factory=dict)
    """PATH/CURVE of the applications' panels → slots and values, (2, g)."""

    @classmethod
    def joined(cls, moves: Sequence[Moved]) -> Moved:
        """Consecutive slots as one."""
        curves = {path: np.concatenate([move.curves[path] for move in moves], axis=1) for path in moves[0].curves}
        return cls(np.concatenate([move.values for move in moves]), curves)


@dataclass(frozen=True, eq=False)
class SceneSlots(Record):
    """c consecutive slots, complete. The view keeps its arrays for a while, so they must not be changed afterwards."""

    x: Floats = column("c n", "true states of the first recorded trial")
    nu: Flags = column("c", "ν of the first recorded trial: true for an innovation", "?")
    peers: Mapping[str, PeerSlots] = field(default_factory=dict)
    """By name, for each receiver of the scene."""
    moved: Moved | None = None
    """None without a closed loop."""
    sent: Flags | None = column(
        "c", "whether the sensor sent a packet in the first recorded trial; None: in every slot", "?", default=None
    )
    acknowledged: Codes | None = column(
        "c", "`AckFate` in the first recorded trial; None without acknowledgements", "u1", default=None
    )

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Numbers of the slots, (c,)."""
        return np.arange(self.first, self.first + self.count)

    @classmethod
    def joined(cls, parts: Sequence[SceneSlots]) -> SceneSlots:
        """Consecutive slots as one, whose arrays cannot be written to."""
        peers = {
            name: PeerSlots.joined([part.peers[name] for part in parts]).mapped(_read_only) for name in parts[0].peers
        }
        moves = [part.moved for part in parts if part.moved is not None]
        whole = super().joined(parts).mapped(_read_only)
        return whole.changed(peers=peers, moved=Moved.joined(moves) if moves else None)


def _read_only(_: RecordColumn, array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view
