"""Sums over blocks: the same bits however slots are added, and by whichever process."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.digest import BlockSums, added_in_order

SLOTS, CUTS = 700, (300, 310)
STARTS = [0, 256, 300, 310, 512]


@settings(deadline=None)
@given(st.lists(st.integers(1, 400), max_size=8), st.sampled_from([1, 2, 3, 64]))
def test_parts_do_not_change_the_sums(lengths: list[int], trials: int) -> None:
    """Slot by slot from 0, to the bit, for a single trial as well; a block that has not ended is not among them."""
    numbers = np.random.default_rng(3).lognormal(sigma=8.0, size=(SLOTS - 50, trials))
    sums, complete, k = BlockSums(trials, SLOTS, CUTS), dict[int, np.ndarray](), 0
    for length in [*lengths, SLOTS]:
        stop = min(k + length, len(numbers))
        complete |= sums.add(range(k, stop), numbers[k:stop])
        k = stop
    assert list(complete) == STARTS[:-1]
    for start, end in zip(STARTS, [*STARTS[1:], len(numbers)], strict=True):
        expected = np.zeros(trials)
        for row in numbers[start:end]:
            expected = expected + row
        assert np.array_equal(complete.get(start, sums.unfinished), expected)


def test_another_process_continues_with_a_block() -> None:
    """From the slot after an outage on its sums are those of one process."""
    numbers = np.random.default_rng(4).random((SLOTS, 2))
    whole = BlockSums(2, SLOTS, CUTS).add(range(SLOTS), numbers)
    later = BlockSums(2, SLOTS, CUTS).add(range(310, SLOTS), numbers[310:])
    assert all(np.array_equal(later[start], whole[start]) for start in STARTS[3:])


def test_few_and_many_trials_are_added_in_the_same_order() -> None:
    """A trial's sum has the same bits alone and among many: one slot after the other, however it is computed."""
    rng = np.random.default_rng(5)
    numbers = rng.standard_normal((40, 200)) * 10.0 ** rng.integers(-8, 9, (40, 200))
    total = rng.standard_normal(200)
    together = added_in_order(total, numbers)
    alone = [added_in_order(total[[i]], numbers[:, [i]])[0] for i in range(200)]
    assert together.tolist() == alone
