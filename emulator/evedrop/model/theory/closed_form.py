"""The base of closed forms of receivers whose slots differ, and what they are made from.

Source: docs/your-own.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from evedrop.model.acknowledgements import HeedRule
from evedrop.model.process import Floats
from evedrop.model.theory.directions import Growth

Hears = Callable[[bool, bool], float]
"""(whether the user hears a packet, whether the hijacker does) → the probability that a receiver hears it."""


class ClosedForm(ABC):
    """One receiver's expected error covariance over the slots of a run."""

    bound: bool = False
    """Whether this is only a lower bound, in every slot; its limit is exact."""

    @property
    @abstractmethod
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""

    @property
    @abstractmethod
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if it is too large to compute."""

    @property
    @abstractmethod
    def infinite_variance(self) -> bool:
        """Whether the variance of tr P over trials has no bound (docs/mathematics.md, heavy tails)."""

    @property
    def growth(self) -> Growth | None:
        """The directions in which the error grows without bound; None if they are unknown."""
        return None


@dataclass(frozen=True)
class Hijack:
    """A hijacked sensor that counts the packets its eavesdropper has missed."""

    mu: float
    """Quality of the user's link."""
    mu_e: float
    """Quality of the link of the eavesdropper that the sensor serves."""
    heed_rule: HeedRule
    hears: Hears
    """For the receiver whose closed form is made."""


@dataclass(frozen=True)
class ReceiverConditions:
    """What theory knows of a receiver's link and of the acknowledgements, for the makers in `Scheme.closed_forms`."""

    slots: int
    legitimate: bool
    """Whether the receiver is the legitimate estimator."""
    received: float | None
    """The probability that it receives a packet that is sent; None unless losses are independent and alike in all slots."""
    uses: tuple[float, float] | None = None
    """The probabilities that its strategy uses a packet with ν = 0, and with ν = 1; None unless it decides by ν alone."""
    acknowledged: tuple[float, float] | None = None
    """The probabilities that a packet is acknowledged and the receiver heard it, and that it is acknowledged and the receiver did
    not. None: there are no acknowledgements, or their probabilities differ from slot to slot. Else `received` is known."""
    forged: bool = False
    """Whether an attacker sends acknowledgements in the user's name."""
    hijack: Hijack | None = None
    """The hijacked sensor, if it needs more than the last packet to decide which acknowledgements it heeds."""


ClosedFormMaker = Callable[[Any, ReceiverConditions], ClosedForm | None]
"""(a scheme, a receiver's conditions) → the receiver's closed form; None if there is none under these conditions."""
