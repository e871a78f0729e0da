"""The outcomes of a slot at a receiver, by scheme and strategy, where one slot alone determines them.

Source: docs/mathematics/eavesdroppers.md, eavesdroppers; docs/schemes.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import PacketTaker
from evedrop.model.eavesdroppers.fixed_rules import ConstantEstimate
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.theory.covariances import Outcomes, OutcomesAt


def legitimate_outcomes(scheme: Scheme) -> OutcomesAt | None:
    """Maps its link's quality to the outcomes of the legitimate estimator; None if there is no such closed form.

    Of a scheme whose μ_d differs from slot to slot: their mean over the slots. `Scheme.in_slot` has those of a slot.
    """
    if scheme.outcomes(0.5) is None:
        return None
    return lambda quality: _known(scheme.outcomes(quality))


def eavesdropper_outcomes(scheme: Scheme, strategy: str, parameters: Mapping[str, Any]) -> OutcomesAt | None:
    """The same for an eavesdropper's strategy with its parameters."""
    kind = STRATEGIES[strategy]
    name = str(parameters["reads_as"]) if "reads_as" in kind.parameters else strategy
    reader = READERS[name] if "reads_as" in kind.parameters else kind
    if scheme.reader_outcomes(name, 0.5) is not None:
        return lambda quality: _known(scheme.reader_outcomes(name, quality))
    if kind.outcomes(parameters, scheme.state_probability) is None:
        return None
    if type(scheme) is Innovation or reader is ConstantEstimate:
        return kind.outcomes(parameters, scheme.state_probability)
    if not issubclass(reader, PacketTaker):
        return None
    uses = reader.use_probabilities(parameters)

    if scheme.eavesdropper_outcomes(0.5, *uses) is None:
        return None
    return lambda quality: _known(scheme.eavesdropper_outcomes(quality, *uses))


def _known(outcomes: Outcomes | None) -> Outcomes:
    assert outcomes is not None  # noqa: S101 - the same scheme knows those of another quality
    return outcomes


def uses_of(strategy: str, parameters: Mapping[str, Any]) -> tuple[float, float] | None:
    """The probabilities that a strategy uses a packet with ν = 0, and with ν = 1; None unless it decides by ν alone."""
    kind = STRATEGIES[strategy]
    return kind.use_probabilities(parameters) if issubclass(kind, PacketTaker) else None
