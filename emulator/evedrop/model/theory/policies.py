"""When to send, if the sensor knew the holding times of both receivers: the optimal policy, by value iteration.

Policies have metrics of legitimate estimator, eavesdropper and sensor in the limit, and a Pareto front.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats, Process
from evedrop.model.theory.closed_forms import SensorChain, scheduled
from evedrop.model.theory.json_values import JsonFields
from evedrop.model.theory.ratio import edge

_TOLERANCE = 1e-11
_LAZY = 0.5  # how much of the old values an iteration keeps: it then converges for periodic chains, too
_WEIGHT = 1e-4
_AS_GOOD = 1e-9  # relative difference below which silence is as good as a packet


@dataclass(frozen=True)
class Policy:
    """The optimal decision by the holding times 1, 2 … S: legitimate (row), eavesdropper's (column); S stands for longer ones."""

    send: NDArray[np.bool_]
    """(S, S)."""
    gain: float
    """Its average cost per slot."""
    value: Floats
    """The cost of starting from these holding times, less that of starting from S and S, (S, S)."""

    @property
    def thresholds(self) -> tuple[int, ...]:
        """For each holding time of the eavesdropper: the least one of the estimator at which to send; S + 1 if there is none."""
        return tuple(int(silent) + 1 for silent in (~self.send).sum(axis=0))

    @property
    def ever_sends(self) -> bool:
        """Whether it sends at the beginning, when neither receiver has heard a packet: otherwise it never will."""
        return bool(self.send[-1, -1])


def held_traces(process: Process, states: int) -> Floats:
    """Trace of W_i = Σ_{l<i} A^l Q A^lᵀ for i = 0 … states, (states + 1,): the error i slots after a state.

    Source: docs/mathematics/secrecy.md, the best policy.
    """
    traces = np.zeros(states + 1)
    W = np.zeros_like(process.Q)
    for i in range(1, states + 1):
        W = process.A @ W @ process.A.T + process.Q
        traces[i] = np.trace(W)
    return traces


def best_policy(process: Process, mu: float, mu_e: float, weight: float, states: int, price: float = 0.0) -> Policy:
    """Minimise the average of weight · tr P − (1 − weight) · tr Pᵉ + price · [sent] over all rules by two holding times.

    Holding times longer than `states` slots count as `states`, which keeps the cost of an unstable process finite. By
    relative value iteration. For each holding time of the eavesdropper the policy is a threshold on the estimator's. μ must be
    above 0. Where silence is as good as a packet it is silent.

    Source: docs/mathematics/secrecy.md, the best policy.
    """
    traces = held_traces(process, states - 1)  # indices are holding times at the end of a slot: 0 … states−1
    cost = weight * traces[:, None] - (1.0 - weight) * traces[None, :]
    later = np.minimum(np.arange(states) + 1, states - 1)
    scale = max(1e-300, float(np.abs(cost).max()), price)
    value = np.zeros((states, states))
    while True:
        total = cost + value
        silent = total[np.ix_(later, later)]
        heard = mu_e * total[:, :1] + (1.0 - mu_e) * total[:, later]
        sent = price + mu * heard[:1] + (1.0 - mu) * heard[later]
        change = np.minimum(silent, sent) - value
        if np.ptp(change) <= _TOLERANCE * scale:
            return Policy(sent < silent - _AS_GOOD * scale * (1.0 - mu), float(change.mean()), value)
        value = value + _LAZY * change
        value -= value[-1, -1]


def least_weight(process: Process, mu: float, mu_e: float, price: float, states: int) -> float | None:
    """The weight, to 1e-4, from which on the best policy sends at all; None if it does not even at 1.

    Source: docs/mathematics/secrecy.md, the best policy.
    """

    def sends(weight: float) -> bool:
        return best_policy(process, mu, mu_e, weight, states, price).ever_sends

    return edge(1.0, 0.0, sends, _WEIGHT) if sends(1.0) else None


def policy_chains(send: NDArray[np.bool_], mu: float, mu_e: float) -> tuple[SensorChain, SensorChain, Floats]:
    """A policy's chains for legitimate estimator and eavesdropper, and where it sends, (S,), over the states that it reaches.

    send: (S, S), by holding times. The first slot's are S and S.

    Source: docs/mathematics/secrecy.md, the best policy.
    """
    last = len(send) - 1
    index_of = {(last, last): 0}
    moves: list[tuple[int, int, float, bool, bool]] = []
    queue = [(last, last)]
    for i, j in queue:
        heard = ((False, 1.0 - mu), (True, mu)) if send[i, j] else ((False, 1.0),)
        heard_e = ((False, 1.0 - mu_e), (True, mu_e)) if send[i, j] else ((False, 1.0),)
        for (legitimate, chance), (eve, chance_e) in product(heard, heard_e):
            if chance * chance_e > 0.0:
                to = (0 if legitimate else min(i + 1, last), 0 if eve else min(j + 1, last))
                if to not in index_of:
                    index_of[to] = len(index_of)
                    queue.append(to)
                moves.append((index_of[i, j], index_of[to], chance * chance_e, legitimate, eve))
    start = np.zeros(len(index_of))
    start[0] = 1.0
    matrices = np.zeros((4, len(index_of), len(index_of)))
    for s, r, chance, legitimate, eve in moves:
        matrices[int(legitimate), s, r] += chance
        matrices[2 + int(eve), s, r] += chance
    sends = np.array([float(send[state]) for state in index_of])
    return SensorChain(start, matrices[1], matrices[0]), SensorChain(start, matrices[3], matrices[2]), sends


@dataclass(frozen=True)
class PolicyMetrics(JsonFields):
    """The metrics of one policy in the limit: exact, by the stationary distribution of its chain."""

    legitimate: float
    """Trace of the legitimate theoretical error covariance; inf if it is unbounded."""
    eavesdropper: float
    """The eavesdropper's."""
    transmissions: float
    """The fraction of slots in which the sensor sends."""

    def dominates(self, other: PolicyMetrics) -> bool:
        """Whether one of the three metrics is better and none is worse: our error and transmissions low, theirs high."""
        ours, theirs = self.to_lower, other.to_lower
        return all(a <= b for a, b in zip(ours, theirs, strict=True)) and ours != theirs

    @property
    def to_lower(self) -> tuple[float, float, float]:
        """What a good policy has low, to ten digits: the rest is rounding."""
        metrics = (self.legitimate, -self.eavesdropper, self.transmissions)
        legitimate, eavesdropper, transmissions = (float(f"{value:.10g}") for value in metrics)
        return legitimate, eavesdropper, transmissions

    def cost(self, weight: float, price: float) -> float:
        """Average cost: weight · legitimate − (1 − weight) · eavesdropper + price · transmissions; −inf if only the second is."""
        gained = (1.0 - weight) * self.eavesdropper if weight < 1.0 else 0.0
        paid = weight * self.legitimate if weight > 0.0 else 0.0
        return math.inf if math.isinf(paid) else paid - gained + price * self.transmissions


@dataclass(frozen=True)
class FrontPoint:
    """One policy of the front."""

    weights: tuple[float, float]
    """The least and the largest weight asked for at which it is the best policy."""
    price: float
    """λ, the cost of a transmission."""
    thresholds: tuple[int, ...]
    """By the eavesdropper's holding time 1 … S: the least holding time of the estimator at which to send; S + 1: never."""
    metrics: PolicyMetrics
    scheduled: int
    """The threshold of `scheduled` that costs least at the larger weight, of those in `Front.thresholds`."""


@dataclass(frozen=True)
class Front:
    """The performance of `scheduled` against one eavesdropper, and that of a sensor that knew both holding times."""

    thresholds: tuple[PolicyMetrics, ...]
    """`scheduled` with the thresholds 1, 2 … S."""
    points: tuple[FrontPoint, ...]
    """The best policies, those that another one dominates left out."""
    never: tuple[tuple[float, float], ...]
    """(weight, price) at which the best policy never sends."""
    dominated: int
    """How many policies were left out because another one dominates them."""

    def as_dict(self) -> dict[str, object]:
        """The JSON of `evedrop design --policy`; inf is null."""
        return {
            "scheduled": [{"threshold": i + 1, **entry.as_dict()} for i, entry in enumerate(self.thresholds)],
            "policies": [
                {
                    "weights": list(point.weights),
                    "price": point.price,
                    "thresholds": list(point.thresholds),
                    **point.metrics.as_dict(),
                    "scheduled": point.scheduled,
                }
                for point in self.points
            ],
            "never": [list(entry) for entry in self.never],
            "dominated": self.dominated,
        }


@dataclass(frozen=True)
class LinkProbabilities:
    """The links as the policies need them: of the sensor, the legitimate estimator and one eavesdropper."""

    mu: float
    mu_e: float
    legitimate: tuple[float, float]
    """Probabilities that a packet is acknowledged and the estimator heard it, and that it is acknowledged and it did not."""
    eavesdropper: tuple[float, float]
    """The same for the eavesdropper."""


def policy_metrics(process: Process, send: NDArray[np.bool_], mu: float, mu_e: float) -> PolicyMetrics:
    """The metrics of a rule by the holding times of both receivers, (S, S); holding times beyond S decide like S.

    The errors are exact: only the decisions are cut off, not the covariances.

    Source: docs/mathematics/secrecy.md, the best policy.
    """
    legitimate, eve, sends = policy_chains(send, mu, mu_e)
    return _metrics(process, legitimate, eve, sends)


def scheduled_metrics(process: Process, links: LinkProbabilities, threshold: int) -> PolicyMetrics:
    """The metrics of the scheme `scheduled`.

    Source: docs/mathematics/schemes.md, schedules by holding time.
    """
    legitimate = scheduled(threshold, links.mu, links.legitimate)
    eve = scheduled(threshold, links.mu_e, links.eavesdropper)
    return _metrics(process, legitimate, eve, np.arange(threshold) == threshold - 1)


def _metrics(
    process: Process, legitimate: SensorChain, eve: SensorChain, sends: Floats | NDArray[np.bool_]
) -> PolicyMetrics:
    ours, theirs = (float(np.trace(chain.limit(process))) for chain in (legitimate, eve))
    return PolicyMetrics(ours, theirs, float(legitimate.stationary @ sends))


def front(
    process: Process, links: LinkProbabilities, weights: Sequence[float], prices: Sequence[float], states: int
) -> Front:
    """The best policy for each weight and each price of a transmission, and `scheduled` with each threshold up to `states`.

    Policies that are best for several weights in a row become one point.

    Source: docs/mathematics/secrecy.md, the best policy.
    """
    alone = tuple(scheduled_metrics(process, links, threshold) for threshold in range(1, states + 1))
    points: list[FrontPoint] = []
    never = []
    for price, weight in product(sorted(set(prices)), sorted(set(weights))):
        policy = best_policy(process, links.mu, links.mu_e, weight, states, price)
        if not policy.ever_sends:
            never.append((weight, price))
            continue
        metrics = policy_metrics(process, policy.send, links.mu, links.mu_e)
        cheapest = _cheapest(alone, weight, price)
        if points and points[-1].price == price and points[-1].metrics.to_lower == metrics.to_lower:
            points[-1] = replace(points[-1], weights=(points[-1].weights[0], weight), scheduled=cheapest)
        else:
            points.append(FrontPoint((weight, weight), price, policy.thresholds, metrics, cheapest))
    kept = [point for point in points if not any(other.metrics.dominates(point.metrics) for other in points)]
    return Front(alone, tuple(kept), tuple(never), len(points) - len(kept))


def _cheapest(metrics: Sequence[PolicyMetrics], weight: float, price: float) -> int:
    """The threshold, from 1 on, of the least cost; of equal ones the one with the least error of the legitimate estimator."""
    return min(range(len(metrics)), key=lambda i: (metrics[i].cost(weight, price), metrics[i].legitimate)) + 1
