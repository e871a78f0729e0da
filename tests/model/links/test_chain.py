"""The mean burst of losses that ends within some slots, against a sum over all courses of a few slots."""

from __future__ import annotations

from itertools import groupby, pairwise, product

import pytest

from evedrop.model.links import loss_of
from evedrop.model.links.chain import Chain
from evedrop.model.links.loss_model import Bernoulli


def of_courses(chain: Chain, slots: int, unfinished: bool) -> float:
    """Packets in bursts that end over the number of these, by the probability of every course of states and losses."""
    packets = number = 0.0
    for states in product(range(len(chain.stationary)), repeat=slots):
        odds = chain.stationary[states[0]]
        for before, after in pairwise(states):
            odds *= chain.transitions[before, after]
        for lost in product((False, True), repeat=slots):
            likely = odds
            for state, missing in zip(states, lost, strict=True):
                likely *= 1.0 - chain.quality[state] if missing else chain.quality[state]
            runs = [(missing, len(list(run))) for missing, run in groupby(lost)]
            lengths = [length for missing, length in (runs[:-1] if unfinished else runs) if missing]
            packets, number = packets + likely * sum(lengths), number + likely * len(lengths)
    return packets / number


@pytest.mark.parametrize("unfinished", [True, False])
@pytest.mark.parametrize(
    "loss",
    [
        {"model": "bernoulli", "quality": 0.7},
        {"model": "gilbert-elliott", "p": 0.2, "r": 0.3, "good": 0.1, "bad": 0.9},
        {"model": "gilbert-elliott", "p": 0.2, "r": 0.3},
    ],
)
def test_a_mean_burst_is_that_of_all_courses(loss: dict[str, float | str], unfinished: bool) -> None:
    """Whether or not the burst of the last slot counts; in a long run it does not matter."""
    chain = loss_of(loss).chain
    assert chain is not None
    for slots in (2, 3, 6):
        assert chain.mean_burst(slots, unfinished) == pytest.approx(of_courses(chain, slots, unfinished), rel=1e-12)
    assert chain.mean_burst(10**6, True) == pytest.approx(chain.mean_burst(10**6, False), rel=1e-4)


@pytest.mark.parametrize(("quality", "slots"), [(0.7, 1), (1.0, 9), (0.0, 9)])
def test_there_may_be_no_burst_that_ends(quality: float, slots: int) -> None:
    """In a single slot, and where nothing or everything is lost."""
    assert Bernoulli(quality).chain.mean_burst(slots, True) is None
