"""Closed forms for receivers whose slots differ, because the packets depend on acknowledgements.

Source: docs/mathematics.md, acknowledged references and schedules by holding time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.acknowledgements import FORGING, rates_of
from evedrop.model.process import Floats, Process
from evedrop.model.reference_code import ReferenceCode
from evedrop.model.reference_floor import reference_floor
from evedrop.model.schemes import SCHEMES
from evedrop.model.slot.link_law import law_of
from evedrop.model.theory import covariances as theory
from evedrop.model.theory.closed_forms import SensorChain, encrypted_schedule, reference_covariances, scheduled
from evedrop.model.theory.covariances import Outcomes
from evedrop.names import LEGITIMATE
from evedrop.scenario import Scenario

Split = tuple[float, float]


@final
@dataclass(frozen=True)
class Closed:
    """One receiver's expected error covariance over the slots of a run."""

    process: Process
    slots: int
    received: float
    """The probability that it receives a packet that is sent."""
    acknowledged: Split
    """Probabilities that a packet is acknowledged and the receiver heard it, and that it is acknowledged and it did not."""
    chain: SensorChain | None
    """The sensor's behaviour; None if it sends in every slot."""
    bound: bool = False
    """Whether this is only a lower bound, in every slot; its limit is exact."""

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        if self.bound:
            return reference_floor(self.process, self.received, self.acknowledged, self.slots)
        if self.chain is not None:
            found = self.chain.covariances(self.process, self.slots)
        else:
            found = reference_covariances(self.process, self.received, self.acknowledged, self.slots)
        traces: Floats = np.trace(found, axis1=1, axis2=2)
        return traces

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if it is too large to compute."""
        if self.chain is not None:
            if len(self.chain.start) * self.process.n**2 > theory.LARGEST_OPERATOR:
                return float("nan")
            return float(np.trace(self.chain.limit(self.process)))
        if self.bound:
            # After the first critical slot it knows less and less, in the end no more than a receiver that hears nothing.
            return theory.limit_trace(self.process, theory.NOBODY)
        if self.acknowledged[1] > 0.0:
            return float("inf")
        return theory.limit_trace(self.process, Outcomes.plain(self.received))


@final
class ClosedStream:
    """The traces of a closed form, a number of slots at a time."""

    def __init__(self, closed: Closed) -> None:
        self._closed, self._next = closed, 0

    def next_traces(self, slots: int) -> Floats:
        """The traces of the next slots, (slots,)."""
        self._next += slots
        return self._closed.traces[self._next - slots : self._next]


def closed_of(scenario: Scenario, receiver: str) -> Closed | None:
    """A receiver's closed form; None if scheme and strategy have none, or the links violate its assumptions.

    It assumes links of independent losses without delay, and an attack that is always on or always off.
    """
    table = scenario.acknowledgements
    if table is None or (table.attack != "none" and scenario.timeline.jams is not None):
        return None
    needed = {LEGITIMATE, receiver} | ({table.jammer} if table.jammer is not None else set())
    threshold = scenario.encoding.parameters.get("threshold", 1)
    long = type(threshold) is int and threshold > theory.LARGEST_OPERATOR  # the chain has one state for each slot of it
    if long or not all(_independent(scenario, name) for name in needed):
        return None
    process, quality = scenario.process.process, scenario.quality
    split = _split(scenario, receiver)
    reader = LEGITIMATE if receiver == LEGITIMATE else scenario.eavesdroppers[receiver].strategy
    kind = SCHEMES[scenario.encoding.scheme].closed_forms.get(reader)
    # Unless acknowledgements are forged the user never misses a reference, so it knows more about each slot.
    told = receiver != LEGITIMATE or table.attack in FORGING
    if kind in ("reference", "open-loop") and told:
        bound = kind == "reference" and split[1] > 0.0 and ReferenceCode(process).decorrelates
        return Closed(process, scenario.slots, quality[receiver], split, None, bound)
    if kind == "scheduled":
        chain = scheduled(threshold, quality[receiver], split)
        return Closed(process, scenario.slots, quality[receiver], split, chain)
    if kind == "selective":
        chain = encrypted_schedule(threshold, quality[receiver], split)
        return Closed(process, scenario.slots, quality[receiver], split, chain)
    return None


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
    law = law_of(schedule)
    if law is None or law.alike is None or schedule.correlation is not None or schedule.outages or schedule.changes:
        return False
    return set(schedule.settings) == {"loss"} and scenario.link(receiver).model.chain is not None
