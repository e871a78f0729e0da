"""Streaks behind a link whose quality follows a chain or changes with time, of a genie, and with a μ_d for each slot.

For all streaks that began in slot j by the same kind of event, w(s) is the probability that they last for more than l slots
and that the link is then in state s, and C(s) the expectation of P there. Both follow the recursion of `modulated`, without
resets; they are computed for all j at once, one l after the other.

Source: docs/mathematics.md, rare events.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evedrop.model.modulated import SlotOdds
from evedrop.model.process import Floats, Process
from evedrop.model.slot.link_distribution import LinkDistribution
from evedrop.model.theory.covariances import OutcomesAt, SlotOutcomes, misled_covariances
from evedrop.model.theory.leak import RemainingCovariances
from evedrop.model.theory.rare_events import REST, Streaks

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

    None for late packets and outages, for links whose models have different numbers of states, if the error leaves double
    precision, and for runs that are so long that too much had to be computed (MOST_NUMBERS).
    """
    states = {len(one.chain.stationary) for one in link.segments}
    too_long = slots * process.n**2 * max(states) > _LARGEST_RUN
    if link.window or link.outages or len(states) > 1 or not np.isfinite(total) or too_long:
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
        groups = [_lasting(distributions, carry, *one, length) for one in groups]


def _slot_distributions_of(
    process: Process, link: LinkDistribution, slots: int, outcomes_at: OutcomesAt, slots_at: SlotOutcomes | None
) -> _SlotDistributions:
    starts = [*(one.start for one in link.segments[1:]), slots]
    shape = (slots, len(link.last.stationary))
    transitions, stationary, quality = np.empty((*shape, shape[1])), np.empty(shape), np.empty(shape)
    for segment, stop in zip(link.segments, starts, strict=True):
        some = slice(segment.start, min(stop, slots))
        transitions[some], stationary[some] = segment.chain.transitions, segment.chain.stationary
        transitions[some][:1] = segment.chain.stationary
        quality[some] = segment.quality(range(some.start, max(some.start, some.stop)))
    odds = SlotOdds.of(outcomes_at).at(quality)
    if slots_at is not None:
        for k in range(slots):
            for name, one in SlotOdds.of(slots_at(k)).at(quality[k]).items():
                odds[name][k] = one
    noise = odds["predicted"][:, :, None] * process.Q.reshape(-1)
    if odds["leaked"].any():
        remaining = RemainingCovariances(process)
        M = np.array([np.zeros_like(process.Q), *(remaining.next() for _ in range(1, slots))])
        noise = noise + odds["leaked"][:, :, None] * M.reshape(slots, 1, -1)
    misled = misled_covariances(process, slots) if odds["misled"].any() else np.zeros((slots, process.n**2))
    return _SlotDistributions(transitions, stationary, odds, noise, misled.reshape(slots, -1))


def _begun(process: Process, distributions: _SlotDistributions) -> list[tuple[Floats, Floats]]:
    """The probability of a streak that begins in each slot, (T, S), and P there, (T, S, n²), for each row of `Streaks`.

    Streaks that begin in slot 0, and those of a receiver that is never misled, have that slot alone.
    """
    odds, stationary = distributions.odds, distributions.stationary
    leaving = odds["predicted"] + odds["leaked"]
    decoded = odds["kept"] - leaving
    state = 1.0 - odds["kept"] - odds["misled"]
    first = (stationary * odds["initial"])[:1]
    before, in_step = np.zeros(stationary.shape), stationary[0] - first[0]
    for k in range(1, len(stationary)):
        before[k] = in_step @ distributions.transitions[k]
        in_step = stationary[k] * state[k] + decoded[k] * before[k]
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
    kept, T, noise = distributions.odds["kept"][some], distributions.transitions[some], distributions.noise[some]
    states = range(w.shape[1])
    before, moved = np.zeros(kept.shape), np.zeros(noise.shape)
    for s in states:
        for r in states:
            before[:, s] += T[:, r, s] * w[:count, r]
            moved[:, s] += T[:, r, s, None] * C[:count, r]
    return before * kept, (moved @ carry) * kept[:, :, None] + before[:, :, None] * noise
