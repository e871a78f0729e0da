"""The base of closed forms of receivers whose slots differ."""

from __future__ import annotations

from abc import ABC, abstractmethod

from evedrop.model.process import Floats


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
