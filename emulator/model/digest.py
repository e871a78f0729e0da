"""SHA-256 over all that a receiver received and believed: equal digests mean that two runs agree to the last bit.

For each trial and each aligned block of 256 slots, the digest covers, slot by slot, γ (1 byte), x̂ (n) and P (n × n, row by
row) as little-endian float64; for a controller, whether its decision failed (1 byte) and u (m). A block also ends where an
outage of the receiver begins or ends, since another process may continue. A receiver's digest is that of its block digests,
ordered by trial, then block. A block is named by its first slot.

Source: docs/results.md, digests.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from hashlib import sha256
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Codes, Flags

BLOCK_SLOTS = 256
DIGEST_BYTES = 32
_TILE = 64  # trials transposed at a time, so that a tile fits into the cache

Digests = NDArray[np.uint8]


class Rows(NamedTuple):
    """Beliefs of consecutive slots, one row for each slot."""

    x_hat: Floats
    """(c, n, R)."""
    P: Floats
    """(c, n, n, R)."""
    action: Codes
    """(c, R)."""


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


class BeliefLog:
    """A receiver's beliefs in the current block, and the digests of finished blocks.

    Slots must be added in order; a block must begin with the first one.
    """

    def __init__(self, n: int, trials: int, slots: int, cuts: Iterable[int] = (), first: int = 0) -> None:
        length = min(BLOCK_SLOTS, slots)
        self._ends = {*block_starts(slots, cuts), slots}
        self._start = first
        self._x_hat = np.empty((length, n, trials))
        self._P = np.empty((length, n, n, trials))
        self._action = np.empty((length, trials), np.uint8)

    def add(self, k: int, belief: Belief) -> tuple[int, Digests] | None:
        """Add slot k. At the end of a block returns the block's first slot and its digest for every trial, (R, 32)."""
        if k in self._ends:
            self._start = k
        row = k - self._start
        self._x_hat[row], self._P[row], self._action[row] = belief.x_hat, belief.P, belief.action
        return (self._start, self._digest(row + 1)) if k + 1 in self._ends else None

    def rows(self, first: int, end: int) -> Rows:
        """The beliefs of slots first … end−1 of the current block; overwritten by the next block."""
        rows = slice(first - self._start, end - self._start)
        return Rows(self._x_hat[rows], self._P[rows], self._action[rows])

    def _digest(self, length: int) -> Digests:
        _, n, trials = self._x_hat.shape
        P = self._P[:length].reshape(length, n * n, trials)
        return _digests(self._action[:length] != Action.LOST, [self._x_hat[:length], P])


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
        """Add slot k, u (m, R) and failed (R,). At the end of a block returns its first slot and its digest, (R, 32)."""
        row = k % BLOCK_SLOTS
        self._u[row], self._failed[row] = u, failed
        if row + 1 != BLOCK_SLOTS and k + 1 != self._slots:
            return None
        return k - row, _digests(self._failed[: row + 1], [self._u[: row + 1]])


@final
class PartialDigests:
    """The digests of one block whose slots are added in parts."""

    def __init__(self, trials: int) -> None:
        self._hashes = [sha256() for _ in range(trials)]

    def add(self, x_hat: Floats, P: Floats, action: Codes) -> None:
        """Add the next slots: x̂ (c, n, R), P (c, n, n, R) and action (c, R)."""
        c, n, trials = x_hat.shape
        for row, record in _records(action != Action.LOST, [x_hat, P.reshape(c, n * n, trials)]):
            self._hashes[row].update(record)

    def digests(self) -> Digests:
        """The digests of all slots so far, (R, 32)."""
        return np.array([np.frombuffer(one.digest(), np.uint8) for one in self._hashes])


def _digests(marks: Flags, numbers: Sequence[Floats]) -> Digests:
    """The digest of every trial, (R, 32), over marks (c, R) and numbers, each (c, …, R), slot by slot."""
    digests = np.empty((marks.shape[1], DIGEST_BYTES), np.uint8)
    for row, record in _records(marks, numbers):
        digests[row] = np.frombuffer(sha256(record).digest(), np.uint8)
    return digests


def _records(marks: Flags, numbers: Sequence[Floats]) -> Iterator[tuple[int, memoryview]]:
    """Each trial and its bytes to be digested; the bytes are overwritten by the next tile of trials."""
    length, trials = marks.shape
    width = sum(one.shape[1] for one in numbers)
    ordered = np.empty((_TILE, length, width), "<f8")
    records = np.empty((_TILE, length, 1 + ordered.itemsize * width), np.uint8)
    for start in range(0, trials, _TILE):
        tile = slice(start, min(start + _TILE, trials))
        rows = slice(0, tile.stop - start)
        place = 0
        for one in numbers:
            for i in range(one.shape[1]):
                ordered[rows, :, place] = one[:, i, tile].T
                place += 1
        records[rows, :, 0] = marks[:, tile].T
        records[rows, :, 1:] = ordered[rows].view(np.uint8)
        for row, record in enumerate(records[rows], start):
            yield row, record.data


@final
class RunDigest:
    """A receiver's digest of a whole run, from the block digests of its trials, added in trial order."""

    def __init__(self) -> None:
        self._hash = sha256()

    def add(self, blocks: Mapping[int, Digests]) -> None:
        """Add the next R trials: block → digests, (R, 32)."""
        self._hash.update(np.stack([blocks[block] for block in sorted(blocks)], axis=1).tobytes())

    @property
    def hexadecimal(self) -> str:
        """The digest so far."""
        return self._hash.hexdigest()
