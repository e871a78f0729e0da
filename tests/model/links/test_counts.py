"""The transform of the number of delivered packets, against the distribution of all courses, or of all beginnings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evedrop.model.links import loss_of
from evedrop.model.links.counts import Counted
from evedrop.model.links.loss_model import LossModel
from evedrop.model.links.trace import MOST_BEGINNINGS

POINTS = 12
Z = np.exp(2j * np.pi * np.arange(POINTS) / POINTS)
CORRUPTED = 0.25
RANGES = (range(2, 5), range(9, 13))


def parts(w: NDArray[np.complex128] = Z) -> list[Counted]:
    """Seven packets in two ranges, each of which counts with the same factor."""
    return [Counted(slots, w) for slots in RANGES]


def of_outcomes(courses: list[list[bool]]) -> NDArray[np.complex128]:
    """The transform where each course, a list of all slots, is equally likely."""
    counts = [sum(course[slot] for slots in RANGES for slot in slots) for course in courses]
    spectrum: NDArray[np.complex128] = np.mean([Z**count for count in counts], axis=0)
    return spectrum


def test_certain_fates_are_counted() -> None:
    """Of a pattern, and of a recording with a fixed start: one number is certain; packets may be corrupted besides."""
    outcomes = "110100"
    course = [outcomes[slot % len(outcomes)] == "1" for slot in range(20)]
    for spec in ({"model": "pattern", "outcomes": outcomes}, {"model": "trace", "outcomes": outcomes}):
        spectrum = loss_of(spec).count_spectrum(parts())
        assert spectrum is not None
        assert np.allclose(spectrum, of_outcomes([course]), atol=1e-12)
    delivered = sum(course[slot] for slots in RANGES for slot in slots)
    w = 1.0 - CORRUPTED + CORRUPTED * Z
    corrupted = loss_of({"model": "pattern", "outcomes": outcomes}).count_spectrum(parts(w))
    assert corrupted is not None
    assert np.allclose(corrupted, w**delivered)


def test_a_recording_may_begin_anywhere() -> None:
    """Every place is equally likely; with too many places it is not computed."""
    outcomes = "1101001"
    courses = [
        [outcomes[(begin + slot) % len(outcomes)] == "1" for slot in range(20)] for begin in range(len(outcomes))
    ]
    spectrum = loss_of({"model": "trace", "outcomes": outcomes, "random_start": True}).count_spectrum(parts())
    assert spectrum is not None
    assert np.allclose(spectrum, of_outcomes(courses), atol=1e-12)
    long = {"model": "trace", "outcomes": "10" * MOST_BEGINNINGS, "random_start": True}
    assert loss_of(long).count_spectrum(parts()) is None


def test_large_chains_and_uneven_blocks_are_not_counted() -> None:
    """The work would be too much, or blocks of fading and shadowing would not fit into each other."""
    states = 9
    ring = np.roll(np.eye(states), 1, axis=1) * 0.5 + np.eye(states) * 0.5
    markov = {"model": "markov", "transitions": ring.tolist(), "loss": [0.1 * i for i in range(states)]}
    assert loss_of(markov).count_spectrum(parts()) is None
    distance: dict[str, Any] = {
        "model": "distance",
        "receiver": [120.0, 0.0],
        "sender": [0.0, 0.0],
        "reference_snr": 72.0,
        "exponent": 3.0,
        "threshold": 10.0,
        "shadowing": 4.0,
        "shadowing_block": 10,
        "fading_block": 3,
    }
    assert loss_of(distance).count_spectrum(parts()) is None


def test_an_unknown_memory_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither are too many packets one by one."""
    pattern = loss_of({"model": "pattern", "outcomes": "10"})
    assert pattern.count_spectrum([Counted(range(10**9), Z)]) is None
    monkeypatch.setattr(type(pattern), "memoryless", property(lambda _: False))
    assert LossModel.count_spectrum(pattern, parts()) is None
