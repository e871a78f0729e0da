"""What theory expects of each receiver of a scenario, as far as theory knows its link."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from emulator.model import modulated, theory
from emulator.model.eavesdroppers import STRATEGIES
from emulator.model.links.link import Chain
from emulator.model.process import Floats, Process
from emulator.model.theory import ExpectedCovariance, Outcomes, OutcomesAt
from emulator.network.access import LEGITIMATE
from emulator.scenario import Scenario


class Stream(Protocol):
    """Expected traces, the next slots at a time."""

    def next_traces(self, slots: int) -> Floats:
        """Of the next slots, (slots,)."""


class _Unknown:
    """Of a receiver that no theory is for. Final."""

    def next_traces(self, slots: int) -> Floats:
        """Nothing, (slots,)."""
        return np.full(slots, np.nan)


@dataclass(frozen=True)
class Expectation:
    """One receiver's expected actual error covariance, by the chain that its link's losses follow."""

    process: Process
    chain: Chain | None
    """None: the losses follow none."""
    outcomes_at: OutcomesAt | None
    """From the quality of a link to what the receiver does with a slot; None: nobody knows how often it does what."""
    bound_at: OutcomesAt | None = None
    """Of a receiver without the secret that has no theory of its own: the genie, which nobody outdoes."""

    @property
    def known(self) -> bool:
        """Whether there is a theory for the link and for what the receiver does."""
        return self._known is not None

    @property
    def _known(self) -> tuple[Chain, OutcomesAt] | None:
        return None if self.chain is None or self.outcomes_at is None else (self.chain, self.outcomes_at)

    @property
    def independent(self) -> bool:
        """Whether the link's losses are independent, as in the paper."""
        return self.chain is not None and self.chain.independent

    @property
    def _outcomes(self) -> Outcomes | None:
        """Of a link whose losses are independent, as in the paper."""
        if self._known is None or not self._known[0].independent:
            return None
        chain, outcomes_at = self._known
        return outcomes_at(float(chain.quality[0]))

    @property
    def bound(self) -> Expectation | None:
        """What the receiver's error cannot fall below, if that is all that theory knows of it."""
        if self.known or self.chain is None or self.bound_at is None:
            return None
        return Expectation(self.process, self.chain, self.bound_at)

    def stream(self) -> Stream:
        """The expected traces from slot 0 on; NaN where there is no theory."""
        if self._outcomes is not None:
            return ExpectedCovariance(self.process, self._outcomes)
        return _Unknown() if self._known is None else modulated.ModulatedCovariance(self.process, *self._known)

    def traces(self, slots: int) -> Floats:
        """The expected traces of slots 0 … slots−1, (slots,); NaN where there is no theory."""
        return self.stream().next_traces(slots)

    @property
    def limit(self) -> float:
        """Trace of the limit; inf if unbounded, NaN where there is no theory."""
        if self._outcomes is not None:
            return theory.limit_trace(self.process, self._outcomes)
        return math.nan if self._known is None else modulated.limit_trace(self.process, *self._known)

    @property
    def infinite_variance(self) -> bool:
        """Whether the variance of tr P over trials has no bound (docs/mathematics.md, heavy tails)."""
        if self.bound is not None:
            return self.bound.infinite_variance
        if self._known is None:
            return False
        if self._outcomes is not None:
            return theory.has_infinite_variance(self.process, self._outcomes)
        return theory.has_infinite_variance(self.process, modulated.tail_outcomes(*self._known))


def expectations_of(scenario: Scenario) -> dict[str, Expectation]:
    """Receiver → what theory expects of it."""
    process, mu_d = scenario.process.process, scenario.encoding.mu_d
    found = {
        LEGITIMATE: Expectation(
            process, scenario.link(LEGITIMATE).model.chain, lambda quality: Outcomes.legitimate(quality, mu_d)
        )
    }
    for name, table in scenario.eavesdroppers.items():
        chain, strategy = scenario.link(name).model.chain, STRATEGIES[table.strategy]
        bound_at = None if strategy.betrayed(table.parameters) is not None else partial(_genie, mu_d)
        found[name] = Expectation(process, chain, strategy.outcomes(table.parameters, mu_d), bound_at)
    return found


def _genie(mu_d: float, quality: float) -> Outcomes:
    return Outcomes.genie(quality, mu_d)


def expected_traces_of(scenario: Scenario) -> dict[str, Floats]:
    """Receiver → trace of the expected actual error covariance in every slot, (slots,); NaN where there is no theory."""
    return {name: one.traces(scenario.slots) for name, one in expectations_of(scenario).items()}
