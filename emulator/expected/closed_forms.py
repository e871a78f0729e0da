"""Closed forms for receivers whose slots differ, because packets depend on acknowledgements, or that mistake noise for states.

Source: docs/mathematics.md, acknowledged references, schedules by holding time and noise packets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.acknowledgements import FORGING, Heeding, heeding_of, rates_of
from evedrop.model.checks import is_number
from evedrop.model.outcomes import noise_taken
from evedrop.model.process import Floats, Process
from evedrop.model.reference_code import ReferenceCode
from evedrop.model.reference_floor import reference_floor
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import ClosedFormName
from evedrop.model.slot.link_law import law_of
from evedrop.model.theory import covariances as theory
from evedrop.model.theory.closed_form import ClosedForm
from evedrop.model.theory.closed_forms import (
    SensorChain,
    always_sent,
    encrypted_schedule,
    hijacked_schedule,
    reference_covariances,
    reference_limit,
    scheduled,
)
from evedrop.model.theory.noise_taken import NoiseTaken
from evedrop.model.theory.quantisation import QuantisationError
from evedrop.names import LEGITIMATE
from evedrop.scenario import Scenario

Split = tuple[float, float]


@final
@dataclass(frozen=True)
class TakesNoise(ClosedForm):
    """That of a receiver that takes noise packets for states, behind a link of independent losses."""

    taken: NoiseTaken
    slots: int

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        traces: Floats = np.trace(self.taken.covariances(self.slots), axis1=1, axis2=2)
        return traces

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded."""
        return float(np.trace(self.taken.limit))

    @property
    def infinite_variance(self) -> bool:
        """Whether the variance of tr P over trials has no bound: not where noise is used, which leaves an error like x itself."""
        return theory.has_infinite_variance(self.taken.process, self.taken.outcomes)


@final
@dataclass(frozen=True)
class Closed(ClosedForm):
    """That of a receiver of packets that depend on acknowledgements."""

    process: Process
    slots: int
    received: float
    """The probability that it receives a packet that is sent."""
    acknowledged: Split
    """Probabilities that a packet is acknowledged and the receiver heard it, and that it is acknowledged and it did not."""
    chain: SensorChain | None
    """The sensor's behaviour; None if it sends in every slot."""
    bound: bool = False
    quantisation: QuantisationError | None = None
    """The error of a state that is read from a packet; None if there is none."""

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        if self.bound:
            return reference_floor(self.process, self.received, self.acknowledged, self.slots)
        if self.chain is not None:
            found = self.chain.covariances(self.process, self.slots, self.quantisation)
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
            return float(np.trace(self.chain.limit(self.process, self.quantisation)))
        if self.bound:
            # After the first critical slot it knows less and less, in the end no more than a receiver that hears nothing.
            return theory.limit_trace(self.process, theory.NOBODY)
        return reference_limit(self.process, self.received, self.acknowledged)

    @cached_property
    def infinite_variance(self) -> bool:
        """Whether the variance over trials has no bound: not if only the steps of a quantiser grow."""
        return math.isinf(self.limit if self.quantisation is None else replace(self, quantisation=None).limit)


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
    if _kind_of(scenario, receiver) == "noise":
        return _takes_noise(scenario, receiver)
    found = acknowledged_form(scenario, receiver)
    return _of_scheme(scenario, receiver) if found is None else found


def _kind_of(scenario: Scenario, receiver: str) -> ClosedFormName | None:
    reader = LEGITIMATE if receiver == LEGITIMATE else scenario.eavesdroppers[receiver].strategy
    return SCHEMES[scenario.encoding.scheme].closed_forms.get(reader)


def _takes_noise(scenario: Scenario, receiver: str) -> TakesNoise | None:
    if not _independent(scenario, receiver):
        return None
    scheme, table = scheme_of(scenario.process.process, scenario.encoding.spec), scenario.eavesdroppers[receiver]
    found = noise_taken(scheme, table.strategy, table.parameters)
    return None if found is None else TakesNoise(found(scenario.quality[receiver]), scenario.slots)


def _of_scheme(scenario: Scenario, receiver: str) -> ClosedForm | None:
    """What the scheme itself knows of an eavesdropper's strategy; None for one that learns more than packets tell."""
    if receiver == LEGITIMATE or receiver in scenario.leaks:
        return None
    scheme, table = scheme_of(scenario.process.process, scenario.encoding.spec), scenario.eavesdroppers[receiver]
    received = scenario.quality[receiver] if _independent(scenario, receiver) else None
    return scheme.closed_form(table.reads_as or table.strategy, received, scenario.slots)


def acknowledged_form(scenario: Scenario, receiver: str) -> Closed | None:
    """The closed form of a receiver of a scheme that acts on acknowledgements; None as for `closed_of`.

    It assumes links of independent losses without delay, and an attack that is always on or always off.
    """
    table = scenario.acknowledgements
    if table is None or (table.attack != "none" and scenario.timeline.jams is not None):
        return None
    needed = {LEGITIMATE, receiver} | ({table.jammer} if table.jammer is not None else set())
    threshold = scenario.encoding.parameters.get("threshold", 1)
    long = is_number(threshold) and threshold > theory.LARGEST_OPERATOR  # the chain has one state for each slot of it
    kind, remembers = _kind_of(scenario, receiver), _remembers(scenario)
    unknown = remembers and kind not in ("scheduled", "always sent")
    if long or unknown or not all(_independent(scenario, name) for name in needed):
        return None
    process, quality = scenario.process.process, scenario.quality
    split = _split(scenario, receiver)
    # Unless acknowledgements are forged the user never misses a reference, so it knows more about each slot.
    told = receiver != LEGITIMATE or table.attack in FORGING
    if kind in ("reference", "open-loop") and told:
        bound = kind == "reference" and split[1] > 0.0 and ReferenceCode(process).decorrelates
        return Closed(process, scenario.slots, quality[receiver], split, None, bound)
    if kind == "scheduled":
        silent = _hijacked(scenario, receiver) if remembers else scheduled(threshold, quality[receiver], split)
        return None if silent is None else Closed(process, scenario.slots, quality[receiver], split, silent)
    if kind in ("selective", "always sent"):
        heard = quality[receiver]
        chain = encrypted_schedule(threshold, heard, split) if kind == "selective" else always_sent(heard)
        quantisation = scheme_of(process, scenario.encoding.spec).quantisation
        return Closed(process, scenario.slots, heard, split, chain, quantisation=quantisation)
    return None


def _remembers(scenario: Scenario) -> bool:
    """Whether a hijacked sensor depends on more than the last packet: if α > μ_e, and some acknowledgements are lost."""
    heeding = _heeding_of(scenario)
    return heeding is not None and heeding.patience > 0


def _heeding_of(scenario: Scenario) -> Heeding | None:
    table = scenario.acknowledgements
    if table is None or table.jammer is None:
        return None
    return heeding_of(table.attack, table.link.quality, scenario.quality[table.jammer])


def _hijacked(scenario: Scenario, receiver: str) -> SensorChain | None:
    """The chain of `scheduled` with a hijacked sensor that counts misses; None if it is too long."""
    table, heeding, quality = scenario.acknowledgements, _heeding_of(scenario), scenario.quality
    threshold, n = scenario.encoding.parameters["threshold"], scenario.process.process.n
    if table is None or table.jammer is None or heeding is None:
        return None
    if threshold * (heeding.patience + 2) * n**2 > theory.LARGEST_OPERATOR:
        return None

    def hears(user: bool, served: bool) -> float:
        if receiver == LEGITIMATE:
            return float(user)
        return float(served) if receiver == table.jammer else quality[receiver]

    return hijacked_schedule(threshold, quality[LEGITIMATE], quality[table.jammer], heeding, hears)


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
