"""Messages to the observer: the true state, what a receiver believes, and the journal of every packet's fate.

Source: docs/protocol.md, messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.model.account import COUNTED_BURSTS, Account
from emulator.model.digest import DIGEST_BYTES, Digests
from emulator.model.links.link import REASONS
from emulator.model.process import Floats
from emulator.model.receiver import Action, Belief, Codes, Flags
from emulator.network.wire import Reader, flags_of, pack, packed_flags


def held(k: int) -> bytes:
    """The sensor's telemetry when it holds before slot k."""
    return pack({"k": k, "held": True})


def is_held(message: Reader) -> bool:
    """Whether the sensor's telemetry says that it holds."""
    return message.has("held")


@dataclass(frozen=True)
class Truth:
    """The sensor's telemetry over c slots."""

    first: int
    x: Floats
    """(c, n, R)."""
    nu: Flags
    """(c, R)."""
    sent: Flags | None = None
    """Whether there was a packet, (c, R); None of a scheme that sends in every slot."""
    alarms: Flags | None = None
    """Whether the sensor has become sure that its acknowledgements are attacked, (c, R); None where it does not watch them."""
    u: Floats | None = None
    """The inputs as they were decided, (c, m, R); None without a controller."""
    failed: Flags | None = None
    """Where their decision failed, (c, R)."""
    true: Floats | None = None
    """The true states, (c, n, R), of a sensor that filters: x is what it makes of them; None where they are x."""

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x)

    def pack(self) -> bytes:
        """As a message."""
        fields = {"k": self.first, "c": self.count, "x": self.x.tobytes(), "nu": packed_flags(self.nu).tobytes()}
        if self.sent is not None:
            fields["sent"] = packed_flags(self.sent).tobytes()
        if self.alarms is not None:
            fields["alarms"] = packed_flags(self.alarms).tobytes()
        if self.u is not None:
            fields["u"] = self.u.tobytes()
        if self.failed is not None and self.failed.any():
            fields["failed"] = packed_flags(self.failed).tobytes()
        if self.true is not None:
            fields["true"] = self.true.tobytes()
        return pack(fields)


def read_truth(message: Reader, first: int, shape: tuple[int, int], inputs: int = 0, measures: bool = False) -> Truth:
    """The sensor's telemetry that must begin at slot `first`, with so many inputs, and of one that filters or not."""
    k, c = message.slot(first), message.integer("c", 1)
    n, trials = shape
    flags = {
        name: flags_of(message.array(name, "u1", (c, (trials + 7) // 8)), trials) if message.has(name) else None
        for name in ("sent", "alarms")
    }
    masks = message.array("nu", "u1", (c, (trials + 7) // 8))
    return Truth(
        k,
        message.finite("x", (c, n, trials)),
        flags_of(masks, trials),
        flags["sent"],
        flags["alarms"],
        message.finite("u", (c, inputs, trials)) if inputs else None,
        read_failed(message, (c, trials)) if inputs else None,
        message.finite("true", (c, n, trials)) if measures else None,
    )


def read_failed(message: Reader, shape: tuple[int, ...]) -> Flags:
    """Where decisions failed, (…, R): nowhere, unless it is said."""
    if not message.has("failed"):
        return np.zeros(shape, np.bool_)
    return flags_of(message.array("failed", "u1", (*shape[:-1], (shape[-1] + 7) // 8)), shape[-1])


def read_digests(message: Reader, trials: int) -> dict[int, Digests]:
    """Block, by its first slot → digests, (R, 32)."""
    digests: dict[int, Digests] = {}
    for block, value in message.map("digests").items():
        if type(block) is not int or not isinstance(value, bytes) or len(value) != trials * DIGEST_BYTES:
            raise message.malformed(f"digests of block {block!r}", f"{trials * DIGEST_BYTES} bytes a block")
        digests[block] = np.frombuffer(value, np.uint8).reshape(trials, DIGEST_BYTES)
    return digests


@dataclass(frozen=True)
class Report:
    """A receiver's telemetry over c slots."""

    first: int
    x_hat: Floats
    """(c, n, R)."""
    action: Codes
    """(c, R)."""
    P: Floats
    """Believed covariance of the recorded trials, (c, n, n, recorded)."""
    trace: Floats
    """Sum over all trials of tr P and of its square, (c, 2)."""
    late: NDArray[np.uint16] | None
    """Packets of earlier slots that arrived within the window, (c, R); None of who has none."""
    digests: Mapping[int, Digests]
    """Block, by its first slot → digests, (R, 32), of the blocks that ended in these slots."""
    late_used: NDArray[np.uint16] | None = None
    """Those of `late` that were used, and not discarded, (c, R)."""

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x_hat)

    def pack(self) -> bytes:
        """As a message."""
        return pack(
            {
                "k": self.first,
                "c": self.count,
                "x_hat": self.x_hat.tobytes(),
                "action": self.action.tobytes(),
                "P": self.P.tobytes(),
                "trace": self.trace.tobytes(),
                **({} if self.late is None else {"late": self.late.astype("<u2").tobytes()}),
                **({} if self.late_used is None else {"late_used": self.late_used.astype("<u2").tobytes()}),
                "digests": {block: digests.tobytes() for block, digests in self.digests.items()},
            }
        )


def read_report(message: Reader, first: int, shape: tuple[int, int], recorded: int) -> Report:
    """A receiver's telemetry that must begin at slot `first`."""
    k, c = message.slot(first), message.integer("c", 1)
    n, trials = shape
    action = message.array("action", "u1", (c, trials))
    if action.size and int(action.max()) > max(Action):
        raise message.malformed(f"action {int(action.max())}", f"actions from 0 to {int(max(Action))}")
    return Report(
        k,
        message.finite("x_hat", (c, n, trials)),
        action,
        message.finite("P", (c, n, n, recorded)),
        message.finite("trace", (c, 2)),
        message.array("late", "<u2", (c, trials)) if message.has("late") else None,
        read_digests(message, trials),
        message.array("late_used", "<u2", (c, trials)) if message.has("late_used") else None,
    )


def leaving(k: int, belief: Belief) -> bytes:
    """A receiver's last word before an outage that begins with slot k: what it believes."""
    return pack({"k": k, "leaves": True, "x_hat": belief.x_hat.tobytes(), "P": belief.P.tobytes()})


def is_leaving(message: Reader) -> bool:
    """Whether a receiver's telemetry is such a word."""
    return message.has("leaves")


def read_leaving(message: Reader, shape: tuple[int, int]) -> tuple[int, Belief]:
    """The slot before which a receiver leaves, and what it believes."""
    n, trials = shape
    x_hat, P = message.finite("x_hat", shape), message.finite("P", (n, n, trials))
    return message.integer("k"), Belief(x_hat, P, np.zeros(trials, np.uint8))


@dataclass(frozen=True)
class Journal:
    """The router's journal over c slots."""

    first: int
    count: int
    links: Mapping[str, Account]

    def pack(self) -> bytes:
        """As a message."""
        links = {name: _account(link) for name, link in self.links.items()}
        return pack({"k": self.first, "c": self.count, "links": links})


def _account(link: Account) -> dict[str, Any]:
    return {
        "delivered": packed_flags(link.delivered).tobytes(),
        "lost": {reason: counts.astype("<u4").tobytes() for reason, counts in link.lost.items()},
        **({} if link.late is None else {"late": link.late.astype("<u2").tobytes()}),
        "bursts": link.bursts.astype("<u4").tobytes(),
        "delays": link.delays.astype("<u4").tobytes(),
        **({} if link.unsent is None else {"unsent": link.unsent.astype("<u4").tobytes()}),
    }


def read_journal(message: Reader, first: int, windows: Mapping[str, int], trials: int) -> Journal:
    """The journal that must begin at slot `first`, with every receiver in it; windows: receiver → its window."""
    k, c = message.slot(first), message.integer("c", 1)
    links: dict[str, Account] = {}
    for name, window in windows.items():
        link = message.nested("links").nested(name)
        reasons = link.nested("lost")
        if set(link.map("lost")) != set(REASONS):
            raise message.malformed(f"{name} lost for {list(link.map('lost'))}", f"the reasons {sorted(REASONS)}")
        links[name] = Account(
            flags_of(link.array("delivered", "u1", (c, (trials + 7) // 8)), trials),
            {reason: reasons.array(reason, "<u4", (c,)) for reason in REASONS},
            link.array("late", "<u2", (c, trials)) if link.has("late") else None,
            link.array("bursts", "<u4", (COUNTED_BURSTS,)),
            link.array("delays", "<u4", (window + 2,)),
            link.array("unsent", "<u4", (c,)) if link.has("unsent") else None,
        )
    return Journal(k, c, links)
