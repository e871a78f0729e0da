"""All random numbers of a run: named streams, addressed by (slot, trial).

One primitive serves all: AES-256 in counter mode. The key of a stream is BLAKE2b(root, name), its counter
slot · 2⁶⁴ + trial · (16-byte blocks per trial). Any number can be drawn without drawing the numbers before it, and adding,
removing, losing or delaying anything does not change the numbers of other streams. The conversions to uniforms and normals
are this project's own, so that no release of a library changes them.

Source: docs/mathematics.md, random numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from hashlib import blake2b
from typing import final

import numpy as np
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from numpy.typing import NDArray

from evedrop.kernels.elementary import normal_quantile

Words = NDArray[np.uint64]
Floats = NDArray[np.float64]

MOST_SLOTS = 100_000_000
"""The most slots of a run."""
KEY_BYTES = 32
_AES_BLOCK = 16
_BLOCK_WORDS = 16_384  # words drawn ahead at once: large enough to hide the cost of a call, small enough for the cache


def root_of_seed(seed: int) -> bytes:
    """Root of all streams of a scenario's seed, a non-negative integer below 2²⁵⁶."""
    return seed.to_bytes(32, "little")


def stream_key(root: bytes, name: str) -> bytes:
    """Key (32 bytes) of the stream `name` under a root: the seed's, or a secret's."""
    return blake2b(name.encode(), key=blake2b(root, digest_size=KEY_BYTES).digest(), digest_size=KEY_BYTES).digest()


class Stream:
    """A stream over a range of trials (step 1), `per_trial` words for each in every slot.

    AES in ECB mode over counter blocks formed here is counter mode with jumps: one call serves many slots. The
    blocks are kept between calls; only their slot numbers change.
    """

    def __init__(self, key: bytes, trials: range, per_trial: int) -> None:
        self._encryptor = Cipher(algorithms.AES(key), modes.ECB()).encryptor()  # noqa: S305 - counter mode, see above
        self._blocks = (per_trial + 1) // 2
        self._trials = trials
        self._per_trial = per_trial
        self._counters = np.empty((0, len(trials) * self._blocks, 2), dtype=">u8")
        self._keystream = bytearray()

    def words(self, slots: range) -> Words:
        """Raw 64-bit words, (slots, trials, per_trial), for a range of step 1; the next call overwrites them."""
        if len(slots) > len(self._counters):
            self._counters = np.empty((len(slots), *self._counters.shape[1:]), dtype=">u8")
            first, last = self._trials.start * self._blocks, self._trials.stop * self._blocks
            self._counters[:, :, 1] = np.arange(first, last, dtype=np.uint64)
            self._keystream = bytearray(self._counters.nbytes + _AES_BLOCK)
        counters = self._counters[: len(slots)]
        counters[:, :, 0] = np.arange(slots.start, slots.stop, dtype=np.uint64)[:, None]
        length = self._encryptor.update_into(counters.data.cast("B"), self._keystream)
        drawn = np.frombuffer(self._keystream, dtype="<u8", count=length // 8)
        return drawn.reshape(len(slots), len(self._trials), 2 * self._blocks)[:, :, : self._per_trial]


def uniforms(raw: Words) -> Floats:
    """Uniform numbers in [0, 1), multiples of 2⁻⁵³, one for each word."""
    numbers = (raw >> np.uint64(11)).view(np.int64).astype(np.float64)  # signed words are converted faster
    numbers *= 2.0**-53
    return numbers


def normals(raw: Words) -> Floats:
    """Standard normal numbers, one for each word, by the inverse distribution function on an odd grid of 2⁻⁵³."""
    numbers = (raw >> np.uint64(12)).view(np.int64).astype(np.float64)
    numbers += 0.5
    numbers *= 2.0**-52
    return normal_quantile(numbers)


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


@final
class BlockReader:
    """Draws a stream ahead, a block of slots at a time, and converts a block in one call.

    Holds one block: reading slots in order costs each number once; any other order is correct, only slower.
    """

    def __init__(self, key: bytes, batch: Batch, per_trial: int) -> None:
        self._stream = Stream(key, batch.trial_range, per_trial)
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
        return self._converted(slots, uniforms)

    def normals(self, slots: range) -> Floats:
        """Standard normals, shape (slots, per_trial, trials)."""
        return self._converted(slots, normals)

    def _converted(self, slots: range, convert: Callable[[Words], Floats]) -> Floats:
        """Convert a block at a time, so that intermediate arrays stay in the cache, and the allocator keeps its pages."""
        if len(slots) <= self._length:
            return convert(self._words(slots))
        numbers = np.empty((len(slots), self._per_trial, self._batch.trials))
        for start in range(0, len(slots), self._length):
            some = slice(start, start + self._length)
            numbers[some] = convert(self._words(slots[some]))
        return numbers

    def _words(self, slots: range) -> Words:
        return np.ascontiguousarray(self._stream.words(slots).transpose(0, 2, 1))
