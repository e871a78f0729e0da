"""When and what a process reports: columns of many slots, never a message per number."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from emulator.model.digest import BLOCK_SLOTS, BlockDigester, Digests
from emulator.model.process import Floats
from emulator.model.receiver import Belief, Flags, trace_of
from emulator.network.wire import Report, Truth, progress

_REPORT_SECONDS = 0.04


class Batcher:
    """Says when a report is due: at the end of a batch of slots, at the last slot, or when the last one is 40 ms old.

    Final. The ends of batches are the same for everybody, so a full window always holds a reported one: nobody can wait
    for a report that waits for a packet.
    """

    def __init__(self, slots: int, batch: int) -> None:
        self._slots = slots
        self._batch = batch
        self._last = time.monotonic()

    def due(self, k: int) -> bool:
        """Whether to report after slot k."""
        now = time.monotonic()
        if (k + 1) % self._batch and k + 1 != self._slots and now - self._last < _REPORT_SECONDS:
            return False
        self._last = now
        return True


class TruthReporter:
    """The sensor's reports: states and schedule. Final."""

    def __init__(self, shape: tuple[int, int], batch: int, put: Callable[[bytes], None], batcher: Batcher) -> None:
        self._x = np.empty((batch, *shape))
        self._nu = np.empty((batch, shape[1]), np.bool_)
        self._put = put
        self._batcher = batcher
        self._count = 0

    def add(self, k: int, x: Floats, nu: Flags) -> None:
        """Take slot k, and report if it is time."""
        self._x[self._count] = x
        self._nu[self._count] = nu
        self._count += 1
        if self._batcher.due(k):
            count = self._count
            self._put(Truth(k + 1 - count, self._x[:count], self._nu[:count]).pack())
            self._count = 0


class BeliefReporter:
    """A receiver's reports: estimates, actions, covariances of the recorded trials, digests, and its progress. Final."""

    def __init__(
        self,
        shape: tuple[int, int],
        slots: int,
        batch: int,
        recorded: int,
        put: Callable[[bytes], None],
        put_progress: Callable[[bytes], None],
    ) -> None:
        n, trials = shape
        self._x_hat = np.empty((batch, n, trials))
        self._action = np.empty((batch, trials), np.uint8)
        self._P = np.empty((batch, n, n, recorded))
        self._trace = np.empty((batch, 2))
        self._recorded = recorded
        self._digester = BlockDigester(n, trials, slots)
        self._digests: dict[int, Digests] = {}
        self._put = put
        self._put_progress = put_progress
        self._batcher = Batcher(slots, batch)
        self._count = 0

    def add(self, k: int, belief: Belief) -> None:
        """Take slot k, and report if it is time."""
        row = self._count
        self._x_hat[row] = belief.x_hat
        self._action[row] = belief.action
        self._P[row] = belief.P[:, :, : self._recorded]
        trace = trace_of(belief.P)
        self._trace[row] = trace.sum(), (trace * trace).sum()
        digests = self._digester.add(k, belief)
        if digests is not None:
            self._digests[k // BLOCK_SLOTS] = digests
        self._count += 1
        if self._batcher.due(k):
            self._report(k + 1)

    def _report(self, end: int) -> None:
        rows = slice(0, self._count)
        self._put(
            Report(
                end - self._count,
                self._x_hat[rows],
                self._action[rows],
                self._P[rows],
                self._trace[rows],
                self._digests,
            ).pack()
        )
        self._put_progress(progress(end))
        self._count, self._digests = 0, {}
