"""Messages of a closed loop: the controller's data, its decisions, and its reports.

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
    """Encode the state that the controller acts on in slot k, (n, R); name: `x_hat` for an estimate, `x` for the true state."""
    return pack({"k": k, name: x.tobytes()})


def read_known(message: Reader, name: str, k: int, shape: tuple[int, int]) -> Floats:
    """Decode the state that the controller acts on, (n, R), which must be that of slot k."""
    message.slot(k)
    return message.finite(name, shape)


def decided(k: int, u: Floats, failed: Flags) -> bytes:
    """Encode the inputs (m, R) from slot k on, and where the decision failed, (R,), so that the previous inputs stay."""
    fields = {"k": k, "u": u.tobytes()}
    if failed.any():
        fields["failed"] = packed_flags(failed).tobytes()
    return pack(fields)


def read_decided(message: Reader, k: int, shape: tuple[int, int]) -> tuple[Floats, Flags]:
    """Decode the inputs (m, R), which must be from slot k on, and where the decision failed."""
    message.slot(k)
    return message.finite("u", shape), read_failed(message, (shape[1],))


@dataclass(frozen=True)
class Decisions:
    """The controller's telemetry over c slots."""

    first: int
    count: int
    seconds: Floats
    """The seconds that each decision took."""
    digests: Mapping[int, Digests]
    """As in `Report`."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        digests = {block: digests.tobytes() for block, digests in self.digests.items()}
        return pack({"k": self.first, "c": self.count, "seconds": self.seconds.tobytes(), "digests": digests})


def read_decisions(message: Reader, first: int, extent: Extent, blocks: Blocks, period: int) -> Decisions:
    """Decode the controller's telemetry, which must begin at slot `first`, with a decision every `period` slots."""
    c = message.span(first, extent.slots, extent.batch + period)
    made = len(range(-(-first // period) * period, first + c, period))
    seconds = message.finite("seconds", (made,))
    if seconds.size and float(seconds.min()) < 0.0:
        raise message.malformed(f"seconds of {float(seconds.min()):g}", "numbers of at least 0")
    return Decisions(first, c, seconds, read_digests(message, extent.trials, blocks.ended(first, first + c)))
