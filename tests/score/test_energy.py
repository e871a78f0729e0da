"""Energy bought and sold, and the three measures of how two runs differ, against sums by hand."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evedrop.score.energy import EnergyDifference, Meter, energy


def difference(run: np.ndarray, reference: np.ndarray) -> EnergyDifference:
    """Of a run from one reference for all its trials."""
    return Meter.over(run, reference.reshape(reference.shape + (1,) * (run.ndim - reference.ndim))).difference


def test_energy_is_power_times_time() -> None:
    """An hour at 2 kW and half an hour at −1 kW, in slots of ten seconds, for two trials."""
    power = np.concatenate([np.full(360, 2.0), np.full(180, -1.0)])
    both = np.stack([power, -power], axis=1)
    meter = Meter.over(both, 0.0 * both)
    assert np.allclose(energy(meter.bought, 10.0), [2.0, 0.5])
    assert np.allclose(energy(meter.sold, 10.0), [0.5, 2.0])


def test_the_three_measures_by_hand() -> None:
    """A reference that buys 3 and sells 1, and a run that buys 2 and sells 2, one slot apart."""
    reference = np.array([1.0, 2.0, -1.0, 0.0])
    run = np.array([2.0, -1.0, 0.0, -1.0])
    result = difference(run, reference)
    assert np.isclose(result.net, 1.0)  # |0 − 2| / 2
    assert np.isclose(result.total, 0.0)  # |4 − 4| / 4
    assert np.isclose(result.summed, 6.0 / 4.0)


def test_a_measure_of_nothing_is_said_to_be_none() -> None:
    """A reference that neither buys nor sells gives no fractions."""
    result = difference(np.array([1.0, 1.0]), np.array([0.0, 0.0]))
    assert np.isinf(result.net)
    assert np.isinf(result.summed)
    assert np.isnan(difference(np.zeros(2), np.zeros(2)).total)


@given(
    arrays(np.float64, (6, 3), elements=st.floats(-5.0, 5.0)),
    arrays(np.float64, 6, elements=st.floats(0.1, 5.0)),
)
def test_what_differs_slot_by_slot_bounds_the_rest(run: np.ndarray, reference: np.ndarray) -> None:
    """Net and total differ by no more than the slots together, and a run differs from itself by nothing."""
    result = difference(run, reference)
    assert np.all(result.total <= result.summed + 1e-12)
    assert np.all(result.net <= result.summed + 1e-12)
    same = difference(reference, reference)
    assert same.net == same.total == same.summed == 0.0
    alone = [difference(run[:, r], reference).summed for r in range(3)]
    assert np.array_equal(result.summed, alone)


def test_a_meter_may_be_read_in_parts() -> None:
    """Sums over parts of the slots and of the trials equal the sum over all at once, to the bit."""
    rng = np.random.default_rng(4)
    run, other = rng.standard_normal((2, 50, 4))
    whole = Meter.over(run, other)
    by_slots = Meter.zero(4).then(run[:20], other[:20]).then(run[20:], other[20:])
    by_trials = Meter.of_all([Meter.over(run[:, :1], other[:, :1]), Meter.over(run[:, 1:], other[:, 1:])])
    for name in ("net", "total", "summed"):
        assert np.array_equal(getattr(by_slots.difference, name), getattr(whole.difference, name))
        assert np.array_equal(getattr(by_trials.difference, name), getattr(whole.difference, name))
