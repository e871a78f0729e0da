"""Crimson, Kennedy and Quevedo: the threshold on the probability of noise, and the detector's promise."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.detection import ShiryaevTest
from evedrop.studies.papers.crimson2023 import detection, filter_error, noise_threshold, open_loop

A, Q = np.array([[0.5, 0.1], [0.4, 0.6]]), 0.01 * np.eye(2)


def test_at_the_threshold_both_err_alike() -> None:
    """By iterating the published recursions; with equal losses any noise puts the eavesdropper behind."""
    P, P_OL, mu = filter_error(), open_loop(), noise_threshold(0.4, 0.25)
    legitimate = eavesdropper = P_OL
    for _ in range(500):
        a = 0.6 * (1.0 - mu)
        legitimate = a * P + (1.0 - a) * (A @ legitimate @ A.T + Q)
        used = (1.0 - mu) * P + mu * (P_OL + P)
        eavesdropper = 0.75 * used + 0.25 * (A @ eavesdropper @ A.T + Q)
    assert np.trace(legitimate) == pytest.approx(np.trace(eavesdropper), rel=1e-9)
    assert mu == pytest.approx(0.1409, abs=1e-4)
    assert noise_threshold(0.3, 0.3) < 1e-9


def test_false_alarms_are_as_rare_as_asked_for() -> None:
    """Of 2000 changes at random times at most h, at 4 standard errors; a larger rise is noticed sooner."""
    slow, quick = (detection(ShiryaevTest(0.1, raised, 0.02, 0.05), 2000) for raised in (0.3, 0.6))
    for false, _ in (slow, quick):
        assert 0.0 < false[0] <= 0.05 + 4.0 * false[1]
    assert 0.0 < quick[1][0] < 0.7 * slow[1][0]
