"""`[encoding]` of a scenario.

Source: docs/scenario.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field

from evedrop.model.registry import asked
from evedrop.model.schedule import StateProbability, mean_of
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.table import Found, Table, parameter_mistakes, registered


class EncodingTable(Table):
    """`[encoding]`: the scheme and its parameters."""

    model_config = ConfigDict(extra="allow")

    scheme: Annotated[str, Field(strict=True, examples=["innovation"]), AfterValidator(registered(SCHEMES))]

    def mistakes(self) -> Iterator[Found]:
        """Missing, unknown and wrong parameters of the scheme."""
        scheme, given = SCHEMES[self.scheme], self.parameters
        yield from parameter_mistakes("scheme", self.scheme, scheme, given)
        yield from asked(scheme, {name: value for name, value in given.items() if name in scheme.parameters})

    @property
    def parameters(self) -> dict[str, Any]:
        """The scheme's parameters."""
        return dict(self.model_extra or {})

    @property
    def spec(self) -> dict[str, Any]:
        """The scheme's description for sensor and legitimate estimator."""
        return {"scheme": self.scheme, **self.parameters}

    @property
    def mu_d(self) -> float:
        """μ_d, or its mean over slots k ≥ 1; 1 for a scheme without `state_probability`."""
        return mean_of(self._mu_d)

    @property
    def state_probabilities(self) -> tuple[float, ...] | None:
        """μ_d(k) for every slot; None if it is the same in all slots."""
        return self._mu_d if isinstance(self._mu_d, tuple) else None

    @property
    def _mu_d(self) -> StateProbability:
        given = self.parameters.get("state_probability", 1.0)
        return tuple(map(float, given)) if isinstance(given, list) else float(given)
