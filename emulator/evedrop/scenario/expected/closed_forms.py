"""Closed forms of a scenario's receivers whose slots differ, as the scheme's class states them.

Source: docs/mathematics.md, acknowledged references, schedules by holding time and noise packets.
"""

from __future__ import annotations

from typing import final

from evedrop.model.acknowledgements import FORGING, heed_rule_of, rates_of
from evedrop.model.outcomes import uses_of
from evedrop.model.process import Floats
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.slot.link_distribution import distribution_of
from evedrop.model.theory.closed_forms import ClosedForm, Hijack, ReceiverConditions
from evedrop.names import LEGITIMATE
from evedrop.scenario.tables import Scenario

Split = tuple[float, float]


@final
class ClosedStream:
    """The traces of a closed form, a number of slots at a time."""

    def __init__(self, closed: ClosedForm) -> None:
        self._closed, self._next = closed, 0

    def next_traces(self, slots: int) -> Floats:
        """The traces of the next slots, (slots,)."""
        self._next += slots
        return self._closed.traces[self._next - slots : self._next]


def closed_of(scenario: Scenario, receiver: str) -> ClosedForm | None:
    """A receiver's closed form; None if scheme and strategy have none, or the links violate its assumptions."""
    form = stated_form(scenario, receiver)
    return _of_scheme(scenario, receiver) if form is None else form


def stated_form(scenario: Scenario, receiver: str) -> ClosedForm | None:
    """The closed form that the scheme's class states for a receiver in `Scheme.closed_forms`; None as for `closed_of`."""
    reader = LEGITIMATE if receiver == LEGITIMATE else scenario.eavesdroppers[receiver].strategy
    make = SCHEMES[scenario.encoding.scheme].closed_forms.get(reader)
    if make is None:
        return None
    return make(scheme_of(scenario.process.process, scenario.encoding.spec), conditions_of(scenario, receiver))


def _of_scheme(scenario: Scenario, receiver: str) -> ClosedForm | None:
    """What the scheme itself knows of an eavesdropper's strategy; None for one that learns more than packets tell."""
    if receiver == LEGITIMATE or receiver in scenario.leaks:
        return None
    scheme, table = scheme_of(scenario.process.process, scenario.encoding.spec), scenario.eavesdroppers[receiver]
    received = scenario.quality[receiver] if _independent(scenario, receiver) else None
    return scheme.closed_form(table.reads_as or table.strategy, received, scenario.slots)


def conditions_of(scenario: Scenario, receiver: str) -> ReceiverConditions:
    """What theory knows of a receiver's link and of the acknowledgements."""
    table = scenario.acknowledgements
    eavesdropper = None if receiver == LEGITIMATE else scenario.eavesdroppers[receiver]
    return ReceiverConditions(
        slots=scenario.slots,
        legitimate=receiver == LEGITIMATE,
        received=scenario.quality[receiver] if _independent(scenario, receiver) else None,
        uses=None if eavesdropper is None else uses_of(eavesdropper.strategy, eavesdropper.parameters),
        acknowledged=_split(scenario, receiver) if _alike(scenario, receiver) else None,
        forged=table is not None and table.attack in FORGING,
        hijack=_hijack(scenario, receiver),
    )


def _alike(scenario: Scenario, receiver: str) -> bool:
    """Whether there are acknowledgements with the same probabilities in all slots, and the receiver hears as often in all slots.

    They have these with links of independent losses without delay, and an attack that is always on or always off.
    """
    table = scenario.acknowledgements
    if table is None or (table.attack != "none" and scenario.timeline.jams is not None):
        return False
    needed = {LEGITIMATE, receiver} | ({table.jammer} if table.jammer is not None else set())
    return all(_independent(scenario, name) for name in needed)


def _hijack(scenario: Scenario, receiver: str) -> Hijack | None:
    """The hijacked sensor, if it depends on more than the last packet: if α > μ_e, and some acknowledgements are lost."""
    table, quality = scenario.acknowledgements, scenario.quality
    if table is None or table.jammer is None:
        return None
    jammer = table.jammer
    heed_rule = heed_rule_of(table.attack, table.link.quality, quality[jammer])
    if heed_rule is None or heed_rule.patience == 0:
        return None

    def hears(user: bool, served: bool) -> float:
        if receiver == LEGITIMATE:
            return float(user)
        return float(served) if receiver == jammer else quality[receiver]

    return Hijack(quality[LEGITIMATE], quality[jammer], heed_rule, hears)


def _split(scenario: Scenario, receiver: str) -> Split:
    table, quality = scenario.acknowledgements, scenario.quality
    assert table is not None  # noqa: S101 - asked by the caller
    mu, alpha, flip = quality[LEGITIMATE], table.link.quality, table.flip or 0.0
    if receiver == LEGITIMATE:
        mu_e = 1.0 if table.jammer is None else quality[table.jammer]
        return rates_of(table.attack, mu, mu_e, alpha, flip).user
    if table.jammer in (None, receiver):
        return rates_of(table.attack, mu, quality[receiver], alpha, flip).eavesdropper
    arrives = rates_of(table.attack, mu, quality[table.jammer], alpha, flip).arrives
    return arrives * quality[receiver], arrives * (1.0 - quality[receiver])


def _independent(scenario: Scenario, receiver: str) -> bool:
    """Whether a link loses packets independently, and neither delays nor changes; colluding links count as one."""
    schedule = scenario.schedule(receiver)
    link = distribution_of(schedule)
    if link is None or link.alike is None or schedule.correlation is not None or schedule.outages or schedule.changes:
        return False
    return set(schedule.settings) == {"loss"} and scenario.link(receiver).model.chain is not None
