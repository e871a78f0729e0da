"""Digests of what a receiver received and estimated, and sums over slots: their bits do not depend on where blocks begin.

Equal digests mean that two runs agree to the last bit.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from hashlib import sha256
from typing import final

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_128, xxh3_128_digest

from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Beliefs, Codes, Flags

BLOCK_SLOTS = 256
DIGEST_BYTES = 16
_TILE_BYTES = 2**18  # of the records made at a time, so that they are still in the cache when they are hashed
_TILE_TRIALS = 8, 256  # at least as many trials at a time as share a line of the cache, and at most as many as pay
# Of beliefs that wait for the next ones: a call of the hash costs as much as the bytes of some tens of slots.
_HELD_BYTES = 2**20

Digests = NDArray[np.uint8]


def block_starts(slots: int, cuts: Iterable[int] = ()) -> list[int]:
    """The first slots of a run's blocks; cuts: slots in which an outage of the receiver begins or ends."""
    return sorted({*range(0, slots, BLOCK_SLOTS), *(cut for cut in cuts if 0 < cut < slots)})


@final
class Blocks:
    """The blocks of a run for one receiver."""

    def __init__(self, slots: int, cuts: Iterable[int] = ()) -> None:
        """cuts: as in `block_starts`."""
        self._bounds = [*block_starts(slots, cuts), slots]

    def end(self, k: int) -> int:
        """The slot after the block that contains slot k."""
        return self._bounds[bisect_right(self._bounds, k)]

    def start(self, k: int) -> int:
        """The first slot of the block that contains slot k."""
        return self._bounds[bisect_right(self._bounds, k) - 1]

    def ended(self, first: int, end: int) -> list[int]:
        """The first slots of the blocks whose last slot is one of first … end − 1."""
        bounds = self._bounds
        return [bounds[i - 1] for i in range(bisect_right(bounds, first), bisect_right(bounds, end)) if i > 0]


class InputLog:
    """A controller's inputs in the current block, and the digests of finished blocks.

    Slots must be added in order from 0.
    """

    def __init__(self, inputs: int, trials: int, slots: int) -> None:
        length = min(BLOCK_SLOTS, slots)
        self._slots = slots
        self._u = np.empty((length, inputs, trials))
        self._failed = np.empty((length, trials), np.bool_)

    def add(self, k: int, u: Floats, failed: Flags) -> tuple[int, Digests] | None:
        """Add slot k, u (m, R) and failed (R,). At the end of a block returns its first slot and its digest, (R, 16)."""
        row = k % BLOCK_SLOTS
        self._u[row], self._failed[row] = u, failed
        if row + 1 != BLOCK_SLOTS and k + 1 != self._slots:
            return None
        records = _records(self._failed[: row + 1], self._u[: row + 1], None)
        return k - row, _joined(xxh3_128_digest(record) for _, of_trials in records for record in of_trials)


@final
class PartialDigests:
    """The digests of one block after the other, whose slots are added in parts.

    Small parts are held until there are enough slots for one call of the hash for each trial.
    """

    def __init__(self, trials: int) -> None:
        self._hashes = [xxh3_128() for _ in range(trials)]
        self._held: Beliefs | None = None
        self._count = 0

    def add(self, x_hat: Floats, P: Floats, action: Codes) -> None:
        """Add the next slots: x̂ (c, n, R), P (c, n, n, R) and action (c, R)."""
        held = self._held = self._held or _room(*x_hat.shape[1:])
        slots, room = len(action), len(held.action)
        if self._count + slots > room or 2 * slots > room:
            self._hash_held()
        if 2 * slots > room:
            self._hash(Beliefs(x_hat, P, action))
            return
        rows = slice(self._count, self._count + slots)
        held.x_hat[rows], held.P[rows], held.action[rows] = x_hat, P, action
        self._count += slots

    def finished(self) -> Digests:
        """The digests of all slots since the last call, (R, 16); the next slot begins another block."""
        self._hash_held()
        digests = _joined(map(xxh3_128.digest, self._hashes))
        deque(map(xxh3_128.reset, self._hashes), maxlen=0)
        return digests

    def _hash_held(self) -> None:
        if self._held is not None and self._count:
            x_hat, P, action = self._held
            self._hash(Beliefs(x_hat[: self._count], P[: self._count], action[: self._count]))
            self._count = 0

    def _hash(self, beliefs: Beliefs) -> None:
        for first, records in _records(beliefs.action != int(Action.LOST), beliefs.x_hat, beliefs.P):
            deque(map(xxh3_128.update, self._hashes[first : first + len(records)], records), maxlen=0)


def _room(n: int, trials: int) -> Beliefs:
    """Room for the beliefs of as many slots as are held."""
    slots = max(1, min(BLOCK_SLOTS, _HELD_BYTES // (trials * (8 * (n + n * n) + 1))))
    return Beliefs.empty((slots, n, trials))


@final
class BlockDigests:
    """The digests of a receiver's blocks, from beliefs that are added one slot or many at a time, in order.

    Many are hashed at once, while they are still in the processor's cache. cuts: as in `block_starts`.
    """

    def __init__(self, trials: int, slots: int, cuts: Iterable[int] = ()) -> None:
        self._blocks = Blocks(slots, cuts)
        self._part = PartialDigests(trials)

    def add(self, slots: range, beliefs: Beliefs) -> dict[int, Digests]:
        """Add consecutive slots of one block; returns the block's first slot and its digests, (R, 16), if it ends with them."""
        self._part.add(*beliefs)
        if slots.stop != self._blocks.end(slots.start):
            return {}
        return {self._blocks.start(slots.start): self._part.finished()}


def _joined(digests: Iterable[bytes]) -> Digests:
    return np.frombuffer(b"".join(digests), np.uint8).reshape(-1, DIGEST_BYTES)


def _records(marks: Flags, a: Floats, P: Floats | None) -> Iterator[tuple[int, list[memoryview]]]:
    """Each tile of trials: its first trial, and the bytes of every trial to be digested; the next tile overwrites them.

    They are made, slot by slot, of marks (c, R), numbers (c, m, R) and covariances (c, n, n, R).
    """
    slots, trials = marks.shape
    n = 0 if P is None else P.shape[1]
    size = 1 + 8 * (a.shape[1] + n * (n + 1) // 2)
    least, most = _TILE_TRIALS
    some = min(trials, most, max(least, _TILE_BYTES // (slots * size)))
    tile = np.empty((some, slots, size), np.uint8)
    flat, length = tile.reshape(-1).data, slots * size
    rows = [flat[start : start + length] for start in range(0, some * length, length)]
    # Parts of larger arrays are copied here once, and not for each tile.
    a, P = np.ascontiguousarray(a), None if P is None else np.ascontiguousarray(P)
    for first in range(0, trials, some):
        count = min(some, trials - first)
        kernels.records(marks, a, P, tile[:count], first)
        yield first, rows[:count]


@final
class DigestLog(Mapping[int, Digests]):
    """The digests of a run's blocks, (R, 16) each, by the block's first slot: some bytes for each, and no objects."""

    def __init__(self) -> None:
        self._starts = array("q")
        self._bytes = bytearray()

    def add(self, blocks: Mapping[int, Digests]) -> None:
        """Add the next blocks, which are later than all that have been added."""
        for start in sorted(blocks):
            self._starts.append(start)
            self._bytes += blocks[start].tobytes()

    def after(self, count: int) -> dict[int, Digests]:
        """All blocks but the first `count`."""
        return {start: self[start] for start in self._starts[count:]}

    def __getitem__(self, start: int) -> Digests:
        place = bisect_left(self._starts, start)
        if place == len(self._starts) or self._starts[place] != start:
            raise KeyError(start)
        size = len(self._bytes) // len(self._starts)
        return np.frombuffer(self._bytes[place * size : (place + 1) * size], np.uint8).reshape(-1, DIGEST_BYTES)

    def __iter__(self) -> Iterator[int]:
        return iter(self._starts)

    def __len__(self) -> int:
        return len(self._starts)


@final
class RunDigest:
    """A receiver's digest of a whole run, from the block digests of its trials, added in trial order."""

    def __init__(self) -> None:
        self._hash = sha256()

    def add(self, blocks: Mapping[int, Digests]) -> None:
        """Add the next R trials: block → digests, (R, 16)."""
        self._hash.update(np.stack([blocks[block] for block in sorted(blocks)], axis=1).tobytes())

    @property
    def hexadecimal(self) -> str:
        """The digest so far."""
        return self._hash.hexdigest()


_FEW_TRIALS = 64  # up to this number, numpy adds a slot at a time more slowly than it accumulates all slots


def added_in_order(total: Floats, numbers: Floats) -> Floats:
    """A total of every trial, (R,), and the numbers of some slots, (c, R): their sum, (R,), one slot added after the other."""
    if numbers.shape[1] < _FEW_TRIALS:
        return np.asarray(np.add.accumulate(np.concatenate([total[None], numbers]), axis=0)[-1])
    total = total.copy()
    for row in numbers:
        total += row
    return total


@final
class BlockSums:
    """The sum of a number of every trial over each block of slots, the blocks of a receiver's digests.

    A process that begins with a block, after an outage, continues where another one ended. cuts: as in `block_starts`.
    """

    def __init__(self, trials: int, slots: int, cuts: Iterable[int] = ()) -> None:
        self._blocks = Blocks(slots, cuts)
        self.unfinished: Floats = np.zeros(trials)
        """The sum over the slots so far of the block that has not ended, (R,)."""

    def add(self, slots: range, numbers: Floats) -> dict[int, Floats]:
        """Add consecutive slots, (c, R); returns the sums (R,) of the blocks that end with one of them, by first slot."""
        finished: dict[int, Floats] = {}
        k = slots.start
        while k < slots.stop:
            stop = min(slots.stop, self._blocks.end(k))
            rows = numbers[k - slots.start : stop - slots.start]
            self.unfinished = added_in_order(self.unfinished, rows)
            if stop == self._blocks.end(k):
                finished[self._blocks.start(k)] = self.unfinished
                self.unfinished = np.zeros_like(self.unfinished)
            k = stop
        return finished
