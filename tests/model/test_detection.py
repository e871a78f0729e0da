"""The probability that a link's loss rate has risen, against Bayes' rule over all times of the change."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.detection import ShiryaevTest

TEST = ShiryaevTest(normal=0.2, raised=0.6, hazard=0.1, risk=0.05)


def test_it_is_the_posterior_over_all_times_of_the_change() -> None:
    """Of every word of six losses and deliveries, enumerated: prior κ(1−κ)^j for a change in slot j."""
    slots = 6
    words = np.array([[(word >> k) & 1 for word in range(2**slots)] for k in range(slots)], np.bool_)
    p = TEST.start(2**slots)
    for k in range(slots):
        p = TEST.step(p, words[k])
        joint = np.empty((k + 2, 2**slots))  # the change in slot j ≤ k, or later
        for j in range(k + 2):
            prior = 0.1 * 0.9**j if j <= k else 0.9 ** (k + 1)
            rates = np.where(np.arange(k + 1) >= j, 0.6, 0.2)[:, None]
            joint[j] = prior * np.where(words[: k + 1], rates, 1.0 - rates).prod(axis=0)
        np.testing.assert_allclose(p, joint[:-1].sum(axis=0) / joint.sum(axis=0), rtol=1e-12)
    assert np.array_equal(TEST.alarms(p), 1.0 - p <= 0.05)
    assert TEST.alarms(p).any()
    assert not TEST.alarms(p).all()


@pytest.mark.parametrize(
    "numbers",
    [
        (0.6, 0.2, 0.1, 0.1),
        (0.2, 0.2, 0.1, 0.1),
        (0.0, 0.5, 0.1, 0.1),
        (0.2, 1.0, 0.1, 0.1),
        (0.2, 0.5, 0.0, 0.1),
        (0.2, 0.5, 0.1, 1.0),
    ],
)
def test_rates_that_cannot_be_told_apart_are_refused(numbers: tuple[float, float, float, float]) -> None:
    """A rate that does not rise, and numbers that are not between 0 and 1."""
    with pytest.raises(ValueError, match="a second rate above the first"):
        ShiryaevTest(*numbers)
