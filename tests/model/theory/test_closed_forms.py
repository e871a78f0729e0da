"""Closed forms with a memory: where they leave double precision they are infinite, without a warning."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.process import Floats, Process
from evedrop.model.theory.closed_forms import reference_covariances, scheduled, twin_track_bound
from tests.builders import UNSTABLE

FAST = Process(1e20 * UNSTABLE.A, UNSTABLE.Q, UNSTABLE.initial_covariance)


@pytest.mark.parametrize("case", ["reference", "scheduled"])
def test_covariances_that_overflow_are_infinite_from_there_on(case: str) -> None:
    """Never NaN; before that they are finite."""
    slots = 30
    covariances: Floats
    if case == "reference":
        covariances = reference_covariances(FAST, 0.5, (0.2, 0.2), slots)
    else:
        covariances = scheduled(2, 0.5, (0.2, 0.2)).covariances(FAST, slots)
    assert covariances.shape == (slots, 2, 2)
    finite = np.array([np.isfinite(covariance).all() for covariance in covariances])
    first = int(np.argmin(finite))
    assert 1 < first < slots - 1
    assert finite[:first].all()
    assert np.isposinf(covariances[first:]).all()


def test_a_bound_that_overflows_is_infinite() -> None:
    """½ tr A^k Σ0 A^kᵀ, which grows by 40 decades in a slot."""
    result = twin_track_bound(FAST, 20)
    finite = np.array([np.isfinite(bound) for bound in result])
    assert finite[:5].all()
    assert np.isposinf(result[~finite]).all()
    assert (~finite).sum() > 5
