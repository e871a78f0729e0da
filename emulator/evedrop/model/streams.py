"""All random numbers of a run: named streams, addressed by (slot, trial).

One primitive serves all: AES-256 in counter mode. The key of a stream is BLAKE2b(root, name), its counter
slot · 2⁶⁴ + trial · (16-byte blocks per trial). Any number can be drawn without drawing the numbers before it, and adding,
removing, losing or delaying anything does not change the numbers of other streams. The conversions to uniforms and normals
are this project's own, so that no release of a library changes them.

Source: docs/mathematics/numerics.md, random numbers.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from typing import Any, Generic, Protocol, TypeVar, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels import reference
from evedrop.model.kernels.current import kernels

Words = NDArray[np.uint64]
Floats = NDArray[np.float64]
Made = TypeVar("Made", bound=np.generic)
Value = TypeVar("Value")

MOST_SLOTS = 100_000_000
"""The most slots of a run."""
LAST_TRIAL = 2**48
"""The largest number of a trial."""
KEY_BYTES = 32
_AES_BLOCK = 16
_WORD = np.dtype("<u8")
_BLOCK_WORDS = 16_384  # words drawn ahead at once: large enough to hide the cost of a call, small enough for the cache


def root_of_seed(seed: int) -> bytes:
    """Root of all streams of a scenario's seed, a non-negative integer below 2²⁵⁶."""
    return seed.to_bytes(32, "little")


def stream_key(root: bytes, name: str) -> bytes:
    """Key (32 bytes) of the stream `name` under a root: the seed's, or a secret's."""
    return stream_keys(root)(name)


def stream_keys(root: bytes) -> Callable[[str], bytes]:
    """`stream_key` for many names under a root: what does not depend on the name is computed once."""
    begun = blake2b(key=blake2b(root, digest_size=KEY_BYTES).digest(), digest_size=KEY_BYTES)

    def key_of(name: str) -> bytes:
        hashed = begun.copy()
        hashed.update(name.encode())
        return hashed.digest()

    return key_of


def _encryptor(key: bytes) -> Any:
    """AES-256 of single blocks."""
    from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes  # noqa: PLC0415 - 6 MB; a launcher draws nothing

    return Cipher(algorithms.AES(key), modes.ECB()).encryptor()  # noqa: S305 - counter mode, see `Stream`


class Stream:
    """A stream over a range of trials (step 1), `per_trial` words for each in every slot.

    AES in ECB mode over counter blocks formed here is counter mode with jumps: one call serves many slots.
    """

    def __init__(self, key: bytes, trials: range, per_trial: int) -> None:
        self._encryptor = _encryptor(key)
        self._blocks = (per_trial + 1) // 2
        self._trials = trials
        self._per_trial = per_trial
        self._counters: Words = np.empty((0, len(trials) * self._blocks, 2), np.uint64)
        self._keystream = bytearray()

    def words(self, slots: range) -> Words:
        """Raw 64-bit words, (slots, trials, per_trial), for a range of step 1; the next call overwrites them."""
        return self.whole_blocks(slots)[:, :, : self._per_trial]

    def whole_blocks(self, slots: range) -> Words:
        """The same with the unused last word of each trial where `per_trial` is odd, so that the array is contiguous."""
        if len(slots) > len(self._counters):
            self._counters = np.empty((len(slots), *self._counters.shape[1:]), np.uint64)
            self._keystream = bytearray(self._counters.nbytes + _AES_BLOCK)
        counters = self._counters[: len(slots)]
        kernels.fill_counters(counters, slots.start, self._trials.start * self._blocks)
        length = self._encryptor.update_into(counters.data.cast("B"), self._keystream)
        drawn = np.frombuffer(self._keystream, dtype="<u8", count=length // 8)
        return drawn.reshape(len(slots), len(self._trials), 2 * self._blocks)


def uniforms(raw: Words) -> Floats:
    """Uniform numbers in [0, 1), multiples of 2⁻⁵³, one for each word."""
    return kernels.uniforms(raw.reshape(1, -1, 1), 1).reshape(raw.shape)


def normals(raw: Words) -> Floats:
    """Standard normal numbers, one for each word, by the inverse distribution function on an odd grid of 2⁻⁵³."""
    return kernels.normals(raw.reshape(1, -1, 1), 1).reshape(raw.shape)


@final
@dataclass(frozen=True)
class Lineage:
    """Whose random numbers each trial of a batch reads: its ancestors' up to the last split, and its own from then on.

    A trial is a function of its random numbers, so one that reads those of another up to some slot is a copy of it up to
    there, with whatever memory links, packets and receivers have.

    Source: docs/mathematics/verdicts.md, splitting.
    """

    stops: tuple[int, ...] = ()
    """The first slot after each split, ascending."""
    columns: tuple[NDArray[np.intp], ...] = ()
    """For each of these stretches of slots, the place in the batch of the trial that is read, (R,)."""

    def split(self, stop: int, ancestors: NDArray[np.intp]) -> Lineage:
        """Replace each trial by a copy of one of the trials, (R,), in all slots before this one."""
        return Lineage((*self.stops, stop), (*(column[ancestors] for column in self.columns), ancestors))

    def read(self, slots: range, drawn: Words) -> Words:
        """The words that the trials read, from those that each would draw by itself, both (c, R, m)."""
        if not self.stops or slots.start >= self.stops[-1]:
            return drawn
        words = drawn.copy()
        for row, k in enumerate(slots):
            stretch = bisect_right(self.stops, k)
            if stretch < len(self.stops):
                np.take(drawn[row], self.columns[stretch], axis=0, out=words[row])
        return words


OWN = Lineage()
"""The lineage of trials that are copies of none."""


@dataclass(frozen=True)
class Batch:
    """The slots and trials a process draws for: slots 0 … slots−1, trials first_trial … first_trial+trials−1."""

    slots: int
    trials: int
    first_trial: int = 0
    lineage: Lineage = field(default=OWN, compare=False)

    @property
    def trial_range(self) -> range:
        """The trials' numbers."""
        return range(self.first_trial, self.first_trial + self.trials)


class StreamReader(Protocol):
    """Reads the numbers of a stream."""

    def uniforms(self, slots: range) -> Floats:
        """Uniforms, shape (slots, per_trial, trials)."""

    def normals(self, slots: range) -> Floats:
        """Standard normals, shape (slots, per_trial, trials)."""


@final
class SingleTrialReader:
    """The numbers of a stream for the one trial of a batch, made as quickly as possible for a few slots.

    A compiled kernel lets other threads run meanwhile, which takes longer than some numbers do.
    """

    __slots__ = ("_encryptor", "_per_trial")

    def __init__(self, key: bytes, batch: Batch, per_trial: int) -> None:
        """Raises ValueError unless the batch is trial 0 alone."""
        if batch.trial_range != range(1):
            raise ValueError(batch)
        self._encryptor = _encryptor(key)
        self._per_trial = per_trial

    def uniforms(self, slots: range) -> Floats:
        """Uniforms, shape (slots, per_trial, 1)."""
        return reference.fractions(self._words(slots).swapaxes(1, 2)[:, : self._per_trial])

    def normals(self, slots: range) -> Floats:
        """Standard normals, shape (slots, per_trial, 1)."""
        return kernels.normals(self._words(slots), self._per_trial)

    def _words(self, slots: range) -> Words:
        blocks = (self._per_trial + 1) // 2
        drawn = self._encryptor.update(_counters(slots.start, slots.stop, blocks))
        return np.frombuffer(drawn, _WORD).reshape(len(slots), 1, 2 * blocks)


@lru_cache(maxsize=256)
def _counters(start: int, stop: int, blocks: int) -> bytes:
    """The AES counters of trial 0 in slots start ≤ k < stop."""
    counters = np.empty((stop - start, blocks, 2), np.uint64)
    kernels.fill_counters(counters, start, 0)
    return counters.tobytes()


@final
class BlockReader:
    """Converts the numbers of a stream, block by block of the size that is fastest."""

    def __init__(self, key: bytes, batch: Batch, per_trial: int) -> None:
        self._stream = Stream(key, batch.trial_range, per_trial)
        self._batch = batch
        self._per_trial = per_trial
        width = max(1, batch.trials * per_trial)
        self._length = max(1, min(256, _BLOCK_WORDS // width, batch.slots))

    def ahead(self, slots: range) -> range:
        """These slots, and the rest of the block that the last of them is in; many slots are as fast without it."""
        last = slots.stop if len(slots) >= self._length else -(-slots.stop // self._length) * self._length
        return range(slots.start, min(last, self._batch.slots))

    def uniforms(self, slots: range) -> Floats:
        """Uniforms, shape (slots, per_trial, trials)."""
        return self._converted(slots, kernels.uniforms)

    def normals(self, slots: range) -> Floats:
        """Standard normals, shape (slots, per_trial, trials)."""
        return self._converted(slots, kernels.normals)

    def _converted(self, slots: range, convert: Callable[[Words, int, Floats], Floats]) -> Floats:
        """Convert a block at a time, so that intermediate arrays stay in the cache, and the allocator keeps its pages."""
        numbers = np.empty((len(slots), self._per_trial, self._batch.trials))
        for start in range(0, len(slots), self._length):
            some = slice(start, start + self._length)
            convert(self._words(slots[some]), self._per_trial, numbers[some])
        return numbers

    def _words(self, slots: range) -> Words:
        return self._batch.lineage.read(slots, self._stream.whole_blocks(slots))


@final
class Ahead(Generic[Made]):
    """Values that are made some slots ahead of need, and read a slot or many slots at a time.

    extended: the slots to make when these are asked for: the same, and some after them, such as `BlockReader.ahead`; make: the
    values of consecutive slots, (c, …). Reading slots in order makes each value once; any other order is correct, only slower.
    """

    def __init__(self, extended: Callable[[range], range], make: Callable[[range], NDArray[Made]]) -> None:
        self._extended, self._make = extended, make
        self._slots = range(0)
        self._values: NDArray[Made]

    def at(self, k: int) -> NDArray[Made]:
        """The values of slot k, (…)."""
        if k not in self._slots:
            self._draw(range(k, k + 1))
        row: NDArray[Made] = self._values[k - self._slots.start]
        return row

    def of(self, slots: range) -> NDArray[Made]:
        """The values of consecutive slots, at least one, (c, …)."""
        if slots.start < self._slots.start or slots.stop > self._slots.stop:
            self._draw(slots)
        start = self._slots.start
        return self._values[slots.start - start : slots.stop - start]

    def _draw(self, slots: range) -> None:
        held, wanted = self._slots, self._extended(slots)
        if slots.start in held:
            more = self._make(range(held.stop, wanted.stop))
            self._values = np.concatenate([self._values[slots.start - held.start :], more])
        else:
            self._values = self._make(wanted)
        self._slots = wanted


@final
class BlockByBlock:
    """Numbers of slots from 0 on that are made a block at a time, and read any number of slots at a time."""

    def __init__(self, first: Floats, following: Callable[[], Floats]) -> None:
        """first, following: the first block, (c, …), and what makes the next one."""
        self._block, self._following, self._next = first, following, 0

    def next(self, slots: int) -> Floats:
        """Those of the next slots, (slots, …)."""
        parts = [self._block[:0]]
        while slots > 0:
            if self._next == len(self._block):
                self._block, self._next = self._following(), 0
            part = self._block[self._next : self._next + slots]
            self._next += len(part)
            slots -= len(part)
            parts.append(part)
        return np.concatenate(parts)


@final
class Recurrence(Generic[Value]):
    """Values of the slots from 0 on, each made from the one before; slots in order are quick, any other order is correct."""

    def __init__(self, first: Value, following: Callable[[Value], Value]) -> None:
        self._first, self._following = first, following
        self._k, self._value = 0, first

    def at(self, k: int) -> Value:
        """That of slot k."""
        if k < self._k:
            self._k, self._value = 0, self._first
        while self._k < k:
            self._value = self._following(self._value)
            self._k += 1
        return self._value
