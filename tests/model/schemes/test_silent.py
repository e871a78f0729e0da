"""Withholding: no receiver has the packets that are not sent."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.schemes.silent import Withholding
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import limit, lyapunov, theoretical_covariances
from tests.builders import DRIFTING, UNSTABLE
from tests.model.slot_loop import coins, play


def test_packets_are_sent_with_their_probability() -> None:
    """Always in slot 0, then with probability p, independent of the state: binomial bounds at 1e-6 confidence."""
    played = play(Withholding(DRIFTING, 0.3), Batch(50, 2000), {"legitimate": np.ones((50, 2000), bool)})
    sent = np.array([packet.sent for packet in played.packets])
    assert sent[0].all()
    assert stats.binomtest(int(sent[1:].sum()), sent[1:].size, 0.3).pvalue > 1e-6
    assert all(np.array_equal(packet.z, x) for packet, x in zip(played.packets, played.x, strict=True))


def test_errors_are_the_closed_form() -> None:
    """Mean squared error and mean P of both receivers are those of a link of quality μp, at 5 standard errors."""
    slots, trials, scheme = 25, 20_000, Withholding(DRIFTING, 0.4)
    naive = STRATEGIES["naive"](Knowledge(DRIFTING, 1.0, {}, {}), Batch(slots, trials))
    gamma = {"legitimate": coins(0.8, slots, trials, 1), "naive": coins(0.6, slots, trials, 2)}
    played = play(scheme, Batch(slots, trials), gamma, {"naive": naive})
    for name, outcomes in (
        ("legitimate", scheme.outcomes(0.8)),
        ("naive", scheme.eavesdropper_outcomes(0.6, 1.0, 1.0)),
    ):
        expected = np.trace(theoretical_covariances(DRIFTING, outcomes, slots), axis1=1, axis2=2)
        for errors in (played.squared_error(name), played.trace(name)):
            difference = np.abs(errors.mean(1) - expected)
            assert (difference < 5.0 * errors.std(1) / np.sqrt(trials) + 1e-15).all()


def test_the_limit_is_the_papers() -> None:
    """(1 − μp) S(μp)."""
    result = limit(UNSTABLE, Withholding(UNSTABLE, 0.8).outcomes(0.9))
    assert np.allclose(result, (1.0 - 0.72) * lyapunov(UNSTABLE, 1.0 - 0.72), rtol=1e-12)


@pytest.mark.parametrize("p", [0, 0.0, -0.0])
def test_a_sensor_that_never_sends_is_refused(p: float) -> None:
    """With the bound, and what to write instead; the least number above 0 is allowed."""
    (mistake,) = Withholding.mistakes({"state_probability": p})
    assert mistake[0] == "state_probability"
    assert mistake[1].startswith(f"is {p}, so nothing is sent after slot 0")
    assert mistake[1].endswith("expected a number above 0, up to 1")
    assert Withholding.mistakes({"state_probability": 5e-324}) == []
    for other in (-0.1, 1.1, "0", False):
        (mistake,) = Withholding.mistakes({"state_probability": other})
        assert mistake[1].endswith("expected a number from 0 to 1")
