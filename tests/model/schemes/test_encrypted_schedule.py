"""Quantised packets with an encryption schedule: the quantiser's error, the threshold between two numbers, the budget."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.number_codes import DitheredQuantiser, LevelPad
from evedrop.model.process import Process
from evedrop.model.receiver import Action
from evedrop.model.schemes.encrypted_schedule import QuantisedSchedule
from evedrop.model.streams import Batch, Stream, stream_key
from evedrop.model.theory.closed_forms import (
    QuantisationError,
    SensorChain,
    always_sent,
    encrypted_fraction,
    encrypted_schedule,
    threshold_for,
)
from evedrop.model.theory.covariances import state_covariances
from tests.builders import DRIFTING, UNSTABLE
from tests.model.slot_loop import ROOT, STABLE, coins, play

DITHER, MASK = stream_key(ROOT, "dither"), stream_key(ROOT, "mask")
MU, MU_E, ARRIVES = 0.7, 0.6, 0.8


def quantised_in_words(
    process: Process, k: int, x: float, i: int, trial: int, bits: int, standard_deviations: float
) -> float:
    """The value read of one state by docs/mathematics/schemes.md, from the words of the stream."""
    word = int(Stream(DITHER, range(trial, trial + 1), process.n).words(range(k, k + 1))[0, 0, i])
    step = 2.0 * standard_deviations * float(np.sqrt(state_covariances(process, k + 1)[k, i, i])) / 2.0**bits
    dither = ((word >> 11) / 2.0**53 - 0.5) * step
    level = min(max(int(np.floor((x + dither) / step)), -(2 ** (bits - 1))), 2 ** (bits - 1) - 1)
    return float((level + 0.5) * step - dither)


@pytest.mark.parametrize("process", [STABLE, UNSTABLE, DRIFTING])
@pytest.mark.parametrize(("bits", "k"), [(1, 0), (4, 3), (8, 30), (32, 7)])
def test_quantising_is_rounding_with_dither(process: Process, bits: int, k: int) -> None:
    """The state plus dither is cut to a level, and the dither is subtracted from its middle; far states have the last level."""
    x = np.sqrt(np.diag(state_covariances(process, k + 1)[k]))[:, None] * np.linspace(-7.0, 7.0, 6)
    quantiser = DitheredQuantiser(process, bits, 5.0, DITHER, Batch(50, 6, 11))
    levels = quantiser.levels(k, x)
    assert levels.min() >= 0
    assert levels.max() < 2**bits
    read = quantiser.read(k, levels)
    expected = [
        [quantised_in_words(process, k, x[i, r], i, 11 + r, bits, 5.0) for r in range(6)] for i in range(process.n)
    ]
    assert np.allclose(read, expected, rtol=1e-12, atol=1e-12 * np.abs(x).max())
    assert np.array_equal(quantiser.levels_of(k, quantiser.centres(k, levels)), levels)
    inside = (np.abs(x) < (5.0 * np.sqrt(np.diag(state_covariances(process, k + 1)[k])))[:, None]) & (bits > 1)
    assert (np.abs(read - x) <= 0.500001 * quantiser.steps(k)[:, None])[inside].all()


def test_the_error_is_white_and_uniform_whatever_the_state_is() -> None:
    """Of 20,000 trials with one state, and with normal ones: uniform over a step (p > 1e-4), and uncorrelated with the state."""
    trials = 20_000
    quantiser = DitheredQuantiser(STABLE, 3, 6.0, DITHER, Batch(4, trials))
    scale = np.sqrt(np.diag(state_covariances(STABLE, 4)[3]))[:, None]
    for x in (np.full((2, trials), 0.3) * scale, np.random.default_rng(1).normal(size=(2, trials)) * scale):
        error = (quantiser.read(3, quantiser.levels(3, x)) - x) / quantiser.steps(3)[:, None]
        for error_of_state, state in zip(error, x, strict=True):
            assert stats.kstest(error_of_state, "uniform", args=(-0.5, 1.0)).pvalue > 1e-4
            if state.std() > 0.0:
                assert abs(np.corrcoef(error_of_state, state)[0, 1]) < 4.0 / np.sqrt(trials)
    expected = QuantisationError.of(3, 6.0).covariances(STABLE, 4)[3]
    assert np.allclose(np.diag(expected), quantiser.steps(3) ** 2 / 12.0)


@pytest.mark.parametrize(
    ("width", "bits", "warned"), [(2.0, 8, True), (4.0, 8, True), (4.0, 4, False), (6.0, 16, False)]
)
def test_a_range_that_states_exceed_is_a_warning(width: float, bits: int, warned: bool) -> None:
    """Where the cut levels add more than a hundredth to the quantiser's own error, which is all that theory knows of."""
    process = Process(np.array([[0.9]]), np.array([[0.19]]), np.eye(1))
    warnings = QuantisedSchedule(process, 1.5, bits, width).warnings()
    assert bool(warnings) is warned
    quantiser = DitheredQuantiser(process, bits, width, stream_key(ROOT, "dither"), Batch(1, 400_000))
    x = np.random.default_rng(3).standard_normal((1, 400_000))
    error = float(((quantiser.read(0, quantiser.levels(0, x)) - x) ** 2).mean())
    assert (error > 1.02 * width**2 / (3.0 * 4.0**bits)) is warned


def test_masked_levels_say_nothing() -> None:
    """The masked value of any level is uniform (p > 1e-4); the pad is undone exactly, in any order of slots."""
    pad = LevelPad(2, 4, MASK, Batch(6, 8000))
    for level in (0, 7, 15):
        levels = np.full((2, 8000), level)
        masked = pad.hide(5, levels)
        assert stats.chisquare(np.bincount(masked[0], minlength=16)).pvalue > 1e-4
        assert np.array_equal(pad.reveal(5, masked), levels)
    assert not np.array_equal(pad.hide(2, levels), masked)


@pytest.mark.parametrize("threshold", [1.0, 1.4, 3.0, 2.75])
def test_packets_go_by_the_holding_time_and_a_coin(threshold: float) -> None:
    """Encrypted from ⌈θ⌉ on, never before ⌊θ⌋, and at ⌊θ⌋ with probability 1 − (θ − ⌊θ⌋); both kinds are read alike."""
    scheme = QuantisedSchedule(UNSTABLE, threshold, 10, 6.0)
    gamma, slots, trials = coins(0.6, 40, 500), 40, 500
    selective = STRATEGIES["selective"](Knowledge(UNSTABLE, 1.0, {}, {}), Batch(slots, trials))
    played = play(scheme, Batch(slots, trials), {"legitimate": gamma, "eve": gamma}, {"eve": selective})
    held, early = np.full(trials, 10**6), []
    for k, packet in enumerate(played.packets):
        assert packet.header is not None
        encrypted = packet.header[0] == 1
        assert encrypted[held >= np.ceil(threshold)].all()
        assert not encrypted[held < np.floor(threshold)].any()
        if threshold % 1.0:
            early += encrypted[held == np.floor(threshold)].tolist()
        steps = np.sqrt(12.0 * np.diag(scheme.quantisation.covariances(UNSTABLE, slots)[k]))[:, None]
        legitimate, eve = played.beliefs["legitimate"][k], played.beliefs["eve"][k]
        assert (np.abs(legitimate.x_hat - played.x[k]) <= 0.500001 * steps)[:, gamma[k]].all()
        assert np.allclose(legitimate.P[:, :, gamma[k]], np.diag(steps[:, 0] ** 2 / 12.0)[:, :, None], rtol=1e-9)
        clear = gamma[k] & ~encrypted
        assert np.array_equal(eve.x_hat[:, clear], legitimate.x_hat[:, clear])
        assert (eve.action[gamma[k] & encrypted] == Action.DISCARDED).all()
        held = np.where(gamma[k], 1, held + 1)
    if early:
        fraction = 1.0 - threshold % 1.0
        assert abs(np.mean(early) - fraction) < 4.0 * np.sqrt(fraction * (1.0 - fraction) / len(early))


@pytest.mark.parametrize("process", [pytest.param(STABLE, marks=pytest.mark.long), UNSTABLE])
@pytest.mark.parametrize("threshold", [1.0, 1.3, 2.0, 2.6])
def test_expectations_are_those_of_all_courses(process: Process, threshold: float) -> None:
    """E P over every course of links, acknowledgements and coins in four slots, for legitimate estimator and eavesdropper."""
    slots, error = 4, QuantisationError.of(3, 4.0)
    courses = np.array(list(itertools.product(range(16), repeat=slots))).T
    gamma, gamma_e, link, coin = (courses // 2**bit % 2 == 1 for bit in range(4))
    odds = zip((gamma, gamma_e, link, coin), (MU, MU_E, ARRIVES, 1.0 - threshold % 1.0), strict=True)
    chances = np.prod([np.where(events, p, 1.0 - p) for events, p in odds], axis=0).prod(axis=0)
    R = error.covariances(process, slots)
    held, P = np.full(chances.shape, 10**6), {name: np.zeros((chances.size, 2, 2)) for name in ("legitimate", "eve")}
    expected = {
        "legitimate": always_sent(MU).covariances(process, slots, error),
        "eve": encrypted_schedule(threshold, MU_E, (MU * MU_E * ARRIVES, MU * (1 - MU_E) * ARRIVES)).covariances(
            process, slots, error
        ),
    }
    encrypted_fractions = []
    for k in range(slots):
        encrypted = (held >= np.ceil(threshold)) | ((held >= np.floor(threshold)) & coin[k])
        encrypted_fractions.append(float(chances @ encrypted))
        for name, heard in (("legitimate", gamma[k]), ("eve", gamma_e[k] & ~encrypted)):
            grown = process.A @ P[name] @ process.A.T + process.Q if k else process.initial_covariance
            P[name] = np.where(heard[:, None, None], R[k], grown)
            assert np.allclose(np.tensordot(chances, P[name], axes=1), expected[name][k], rtol=1e-9)
        held = np.where(gamma[k] & link[k], 1, held + 1)
    assert encrypted_fractions[0] == pytest.approx(1.0)
    # Once as many slots as the threshold have passed, the chain is as good as stationary.
    if threshold < 3.0:
        assert encrypted_fractions[-1] == pytest.approx(encrypted_fraction(threshold, MU * ARRIVES), abs=1e-9)


@pytest.mark.parametrize("threshold", [1.0, 1.5, 2.0, 4.25])
def test_limits_and_the_distribution_of_the_chain(threshold: float) -> None:
    """The limit is the expectation after many slots; the encrypted fraction is that of the chain; growing steps are unbounded."""
    error = QuantisationError.of(4, 6.0)
    chain = encrypted_schedule(threshold, 0.9, (0.5, 0.2))
    assert np.allclose((chain.reset + chain.carried).sum(1), 1.0)
    assert np.allclose(chain.limit(STABLE, error), chain.covariances(STABLE, 2000, error)[-1], rtol=1e-9)
    whole, part = int(threshold), threshold % 1.0
    of_chain = chain.stationary[-1] + (chain.stationary[whole - 1] * (1.0 - part) if part else 0.0)
    assert encrypted_fraction(threshold, 0.7) == pytest.approx(of_chain)
    legitimate = always_sent(0.9)
    assert np.allclose(legitimate.limit(STABLE, error), legitimate.covariances(STABLE, 2000, error)[-1], rtol=1e-9)
    assert np.isfinite(legitimate.limit(UNSTABLE)).all()
    assert np.isinf(legitimate.limit(UNSTABLE, error)).all()
    assert isinstance(legitimate, SensorChain)


@given(st.floats(1e-6, 1.0), st.floats(0.01, 1.0))
def test_any_fraction_has_its_threshold(fraction: float, arrives: float) -> None:
    """The threshold for a fraction gives that fraction, exactly up to rounding."""
    threshold = threshold_for(fraction, arrives)
    assert threshold >= 1.0
    assert encrypted_fraction(threshold, arrives) == pytest.approx(fraction, rel=1e-7)


def test_thresholds_at_the_ends() -> None:
    """To encrypt all takes θ = 1; less is not possible if no acknowledgement arrives."""
    assert threshold_for(1.0, 0.5) == threshold_for(1.0, 0.0) == 1.0
    assert threshold_for(0.5, 0.0) == np.inf
    assert threshold_for(0.4, 0.72) == pytest.approx(1.0 + 0.6 / 0.72)
    assert encrypted_fraction(threshold_for(0.25, 1.0), 1.0) == 0.25
