"""Quickest detection of a change, such as a rise in a link's loss rate.

The sensor tests the rate of acknowledgements by CUSUM in whole numbers, which is therefore exact. Shiryaev's test computes the
probability that a change has already happened.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import expect_slots
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags

_FINEST = 4  # largest denominator of the ratio of scores: finer ratios need more states and hardly reduce the delay
_HIGHEST = 1024  # states of the largest chain that is solved

Statistic = NDArray[np.int64]


@dataclass(frozen=True)
class Chart:
    """S ← max(0, S + score), with an alarm where S ≥ threshold. Scores are whole numbers, one of them positive."""

    acknowledged: int
    """Score of a packet that is acknowledged."""
    missing: int
    """Score of a packet that is not acknowledged."""
    threshold: int

    def __post_init__(self) -> None:
        expect_slots(*map(abs, (self.acknowledged, self.missing, self.threshold)))  # S has 64 bits

    def start(self, trials: int) -> Statistic:
        """S before anything is sent, (R,)."""
        return np.zeros(trials, np.int64)

    def step(self, S: Statistic, acknowledged: Flags, sent: Flags | None = None) -> Statistic:
        """S after a slot, (R,), from the acknowledgements received; unchanged where nothing was sent, or after an alarm."""
        after = np.maximum(0, S + np.where(acknowledged, self.acknowledged, self.missing))
        counts = self.alarms(S) if sent is None else self.alarms(S) | ~sent
        return np.where(counts, S, after)

    def alarms(self, S: Statistic) -> Flags:
        """Whether the alarm is raised, (R,)."""
        return self.threshold <= S

    def run_length(self, rate: float) -> float:
        """Mean number of packets until the alarm from S = 0, if each is acknowledged with this probability. Exact.

        The mean is longest from S = 0, so it bounds the mean delay after a change at any time. inf if there is never an alarm.
        """
        chain = np.zeros((self.threshold, self.threshold))
        for s in range(self.threshold):
            for score, chance in ((self.acknowledged, rate), (self.missing, 1.0 - rate)):
                after = max(0, s + score)
                if after < self.threshold:
                    chain[s, after] += chance
        return _steps_to_leave(chain)


@final
class CusumBatch:
    """A chart over a batch of trials, slot by slot."""

    def __init__(self, chart: Chart, trials: int) -> None:
        self._chart = chart
        self._S = chart.start(trials)

    def take(self, acknowledged: Flags, sent: Flags | None = None) -> Flags:
        """Whether the alarm is raised in this slot, (R,), for the first time."""
        before = self._chart.alarms(self._S)
        self._S = self._chart.step(self._S, acknowledged, sent)
        return self._chart.alarms(self._S) & ~before


@lru_cache(maxsize=32)  # a study asks for the same one for each batch of its trials, a comparison for each scheme
def chart_for(normal: float, attacked: float, mean_packets: float) -> Chart:
    """The chart for a change of rate, with the least threshold whose false alarms are `mean_packets` or more apart.

    normal, attacked: probabilities that a packet is acknowledged, before and after. The ratio of the scores approximates, with
    small whole numbers, that of the logarithms of the likelihood ratios; where one of these is infinite, a single packet of
    that kind raises the alarm.

    Raises ValueError if the rates are not two different probabilities, if the normal one is certain, or if no chart of
    1024 states has so few false alarms.
    """
    if not (0.0 < normal < 1.0 and 0.0 <= attacked <= 1.0 and normal != attacked):
        raise ValueError(f"rates {normal} and {attacked}; expected two different ones, the normal one between 0 and 1")
    falls = attacked < normal
    # Scores of packets that are evidence for an attack, and of packets that are evidence against it.
    kinds = [(attacked, normal), (1.0 - attacked, 1.0 - normal)]
    against, speaks = kinds if falls else kinds[::-1]
    up = math.log(speaks[0] / speaks[1])
    down = -math.log(against[0] / against[1]) if against[0] > 0.0 else math.inf
    gain, loss = (1, 0) if math.isinf(down) else _whole(up, down)

    def chart(threshold: int) -> Chart:
        back = -(loss or threshold)
        return Chart(back, gain, threshold) if falls else Chart(gain, back, threshold)

    low, high = 0, 1
    while chart(high).run_length(normal) < mean_packets:
        low, high = high, 2 * high
        if high > _HIGHEST:
            raise ValueError(f"no chart of {_HIGHEST} states has its false alarms {mean_packets:g} packets apart")
    enough = bisect_left(range(low + 1, high), mean_packets, key=lambda threshold: chart(threshold).run_length(normal))
    return chart(low + 1 + enough)


def _whole(up: float, down: float) -> tuple[int, int]:
    """Small whole numbers, at least 1, in approximately this ratio."""
    larger = Fraction(max(up, down) / min(up, down)).limit_denominator(_FINEST)
    pair = larger.numerator, larger.denominator
    return pair if up >= down else pair[::-1]


def _steps_to_leave(chain: Floats) -> float:
    """Mean number of steps from state 0 until the chain is left; its rows need not sum to 1. inf if it is never left.

    States are eliminated from the last one down by sums and quotients only, so that a mean of 10¹⁰ is as exact as a mean
    of 10 (Grassmann, Taksar, Heyman, 1985).
    """
    states = len(chain)
    moves = chain.copy()
    leaves = np.maximum(0.0, 1.0 - chain.sum(axis=1))
    leaves[leaves < 1e-15] = 0.0
    steps = np.ones(states)
    for last in range(states - 1, 0, -1):
        out = float(moves[last, :last].sum() + leaves[last])
        if out == 0.0:
            return math.inf
        # A score reaches only a few states, and elimination preserves that.
        sources, targets = np.flatnonzero(moves[:last, last]), np.flatnonzero(moves[last, :last])
        enters = moves[sources, last] / out
        steps[sources] += enters * steps[last]
        leaves[sources] += enters * leaves[last]
        moves[np.ix_(sources, targets)] += enters[:, None] * moves[last, targets]
    return math.inf if leaves[0] == 0.0 else float(steps[0] / leaves[0])


def probability_of_change(p: Floats, hazard: float, changed: Floats, same: Floats | float) -> Floats:
    """p⁻ = p + (1−p)κ, then p⁻ f₁ / (p⁻ f₁ + (1−p⁻) f₀): the probability that the change has happened, (R,), after a slot.

    p: the same before the slot, (R,); hazard: κ; changed, same: f₁ and f₀, (R,), up to a common factor.
    """
    before = p + (1.0 - p) * hazard
    after = before * changed
    return after / (after + (1.0 - before) * same)


@final
@dataclass(frozen=True)
class ShiryaevTest:
    """The test of a link's loss rate by `probability_of_change`, with an alarm where 1 − p ≤ h.

    f₁ and f₀ are the probabilities of what happened to the packet, with and without the change. Raises ValueError if the second
    rate is not above the first, or if a number is not between 0 and 1.
    """

    normal: float
    """Probability of a loss before the change."""
    raised: float
    """The same after it."""
    hazard: float
    """κ: the probability that the change happens in a slot, if it has not happened before."""
    risk: float
    """h: of all alarms, the fraction of false ones is at most this, if the change happens as κ says."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        inside = all(0.0 < probability < 1.0 for probability in (self.normal, self.raised, self.hazard, self.risk))
        if not inside or self.raised <= self.normal:
            raise ValueError(
                f"loss rates {self.normal:g} and {self.raised:g}, hazard {self.hazard:g}, risk {self.risk:g}; expected numbers "
                "between 0 and 1, and a second rate above the first"
            )

    def start(self, trials: int) -> Floats:
        """P before the first slot, (R,)."""
        return np.zeros(trials)

    def step(self, p: Floats, lost: Flags) -> Floats:
        """P after a slot, (R,)."""
        changed = np.where(lost, self.raised, 1.0 - self.raised)
        return probability_of_change(p, self.hazard, changed, np.where(lost, self.normal, 1.0 - self.normal))

    def alarms(self, p: Floats) -> Flags:
        """Whether the alarm is raised, (R,)."""
        return 1.0 - p <= self.risk
