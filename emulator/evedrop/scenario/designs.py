"""The designs that theory finds for a scenario: when to encrypt, within an energy budget, and when to send.

For a budget, it is the threshold of the encryption schedule that meets it, and what other thresholds cost and achieve. For when
to send, it is the best transmission policies against each eavesdropper.

Source: docs/mathematics/schemes.md, quantised packets; docs/mathematics/secrecy.md, the best policy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evedrop.counting import counted
from evedrop.errors import UsageError
from evedrop.model.schemes import SCHEMES
from evedrop.model.theory.closed_forms import encrypted_fraction, threshold_for
from evedrop.model.theory.covariances import LARGEST_OPERATOR, stability_bound
from evedrop.model.theory.json_values import JsonFields
from evedrop.model.theory.policies import Front, LinkProbabilities, front, held_traces, least_weight
from evedrop.names import LEGITIMATE
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import conditions_of, stated_form
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
    """Eavesdropper → the trace of its theoretical error covariance in the limit; inf if it is unbounded."""


@dataclass(frozen=True)
class BudgetDesign(JsonFields):
    """The threshold for a budget, between others."""

    budget: float
    unencrypted: float
    """Energy of an unencrypted packet."""
    encrypted: float
    """Energy of an encrypted packet."""
    legitimate: float
    """The trace of the legitimate theoretical error covariance in the limit, whatever the threshold is."""
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
        able = [scheme for scheme in SCHEMES if SCHEMES[scheme].meets_energy_budget]
        raise UsageError(
            f"an energy budget is met by the threshold of the scheme {listed(able)}, and this scenario has {name}; "
            f"evedrop compare SCENARIO --schemes {able[0]} --out DIR writes DIR/scenarios/{able[0]}.toml, which can be designed"
        )
    legitimate, acknowledged = (
        stated_form(_with(scenario, 1.0), LEGITIMATE),
        conditions_of(scenario, LEGITIMATE).acknowledged,
    )
    forms = {eavesdropper: stated_form(_with(scenario, 1.0), eavesdropper) for eavesdropper in scenario.eavesdroppers}
    left_out = {name: scenario.eavesdroppers[name].strategy for name, form in forms.items() if form is None}
    if legitimate is None or acknowledged is None:
        raise UsageError(
            "the design for a budget is for independent losses that stay the same, without late packets and outages, and for an "
            "attack on acknowledgements that is always on; give the legitimate link only a quality, such as "
            "legitimate.link={quality = 0.9}, and remove events"
        )
    scheme = scenario.make_scheme()
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

    def metrics(threshold: float) -> ThresholdMetrics:
        fraction = encrypted_fraction(threshold, arrives)
        errors = {}
        for eavesdropper in forms:
            form = stated_form(_with(scenario, threshold), eavesdropper)
            if form is not None:
                errors[eavesdropper] = form.limit
        return ThresholdMetrics(threshold, fraction, model.spent(scheme, 1.0, fraction), errors)

    others = tuple(metrics(float(whole)) for whole in range(1, _SHOWN + 1))
    return BudgetDesign(budget, unencrypted, encrypted, legitimate.limit, metrics(threshold), others, left_out)


def _with(scenario: Scenario, threshold: float) -> Scenario:
    return scenario.model_copy(update={"encoding": scenario.encoding.model_copy(update={"threshold": threshold})})


_LARGEST_CHAIN = 4 * LARGEST_OPERATOR  # rows of the linear equation of a policy's chain, which then takes a second
_LARGEST_ERROR = 1e200  # the sums of value iteration are then far from overflow


@dataclass(frozen=True)
class PolicyDesign:
    """The best policies against each eavesdropper of a scenario."""

    mu: float
    states: int
    """Holding times are distinguished up to this one."""
    fronts: dict[str, Front]
    left_out: dict[str, str]
    """Eavesdropper → strategy, for those whose error has no closed form under this scheme."""

    def as_dict(self) -> dict[str, object]:
        """The JSON of `evedrop design --policy`; `left_out` is present only if it has values."""
        entries: dict[str, object] = {
            "mu": self.mu,
            "states": self.states,
            "eavesdroppers": {name: front.as_dict() for name, front in self.fronts.items()},
        }
        return {**entries, "left_out": self.left_out} if self.left_out else entries


def policies_of(scenario: Scenario, weights: Sequence[float], prices: Sequence[float], states: int) -> PolicyDesign:
    """The front of each eavesdropper of a scenario.

    weights: of the legitimate error, from 0 to 1, the eavesdropper's has the rest; prices: of a transmission; states: how many
    holding times are distinguished.

    Raises UsageError if acknowledgements do not decide when the scheme sends, if the losses of a link are not independent and
    alike in all slots, if the legitimate error is unbounded under every policy, for weights at which the best policy never sends,
    for numbers out of range, and for so many holding times that the error grows too large.
    """
    _check_numbers(scenario, weights, prices, states)
    kind = SCHEMES[scenario.encoding.scheme]
    if not kind.sends_by_holding_time:
        raise UsageError(_not_for(scenario.encoding.scheme))
    left_out = {
        name: table.strategy
        for name, table in scenario.eavesdroppers.items()
        if table.strategy not in kind.closed_forms
    }
    heard = {name: _heard(scenario, name) for name in scenario.receivers if name not in left_out}
    if len(heard) == 1:
        raise UsageError(
            "the design of a policy needs an eavesdropper whose error has a closed form under this scheme; expected a "
            f"strategy of {listed(sorted(set(kind.closed_forms) - {LEGITIMATE}))}"
        )
    unknown = [name for name, conditions in heard.items() if conditions is None]
    unknown = (
        [LEGITIMATE] if LEGITIMATE in unknown else unknown
    )  # without the estimator's, no other closed form is known
    if unknown:
        raise UsageError(
            "the design of a policy is for independent losses that stay the same, without late packets and outages, and for "
            "an attack on acknowledgements that is always on; the link of "
            f"{', '.join(unknown)} is different; give each link only a quality, such as "
            "legitimate.link={quality = 0.9}, and remove events"
        )
    legitimate = heard[LEGITIMATE]
    assert legitimate is not None  # noqa: S101 - refused above
    process, (mu, acknowledged) = scenario.process.process, legitimate
    with np.errstate(over="ignore", invalid="ignore"):
        largest = float(held_traces(process, states)[-1])
    if not largest <= _LARGEST_ERROR:
        raise UsageError(
            f"{states} states: {states} slots after a packet the error exceeds {_LARGEST_ERROR:g}, and policies cannot be "
            "compared; give fewer holding times"
        )
    if mu == 0.0 or (process.spectral_radius >= 1.0 and stability_bound(process, mu) >= 1.0):
        bound = max(0.0, 1.0 - process.spectral_radius**-2)
        raise UsageError(
            f"no policy keeps the legitimate error bounded: the legitimate link's quality μ = {mu:g} must exceed "
            f"max(0, 1 − ρ⁻²) = {bound:.6g}; give a better link, such as legitimate.link.quality={0.5 + 0.5 * bound:.3g}"
        )
    fronts = {}
    for name, conditions in heard.items():
        if name == LEGITIMATE or conditions is None:
            continue
        links = LinkProbabilities(mu, conditions[0], acknowledged, conditions[1])
        fronts[name] = front(process, links, weights, prices, states)
        if not fronts[name].points:
            raise UsageError(_never(scenario, name, links, max(weights), min(prices), states))
    return PolicyDesign(mu, states, fronts, left_out)


def _heard(scenario: Scenario, receiver: str) -> tuple[float, tuple[float, float]] | None:
    """`received` and `acknowledged` of a receiver's conditions; None if its error has no closed form under them."""
    conditions = conditions_of(scenario, receiver)
    if conditions.received is None or conditions.acknowledged is None or stated_form(scenario, receiver) is None:
        return None
    return conditions.received, conditions.acknowledged


def _check_numbers(scenario: Scenario, weights: Sequence[float], prices: Sequence[float], states: int) -> None:
    for weight in weights:
        if not 0.0 <= weight <= 1.0:
            raise UsageError(
                f"a weight of {weight:g}: expected a number from 0 to 1, the weight of the legitimate error"
            )
    for price in prices:
        if not 0.0 <= price < math.inf:
            raise UsageError(
                f"a price of {price:g}: expected a finite number of at least 0, the cost of a transmission"
            )
    most = math.isqrt(_LARGEST_CHAIN // scenario.process.process.n**2)
    if not 2 <= states <= max(2, most):
        raise UsageError(
            f"{counted(states, 'state')}: "
            f"expected a whole number from 2 to {max(2, most)}, how many holding times are distinguished"
        )


def _not_for(scheme: str) -> str:
    able = [name for name in SCHEMES if SCHEMES[name].sends_by_holding_time]
    return (
        f"a policy decides, by acknowledgements, when to send: its design is for the scheme {listed(able)}, and this scenario "
        f"has {scheme}; evedrop compare SCENARIO --schemes {able[0]} --out DIR writes DIR/scenarios/{able[0]}.toml, "
        "which can be designed"
    )


def _never(scenario: Scenario, name: str, links: LinkProbabilities, weight: float, price: float, states: int) -> str:
    least = least_weight(scenario.process.process, links.mu, links.mu_e, price, states)
    never = f"the best policy against {name} never sends at weight {weight:g} and price {price:g}"
    if least is None:
        return f"{never}, nor at any other weight: give a lower price"
    return f"{never}: it sends from weight {least:.4f} on; give a larger weight to the legitimate error, up to 1"
