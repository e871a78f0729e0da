"""The closed form of a receiver whose error follows the sensor's Markov chain.

Source: docs/mathematics.md, schedules by holding time and quantised packets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.process import Floats, Process
from evedrop.model.theory.closed_form import ClosedForm
from evedrop.model.theory.closed_forms import SensorChain
from evedrop.model.theory.covariances import LARGEST_OPERATOR
from evedrop.model.theory.quantisation import QuantisationError


@final
@dataclass(frozen=True)
class ChainForm(ClosedForm):
    """That of a receiver whose error is reset or predicted, as the sensor's behaviour and the link decide."""

    process: Process
    slots: int
    chain: SensorChain
    quantisation: QuantisationError | None = None
    """The error of a state that is read from a packet; None if there is none."""

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        found = self.chain.covariances(self.process, self.slots, self.quantisation)
        traces: Floats = np.trace(found, axis1=1, axis2=2)
        return traces

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if it is too large to compute."""
        if len(self.chain.start) * self.process.n**2 > LARGEST_OPERATOR:
            return float("nan")
        return float(np.trace(self.chain.limit(self.process, self.quantisation)))

    @cached_property
    def infinite_variance(self) -> bool:
        """Whether the variance over trials has no bound: not if only the steps of a quantiser grow."""
        return self.chain.has_infinite_variance(self.process)
