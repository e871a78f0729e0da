"""Delays recorded on a real link, in their order."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.checks import is_number
from evedrop.model.delays.delay import LONGEST, DelayModel
from evedrop.model.process import Floats

MOST_DELAYS = 900_000
"""The most recorded delays of all links of a scenario together: the results contain them in their copy of the scenario."""


class RecordedDelay(DelayModel):
    """The packet of slot k takes `values[k]`, repeated without end, and the same in every trial.

    A scenario names a `file`; loading it replaces the name by its numbers, as `values`.
    """

    parameters = MappingProxyType({"values": [0.5, 2.0, 1.25]})
    lengths = ("values",)
    recorded = "values"

    def __init__(self, values: list[float]) -> None:
        self._values = np.array(values, np.float64)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Delays, and at least one."""
        values = given.get("values", [0.0])
        if not isinstance(values, list) or not 1 <= len(values) <= MOST_DELAYS:
            return [("values", f"is not a list of 1 to {MOST_DELAYS} delays; expected values = [0.5, 2.0]")]
        wrong = next((i for i, one in enumerate(values) if not is_number(one, 0.0, LONGEST)), None)
        if wrong is not None:
            return [(f"values.{wrong}", f"is not a delay; expected a number from 0 to {LONGEST:.0f}")]
        return []

    def delays(self, first: int, numbers: Floats) -> Floats:
        """The delays of these slots, the same in every trial."""
        places = np.arange(first, first + len(numbers)) % len(self._values)
        return np.repeat(self._values[places][:, None], numbers.shape[1], axis=1)

    def arrived(self, lag: int) -> float | None:  # noqa: ARG002 - slots differ
        """None, because slots differ."""
        return None
