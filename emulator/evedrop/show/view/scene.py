"""The view's input: the scene before the first slot, then slots in columns. Does not use Rerun."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.links.way import Way
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags
from evedrop.scenario.application import Panel

TRUTH_NAME = "truth"
"""The name of the true state where receivers' names are those of their estimates."""


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


@dataclass(frozen=True)
class PeerSlots:
    """One receiver over c consecutive slots."""

    x_hat: Floats
    """Estimate in the first recorded trial, (c, n)."""
    P: Floats
    """Covariance that it reports in the first recorded trial, (c, n, n)."""
    action: Codes
    """`Action` in the first recorded trial, (c,)."""
    squared_error: Floats
    """|x − x̂|², mean over trials, (c,)."""
    standard_error: Floats
    """The standard error of this mean, (c,); NaN for one trial."""
    trace: Floats
    """tr P that it reports, mean over trials, (c,)."""
    theoretical_trace: Floats
    """Trace of the actual error covariance by theory, (c,); NaN where there is none."""

    def mapped(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> PeerSlots:
        """The same with every array changed, for example cut to some slots."""
        return PeerSlots(*(change(getattr(self, field.name)) for field in fields(self)))


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
        curves = {path: _joined([move.curves[path] for move in moves], axis=1) for path in moves[0].curves}
        return cls(_joined([move.values for move in moves]), curves)


@dataclass(frozen=True)
class SceneSlots:
    """c consecutive slots, complete. The view keeps its arrays for a while, so they must not be changed afterwards."""

    first: int
    """Number of the first of them."""
    x: Floats
    """True state of the first recorded trial, (c, n)."""
    nu: Flags
    """ν of the first recorded trial, (c,): true for an innovation."""
    peers: Mapping[str, PeerSlots]
    """By name, one for each receiver of the scene."""
    moved: Moved | None = None
    """None without a closed loop."""
    sent: Flags | None = None
    """Whether the sensor sent a packet in the first recorded trial, (c,); None: in every slot."""

    @property
    def count(self) -> int:
        """The number of slots, c."""
        return len(self.nu)

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Numbers of the slots, (c,)."""
        return np.arange(self.first, self.first + self.count)

    @classmethod
    def joined(cls, chunks: Sequence[SceneSlots]) -> SceneSlots:
        """Consecutive slots as one, whose arrays cannot be written to."""
        first = chunks[0]
        peers = {
            name: PeerSlots(
                *(_joined([getattr(chunk.peers[name], field.name) for chunk in chunks]) for field in fields(peer))
            )
            for name, peer in first.peers.items()
        }
        moves = [chunk.moved for chunk in chunks if chunk.moved is not None]
        sent = None
        if any(chunk.sent is not None for chunk in chunks):
            sent = _joined([np.ones(chunk.count, np.bool_) if chunk.sent is None else chunk.sent for chunk in chunks])
        return cls(
            first.first,
            _joined([chunk.x for chunk in chunks]),
            _joined([chunk.nu for chunk in chunks]),
            peers,
            Moved.joined(moves) if moves else None,
            sent,
        )


def _joined(parts: Sequence[NDArray[Any]], axis: int = 0) -> NDArray[Any]:
    whole = parts[0].view() if len(parts) == 1 else np.concatenate(parts, axis=axis)
    whole.flags.writeable = False
    return whole
