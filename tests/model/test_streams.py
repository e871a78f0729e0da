"""Random numbers: against AES in counter mode as the library has it, in any order, alone and among others."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.streams import (
    Ahead,
    Batch,
    BlockReader,
    SingleTrialReader,
    Stream,
    normals,
    root_of_seed,
    stream_key,
    stream_keys,
    uniforms,
)

KEY = bytes(range(32))
SLOTS = st.integers(0, 2**45)


def counter_mode(key: bytes, k: int, r: int, per_trial: int) -> list[int]:
    """The words of one slot and trial by AES-CTR itself, started at their counter."""
    blocks = -(-per_trial // 2)
    start = (k * 2**64 + r * blocks).to_bytes(16, "big")
    keystream = Cipher(algorithms.AES(key), modes.CTR(start)).encryptor().update(bytes(16 * blocks))
    words: list[int] = np.frombuffer(keystream, "<u8")[:per_trial].tolist()
    return words


@settings(deadline=None)
@given(
    st.binary(min_size=32, max_size=32),
    SLOTS,
    st.integers(0, 2**48),
    st.integers(1, 5),
    st.integers(1, 3),
    st.integers(1, 4),
)
def test_words_are_aes_in_counter_mode(key: bytes, k: int, r: int, per_trial: int, slots: int, trials: int) -> None:
    """Every word of a block of slots and trials is the library's AES-256-CTR at the documented counter."""
    drawn = Stream(key, range(r, r + trials), per_trial).words(range(k, k + slots))
    assert drawn.shape == (slots, trials, per_trial)
    expected = [[counter_mode(key, k + i, r + j, per_trial) for j in range(trials)] for i in range(slots)]
    assert drawn.tolist() == expected


def test_the_cipher_is_aes_256() -> None:
    """The key and block of NIST's FIPS 197, appendix C.3, come out of a stream at the counter that is this block."""
    k, r = 0x0011223344556677, 0x8899AABBCCDDEEFF
    drawn = Stream(KEY, range(r, r + 1), 2).words(range(k, k + 1))
    assert drawn.astype("<u8").tobytes().hex() == "8ea2b7ca516745bfeafc49904b496089"


def test_keys_are_keyed_blake2b() -> None:
    """The key of a stream is keyed BLAKE2b of its name; names and roots tell streams apart."""
    root = root_of_seed(258)
    assert root == b"\x02\x01" + bytes(30)
    inner = hashlib.blake2b(root, digest_size=32).digest()
    assert stream_key(root, "link/eve") == hashlib.blake2b(b"link/eve", key=inner, digest_size=32).digest()
    roots = [root_of_seed(seed) for seed in (0, 1, 256)]
    keys = {stream_key(root, name) for root in roots for name in ("process", "schedule", "noise", "link/a", "link/ab")}
    assert len(keys) == 15


@settings(deadline=None)
@given(st.data(), st.integers(1, 40), st.integers(1, 6), st.integers(1, 3), st.integers(0, 1000))
def test_reader_gives_the_same_numbers_in_any_order(
    data: st.DataObject, slots: int, trials: int, per_trial: int, first: int
) -> None:
    """Blocks asked for in any order, of any length, hold the numbers of their slots and trials, nothing else."""
    batch = Batch(slots, trials, first)
    reader = BlockReader(KEY, batch, per_trial)
    whole = reader.normals(range(slots)), reader.uniforms(range(slots))
    assert whole[0].shape == (slots, per_trial, trials)
    for _ in range(4):
        start = data.draw(st.integers(0, slots - 1))
        stop = data.draw(st.integers(start + 1, slots))
        assert np.array_equal(reader.normals(range(start, stop)), whole[0][start:stop])
        assert np.array_equal(reader.uniforms(range(start, stop)), whole[1][start:stop])
    alone = data.draw(st.integers(0, trials - 1))
    other = BlockReader(KEY, Batch(slots, 1, first + alone), per_trial)
    assert np.array_equal(other.normals(range(slots))[:, :, 0], whole[0][:, :, alone])


def test_what_was_drawn_stays() -> None:
    """A later draw does not overwrite numbers that were handed out, whatever the shape."""
    for trials, per_trial in ((1, 1), (1, 2), (1, 4), (3, 1), (3, 2)):
        reader = BlockReader(KEY, Batch(8, trials), per_trial)
        first = reader.uniforms(range(4)), reader.normals(range(4))
        before = [array.copy() for array in first]
        reader.uniforms(range(4, 8))
        reader.normals(range(4, 8))
        assert all(np.array_equal(array, was) for array, was in zip(first, before, strict=True))


@given(st.data(), st.sampled_from([(1, 1), (30, 1), (255, 1), (600, 1), (600, 1000), (40, 100_000)]))
def test_what_is_drawn_ahead_is_drawn_once_and_in_order(data: st.DataObject, shape: tuple[int, int]) -> None:
    """However many slots are read at a time, in order; another order gives the same values."""
    slots, trials = shape
    made: list[int] = []

    def make(some: range) -> np.ndarray[Any, np.dtype[np.int64]]:
        made.extend(some)
        return np.array(some)

    ahead = Ahead(BlockReader(KEY, Batch(slots, trials), 2).ahead, make)
    k = 0
    while k < slots:
        stop = data.draw(st.integers(k + 1, slots))
        assert ahead.of(range(k, stop)).tolist() == list(range(k, stop))
        assert ahead.at(stop - 1) == stop - 1
        k = stop
    assert made == list(range(slots))
    for _ in range(3):
        start = data.draw(st.integers(0, slots - 1))
        stop = data.draw(st.integers(start + 1, slots))
        assert ahead.of(range(start, stop)).tolist() == list(range(start, stop))
        assert ahead.at(start) == start


def test_extreme_words() -> None:
    """Uniforms stay in [0, 1); normals stay finite and symmetric at both ends."""
    ends = np.array([0, 2**64 - 1], np.uint64)
    assert uniforms(ends).tolist() == [0.0, 1 - 2.0**-53]
    low, high = normals(ends).tolist()
    assert low == -high
    assert 8.1 < high < 8.3


@pytest.mark.parametrize("per_trial", [1, 2, 3])
def test_numbers_have_their_distributions(per_trial: int) -> None:
    """Kolmogorov-Smirnov over 200 000 numbers, and correlations between slots, trials and words, at 1e-6 confidence."""
    reader = BlockReader(KEY, Batch(200, 1000), per_trial)
    x, u = reader.normals(range(200)), reader.uniforms(range(200))
    assert stats.kstest(x.ravel(), "norm").pvalue > 1e-6
    assert stats.kstest(u.ravel(), "uniform").pvalue > 1e-6
    pairs = [(x[1:], x[:-1]), (x[:, :, 1:], x[:, :, :-1])] + ([(x[:, 1:], x[:, :-1])] if per_trial > 1 else [])
    for left, right in pairs:
        correlation = np.mean(left * right)
        assert abs(correlation) < 4.9 / np.sqrt(left.size)


@pytest.mark.parametrize("per_trial", [1, 2, 3])
@pytest.mark.parametrize("slots", [range(8), range(5, 6), range(64, 72)])
def test_a_short_reader_has_the_numbers_of_the_stream(per_trial: int, slots: range) -> None:
    """In any order, to the bit."""
    batch = Batch(100, 1)
    short, block = SingleTrialReader(KEY, batch, per_trial), BlockReader(KEY, batch, per_trial)
    for _ in range(2):
        for made, expected in (
            (short.normals(slots), block.normals(slots)),
            (short.uniforms(slots), block.uniforms(slots)),
        ):
            assert made.dtype == np.float64
            assert made.shape == (len(slots), per_trial, 1)
            assert made.tolist() == expected.tolist()


@pytest.mark.parametrize("batch", [Batch(100, 2), Batch(100, 1, first_trial=1)])
def test_a_short_reader_reads_the_first_trial_alone(batch: Batch) -> None:
    """Others are refused."""
    with pytest.raises(ValueError, match="Batch"):
        SingleTrialReader(KEY, batch, 1)


def test_many_keys_under_one_root_are_those_of_each_name() -> None:
    """Names do not add up."""
    root = root_of_seed(7)
    key_of = stream_keys(root)
    assert [key_of(name) for name in ("a", "b", "a")] == [stream_key(root, name) for name in ("a", "b", "a")]
