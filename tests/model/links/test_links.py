"""Links: fates from their own stream, in order, batch by batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.links import LOSS_MODELS, pooled_spec, single_specs
from evedrop.model.links.loss_model import REASONS, Fate
from evedrop.model.slot.link import Accountant, Fates, link_of
from evedrop.model.streams import Batch, Stream, root_of_seed, stream_key, uniforms

KEY = stream_key(root_of_seed(8), "link/eve")
SPECS: dict[str, dict[str, Any]] = {
    "bernoulli": {"model": "bernoulli", "quality": 0.7},
    "distance": {
        "model": "distance",
        "sender": [0, 0],
        "receiver": [[0, 90.0, 5.0], [40, 10.0, 90.0]],
        "reference_snr": 70.0,
        "exponent": 3.0,
        "threshold": 8.0,
        "shadowing": 6.0,
        "shadowing_block": 7,
        "fading_block": 3,
    },
    "gilbert-elliott": {"model": "gilbert-elliott", "p": 0.1, "r": 0.4, "good": 0.05, "bad": 0.8},
    "markov": {
        "model": "markov",
        "transitions": [[0.8, 0.15, 0.05], [0.3, 0.5, 0.2], [0.0, 1.0, 0.0]],
        "loss": [0.01, 0.4, 1.0],
    },
    "pattern": {"model": "pattern", "outcomes": "1101001"},
    "trace": {"model": "trace", "outcomes": "110100111", "random_start": True},
}


def test_every_model_is_tested() -> None:
    """A new loss model must be added to this file."""
    assert set(SPECS) == set(LOSS_MODELS)


@pytest.mark.parametrize("model", SPECS)
@settings(deadline=None)
@given(data=st.data(), slots=st.integers(1, 60), trials=st.integers(1, 9), first=st.integers(0, 2**40))
def test_fates_do_not_depend_on_blocks_or_batch(
    model: str, data: st.DataObject, slots: int, trials: int, first: int
) -> None:
    """Asked for in blocks of any length, for one trial or for many, a packet has the same fate."""
    whole = link_of(SPECS[model], KEY, Batch(slots, trials, first)).fates(range(slots)).codes
    assert whole.shape == (slots, trials)
    link, start, parts = link_of(SPECS[model], KEY, Batch(slots, trials, first)), 0, []
    while start < slots:
        stop = data.draw(st.integers(start + 1, slots))
        parts.append(link.fates(range(start, stop)).codes.copy())
        start = stop
    assert np.array_equal(np.concatenate(parts), whole)
    r = data.draw(st.integers(0, trials - 1))
    alone = link_of(SPECS[model], KEY, Batch(slots, 1, first + r)).fates(range(slots)).codes
    assert np.array_equal(alone[:, 0], whole[:, r])


@pytest.mark.parametrize("quality", [0.0, 0.05, 0.7, 1.0])
def test_bernoulli_is_the_papers(quality: float) -> None:
    """γ = 1 exactly where the stream's uniform is below the quality, which comes to the quality, at 1e-6 confidence."""
    fates = link_of({"model": "bernoulli", "quality": quality}, KEY, Batch(100, 1000, 7)).fates(range(100)).codes
    drawn = uniforms(Stream(KEY, range(7, 1007), 1).words(range(100)))[:, :, 0]
    assert np.array_equal(fates == Fate.DELIVERED, drawn < quality)
    assert set(np.unique(fates)) <= {Fate.DELIVERED, Fate.LOST}
    delivered = int((fates == Fate.DELIVERED).sum())
    assert delivered == quality * fates.size if quality in {0.0, 1.0} else True
    assert stats.binomtest(delivered, fates.size, quality).pvalue > 1e-6


def test_links_are_independent() -> None:
    """Fates on two links, and of neighbouring slots and trials of one, are uncorrelated, at 1e-6 confidence."""
    other = stream_key(root_of_seed(8), "link/legitimate")
    a, b = (
        link_of(SPECS["bernoulli"], key, Batch(300, 500)).fates(range(300)).codes == Fate.LOST for key in (KEY, other)
    )
    for left, right in ((a, b), (a[1:], a[:-1]), (a[:, 1:], a[:, :-1])):
        assert abs(np.corrcoef(left.ravel(), right.ravel())[0, 1]) < 4.9 / np.sqrt(left.size)


@settings(deadline=None)
@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 2**31))
def test_losses_account_for_every_packet(slots: int, trials: int, seed: int) -> None:
    """Delivered and the losses of all reasons add up to what was offered, slot by slot."""
    fates = np.random.default_rng(seed).integers(0, int(Fate.UNSENT), (slots, trials), np.uint8)
    counted = Accountant(0, trials).account(range(slots), Fates(fates)).slots.lost
    assert counted.dtype == np.uint32
    assert np.array_equal((fates == Fate.DELIVERED).sum(axis=1) + counted.sum(axis=1), np.full(slots, trials))
    for column, reason in zip(counted.T, REASONS, strict=True):
        assert np.array_equal(column, (fates == Fate[reason.upper()]).sum(axis=1)), reason


def test_a_pooled_description_names_the_models_of_its_links() -> None:
    """In their order; any other description names one."""
    specs = [SPECS["bernoulli"], SPECS["distance"]]
    assert single_specs(pooled_spec(specs)) == specs
    assert single_specs(specs[0]) == specs[:1]
