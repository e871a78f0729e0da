"""Loss models for a recording of outcomes, each with its most likely parameters."""

from __future__ import annotations

import math

import numpy as np

from evedrop.fitting.candidate import Candidate, rounded, wilson
from evedrop.fitting.hidden import TwoStates, most_likely
from evedrop.recordings.link_recording import Outcomes


def bernoulli(outcomes: Outcomes) -> Candidate:
    """The same quality for every packet."""
    count, hits = len(outcomes), int(outcomes.sum())
    quality = hits / count
    likelihood = hits * math.log(quality) + (count - hits) * math.log1p(-quality)
    return Candidate(
        "bernoulli",
        {"model": "bernoulli", "quality": rounded(quality)},
        likelihood,
        1,
        {"quality": wilson(hits, count)},
    )


def gilbert(outcomes: Outcomes) -> Candidate:
    """Gilbert's model: good loses nothing and bad everything, so outcomes are states, and their changes are counted."""
    before, after = outcomes[:-1] == 0, outcomes[1:] == 0
    from_bad = int(before.sum())
    from_good = len(before) - from_bad
    worse, better = int((~before & after).sum()), int((before & ~after).sum())
    # A recording that ends or begins in its only burst lacks one of the changes, which then counts as half a change.
    p, r = (worse or 0.5) / max(1, from_good), (better or 0.5) / max(1, from_bad)
    model = TwoStates(min(p, 1.0), min(r, 1.0), 0.0, 1.0)
    return Candidate(
        "gilbert",
        {"model": "gilbert-elliott", "p": rounded(model.p), "r": rounded(model.r)},
        model.log_likelihood_of_states(outcomes == 0),
        2,
        {"p": wilson(worse, max(1, from_good)), "r": wilson(better, max(1, from_bad))},
    )


def gilbert_elliott(outcomes: Outcomes) -> Candidate:
    """Gilbert and Elliott's model with all four parameters, by expectation-maximisation."""
    model, likelihood = most_likely(outcomes, _starts(outcomes))
    spec = {"model": "gilbert-elliott", "p": rounded(model.p), "r": rounded(model.r)}
    spec |= {"good": rounded(model.good), "bad": rounded(model.bad)}
    return Candidate("gilbert-elliott", spec, likelihood, 4)


def _starts(outcomes: Outcomes) -> list[TwoStates]:
    """Starting points: Gilbert's own solution, softened, and regimes of tens, hundreds and thousands of slots."""
    loss = 1.0 - float(outcomes.mean())
    own = gilbert(outcomes).spec
    mild, harsh = 0.5 * loss, min(0.95, 0.5 + 0.5 * loss)
    starts = [
        TwoStates(own["p"], own["r"], 0.1 * loss, 0.95),
        TwoStates(0.5 * own["p"], 0.5 * own["r"], mild, harsh),
    ]
    for slots in (20.0, 200.0, 2000.0):
        if slots * 4 < len(outcomes):
            starts.append(TwoStates(0.5 / slots, 1.0 / slots, 0.3 * loss, min(0.95, 2.5 * loss)))
    return [TwoStates(*(float(np.clip(value, 1e-4, 0.999)) for value in vars(one).values())) for one in starts]
