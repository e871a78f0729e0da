"""The closed form of a reader of state-secrecy codes, or a lower bound on its error.

Source: docs/mathematics.md, acknowledged references.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.process import Floats, Process
from evedrop.model.reference_code import ReferenceCode
from evedrop.model.reference_floor import reference_floor
from evedrop.model.theory.closed_form import ClosedForm, ReceiverConditions
from evedrop.model.theory.closed_forms import reference_covariances, reference_limit
from evedrop.model.theory.covariances import NOBODY, Outcomes, has_infinite_variance, limit_trace


@final
@dataclass(frozen=True)
class ReferenceForm(ClosedForm):
    """That of a receiver that keeps the references it may have acknowledged."""

    process: Process
    slots: int
    received: float
    """The probability that it receives a packet that is sent."""
    acknowledged: tuple[float, float]
    """Probabilities that a packet is acknowledged and the receiver heard it, and that it is acknowledged and it did not."""
    bound: bool = False

    @classmethod
    def of(cls, process: Process, conditions: ReceiverConditions, *, open_loop: bool) -> ReferenceForm | None:
        """The form under a receiver's conditions; None for a user that never misses a reference: it learns more from each slot.

        open_loop: whether references are carried by A, so that packets depend on the state.
        """
        received, acknowledged = conditions.received, conditions.acknowledged
        if received is None or acknowledged is None or conditions.hijack is not None:
            return None
        if conditions.legitimate and not conditions.forged:
            return None
        bound = not open_loop and acknowledged[1] > 0.0 and ReferenceCode(process).decorrelates
        return cls(process, conditions.slots, received, acknowledged, bound)

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        if self.bound:
            return reference_floor(self.process, self.received, self.acknowledged, self.slots)
        found = reference_covariances(self.process, self.received, self.acknowledged, self.slots)
        traces: Floats = np.trace(found, axis1=1, axis2=2)
        return traces

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if it is too large to compute."""
        if self.bound:
            # After the first critical slot it knows less and less, in the end no more than a receiver that hears nothing.
            return limit_trace(self.process, NOBODY)
        return reference_limit(self.process, self.received, self.acknowledged)

    @property
    def infinite_variance(self) -> bool:
        """Whether the variance over trials has no bound: only where no packet is acknowledged that the reader did not hear.

        After such a packet nothing ends the growth of its error, in any trial.

        Source: docs/mathematics.md, heavy tails.
        """
        return self.acknowledged[1] == 0.0 and has_infinite_variance(self.process, Outcomes.plain(self.received))
