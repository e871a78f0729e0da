"""Truth, estimates and fates of the same slots, joined: what is scored, recorded and shown, live and in memory alike."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from emulator.model.digest import Digests
from emulator.model.process import Floats
from emulator.model.receiver import Codes, Flags
from emulator.network.wire import Journal, Report, Truth, read_journal, read_report, read_truth

Message = TypeVar("Message")


@dataclass(frozen=True)
class ReceiverSlots:
    """One receiver over c slots."""

    x_hat: Floats
    """(c, n, R)."""
    action: Codes
    """(c, R)."""
    P: Floats
    """Believed covariance of the recorded trials, (c, n, n, recorded)."""
    trace: Floats
    """Sum over all trials of tr P and of its square, (c, 2)."""
    delivered: Flags
    """What the router says it passed on, (c, R)."""
    lost: Mapping[str, NDArray[np.uint32]]
    """Reason → packets the router says were lost for it, (c,)."""


@dataclass(frozen=True)
class Slots:
    """c consecutive slots of all trials, complete."""

    first: int
    x: Floats
    """(c, n, R)."""
    nu: Flags
    """(c, R)."""
    receivers: Mapping[str, ReceiverSlots]

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x)

    @property
    def trials(self) -> int:
        """Number of trials."""
        return int(self.x.shape[2])

    def copied(self) -> Slots:
        """The same in arrays of its own."""
        receivers = {
            name: replace(one, x_hat=one.x_hat.copy(), action=one.action.copy(), P=one.P.copy())
            for name, one in self.receivers.items()
        }
        return replace(self, x=self.x.copy(), nu=self.nu.copy(), receivers=receivers)


def concatenated(parts: Sequence[Slots]) -> Slots:
    """Consecutive slots as one; the fates' reasons, which nobody asks for any more, are left out."""

    def column(name: str, one: str) -> NDArray[Any]:
        return np.concatenate([getattr(part.receivers[name], one) for part in parts])

    receivers = {
        name: ReceiverSlots(**{one: column(name, one) for one in _ARRAYS}, lost={}) for name in parts[0].receivers
    }
    x, nu = (np.concatenate([getattr(part, one) for part in parts]) for one in ("x", "nu"))
    return Slots(parts[0].first, x, nu, receivers)


_ARRAYS = ("x_hat", "action", "P", "trace", "delivered")


class Joiner:
    """Takes the messages of all processes as they come and gives back slots as soon as all have reported them. Final."""

    def __init__(self, receivers: tuple[str, ...], shape: tuple[int, int], recorded: int) -> None:
        self._receivers = receivers
        self._shape = shape
        self._recorded = recorded
        self._truth = _Column[Truth]()
        self._journal = _Column[Journal]()
        self._reports = {name: _Column[Report]() for name in receivers}
        self._done = 0
        self.digests: dict[str, dict[int, Digests]] = {name: {} for name in receivers}
        """Receiver → block number → digests."""

    @property
    def done(self) -> int:
        """The first slot that has not been given back."""
        return self._done

    def truth(self, key: str, payload: bytes) -> None:
        """Take the sensor's telemetry."""
        message = read_truth(key, payload, self._truth.end, self._shape)
        self._truth.add(message, message.count)

    def report(self, name: str, key: str, payload: bytes) -> None:
        """Take a receiver's telemetry."""
        message = read_report(key, payload, self._reports[name].end, self._shape, self._recorded)
        self._reports[name].add(message, message.count)
        self.digests[name].update(message.digests)

    def journal(self, key: str, payload: bytes) -> None:
        """Take the router's journal."""
        message = read_journal(key, payload, self._journal.end, self._receivers, self._shape[1])
        self._journal.add(message, message.count)

    def take(self) -> Slots | None:
        """The next slots that all have reported, if there are any."""
        count = min(self._truth.available, self._journal.available, *(c.available for c in self._reports.values()))
        if count == 0:
            return None
        first, self._done = self._done, self._done + count
        truth = self._truth.take(count)
        journal = self._journal.take(count)
        receivers = {}
        for name in self._receivers:
            parts = self._reports[name].take(count)
            receivers[name] = ReceiverSlots(
                x_hat=_rows(parts, [part.x_hat for part, _ in parts]),
                action=_rows(parts, [part.action for part, _ in parts]),
                P=_rows(parts, [part.P for part, _ in parts]),
                trace=_rows(parts, [part.trace for part, _ in parts]),
                delivered=_rows(journal, [part.delivered[name] for part, _ in journal]),
                lost={
                    reason: _rows(journal, [part.lost[name][reason] for part, _ in journal])
                    for reason in journal[0][0].lost[name]
                },
            )
        x = _rows(truth, [part.x for part, _ in truth])
        nu = _rows(truth, [part.nu for part, _ in truth])
        return Slots(first, x, nu, receivers)


class _Column(Generic[Message]):
    """Messages of one sender, some of whose slots were taken."""

    def __init__(self) -> None:
        self._messages: deque[tuple[Message, int]] = deque()
        self._taken = 0  # slots of the first message that are gone
        self.end = 0
        self.available = 0

    def add(self, message: Message, count: int) -> None:
        self._messages.append((message, count))
        self.end += count
        self.available += count

    def take(self, count: int) -> list[tuple[Message, slice]]:
        """The next slots, as messages and which of their rows."""
        self.available -= count
        parts = []
        while count:
            message, length = self._messages[0]
            rows = slice(self._taken, min(length, self._taken + count))
            parts.append((message, rows))
            count -= rows.stop - rows.start
            self._taken = rows.stop
            if self._taken == length:
                self._messages.popleft()
                self._taken = 0
        return parts


def _rows(parts: list[tuple[Message, slice]], arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """The rows of the parts' arrays, one after the other."""
    chosen = [array[rows] for array, (_, rows) in zip(arrays, parts, strict=True)]
    return chosen[0] if len(chosen) == 1 else np.concatenate(chosen)
