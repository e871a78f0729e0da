"""What the view is given: the scene before the first slot, then slots in columns. No Rerun in here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags


@dataclass(frozen=True)
class Shown:
    """One receiver, for labels."""

    name: str
    """Process name, such as "legitimate" or "smart"."""
    role: str
    """"legitimate" or "eavesdropper"."""
    strategy: str
    """The scheme's name for the legitimate estimator, the strategy's for an eavesdropper."""
    quality: float
    """Probability that its link delivers a packet."""


@dataclass(frozen=True)
class HouseScene:
    """A plant that is a house."""

    load: str
    """Label of its load, one of `Scene.moving`."""
    most: float
    """The most of it in a minute or what the period is, so that the panel is not as high as wrong guesses are."""


@dataclass(frozen=True)
class Scene:
    """What the view must know before the first slot."""

    title: str
    run: str
    """Names the recording: recordings of the same run are shown as one."""
    slots: int
    trials: int
    n: int
    """Number of states."""
    pace: float
    """Seconds a slot; 0 as fast as it goes."""
    receivers: tuple[Shown, ...]
    """The legitimate one first."""
    noise: float
    """Trace of Q: the squared error of one step."""
    states: tuple[str, ...] = ()
    """Labels of the states, such as "SOC (%)"; none, or one for each."""
    moving: tuple[str, ...] = ()
    """Of a closed loop, labels of what moves the plant, such as "P_load (kW)": disturbances, then inputs."""
    house: HouseScene | None = None
    """Where the plant is one."""


@dataclass(frozen=True)
class PeerSlots:
    """One receiver over c consecutive slots."""

    x_hat: Floats
    """Estimate in the first recorded trial, (c, n)."""
    P: Floats
    """Covariance it believes, first recorded trial, (c, n, n)."""
    action: Codes
    """`Action` in the first recorded trial, (c,)."""
    squared_error: Floats
    """|x − x̂|², mean over trials, (c,)."""
    trace: Floats
    """tr P it believes, mean over trials, (c,)."""
    expected_trace: Floats
    """Trace of the actual error covariance by theory, (c,); NaN where there is none."""


@dataclass(frozen=True)
class Moved:
    """What moves the plant of a closed loop over c consecutive slots, in the first recorded trial."""

    values: Floats
    """Of `Scene.moving`, (c, q + m)."""
    energies: Floats | None = None
    """Of a house, what it has bought and sold since slot 0, in kWh, (c, 2)."""
    guesses: Mapping[str, Floats] = field(default_factory=dict)
    """Receiver → slot, and the load it guesses from then on, of periods that ended in these slots, (2, g)."""


@dataclass(frozen=True)
class SceneSlots:
    """c consecutive slots, complete. Its arrays are kept for a while: they must not be changed afterwards."""

    first: int
    """Number of the first of them."""
    x: Floats
    """True state of the first recorded trial, (c, n)."""
    nu: Flags
    """ν of the first recorded trial, (c,): true for an innovation."""
    peers: Mapping[str, PeerSlots]
    """By name, one for each receiver of the scene."""
    moved: Moved | None = None
    """Of a closed loop."""
    sent: Flags | None = None
    """Whether the sensor sent a packet in the first recorded trial, (c,); None: in every slot."""

    @property
    def count(self) -> int:
        """C."""
        return len(self.nu)
