"""The stream cipher: the legitimate estimator reads everything, other receivers nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.number_codes import Mask
from evedrop.model.process import Process
from evedrop.model.schemes.cipher import Cipher
from evedrop.model.streams import Batch, Stream, stream_key
from evedrop.model.theory.covariances import state_covariances, theoretical_covariances
from tests.builders import DRIFTING, UNSTABLE
from tests.model.slot_loop import ROOT, STABLE, coins, play

KEY = stream_key(ROOT, "mask")


def masked_in_words(process: Process, k: int, x: np.ndarray, trial: int) -> list[float]:
    """The formula of docs/mathematics/schemes.md for one state, in Python's integers."""
    words = Stream(KEY, range(trial, trial + 1), process.n).words(range(k, k + 1))[0, 0].tolist()
    masked = []
    for i, word in enumerate(words):
        standard_deviation = float(np.sqrt(state_covariances(process, k + 1)[k, i, i]))
        H = 2.0**-200
        while 16.0 * standard_deviation >= H:
            H *= 2.0
        point = round(float(x[i]) * 2.0**52 / H)
        masked.append((((point + 2**52 + (word >> 11)) % 2**53) - 2**52) * H / 2.0**52)
    return masked


@pytest.mark.parametrize("process", [STABLE, UNSTABLE, DRIFTING])
@pytest.mark.parametrize("k", [0, 1, 7, 40])
def test_masking_is_addition_on_the_grid(process: Process, k: int) -> None:
    """State plus pad modulo the range, and the legitimate estimator's own state again within half a step of the grid."""
    x = 3.0 * np.sqrt(np.diag(state_covariances(process, k + 1)[k]))[:, None] * np.linspace(-1, 1, 5)
    mask = Mask(process, KEY, Batch(50, 5, 11))
    z = mask.hide(k, x)
    assert [masked_in_words(process, k, x[:, r], 11 + r) for r in range(5)] == z.T.tolist()
    assert (np.abs(mask.reveal(k, z) - x) <= 0.5 * mask.steps(k)[:, None]).all()
    assert (mask.steps(k) <= 2.0**-47 * np.sqrt(np.diag(state_covariances(process, k + 1)[k]))).all()


@settings(deadline=None)
@given(slots=st.lists(st.integers(0, 60), min_size=1, max_size=6))
def test_any_slot_may_be_asked_for(slots: list[int]) -> None:
    """Order does not matter: a lost packet desynchronises nothing."""
    ahead = Mask(UNSTABLE, KEY, Batch(61, 2))
    x = np.array([[0.3, -0.1], [0.2, 0.05]])
    for k in slots:
        assert ahead.hide(k, x).tobytes() == Mask(UNSTABLE, KEY, Batch(61, 2)).hide(k, x).tobytes()


@pytest.mark.parametrize("value", [0.0, 1e300, -1e300, 1.0])
def test_what_is_masked_is_finite_and_in_range(value: float) -> None:
    """The packet of any number is in the range, and a number beyond the range is read as its end."""
    mask = Mask(STABLE, KEY, Batch(1, 4))
    z = mask.hide(0, np.full((2, 4), value))
    H = mask.steps(0)[:, None] * 2.0**52
    assert (np.abs(z) <= H).all()
    if abs(value) > 1e200:
        assert (np.abs(mask.reveal(0, z)) >= H * (1.0 - 1e-12)).all()
        assert (np.sign(mask.reveal(0, z)) == np.sign(value)).all()


def test_packets_say_nothing_of_the_state() -> None:
    """Packets are uniform over their range, and their rank correlation with the state is nil, at 1e-6 confidence."""
    trials = 50_000
    played = play(Cipher(STABLE), Batch(3, trials), {"legitimate": np.ones((3, trials), bool)})
    mask = Mask(STABLE, KEY, Batch(3, 1))
    for k, (x, packet) in enumerate(zip(played.x, played.packets, strict=True)):
        H = mask.steps(k) * 2.0**52
        for i in range(2):
            assert stats.kstest(packet.z[i], stats.uniform(-H[i], 2.0 * H[i]).cdf).pvalue > 1e-6
            assert stats.spearmanr(packet.z[i], x[i]).pvalue > 1e-6
            assert stats.spearmanr(packet.z[i], np.abs(x[i])).pvalue > 1e-6


def test_errors_are_the_closed_form() -> None:
    """The legitimate estimator's mean squared error and mean P are the plain scheme's, at 5 standard errors."""
    slots, trials = 25, 20_000
    played = play(Cipher(DRIFTING), Batch(slots, trials), {"legitimate": coins(0.7, slots, trials)})
    expected = np.trace(theoretical_covariances(DRIFTING, Cipher(DRIFTING).outcomes(0.7), slots), axis1=1, axis2=2)
    for errors in (played.squared_error("legitimate"), played.trace("legitimate")):
        assert (np.abs(errors.mean(1) - expected) < 5.0 * errors.std(1) / np.sqrt(trials)).all()


def test_taking_a_masked_packet_for_the_state_is_finite_nonsense() -> None:
    """The naive eavesdropper's error is that of a uniform number: var x + H²/3, far above not listening at all."""
    slots, trials = 6, 20_000
    naive = STRATEGIES["naive"](Knowledge(STABLE, 1.0, {}, {}), Batch(slots, trials))
    gamma = {"legitimate": coins(0.7, slots, trials), "naive": np.ones((slots, trials), bool)}
    played = play(Cipher(STABLE), Batch(slots, trials), gamma, {"naive": naive})
    mask, sigma = Mask(STABLE, KEY, Batch(slots, 1)), state_covariances(STABLE, slots)
    squared_error = played.squared_error("naive")
    assert np.isfinite(squared_error).all()
    for k in range(slots):
        H = mask.steps(k) * 2.0**52
        expected = np.trace(sigma[k]) + (H * H).sum() / 3.0
        assert abs(squared_error[k].mean() - expected) < 5.0 * squared_error[k].std() / np.sqrt(trials)
        assert expected > 80.0 * np.trace(sigma[k])


def test_an_earlier_slot_may_be_asked_for_again() -> None:
    """Its range starts again from Σ0: states, masked states and grid are those of a mask that has not moved before."""
    batch = Batch(40, 2)
    mask = Mask(UNSTABLE, KEY, batch)
    x = np.array([[0.5, -0.25], [1.0, 0.125]])
    for k in (0, 39, 3, 20):
        fresh = Mask(UNSTABLE, KEY, batch)
        assert np.array_equal(mask.steps(k), fresh.steps(k))
        assert np.array_equal(mask.hide(k, x), fresh.hide(k, x))
        assert np.allclose(mask.reveal(k, mask.hide(k, x)), x, rtol=0, atol=float(fresh.steps(k).max()))
