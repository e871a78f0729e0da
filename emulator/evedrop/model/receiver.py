"""The base of every receiver: its belief, its action in a slot, and the prediction between packets.

Actions and the types of packets have words, for the tables of results and for recordings. Flags of trials can be packed to bit
masks. A receiver's class may have methods that take many slots at once; a subclass that changes the method for one slot must not
inherit them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats, Process

Written = TypeVar("Written", bound=Callable[..., Any])


def complete(kind: type, base: type, block: str, single: str, of_one: Callable[[Any], Any], *others: str) -> None:
    """Give a class the method of a pair that it does not write; block, single: the names of the two.

    A class that changes `single`, or one of `others`, after it inherited `block` has the `block` of `base`, which calls `single`
    for each slot. A class that writes `block` alone, and inherits no `single`, has that of a block of one: of_one makes it.
    """
    if outdated(kind, block, single, *others):
        setattr(kind, block, getattr(base, block))
    elif getattr(kind, single) is getattr(base, single) and getattr(kind, block) is not getattr(base, block):
        setattr(kind, single, of_one(getattr(kind, block)))


def needed(method: Written) -> Written:
    """A method for a single slot that a class must have: abstract, unless the class writes the one for blocks of slots.

    Type checkers, which do not know of `complete`, take it for an ordinary method.
    """
    setattr(method, "__isabstractmethod__", True)  # noqa: B010 - mypy refuses the assignment
    return method


def outdated(kind: type, block: str, *single: str) -> bool:
    """Whether a class changes what happens in a single slot after it inherited the method for blocks of slots.

    block: the name of that method; single: the names of the methods for a single slot.
    """
    newest = next(definer for definer in kind.__mro__ if vars(definer).keys() & {block, *single})
    return block not in vars(newest)


Flags = NDArray[np.bool_]
Codes = NDArray[np.uint8]

_ROUNDING = 1e-6  # rounding leaves 1e-15 in a covariance of a few states, and 1e-10 in the worst known one of 30
_SMALLEST = 1e-145  # the square of a smaller number has fewer digits


class Action(IntEnum):
    """What a receiver did in a slot, as far as the receiver knows.

    Compare arrays with `int(Action.LOST)`, not with `Action.LOST`, before which numpy makes them eight times as wide.
    """

    LOST = 0
    """Nothing was received: γ = 0."""
    STATE = 1
    """The packet was used as the state."""
    INNOVATION = 2
    """The packet was read as an innovation: decoded with the secret, or used without it for the little that it leaks."""
    DISCARDED = 3
    """The packet was received and not used."""


def read_actions(gamma: Flags, state: Flags) -> Codes:
    """`Action` codes, (R,), of a receiver that reads each packet that it hears (R,): as the state (R,), or as an innovation."""
    read = np.where(state, np.uint8(Action.STATE), np.uint8(Action.INNOVATION))
    return np.where(gamma, read, np.uint8(Action.LOST))


class Reception(NamedTuple):
    """What a receiver heard in a slot, for R trials."""

    gamma: Flags
    """γ_k: received or not, (R,)."""
    z: Floats
    """The packets, (n, R); undefined where nothing was received."""
    header: NDArray[np.int64] | None = None
    """The unencrypted header that the scheme sends with each packet, (h, R); None for a scheme without a header."""
    truth: Floats | None = None
    """x_k itself, (n, R), in the one slot whose state is betrayed to this receiver, received or not; otherwise None."""


class Belief(NamedTuple):
    """A receiver's knowledge after a slot, for R trials. Immutable: a slot makes a new one."""

    x_hat: Floats
    """Estimate, (n, R)."""
    P: Floats
    """Error covariance the receiver reports, (n, n, R)."""
    action: Codes
    """`Action` of the slot, (R,)."""
    memory: tuple[NDArray[Any], ...] = ()
    """Further knowledge of a receiver: arrays whose last axis is the trials."""


class Beliefs(NamedTuple):
    """Beliefs of c consecutive slots, one row for each slot."""

    x_hat: Floats
    """(c, n, R)."""
    P: Floats
    """(c, n, n, R)."""
    action: Codes
    """(c, R)."""

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> Beliefs:
        """Room for the beliefs of the slots, states and trials of a shape (c, n, R)."""
        c, n, trials = shape
        return cls(np.empty(shape), np.empty((c, n, n, trials)), np.empty((c, trials), np.uint8))

    @classmethod
    def joined(cls, parts: Sequence[Beliefs]) -> Beliefs:
        """The beliefs of consecutive parts, at least one, as one."""
        return parts[0] if len(parts) == 1 else cls(*map(np.concatenate, zip(*parts, strict=True)))

    def put(self, row: int, belief: Belief) -> None:
        """Set one slot's belief."""
        self.x_hat[row], self.P[row], self.action[row] = belief.x_hat, belief.P, belief.action

    def rows(self, some: slice) -> Beliefs:
        """The beliefs of some of the slots."""
        return Beliefs(self.x_hat[some], self.P[some], self.action[some])

    @property
    def last(self) -> Belief:
        """The belief after the last of the slots."""
        return Belief(self.x_hat[-1], self.P[-1], self.action[-1])


def select(flags: Flags, yes: Callable[[], Floats], no: Callable[[], Floats]) -> Floats:
    """`yes()` in the trials where flags (R,) is true, `no()` in the others; neither is called without need."""
    count = np.count_nonzero(flags)
    if count == flags.size:
        return yes()
    if count == 0:
        return no()
    return np.where(flags, yes(), no())


def cleared(flags: Flags, shape: tuple[int, ...], value: Callable[[], Floats]) -> Floats:
    """0 in the trials where flags (R,) is true, `value()`, with shape (…, R), in the others."""
    count = np.count_nonzero(flags)
    if count == flags.size:
        return np.zeros(shape)
    return np.where(flags, 0.0, value()) if count else value()


def trace_of(P: Floats) -> Floats:
    """Tr P of every trial: P (n, n, R) → (R,)."""
    trace: Floats = kernels.traces(P[None])[0]
    return trace


def asymmetry(P: Floats) -> tuple[int, ...] | None:
    """The first place where covariances (…, n, n, R) differ from their transposes by more than rounding; None if nowhere.

    A P Aᵀ is computed entry by entry, so that it is symmetric but for rounding, which is small compared with √(P_ii P_jj).
    """
    other = P.swapaxes(-3, -2)
    if np.array_equal(P, other):
        return None
    with np.errstate(over="ignore"):  # another process may have made these numbers up
        size = np.maximum(np.sqrt(np.abs(np.diagonal(P, axis1=-3, axis2=-2))), _SMALLEST)  # (…, R, n)
        allowed = np.moveaxis(_ROUNDING * size[..., :, None] * size[..., None, :], -3, -1)
        wrong = np.abs(P - other) > allowed
    return tuple(int(i) for i in np.argwhere(wrong)[0]) if wrong.any() else None


def prior(process: Process, trials: int, first: int = 0) -> Belief:
    """Belief of a receiver before slot `first` if it has heard nothing: x̂ = 0, P = Σ_{first−1}, and Σ0 before slot 0.

    Source: docs/mathematics/model.md, legitimate estimator.
    """
    sigma = process.initial_covariance[:, :, None]
    for _ in range(first - 1):
        sigma = process.diffuse(process.carry(sigma))
    return Belief(np.zeros((process.n, trials)), np.repeat(sigma, trials, axis=2), np.zeros(trials, np.uint8))


def _step_one(follow: Callable[..., tuple[Beliefs, Belief]]) -> Callable[..., Belief]:
    return lambda self, k, belief, heard: follow(self, range(k, k + 1), belief, heard.gamma[None], heard.z[None])[1]


class Receiver(ABC):
    """Turns deliveries into beliefs. It keeps no state except what its secret streams read ahead.

    A subclass writes `follow`, or `step` if it reads headers or betrayed states, or takes one slot at a time.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Complete the pair of methods."""
        super().__init_subclass__(**options)
        complete(cls, Receiver, "follow", "step", _step_one, "act")

    def __init__(self, process: Process, trials: int) -> None:
        self.process = process
        self.trials = trials

    def prior(self, first: int = 0) -> Belief:
        """Belief of this receiver before slot `first` if it has heard nothing."""
        return prior(self.process, self.trials, first)

    @abstractmethod
    def act(self, k: int, gamma: Flags) -> Codes:
        """`Action` of slot k in every trial, (R,), from γ (R,) alone: no scheme of this kind looks at the packet first."""

    @needed
    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Belief after slot k, from the belief before it and the reception in it. Any slot may be asked for again."""
        raise NotImplementedError

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """The beliefs after consecutive slots, and the last of them, from γ (c, R) and packets z (c, n, R) without headers.

        A receiver may override this to take many slots at once; the numbers must be those of `step`, slot by slot.
        """
        beliefs = Beliefs.empty(z.shape)
        for row, k in enumerate(slots):
            belief = self.step(k, belief, Reception(gamma[row], z[row]))
            beliefs.put(row, belief)
        return beliefs, belief


STATE = "state"
INNOVATION = "innovation"
NOTHING = "nothing"
"""In tables: the sensor sent no packet."""
SILENT = "silent"
"""The same in recordings and pictures, whose lanes have one word for each slot."""
DROPPED = "dropped"
DISCARDED = "discarded"
MISLED = "misled"
"""The receiver used an innovation as the state."""

TYPES = (STATE, INNOVATION, NOTHING)
"""What the sensor sent. The index of a word of a packet is ν."""
ACTIONS = (DROPPED, STATE, INNOVATION, DISCARDED, MISLED)
"""A receiver's actions as the recorder knows them. The index of a word is its `Action`, except for the last one."""
ACTION_OF: Mapping[str, Action] = {
    DROPPED: Action.LOST,
    STATE: Action.STATE,
    INNOVATION: Action.INNOVATION,
    DISCARDED: Action.DISCARDED,
    MISLED: Action.STATE,
}
"""The word of an action → the action as the receiver knows it."""


def packed_flags(flags: Flags) -> NDArray[np.uint8]:
    """Flags (…, R) as bit masks (…, ⌈R/8⌉), trial 0 in the lowest bit of the first byte."""
    return np.packbits(flags, axis=-1, bitorder="little")


def flags_of(masks: NDArray[np.uint8], trials: int) -> Flags:
    """The flags (…, R) of bit masks (…, ⌈R/8⌉)."""
    return np.unpackbits(masks, axis=-1, count=trials, bitorder="little").view(np.bool_)
