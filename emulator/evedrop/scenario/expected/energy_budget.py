"""The threshold of an encryption schedule that meets an energy budget, and what other thresholds cost and achieve.

Source: docs/mathematics.md, quantised packets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from evedrop.errors import UsageError
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.theory.closed_forms import encrypted_fraction, threshold_for
from evedrop.model.theory.covariances import LARGEST_OPERATOR
from evedrop.model.theory.json_values import JsonFields
from evedrop.names import LEGITIMATE
from evedrop.scenario.expected.closed_forms import conditions_of, stated_form
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import listed

_SHOWN = 5  # whole thresholds


@dataclass(frozen=True)
class ThresholdMetrics(JsonFields):
    """What one threshold costs and achieves in the long run."""

    threshold: float
    encrypted_fraction: float
    energy: float
    """In a slot on average."""
    eavesdroppers: dict[str, float]
    """Eavesdropper → the trace of its expected error covariance in the limit; inf if it is unbounded."""


@dataclass(frozen=True)
class BudgetDesign(JsonFields):
    """The threshold for a budget, between others."""

    budget: float
    unencrypted: float
    """Energy of an unencrypted packet."""
    encrypted: float
    """Energy of an encrypted packet."""
    user: float
    """The trace of the user's expected error covariance in the limit, whatever the threshold is."""
    best: ThresholdMetrics
    """The least threshold that meets the budget."""
    others: tuple[ThresholdMetrics, ...]
    """The whole thresholds 1, 2, …"""
    left_out: dict[str, str]
    """Eavesdropper → strategy, for those whose error has no closed form."""

    def as_dict(self) -> dict[str, object]:
        """The JSON of `evedrop design --budget`; `left_out` is present only if it has values."""
        return {name: value for name, value in super().as_dict().items() if value or name != "left_out"}


def budget_of(scenario: Scenario, budget: float) -> BudgetDesign:
    """The least threshold with which a scenario's sensor spends at most `budget` in a slot on average.

    Raises UsageError if the scheme has no such threshold, if the losses of a link are not independent and alike in all slots,
    and for a budget that no threshold meets.
    """
    if not 0.0 <= budget < math.inf:
        raise UsageError(f"a budget of {budget:g}: expected a finite number of at least 0, an energy in a slot")
    name = scenario.encoding.scheme
    if not SCHEMES[name].meets_energy_budget:
        able = [one for one in SCHEMES if SCHEMES[one].meets_energy_budget]
        raise UsageError(
            f"an energy budget is met by the threshold of the scheme {listed(able)}, and this scenario has {name}; "
            f"evedrop compare SCENARIO --schemes {able[0]} --out DIR writes DIR/scenarios/{able[0]}.toml, which can be designed"
        )
    user, acknowledged = stated_form(_with(scenario, 1.0), LEGITIMATE), conditions_of(scenario, LEGITIMATE).acknowledged
    forms = {one: stated_form(_with(scenario, 1.0), one) for one in scenario.eavesdroppers}
    left_out = {one: scenario.eavesdroppers[one].strategy for one, form in forms.items() if form is None}
    if user is None or acknowledged is None:
        raise UsageError(
            "the design for a budget is for independent losses that stay the same, without late packets and outages, and for an "
            "attack on acknowledgements that is always on; give the legitimate link only a quality, such as "
            "legitimate.link={quality = 0.9}, and remove events"
        )
    scheme = scheme_of(scenario.process.process, scenario.encoding.spec)
    model, arrives = scenario.energy_model, sum(acknowledged)
    unencrypted, encrypted = model.spent(scheme, 1.0, 0.0), model.spent(scheme, 1.0, 1.0)
    threshold = 1.0
    if budget < encrypted:
        threshold = (
            math.inf if budget <= unencrypted else threshold_for((budget - unencrypted) / model.encryption, arrives)
        )
    most = LARGEST_OPERATOR // scenario.process.process.n**2
    if not threshold <= most:
        raise UsageError(
            f"no threshold up to {most} meets the budget {budget:g}: unencrypted packets cost {unencrypted:g} in a slot and "
            f"encrypted ones {encrypted:g}, and {100.0 * encrypted_fraction(most, arrives):.2g} % are encrypted then; give more, "
            f"such as {unencrypted + 0.5 * (encrypted - unencrypted):g}"
            + ("" if arrives else f"; no acknowledgement arrives, so nothing less than {encrypted:g} is enough")
        )

    def metrics(one: float) -> ThresholdMetrics:
        fraction = encrypted_fraction(one, arrives)
        errors = {}
        for eavesdropper in forms:
            form = stated_form(_with(scenario, one), eavesdropper)
            if form is not None:
                errors[eavesdropper] = form.limit
        return ThresholdMetrics(one, fraction, model.spent(scheme, 1.0, fraction), errors)

    others = tuple(metrics(float(whole)) for whole in range(1, _SHOWN + 1))
    return BudgetDesign(budget, unencrypted, encrypted, user.limit, metrics(threshold), others, left_out)


def _with(scenario: Scenario, threshold: float) -> Scenario:
    return scenario.model_copy(update={"encoding": scenario.encoding.model_copy(update={"threshold": threshold})})
