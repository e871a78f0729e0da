"""States that are given in place of a simulated process."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.process import product
from evedrop.model.slot.cores import GivenStates, PlantCore, deviations, recorded
from evedrop.model.streams import Batch
from tests.builders import MARGINAL

level = st.floats(-1e12, 1e12)


@settings(deadline=None)
@given(level, level)
def test_recorded_levels_have_the_same_deviations(value: float, reference: float) -> None:
    """The levels that tables hold give back every bit."""
    r = np.array([reference])
    x = deviations(np.array([[value]]), r)
    assert np.array_equal(deviations(x + r, r), x)


def test_a_plain_difference_would_not_have_them() -> None:
    """It is rare that it does not: all numbers of half precision show it, for some references."""
    levels: Any = np.arange(2**16, dtype=np.uint16).view(np.float16)
    with np.errstate(invalid="ignore", over="ignore"):
        levels = levels[np.abs(levels) < 3e4]
        references: list[Any] = [np.array([r], np.float16) for r in np.random.default_rng(0).choice(levels, 80)]
        plain = [(((levels - r) + r) - r != levels - r).sum() for r in references]
        again = [(deviations(deviations(levels, r) + r, r) != deviations(levels, r)).sum() for r in references]
    assert sum(plain) > 0
    assert sum(again) == 0


def test_trials_share_the_states_however_they_are_read() -> None:
    """Blocks of any lengths; A x of the slot before, and 0 in slot 0."""
    rows = np.random.default_rng(2).standard_normal((7, 2))
    core = PlantCore(MARGINAL, bytes(32), Batch(7, 3), given=GivenStates(MARGINAL, recorded(rows), 3))
    advances = [core.advance(slots) for slots in (range(3), range(3, 4), range(4, 7))]
    x = np.concatenate([advance.x for advance in advances])
    predicted = np.concatenate([advance.predicted for advance in advances])
    assert all(advance.pushed is None for advance in advances)
    assert np.array_equal(x, np.repeat(rows[:, :, None], 3, axis=2))
    assert np.array_equal(predicted[1:], product(MARGINAL.A, x[:-1]))
    assert not predicted[0].any()
