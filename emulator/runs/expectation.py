"""What theory expects of each receiver of a scenario, as far as theory knows its link."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from emulator.model import modulated, theory
from emulator.model.eavesdroppers import STRATEGIES
from emulator.model.links.link import Chain
from emulator.model.process import Floats, Process
from emulator.model.theory import ExpectedCovariance, Outcomes
from emulator.network.access import LEGITIMATE
from emulator.scenario import Scenario


class Stream(Protocol):
    """Expected traces, the next slots at a time."""

    def next_traces(self, slots: int) -> Floats:
        """Of the next slots, (slots,)."""


class _Unknown:
    """Of a link that no theory is for. Final."""

    def next_traces(self, slots: int) -> Floats:
        """Nothing, (slots,)."""
        return np.full(slots, np.nan)


@dataclass(frozen=True)
class Expectation:
    """One receiver's expected actual error covariance, by the chain that its link's losses follow."""

    process: Process
    chain: Chain | None
    """None: the losses follow none."""
    outcomes_at: Callable[[float], Outcomes]
    """From the quality of a link to what the receiver does with a slot."""

    @property
    def known(self) -> bool:
        """Whether there is a theory for the link."""
        return self.chain is not None

    @property
    def independent(self) -> bool:
        """Whether the link's losses are independent, as in the paper."""
        return self.chain is not None and self.chain.independent

    @property
    def _outcomes(self) -> Outcomes | None:
        """Of a link whose losses are independent, as in the paper."""
        if self.chain is None or not self.chain.independent:
            return None
        return self.outcomes_at(float(self.chain.quality[0]))

    def stream(self) -> Stream:
        """The expected traces from slot 0 on; NaN where there is no theory."""
        if self._outcomes is not None:
            return ExpectedCovariance(self.process, self._outcomes)
        return (
            _Unknown()
            if self.chain is None
            else modulated.ModulatedCovariance(self.process, self.chain, self.outcomes_at)
        )

    def traces(self, slots: int) -> Floats:
        """The expected traces of slots 0 … slots−1, (slots,); NaN where there is no theory."""
        return self.stream().next_traces(slots)

    @property
    def limit(self) -> float:
        """Trace of the limit; inf if unbounded, NaN where there is no theory."""
        if self._outcomes is not None:
            return theory.limit_trace(self.process, self._outcomes)
        return math.nan if self.chain is None else modulated.limit_trace(self.process, self.chain, self.outcomes_at)

    @property
    def infinite_variance(self) -> bool:
        """Whether the variance of tr P over trials has no bound (docs/mathematics.md, heavy tails)."""
        if self.chain is None:
            return False
        if self._outcomes is not None:
            return theory.has_infinite_variance(self.process, self._outcomes)
        return theory.has_infinite_variance(self.process, modulated.tail_outcomes(self.chain, self.outcomes_at))


def expectations_of(scenario: Scenario) -> dict[str, Expectation]:
    """Receiver → what theory expects of it."""
    process, mu_d = scenario.process.process, scenario.encoding.mu_d

    def eavesdropper(use_state: float, use_innovation: float) -> Callable[[float], Outcomes]:
        return lambda quality: Outcomes.eavesdropper(quality, mu_d, use_state, use_innovation)

    outcomes_at = {LEGITIMATE: lambda quality: Outcomes.legitimate(quality, mu_d)}
    for name, table in scenario.eavesdroppers.items():
        outcomes_at[name] = eavesdropper(*STRATEGIES[table.strategy].use_probabilities(table.parameters))
    return {name: Expectation(process, scenario.link(name).model.chain, at) for name, at in outcomes_at.items()}


def expected_traces_of(scenario: Scenario) -> dict[str, Floats]:
    """Receiver → trace of the expected actual error covariance in every slot, (slots,); NaN where there is no theory."""
    return {name: one.traces(scenario.slots) for name, one in expectations_of(scenario).items()}
