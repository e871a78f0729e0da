"""Theoretical covariances behind a link whose quality follows a Markov chain or changes with time, or that delays packets.

A block of equal slots behind a chain is computed at once: the recursion as one linear operator. Streaks behind such a link are
computed for a genie and with a μ_d for each slot, too.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.links.chain import Chain
from evedrop.model.process import Floats, Process
from evedrop.model.slot.link_distribution import LinkDistribution, Segment
from evedrop.model.streams import BlockByBlock
from evedrop.model.theory.covariances import (
    LARGEST_OPERATOR,
    NOBODY,
    Outcomes,
    OutcomesAt,
    SlotOutcomes,
    TheoreticalCovariance,
    lyapunov,
    misled_covariances,
    radius,
    theoretical_covariances,
    unbounded,
    without_cancellation,
)
from evedrop.model.theory.leak import RemainingCovariances, remaining_limit
from evedrop.model.theory.rare_events import REST, Streaks


@final
class ModulatedCovariance:
    """E P_k of a receiver behind such a link, a number of slots at a time from k = 0, as `TheoreticalCovariance`."""

    def __init__(
        self, process: Process, link: LinkDistribution, outcomes_at: OutcomesAt, slots_at: SlotOutcomes | None = None
    ) -> None:
        """slots_at: the outcomes of each slot, where they differ; `outcomes_at` is then their mean."""
        process, _ = without_cancellation(process)
        self._process, self._link = process, link
        self._whole = SlotOdds.of(outcomes_at)
        self._slots_at = slots_at
        self._remaining = RemainingCovariances(process) if self._whole.leaks else None
        self._sigma = TheoreticalCovariance(process, NOBODY)
        self._k = 0
        self._settled: Floats | None = None
        self._window: deque[_Slot] = deque(maxlen=link.window)
        self._before: Floats | None = None
        self._traces = BlockByBlock(np.empty(0), self._further)
        self._blocks: dict[int, LinearBlock] = {}

    def next_traces(self, slots: int) -> Floats:
        """The trace of the expectation in the next slots, (slots,); inf once it overflows."""
        return self._traces.next(slots)

    def _further(self) -> Floats:
        """The traces of some more slots: a block of them, or single slots up to the place where a block may begin.

        Their number depends only on the link, so values do not depend on how many slots are asked for at a time.
        """
        k, window = self._k, self._link.window
        segment, stop = self._segment(k)
        marks = [mark for start, end, _ in self._link.outages for mark in (start, end) if mark > k]
        until = min([stop, *marks])
        away = any(start <= k < end + window for start, end, _ in self._link.outages)
        block = self._block_of(segment) if k > segment.start + window and not away and until - k >= BLOCK else None
        if block is not None and (traces := self._in_a_block(segment, block)) is not None:
            return traces
        return self._slot_by_slot(segment, 1 if k == segment.start else min(until - k, BLOCK))

    def _block_of(self, segment: Segment) -> LinearBlock | None:
        """The operator of the segment's blocks; None where its slots differ, or where the operator is too large to be useful."""
        alike = self._slots_at is None and segment.quality_at is None
        if self._link.window > BLOCK or self._remaining is not None or not alike:
            return None
        if self._process.n**2 * (len(segment.chain.stationary) + 1) > _LARGEST:
            return None
        if segment.start not in self._blocks:
            quality = segment.quality(range(segment.start, segment.start + 1))[0]
            odds = [self._whole.at(quality * segment.arrived[lag]) for lag in range(self._link.window + 1)]
            with np.errstate(over="ignore", invalid="ignore"):
                self._blocks[segment.start] = LinearBlock.of(self._process, segment.chain, odds)
        return self._blocks[segment.start]

    def _in_a_block(self, segment: Segment, block: LinearBlock) -> Floats | None:
        """The traces of a block; None, without any change, if a value in it is beyond double precision."""
        assert self._settled is not None  # noqa: S101 - a block never begins with slot 0
        assert self._before is not None  # noqa: S101 - the same
        k, window = self._k, self._link.window
        before = self._window[0].before if window else self._before
        assert before is not None  # noqa: S101 - the same: a block begins more than a window after slot 0
        with np.errstate(over="ignore", invalid="ignore"):
            traces, settled = block.ahead(self._settled, before)
        if not (np.isfinite(traces).all() and np.isfinite(settled).all()):
            return None
        sigma = [self._before, *self._sigma.next(BLOCK)]
        quality = segment.quality(range(k, k + BLOCK))
        for i in range(BLOCK - window, BLOCK):
            self._window.append(_Slot(k + i, segment, False, quality[i], sigma[i], None))
        self._settled, self._before, self._k = settled, sigma[-1], k + BLOCK
        return traces

    def _slot_by_slot(self, segment: Segment, count: int) -> Floats:
        traces = np.empty(count)
        sigma = self._sigma.next(count)
        quality = segment.quality(range(self._k, self._k + count))
        with np.errstate(over="ignore", invalid="ignore"):
            for i in range(count):
                total = float(np.trace(self._next(segment, quality[i], sigma[i]).sum(axis=0)))
                traces[i] = total if np.isfinite(total) else np.inf
        return traces

    def _segment(self, k: int) -> tuple[Segment, int]:
        """The segment that contains a slot, and the first slot after the segment."""
        starts = [segment.start for segment in self._link.segments] + [2**62]
        number = bisect_right(starts, k) - 1
        return self._link.segments[number], starts[number + 1]

    def _next(self, segment: Segment, quality: Floats, sigma: Floats) -> Floats:
        """E_k(s), (states, n, n), of the next slot, which has the covariance Σ_k."""
        k = self._k
        for start, stop, keeps in self._link.outages:
            if start <= k < stop:
                quality = np.zeros_like(quality)
            if k == start > 0 and not keeps and self._before is not None and self._settled is not None:
                self._settled = self._before[None] * segment.chain.stationary[:, None, None]
        fresh = k == segment.start and not segment.continues
        remaining = self._remaining.next(1)[0] if self._remaining is not None and k > 0 else None
        slot = _Slot(k, segment, fresh, quality, self._before, remaining)
        self._before, self._k = sigma, k + 1
        if not self._link.window:
            after = self._settled = self._step(self._settled, slot, 0)
            return after if self._whole.base["initial"] else self._of_start(k, after, segment.chain)
        if len(self._window) == self._link.window:
            self._settled = self._step(self._settled, self._window[0], self._link.window)
        self._window.append(slot)
        states = self._settled
        for earlier in self._window:
            states = self._step(states, earlier, k - earlier.k)
        assert states is not None  # noqa: S101 - the window contains slot k
        return states

    def _of_start(self, k: int, states: Floats, chain: Chain) -> Floats:
        """E(s) after slot k of a receiver that knows the first state without a packet, from E(s) without outages in that slot.

        While it is down, nobody predicts from that state, in slot 0 too. When it restarts from the prior, it knows it again.
        """
        weights = chain.stationary[:, None, None]
        down = [(start, stop) for start, stop, keeps in self._link.outages if not keeps]
        if k == 0 and any(start == 0 for start, _ in down):
            states = self._settled = weights * self._process.initial_covariance
        if any(stop == k + 1 for _, stop in down):
            predicted = theoretical_covariances(self._process, replace(NOBODY, initial=0.0), k + 1)[-1]
            self._settled = weights * predicted
        return states

    def _step(self, states: Floats | None, slot: _Slot, lag: int) -> Floats:
        """E(s) after a slot, from E(s) before it, when the slot is `lag` slots ago."""
        A, chain = self._process.A, slot.segment.chain
        quality = slot.quality * slot.segment.arrived[lag]
        odds = self._whole if self._slots_at is None else SlotOdds.of(self._slots_at(slot.k))
        weights = chain.stationary[:, None, None]
        if states is None or slot.before is None:
            return odds.of_part("initial", quality) * weights * self._process.initial_covariance
        mixed = states.sum(axis=0)[None] * weights if slot.fresh else _mixed(chain, states)
        source = odds.of_part("predicted", quality) * self._process.Q
        if odds.misleads:
            misled = odds.of_part("misled", quality)
            # Without the mask, 0 · inf would spoil a bounded expectation once Σ_k exceeds double precision.
            source = source + np.where(misled > 0.0, misled * (2.0 * (A @ slot.before @ A.T)), 0.0)
        if slot.remaining is not None:
            source = source + odds.of_part("leaked", quality) * slot.remaining
        return odds.of_part("propagated", quality) * (A @ mixed @ A.T) + weights * source


def _mixed(chain: Chain, states: Floats) -> Floats:
    """Σ_s' Π(s', s) E(s'), (states, n, n), from E(s')."""
    mixed: Floats = chain.transitions.T.dot(states.reshape(len(states), -1)).reshape(states.shape)
    return mixed


_LARGEST = 160  # numbers that a block carries along: beyond it the operator costs more than it saves


@final
@dataclass(frozen=True)
class SlotOdds:
    """The probabilities of a slot's outcomes, which are affine in the link's quality."""

    base: Mapping[str, float]
    slope: Mapping[str, float]

    @classmethod
    def of(cls, outcomes_at: OutcomesAt) -> SlotOdds:
        """The probabilities by the outcomes for any quality."""
        never, always = outcomes_at(0.0), outcomes_at(1.0)
        base = {name: getattr(never, name) for name in PARTS}
        return cls(base, {name: getattr(always, name) - base[name] for name in PARTS})

    @property
    def leaks(self) -> bool:
        """Whether a packet may leak what it does not contain."""
        return bool(self.slope["leaked"] or self.base["leaked"])

    @cached_property
    def misleads(self) -> bool:
        """Whether a packet may mislead the receiver."""
        return bool(self.slope["misled"] or self.base["misled"])

    def of_part(self, name: str, quality: Floats) -> Floats:
        """The probability of an outcome in every state, (states, 1, 1), for the qualities of the states."""
        return (self.base[name] + self.slope[name] * quality)[:, None, None]

    def at(self, quality: Floats) -> dict[str, Floats]:
        """The probabilities in every state, (states,) each, for the qualities of the states."""
        return {name: self.base[name] + self.slope[name] * quality for name in PARTS}


@dataclass(frozen=True)
class _Slot:
    """The data of a slot that a step needs."""

    k: int
    segment: Segment
    fresh: bool
    """Whether the chain starts here, in its stationary distribution."""
    quality: Floats
    before: Floats | None
    """Σ_{k−1}."""
    remaining: Floats | None
    """The error of the genie."""


def limit_of(process: Process, link: LinkDistribution, outcomes_at: OutcomesAt) -> float:
    """Trace of lim E P_k for the link in its last state; inf if it is unbounded, NaN if theory does not know it."""
    chain = link.last
    if len(chain.stationary) * process.n**2 > LARGEST_OPERATOR:
        return float("nan")
    states = limit_states(process, chain, outcomes_at)
    if not np.isfinite(states).all():
        return float(states[0, 0, 0])
    arrived = link.segments[-1].arrived
    for lag in range(link.window - 1, -1, -1):
        there = Chain(
            chain.transitions, chain.stationary, chain.quality * (arrived[lag] / arrived[-1] if arrived[-1] else 0.0)
        )
        states = _limit_step(process, there, outcomes_at, states)
    return float(np.trace(states.sum(axis=0)))


def limit_trace(process: Process, chain: Chain, outcomes_at: OutcomesAt) -> float:
    """Trace of lim E P_k; `unbounded` if the operator on (E(s)) does not contract, or misled errors grow."""
    return float(np.trace(limit_states(process, chain, outcomes_at).sum(axis=0)))


def limit_states(process: Process, chain: Chain, outcomes_at: OutcomesAt) -> Floats:
    """Lim E_k(s), (states, n, n); `unbounded` if there is none."""
    outcomes = [outcomes_at(float(quality)) for quality in chain.quality]
    n, states = process.n, len(chain.stationary)
    misled = any(outcome.misled > 0.0 for outcome in outcomes)
    if misled and radius(process) >= 1.0:
        return np.repeat(unbounded(process, 1.0)[None], states, axis=0)
    if not misled and all(outcome.predicted + outcome.leaked + outcome.initial == 0.0 for outcome in outcomes):
        return np.zeros((states, n, n))
    kept = np.repeat([outcome.propagated for outcome in outcomes], n * n)
    operator = kept[:, None] * np.kron(chain.transitions.T, np.kron(process.A, process.A))
    largest = float(np.max(np.abs(np.linalg.eigvals(operator))))
    if largest >= 1.0 - 1e-12:
        starts = any(outcome.initial > 0.0 for outcome in outcomes)
        return np.repeat(unbounded(process, largest / radius(process) ** 2, starts)[None], states, axis=0)
    source = _limit_sources(process, chain, outcomes).reshape(-1)
    return np.linalg.solve(np.eye(len(operator)) - operator, source).reshape(states, n, n)


def _limit_sources(process: Process, chain: Chain, outcomes: list[Outcomes]) -> Floats:
    """The contribution of a slot to E(s) in the limit, (states, n, n)."""
    misled = any(outcome.misled > 0.0 for outcome in outcomes)
    f = 2.0 * (process.A @ lyapunov(process, 1.0) @ process.A.T) if misled else np.zeros_like(process.Q)
    M = remaining_limit(process) if any(outcome.leaked for outcome in outcomes) else np.zeros_like(process.Q)
    return np.array(
        [
            weight * (outcome.predicted * process.Q + outcome.misled * f + outcome.leaked * M)
            for weight, outcome in zip(chain.stationary, outcomes, strict=True)
        ]
    )


def _limit_step(process: Process, chain: Chain, outcomes_at: OutcomesAt, states: Floats) -> Floats:
    outcomes = [outcomes_at(float(quality)) for quality in chain.quality]
    mixed = _mixed(chain, states)
    kept = np.array([outcome.propagated for outcome in outcomes])[:, None, None]
    return kept * (process.A @ mixed @ process.A.T) + _limit_sources(process, chain, outcomes)


def tail_outcomes(chain: Chain, outcomes_at: OutcomesAt) -> Outcomes:
    """The outcomes of an independent link whose errors last equally long; `kept`: the rate at which the chain keeps errors.

    Source: docs/mathematics/links.md, losses in bursts.
    """
    outcomes = [outcomes_at(float(quality)) for quality in chain.quality]
    if all(outcome.predicted + outcome.leaked == 0.0 for outcome in outcomes):
        return outcomes[0]
    keeps = np.array([outcome.propagated for outcome in outcomes])[:, None] * chain.transitions.T
    rate = min(1.0, float(np.max(np.abs(np.linalg.eigvals(keeps)))))
    misled = max(outcome.misled for outcome in outcomes)
    return Outcomes(predicted=rate, state=max(0.0, 1.0 - rate - misled), misled=misled, decoded=0.0, initial=1.0)


BLOCK = 128
"""Slots in a block, a power of 2."""
PARTS = ("propagated", "predicted", "misled", "leaked", "initial")
"""The outcomes of a slot that the recursion needs."""


@final
@dataclass(frozen=True)
class LinearBlock:
    """The operator of a block of slots."""

    traces: Floats
    """t M^j for j = 1 … BLOCK, (BLOCK, D)."""
    last: Floats
    """M^BLOCK, (D, D)."""
    misleads: bool
    """Whether v contains Σ: only where an error may grow with it, because Σ may exceed double precision."""

    @classmethod
    def of(cls, process: Process, chain: Chain, odds: Sequence[Mapping[str, Floats]]) -> LinearBlock:
        """The block of a chain; leaks are not supported.

        odds: lag → the probabilities of the outcomes in the chain's states, (S,) each, of a slot this number of slots ago;
        the last lag is that of settled slots.
        """
        misleads = any(bool(np.any(terms["misled"] > 0.0)) for terms in odds)
        *since, M = (_operator(process, chain, terms, misleads) for terms in odds)
        states = len(chain.stationary) * process.n**2
        row = np.zeros(len(M))
        row[:states] = np.tile(np.eye(process.n).reshape(-1), len(chain.stationary))
        for terms in since:
            row = row @ terms
        rows = np.empty((BLOCK, len(M)))
        for j in range(BLOCK):
            rows[j] = row = row @ M
        return cls(rows, np.linalg.matrix_power(M, BLOCK), misleads)

    def ahead(self, states: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Traces of the slots of a block, (BLOCK,), and E after it, (S, n, n), from E and Σ of the slot before it."""
        parts = [states.reshape(-1), *([sigma.reshape(-1)] if self.misleads else []), np.ones(1)]
        v = np.concatenate(parts)
        after = self.last[: states.size] @ v
        return self.traces @ v, after.reshape(states.shape)


def _operator(process: Process, chain: Chain, odds: Mapping[str, Floats], misleads: bool) -> Floats:
    """M of a slot, (D, D)."""
    size, states = process.n**2, len(chain.stationary)
    carried = np.kron(process.A, process.A)
    count = states * size + (size if misleads else 0) + 1
    M = np.zeros((count, count))
    M[: states * size, : states * size] = np.kron(odds["propagated"][:, None] * chain.transitions.T, carried)
    M[: states * size, -1] = np.kron(chain.stationary * odds["predicted"], process.Q.reshape(-1))
    if misleads:
        sigma = slice(states * size, -1)
        M[: states * size, sigma] = np.kron((chain.stationary * odds["misled"])[:, None], 2.0 * carried)
        M[sigma, sigma] = carried
        M[sigma, -1] = process.Q.reshape(-1)
    M[-1, -1] = 1.0
    return M


MOST_NUMBERS = 2**24
"""The most entries of covariances that are computed for all lengths of streaks, which takes half a second."""
_LARGEST_RUN = 2**18


@dataclass(frozen=True)
class _SlotDistributions:
    """The link and the outcomes of every slot, for T slots and S states of the link."""

    transitions: Floats
    """Into each slot, (T, S, S); of slot 0, and of one in which the link's model changes, into its stationary distribution."""
    stationary: Floats
    """(T, S)."""
    odds: dict[str, Floats]
    """Outcome → its probability in every slot and state, (T, S)."""
    noise: Floats
    """p_d Q + p_l M_k of every slot and state, (T, S, n²)."""
    misled: Floats
    """f_k, (T, n²)."""


@np.errstate(over="ignore", invalid="ignore")
def modulated_streaks(
    process: Process,
    link: LinkDistribution,
    outcomes_at: OutcomesAt,
    slots: int,
    total: float,
    slots_at: SlotOutcomes | None = None,
) -> Streaks | None:
    """The streaks of a receiver in slots 0 … slots−1; total: Σ_k tr E P_k.

    None for late packets and outages, if the error leaves double precision, and for runs that are so long that too much had to
    be computed (MOST_NUMBERS).
    """
    too_long = slots * process.n**2 * _most_states(link) > _LARGEST_RUN
    if link.window or link.outages or not np.isfinite(total) or too_long:
        return None
    distributions = _slot_distributions_of(process, link, slots, outcomes_at, slots_at)
    groups = _begun(process, distributions)
    carry: Floats = np.kron(process.A, process.A).T.astype(np.float64)
    diagonal = np.eye(process.n).reshape(-1)
    number, carried, done, length = [], [], 0, 0
    while True:
        number.append([float(w.sum()) for w, _ in groups])
        carried.append([float((C @ diagonal).sum()) for _, C in groups])
        length, done = length + 1, done + sum(C.size for _, C in groups)
        if done > MOST_NUMBERS:
            return None
        if np.sum(carried) >= (1.0 - REST) * total or length == slots:
            return Streaks(np.array(number).T, np.array(carried).T, total)
        groups = [_lasting(distributions, carry, *segment, length) for segment in groups]


def _most_states(link: LinkDistribution) -> int:
    return max(len(segment.chain.stationary) for segment in link.segments)


def _slot_distributions_of(
    process: Process, link: LinkDistribution, slots: int, outcomes_at: OutcomesAt, slots_at: SlotOutcomes | None
) -> _SlotDistributions:
    starts = [*(segment.start for segment in link.segments[1:]), slots]
    shape = (slots, _most_states(link))
    transitions, stationary, quality = np.zeros((*shape, shape[1])), np.zeros(shape), np.zeros(shape)
    for segment, stop in zip(link.segments, starts, strict=True):
        # A chain with fewer states than another has more here, in which it never is.
        some, states = slice(segment.start, min(stop, slots)), len(segment.chain.stationary)
        transitions[some, :states, :states] = segment.chain.transitions
        stationary[some, :states] = segment.chain.stationary
        if not segment.continues:
            transitions[some][:1, :, :states] = segment.chain.stationary
        # Without a window, a packet that is delayed into a later slot is lost.
        quality[some, :states] = segment.arrived[0] * segment.quality(range(some.start, max(some.start, some.stop)))
    odds = SlotOdds.of(outcomes_at).at(quality)
    if slots_at is not None:
        for k in range(slots):
            for name, value in SlotOdds.of(slots_at(k)).at(quality[k]).items():
                odds[name][k] = value
    noise = odds["predicted"][:, :, None] * process.Q.reshape(-1)
    if odds["leaked"].any():
        M = np.concatenate([np.zeros_like(process.Q)[None], RemainingCovariances(process).next(slots - 1)])
        noise = noise + odds["leaked"][:, :, None] * M.reshape(slots, 1, -1)
    misled = misled_covariances(process, slots) if odds["misled"].any() else np.zeros((slots, process.n**2))
    return _SlotDistributions(transitions, stationary, odds, noise, misled.reshape(slots, -1))


def _begun(process: Process, distributions: _SlotDistributions) -> list[tuple[Floats, Floats]]:
    """The probability of a streak that begins in each slot, (T, S), and P there, (T, S, n²), for each row of `Streaks`.

    Streaks that begin in slot 0, and those of a receiver that is never misled, have that slot alone.
    """
    odds, stationary = distributions.odds, distributions.stationary
    leaving = odds["predicted"] + odds["leaked"]
    decoded = odds["propagated"] - leaving
    state = 1.0 - odds["propagated"] - odds["misled"]
    first = (stationary * odds["initial"])[:1]
    before, synchronised = np.zeros(stationary.shape), stationary[0] - first[0]
    for k in range(1, len(stationary)):
        before[k] = synchronised @ distributions.transitions[k]
        synchronised = stationary[k] * state[k] + decoded[k] * before[k]
    misled = stationary * odds["misled"]
    misled[0] = 0.0
    misled = misled if misled.any() else misled[:1]
    return [
        (before * leaving, before[:, :, None] * distributions.noise),
        (misled, misled[:, :, None] * distributions.misled[: len(misled), None]),
        (first, first[:, :, None] * process.initial_covariance.reshape(-1)),
    ]


def _lasting(
    distributions: _SlotDistributions, carry: Floats, w: Floats, C: Floats, length: int
) -> tuple[Floats, Floats]:
    """The same one slot later, of the streaks that continue, when they have lasted for `length` slots."""
    count = min(len(w), len(distributions.stationary) - length)
    some = slice(length, length + count)
    kept, T, noise = distributions.odds["propagated"][some], distributions.transitions[some], distributions.noise[some]
    states = range(w.shape[1])
    before, moved = np.zeros(kept.shape), np.zeros(noise.shape)
    for s in states:
        for r in states:
            before[:, s] += T[:, r, s] * w[:count, r]
            moved[:, s] += T[:, r, s, None] * C[:count, r]
    return before * kept, (moved @ carry) * kept[:, :, None] + before[:, :, None] * noise
