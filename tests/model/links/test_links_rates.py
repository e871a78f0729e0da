"""A million packets of every loss model, against what the model itself says of each slot and of a trial's rate."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from evedrop.model.links import LOSS_MODELS, loss_of, pooled_spec
from evedrop.model.links.loss_model import Fate
from evedrop.model.streams import Stream, root_of_seed, stream_key, uniforms

KEY = stream_key(root_of_seed(77), "link/eve")
SLOTS, TRIALS = 500, 2000
RADIO = {"model": "distance", "sender": [0, 0], "reference_snr": 75.0, "exponent": 3.0, "threshold": 10.0}
SPECS: dict[str, dict[str, Any]] = {
    "bernoulli": {"model": "bernoulli", "quality": 0.83},
    "bursts": {"model": "gilbert-elliott", "p": 0.02, "r": 0.25},
    "soft bursts": {"model": "gilbert-elliott", "p": 0.01, "r": 0.05, "good": 0.02, "bad": 0.7},
    "no two alike": {"model": "gilbert-elliott", "p": 0.9, "r": 0.95},
    "four states": {
        "model": "markov",
        "transitions": [[0.9, 0.02, 0.08, 0.0], [1.0, 0.0, 0.0, 0.0], [0.3, 0.0, 0.5, 0.2], [0.0, 0.0, 0.4, 0.6]],
        "loss": [0.0, 1.0, 1.0, 0.0],
    },
    "transient": {"model": "markov", "transitions": [[0.5, 0.5, 0.0], [0.0, 0.8, 0.2], [0.0, 0.3, 0.7]], "loss": [1, 0, 0.5]},
    "pattern": {"model": "pattern", "outcomes": "1101001"},
    "trace": {"model": "trace", "outcomes": "11010111", "once": False},
    "random trace": {"model": "trace", "outcomes": "1" * 300 + "10" * 40 + "0" * 37, "random_start": True},
    "standing": {**RADIO, "receiver": [90.0, 0.0]},
    "driving": {**RADIO, "receiver": [[0, -300.0, 20.0], [400, 100.0, 20.0]], "shadowing": 6.0, "shadowing_block": 40},
    "slow": {**RADIO, "receiver": [90.0, 0.0], "shadowing": 4.0, "shadowing_block": 60, "fading_block": 20},
}  # fmt: skip


def test_every_model_is_among_them() -> None:
    """A new loss model must be added here."""
    assert {spec["model"] for spec in SPECS.values()} == set(LOSS_MODELS)


@pytest.mark.parametrize("name", SPECS)
def test_a_million_packets(name: str) -> None:
    """Their rate is the model's, and the trials' rates scatter as it says, both at 1e-6 confidence.

    The mean of all trials is normal with the variance of one divided by their number; the variance of their rates has a
    standard error that its own fourth moment gives.
    """
    loss = loss_of(SPECS[name])
    u = uniforms(Stream(KEY, range(TRIALS), loss.uniforms_per_slot).words(range(SLOTS))).transpose(0, 2, 1)
    rates = (loss.fates(0, u) == Fate.DELIVERED).mean(axis=0)
    quality, variance = loss.quality_at(range(SLOTS)), loss.rate_variance(range(SLOTS))
    assert quality.shape == (SLOTS,)
    assert abs(rates.mean() - quality.mean()) <= 4.9 * math.sqrt(variance / TRIALS) + 1e-12
    if loss.memoryless:
        assert variance == pytest.approx(float((quality * (1.0 - quality)).sum()) / SLOTS**2, abs=1e-15)
    if variance == 0.0:
        assert np.ptp(rates) == 0.0
        return
    centred = rates - rates.mean()
    mean_square = float((centred**2).mean())
    error = math.sqrt((float((centred**4).mean()) / mean_square**2 - 1.0) / TRIALS)
    assert abs(mean_square / variance - 1.0) < 4.9 * error


@pytest.mark.parametrize("name", ["bursts", "soft bursts", "four states", "transient", "slow"])
def test_one_rate_is_within_its_interval(name: str) -> None:
    """Of 2000 trials about as many lie within two standard deviations as the normal distribution says: 95.4 %, within 3 %."""
    loss = loss_of(SPECS[name])
    u = uniforms(Stream(KEY, range(TRIALS), loss.uniforms_per_slot).words(range(SLOTS))).transpose(0, 2, 1)
    rates = (loss.fates(0, u) == Fate.DELIVERED).mean(axis=0)
    off = np.abs(rates - loss.quality_at(range(SLOTS)).mean()) / math.sqrt(loss.rate_variance(range(SLOTS)))
    assert (off < 2.0).mean() == pytest.approx(0.954, abs=0.03)


POOLED: dict[str, tuple[str, ...]] = {
    "independent": ("bernoulli", "bernoulli"),
    "patterns": ("pattern", "trace"),
    "some certain": ("bernoulli", "pattern"),
    "moving": ("bernoulli", "no shadow"),
    "chains": ("bursts", "four states"),
    "chain and pattern": ("soft bursts", "pattern"),
    "slow ones": ("slow", "random trace"),
}
NO_SHADOW = {**RADIO, "receiver": [[0, -300.0, 20.0], [400, 100.0, 20.0]]}


@pytest.mark.parametrize("name", POOLED)
def test_pooled_links(name: str) -> None:
    """A packet gets through unless all lose it: in the mean slot by slot; the rates scatter as said, or at most so."""
    loss = loss_of(pooled_spec([{**SPECS, "no shadow": NO_SHADOW}[each] for each in POOLED[name]]))
    u = uniforms(Stream(KEY, range(TRIALS), loss.uniforms_per_slot).words(range(SLOTS))).transpose(0, 2, 1)
    delivered = loss.fates(0, u) == Fate.DELIVERED
    quality, rates = loss.quality_at(range(SLOTS)), delivered.mean(axis=0)
    off = np.abs(delivered.mean(axis=1) - quality)
    assert (off <= 5.5 * np.sqrt(quality * (1.0 - quality) / TRIALS) + 1e-12).all()
    variance = loss.rate_variance(range(SLOTS))
    exact = loss.memoryless or loss.chain is not None
    assert exact is (name not in {"chain and pattern", "slow ones"})
    assert rates.var() <= 1.2 * variance + 1e-15
    if exact:
        assert rates.var() >= 0.8 * variance - 1e-15
