"""The fraction of an expected error that is due to rare events, and the trials needed to see them, behind independent losses.

A *streak* begins where the error leaves 0, where an innovation misleads the receiver, or in slot 0 if its packet was not
used; it lasts until a state, or the next misleading innovation, replaces the error. Long streaks are rare, and may
nevertheless carry most of the expectation: a mean over too few trials then misses it, and its standard error does not show that.

Source: docs/mathematics/verdicts.md, rare events.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.process import SLOTS_AT_ONCE, Floats, Process, parts_of
from evedrop.model.theory.covariances import (
    NoiseCovariances,
    Outcomes,
    TheoreticalCovariance,
    block_length,
    powers_of,
    without_cancellation,
)

LARGEST_RUN = 2**22
"""The most numbers, slots × n², in the covariances of a run for which the streaks of a misled receiver are computed."""
RARE = 20
"""Events that are expected less often than this in all trials are rare: their number, and with it a mean, is too uncertain."""
REST = 1e-9
"""The fraction of the expectation that is left out, in the longest streaks."""


@final
@dataclass(frozen=True)
class Streaks:
    """What streaks carry of Σ_k tr E P_k over the slots of a run; rows: those begun by a loss, by being misled, and in slot 0."""

    number: Floats
    """Expected number, in one trial, of streaks that last for more than l slots, (3, L) for l = 0, 1, …."""
    carried: Floats
    """What streaks carry in their slot number l, (3, L); the longest ones, which carry next to nothing, are left out."""
    total: float
    """Σ_k tr E P_k."""

    def fraction(self, trials: int) -> float:
        """The fraction of the expectation in slots that fewer than RARE streaks of all trials are expected to reach, 0 … 1."""
        if self.total == 0.0:
            return 0.0
        met = float(self.carried[self._numbers * trials >= RARE].sum()) / self.total
        return 1.0 - met if met < 1.0 - REST else 0.0

    def trials_for(self, fraction: float) -> float:
        """The number of trials for which this fraction is left in such slots; inf beyond double precision. fraction > 1e-9."""
        if self.total == 0.0:
            return 1.0
        order = np.argsort(-self._numbers, axis=None, kind="stable")
        met = np.cumsum(self.carried.reshape(-1)[order])
        last = int(np.searchsorted(met, (1.0 - fraction) * self.total))
        number = float(self._numbers.reshape(-1)[order[min(last, len(order) - 1)]])
        return max(1.0, float(np.ceil(RARE / number))) if number > 0.0 else math.inf

    @property
    def _numbers(self) -> Floats:
        """`number`, with inf where a streak that began in slot 0 certainly lasts so long: every trial has it."""
        numbers = self.number.copy()
        numbers[2, numbers[2] >= 1.0 - REST] = math.inf
        return numbers


@np.errstate(over="ignore", invalid="ignore")
def streaks(process: Process, outcomes: Outcomes, slots: int) -> Streaks | None:
    """The streaks of a receiver in slots 0 … slots−1.

    None if its error leaves double precision, for a genie, whose slots differ (`modulated_streaks` knows them), and for a misled
    receiver in a run that is too long (LARGEST_RUN).

    Source: docs/mathematics/verdicts.md, rare events.
    """
    if outcomes.leaked or (outcomes.misled and slots * process.n**2 > LARGEST_RUN):
        return None
    process, _ = without_cancellation(process)
    total = total_of(TheoreticalCovariance(process, outcomes).next_traces, slots)
    if not math.isfinite(total):
        return None
    kept, lost, misled = outcomes.propagated, outcomes.predicted, outcomes.misled
    last = min(slots, SLOTS_AT_ONCE)
    begun, spread = _begun(process, outcomes, slots, last)
    F = math.sqrt(kept) * process.A
    powers = np.concatenate([np.eye(process.n)[None], powers_of(F, block_length(F))])
    base, noise, terms = powers[0], 0.0, np.zeros((2, 3, 0))
    while terms.shape[2] < slots and terms[1].sum() < (1.0 - REST) * total:
        length = np.arange(terms.shape[2], min(slots, terms.shape[2] + len(powers) - 1))
        if length[-1] >= last:
            last = min(slots, 4 * (int(length[-1]) + 1))
            begun, spread = _begun(process, outcomes, slots, last)
        F_l, after, row = (powers @ base)[: len(length)], slots - 1 - length, last - 1 - length
        base = powers[-1] @ base
        q = _traces(F_l, process.Q)
        u = np.empty(len(length))
        for i, trace in enumerate(q):
            u[i] = noise
            noise = kept * noise + lost * trace
        often = kept**length
        number = [often * begun[row], often * misled * after, often * outcomes.initial]
        carried = [
            begun[row] * (q + u),
            np.zeros(len(length)) if spread is None else misled * (_traces(F_l, spread[row]) + after * u),
            outcomes.initial * (_traces(F_l, process.initial_covariance) + u),
        ]
        terms = np.concatenate([terms, [number, carried]], axis=2)
    return Streaks(terms[0], terms[1], total)


_LARGEST_TABLE = 2**26
"""The most steps, slots × lengths of streaks, for which the rare events of single slots are computed."""


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def rare_in_slots(process: Process, outcomes: Outcomes, slots: int, trials: int) -> Floats | None:
    """The fraction of tr E P_k that rare events carry in each of the slots 0 … slots−1, (slots,), 0 … 1; 0 where tr E P_k is 0.

    Rare in slot k are the streaks of a kind that have lasted for l slots or more, if fewer than RARE of all trials are
    expected to be in one. None where `streaks` knows nothing, and for streaks that last too long.

    Source: docs/mathematics/verdicts.md, rare events.
    """
    kept, lengths = outcomes.propagated, slots
    if kept < 1.0:  # longer streaks are rare
        lengths = 1 + math.floor(math.log(RARE / trials) / math.log(kept)) if kept > 0.0 and trials > RARE else 1
        lengths = min(slots, lengths)
    if outcomes.leaked or slots * lengths > _LARGEST_TABLE or slots * process.n**2 > LARGEST_RUN:
        return None
    expected = TheoreticalCovariance(process, outcomes).next_traces(slots)
    begun = np.zeros((3, slots))
    begun[0] = outcomes.predicted * _Synchronised(outcomes).next(slots)
    begun[1, 1:], begun[2, 0] = outcomes.misled, outcomes.initial
    within = begun.copy()  # the probability of being in a streak of this kind
    for k in range(1, slots):
        within[:, k] += kept * within[:, k - 1]
    misled = 2.0 * NoiseCovariances(process).next(slots) if outcomes.misled else None
    met, F, noise = np.zeros(slots), np.eye(process.n), 0.0
    for length in range(lengths):
        # Streaks that began in slot j are in their slot `length` in slot j + length. F and noise contain the factor kept**length.
        last = slots - length
        losses, deceptions, starts = kept**length * within[:, :last] * trials >= RARE
        from_loss = float(np.trace(F @ process.Q @ F.T))
        met[length:] += np.where(losses, begun[0, :last] * (from_loss + noise), 0.0)
        if misled is not None:
            errors = np.einsum("ij,kjl,il->k", F, misled[:last], F) + noise
            met[length:] += np.where(deceptions, begun[1, :last] * errors, 0.0)
        if starts[0]:
            met[length] += outcomes.initial * (float(np.trace(F @ process.initial_covariance @ F.T)) + noise)
        noise = kept * noise + outcomes.predicted * from_loss
        F = math.sqrt(kept) * process.A @ F
    fraction = np.where(expected > 0.0, 1.0 - met / expected, 0.0)
    return np.where(fraction > REST, np.minimum(fraction, 1.0), 0.0)


def total_of(next_traces: Callable[[int], Floats], slots: int) -> float:
    """Σ_k tr E P_k over slots 0 … slots−1; next_traces: returns tr E P_k of as many next slots as it is asked for."""
    return sum_in_order(float(next_traces(len(part)).sum()) for part in parts_of(range(slots)))


def _begun(process: Process, outcomes: Outcomes, slots: int, last: int) -> tuple[Floats, Floats | None]:
    """For each of the last slots of a run, (last,): the expected number of streaks that a loss has begun so far.

    And Σ f_k so far, (last, n, n); None for a receiver that is never misled.
    """
    number, noise = _Synchronised(outcomes), NoiseCovariances(process) if outcomes.misled else None
    begun, spread = np.zeros(1), np.zeros((1, process.n, process.n))
    kept: list[tuple[Floats, Floats]] = []
    for part in parts_of(range(slots)):
        count = len(part)
        begun = np.cumsum(np.concatenate([begun[-1:], outcomes.predicted * number.next(count)]))[1:]
        if noise is not None:
            spread = np.cumsum(np.concatenate([spread[-1:], 2.0 * noise.next(count)]), axis=0)[1:]
        if part.stop > slots - last:
            kept.append((begun, spread))
    numbers, sums = (np.concatenate(arrays)[-last:] for arrays in zip(*kept, strict=True))
    return numbers, sums if outcomes.misled else None


@final
class _Synchronised:
    """The probability of synchronisation (error 0) before slot k, a number of slots at a time from k = 0; 0 for k = 0."""

    def __init__(self, outcomes: Outcomes) -> None:
        self._outcomes = outcomes
        self._next, self._first = 0.0, True

    def next(self, slots: int) -> Floats:
        """That of the next slots, (slots,)."""
        probabilities, outcomes = np.empty(slots), self._outcomes
        for k in range(slots):
            probabilities[k] = self._next
            after = 1.0 - outcomes.initial if self._first else outcomes.state + outcomes.decoded * self._next
            if not self._first and after == self._next:  # and so in all later slots
                probabilities[k:] = after
                break
            self._next, self._first = after, False
        return probabilities


def _traces(F: Floats, P: Floats) -> Floats:
    """Tr F_l P Fᵀ_l, (L,), of F (L, n, n) and P (n, n) or (L, n, n)."""
    return np.asarray(np.einsum("lij,lij->l", F @ P, F))
