"""Splitting: copies of trials, their weights, and estimates whose stated error is true."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.process import Floats
from evedrop.model.streams import OWN, Batch, BlockReader, Lineage, stream_key
from evedrop.simulate.splitting import SplitPopulations, importance_floor

KEY = stream_key(b"any", "splitting")
GROWTH, KEPT, SLOTS = 1.9, 0.5, 12
"""P ← 1.9 P + 1 with probability 0.5, else 0: α = ln 2 / ln 1.9 = 1.08, so that the variance has no bound."""


def test_a_copy_reads_what_its_ancestor_read() -> None:
    """Up to a split the numbers are the ancestor's, through all earlier splits; from then on they are the trial's own."""
    own = BlockReader(KEY, Batch(9, 4), 3).uniforms(range(9))
    first, second = np.array([1, 1, 2, 0]), np.array([3, 0, 0, 2])
    lineage = OWN.split(2, first).split(5, second)
    for chunk in (1, 4, 9):
        reader = BlockReader(KEY, Batch(9, 4, lineage=lineage), 3)
        slots = [range(start, min(start + chunk, 9)) for start in range(0, 9, chunk)]
        uniforms = np.concatenate([reader.uniforms(slot) for slot in slots])
        assert np.array_equal(uniforms[:2], own[:2][..., first[second]])
        assert np.array_equal(uniforms[2:5], own[2:5][..., second])
        assert np.array_equal(uniforms[5:], own[5:])


def test_a_batch_is_the_same_whatever_its_lineage() -> None:
    """Batches are compared by their slots and trials."""
    assert Batch(3, 2, lineage=Lineage((1,), (np.array([0, 0]),))) == Batch(3, 2)


@settings(deadline=None)
@given(st.integers(1, 4), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_trials_are_copied_in_proportion(populations: int, size: int, seed: int) -> None:
    """As often as the average says, rounded up or down, within their own population; the sum of u G stays."""
    rng = np.random.default_rng(seed)
    of = SplitPopulations(populations, size)
    for _ in range(3):
        importance = rng.lognormal(sigma=3.0, size=(populations, size))
        before, fraction = of.means(importance), of.weigh(importance)
        product = importance * of.weight
        copied = of.split(rng.random(populations))
        count = np.bincount(copied, minlength=populations * size).reshape(populations, size)
        average = size * product / product.sum(axis=1, keepdims=True)
        assert np.all((count >= np.floor(average - 1e-9)) & (count <= np.ceil(average + 1e-9)))
        assert np.allclose(of.means(importance.reshape(-1)[copied].reshape(importance.shape)), before)
        assert np.all((fraction > 0.999 / size) & (fraction <= 1.0 + 1e-12))


def test_equal_trials_count_alike() -> None:
    """A split of equal trials copies each of them once, and all of them count before it."""
    of = SplitPopulations(2, 5)
    assert of.weigh(np.full((2, 5), 3.0)).tolist() == [1.0, 1.0]
    assert of.split(np.array([0.3, 0.9])).tolist() == list(range(10))


def played(rng: np.random.Generator, populations: int, size: int) -> Floats:
    """The estimate of E P_k by each population, (P, SLOTS), with splits in every second slot."""
    of, P, errors = SplitPopulations(populations, size), np.zeros((populations, size)), np.empty((populations, SLOTS))
    for k in range(SLOTS):
        P = np.where(rng.random(P.shape) < KEPT, GROWTH * P + 1.0, 0.0)
        errors[:, k] = of.means(P)
        of.weigh(P + 5.0)
        if k % 2:
            P = P.reshape(-1)[of.split(rng.random(populations))].reshape(P.shape)
    return errors


def test_estimates_have_no_bias_and_their_error_is_true() -> None:
    """The mean over populations is E P_k; of 400 studies with 32 of them 3 to 10 % have |z| > 1.96 (6 % by Student's t)."""
    groups, expected, P = 400, np.empty(SLOTS), 0.0
    for k in range(SLOTS):
        expected[k] = P = KEPT * (GROWTH * P + 1.0)
    result = played(np.random.default_rng(7), 32 * groups, 50)
    spread = result.std(axis=0) / np.sqrt(len(result))
    assert np.all(np.abs(result.mean(axis=0) - expected) < 4.5 * spread)
    means = result.mean(axis=1).reshape(groups, 32)
    z = (means.mean(axis=1) - expected.mean()) / (means.std(axis=1, ddof=1) / np.sqrt(32))
    assert 0.03 < (np.abs(z) > 1.96).mean() < 0.10


@pytest.mark.parametrize("largest", [1e3, 1e9])
def test_the_floor_is_the_usual_error(largest: float) -> None:
    """One huge error does not move it; where no trial has an error it is a thousandth of the scale."""
    errors = np.zeros((2, 300))
    errors[0] = 1.0
    errors[0, 7] = largest
    assert importance_floor(errors, 2.0).tolist() == pytest.approx([1.002, 0.002])
