"""Every random number of a run: named streams, addressed by (slot, trial).

One primitive serves all: AES-256 in counter mode. The key of a stream is BLAKE2b(root, name), its counter
slot · 2⁶⁴ + trial · (16-byte blocks per trial). Any number can be drawn without drawing what comes before it, and nothing
that is added, removed, lost or late moves anybody else's numbers. The conversions to uniforms and normals are this
project's own, so that no release of a library changes them.

Source: docs/mathematics.md, random numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from numpy.typing import NDArray

from emulator.model.elementary import normal_quantile

Words = NDArray[np.uint64]
Floats = NDArray[np.float64]

KEY_BYTES = 32
_BLOCK_WORDS = 16_384  # words drawn ahead at once: large enough to hide the cost of a call, small enough for the cache


def root_of_seed(seed: int) -> bytes:
    """Root of all streams of a scenario's seed, a non-negative integer below 2²⁵⁶."""
    return seed.to_bytes(32, "little")


def stream_key(root: bytes, name: str) -> bytes:
    """Key (32 bytes) of the stream `name` under a root: the seed's, or a secret's."""
    return blake2b(name.encode(), key=blake2b(root, digest_size=KEY_BYTES).digest(), digest_size=KEY_BYTES).digest()


def words(key: bytes, slots: range, trials: range, per_trial: int) -> Words:
    """Raw 64-bit words of a stream, shape (slots, trials, per_trial); both ranges have step 1.

    AES in ECB mode over counter blocks formed here is counter mode with jumps: one call serves many slots.
    """
    blocks = (per_trial + 1) // 2
    counters = np.empty((len(slots), len(trials) * blocks, 2), dtype=">u8")
    counters[:, :, 0] = np.arange(slots.start, slots.stop, dtype=np.uint64)[:, None]
    counters[:, :, 1] = np.arange(trials.start * blocks, trials.stop * blocks, dtype=np.uint64)
    encryptor = Cipher(algorithms.AES(key), modes.ECB()).encryptor()  # noqa: S305 - counter mode, see above
    keystream = encryptor.update(counters.data.cast("B"))
    drawn = np.frombuffer(keystream, dtype="<u8").reshape(len(slots), len(trials), 2 * blocks)
    return drawn[:, :, :per_trial]


def uniforms(raw: Words) -> Floats:
    """Uniform numbers in [0, 1), multiples of 2⁻⁵³, one for each word."""
    return (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53


def normals(raw: Words) -> Floats:
    """Standard normal numbers, one for each word, by the inverse distribution function on an odd grid of 2⁻⁵³."""
    return normal_quantile(((raw >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52)


@dataclass(frozen=True)
class Batch:
    """The slots and trials a process draws for: slots 0 … slots−1, trials first_trial … first_trial+trials−1."""

    slots: int
    trials: int
    first_trial: int = 0

    @property
    def trial_range(self) -> range:
        """The trials' numbers."""
        return range(self.first_trial, self.first_trial + self.trials)


class BlockReader:
    """Draws a stream ahead, a block of slots at a time, and converts a block in one call.

    Final. Holds one block: reading slots in order costs each number once; any other order is correct, only slower.
    """

    def __init__(self, key: bytes, batch: Batch, per_trial: int) -> None:
        self._key = key
        self._batch = batch
        self._per_trial = per_trial
        width = max(1, batch.trials * per_trial)
        self._length = max(1, min(256, _BLOCK_WORDS // width, batch.slots))

    def block(self, k: int) -> range:
        """The slots of the block that holds slot k; blocks are aligned."""
        start = k - k % self._length
        return range(start, min(start + self._length, self._batch.slots))

    def uniforms(self, slots: range) -> Floats:
        """Uniforms, shape (slots, per_trial, trials)."""
        return uniforms(self._words(slots))

    def normals(self, slots: range) -> Floats:
        """Standard normals, shape (slots, per_trial, trials)."""
        return normals(self._words(slots))

    def _words(self, slots: range) -> Words:
        raw = words(self._key, slots, self._batch.trial_range, self._per_trial)
        return np.ascontiguousarray(raw.transpose(0, 2, 1))
