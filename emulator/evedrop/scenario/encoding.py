"""`[encoding]` of a scenario.

Source: docs/scenario.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field

from evedrop.model.registry import asked, is_own
from evedrop.model.schedule import StateProbability, mean_of
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.table import Found, Table, registered
from evedrop.scenario.words import as_toml, listed


class EncodingTable(Table):
    """`[encoding]`: the scheme and its parameters."""

    model_config = ConfigDict(extra="allow")

    scheme: Annotated[str, Field(strict=True, examples=["innovation"]), AfterValidator(registered(SCHEMES))]

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Missing, unknown and wrong parameters of the scheme."""
        scheme = SCHEMES.get(str(table.get("scheme")))
        given = {name: value for name, value in table.items() if name != "scheme"}
        if scheme is None and is_own(table.get("scheme")):
            return []
        if scheme is None:
            anywhere = {name for scheme_class in SCHEMES.values() for name in scheme_class.parameters}
            return [
                (name, "is not a parameter of any scheme; remove the line") for name in given if name not in anywhere
            ]
        mistakes = [
            (name, f"is missing; the scheme {table['scheme']} needs it, such as {name} = {as_toml(example)}")
            for name, example in scheme.parameters.items()
            if name not in given
        ]
        expected_names = f"expected {listed(sorted(scheme.parameters))}" if scheme.parameters else "remove the line"
        sentence = f"is set, but the scheme {table['scheme']} has no such parameter; {expected_names}"
        mistakes += [(name, sentence) for name in given if name not in scheme.parameters]
        return mistakes + asked(scheme, {name: value for name, value in given.items() if name in scheme.parameters})

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
