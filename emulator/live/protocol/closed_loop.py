"""Messages of a closed loop: what the controller acts on, what it decides, and what it reports.

Source: docs/protocol.md, closed loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from evedrop.live.protocol.codec import Reader, pack
from evedrop.live.protocol.telemetry import Extent, read_digests, read_failed
from evedrop.model.digest import Blocks, Digests
from evedrop.model.flag_bits import packed_flags
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags


def known(name: str, k: int, x: Floats) -> bytes:
    """What the controller acts on in slot k, (n, R): `x_hat`, an estimate, or `x`, the true state, as `name` says."""
    return pack({"k": k, name: x.tobytes()})


def read_known(message: Reader, name: str, k: int, shape: tuple[int, int]) -> Floats:
    """The same, which must be of slot k."""
    message.slot(k)
    return message.finite(name, shape)


def decided(k: int, u: Floats, failed: Flags) -> bytes:
    """The inputs (m, R) from slot k on, and where they are those before, because the decision failed, (R,)."""
    fields = {"k": k, "u": u.tobytes()}
    if failed.any():
        fields["failed"] = packed_flags(failed).tobytes()
    return pack(fields)


def read_decided(message: Reader, k: int, shape: tuple[int, int]) -> tuple[Floats, Flags]:
    """The inputs (m, R) that must be from slot k on, and where their decision failed."""
    message.slot(k)
    return message.finite("u", shape), read_failed(message, (shape[1],))


@dataclass(frozen=True)
class Decisions:
    """The controller's telemetry over c slots."""

    first: int
    count: int
    seconds: Floats
    """What each decision took."""
    digests: Mapping[int, Digests]
    """As in `Report`."""

    def pack(self) -> bytes:
        """As a message."""
        digests = {block: digests.tobytes() for block, digests in self.digests.items()}
        return pack({"k": self.first, "c": self.count, "seconds": self.seconds.tobytes(), "digests": digests})


def read_decisions(message: Reader, first: int, extent: Extent, blocks: Blocks, period: int) -> Decisions:
    """The controller's telemetry that must begin at slot `first`, with a decision every period slots."""
    c = message.span(first, extent.slots, extent.batch + period)
    made = len(range(-(-first // period) * period, first + c, period))
    seconds = message.finite("seconds", (made,))
    if seconds.size and float(seconds.min()) < 0.0:
        raise message.malformed(f"seconds of {float(seconds.min()):g}", "numbers of at least 0")
    return Decisions(first, c, seconds, read_digests(message, extent.trials, blocks.ended(first, first + c)))
