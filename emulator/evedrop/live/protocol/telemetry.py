"""Messages about what processes did: the true states, the receivers' beliefs, the journal of every packet's fate, decisions.

They go to the recorder, and in a closed loop to the controller: its data, its decisions and its reports.

Source: docs/protocol.md, messages and closed loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.live.protocol.codec import Reader, pack, shown
from evedrop.model.digest import DIGEST_BYTES, Blocks, Digests
from evedrop.model.links.loss_model import REASONS
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Codes, Flags, asymmetry, packed_flags
from evedrop.model.slot.link import COUNTED_BURSTS, Account


@dataclass(frozen=True)
class Extent:
    """The dimensions of a run, against which messages are checked."""

    slots: int
    batch: int
    """How many slots one report may cover."""
    n: int
    trials: int
    recorded: int = 1
    """How many trials' covariances are reported."""
    inputs: int = 0
    """How many inputs a controller decides; 0 without one."""
    measures: bool = False
    """Whether the sensor filters its measurements."""
    monitored: bool = False
    """Whether the plant's side has a watermark and a detector."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the states of a slot, (n, R)."""
        return self.n, self.trials


def held(k: int) -> bytes:
    """Encode the sensor's telemetry that it holds before slot k."""
    return pack({"k": k, "held": True})


def is_held(message: Reader) -> bool:
    """Whether the sensor's telemetry says that it holds."""
    return message.has("held")


@dataclass(frozen=True)
class Truth:
    """The sensor's telemetry over c slots."""

    first: int
    x: Floats
    """States as they are sent, (c, n, R)."""
    nu: Flags
    """ν, (c, R)."""
    sent: Flags | None = None
    """Whether a packet was sent, (c, R); None if the scheme sends in every slot."""
    alarms: Flags | None = None
    """Whether the sensor raised an alarm that its acknowledgements are attacked, (c, R); None if it does not watch them."""
    u: Floats | None = None
    """The inputs as they were decided, (c, m, R); None without a controller."""
    failed: Flags | None = None
    """Where the decision failed, (c, R)."""
    true: Floats | None = None
    """The true states, (c, n, R), if the sensor filters, so that x is its estimate; None if x is the true state."""
    statistic: Floats | None = None
    """The detector's statistic after each slot, (c, R); None without a detector."""
    watermark: Floats | None = None
    """The watermark of the inputs, (c, m, R); None without a detector."""

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x)

    def pack(self) -> bytes:
        """Encode it as a message."""
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
        if self.statistic is not None and self.watermark is not None:
            fields["statistic"], fields["watermark"] = self.statistic.tobytes(), self.watermark.tobytes()
        return pack(fields)


def read_truth(message: Reader, first: int, extent: Extent) -> Truth:
    """Decode the sensor's telemetry, which must begin at slot `first`."""
    c, (n, trials) = message.span(first, extent.slots, extent.batch), extent.shape
    return Truth(
        first,
        message.finite("x", (c, n, trials)),
        message.flags("nu", (c, trials)),
        message.flags("sent", (c, trials)) if message.has("sent") else None,
        message.flags("alarms", (c, trials)) if message.has("alarms") else None,
        message.finite("u", (c, extent.inputs, trials)) if extent.inputs else None,
        read_failed(message, (c, trials)) if extent.inputs else None,
        message.finite("true", (c, n, trials)) if extent.measures else None,
        message.finite("statistic", (c, trials)) if extent.monitored else None,
        message.finite("watermark", (c, extent.inputs, trials)) if extent.monitored else None,
    )


def read_failed(message: Reader, shape: tuple[int, ...]) -> Flags:
    """Decode where decisions failed, (…, R); nowhere if the field is absent."""
    if not message.has("failed"):
        return np.zeros(shape, np.bool_)
    return message.flags("failed", shape)


def read_digests(message: Reader, trials: int, blocks: list[int]) -> dict[int, Digests]:
    """Decode digests: block, by its first slot → digests, (R, 16); blocks: those that end in the slots of the message."""
    digests: dict[int, Digests] = {}
    by_block = message.map("digests")
    for block, value in by_block.items():
        if type(block) is not int or block not in blocks:
            expected = (
                f"of the blocks that end in these slots, {blocks}" if blocks else "none: no block ends in these slots"
            )
            raise message.malformed(f"digests of block {shown(block)}", expected)
        if not isinstance(value, bytes) or len(value) != trials * DIGEST_BYTES:
            raise message.malformed(f"digests of block {block}", f"{trials * DIGEST_BYTES} bytes a block")
        digests[block] = np.frombuffer(value, np.uint8).reshape(trials, DIGEST_BYTES)
    if len(digests) < len(blocks):
        raise message.malformed(f"digests of blocks {sorted(digests)}", f"those of {blocks}, which end in these slots")
    return digests


@dataclass(frozen=True)
class Report:
    """A receiver's telemetry over c slots."""

    first: int
    x_hat: Floats
    """Estimates, (c, n, R)."""
    action: Codes
    """`Action`, (c, R)."""
    P: Floats
    """Reported covariance of the recorded trials, (c, n, n, recorded)."""
    trace: Floats
    """Sum over all trials of tr P and of its square, (c, 2)."""
    late: NDArray[np.uint16] | None
    """How many packets of earlier slots arrived within the window, (c, R); None for a receiver without a window."""
    digests: Mapping[int, Digests]
    """Block, by its first slot → digests, (R, 16), of the blocks that ended in these slots."""
    late_used: NDArray[np.uint16] | None = None
    """How many of the late packets were used, and not discarded, (c, R)."""
    trace_sums: Mapping[int, Floats] = field(default_factory=dict)
    """Block, by its first slot → sum of tr P over its slots, (R,), of the same blocks; none if all trials are recorded."""

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x_hat)

    def pack(self) -> bytes:
        """Encode it as a message."""
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
                **({"trace_sums": sums} if (sums := _packed_sums(self.trace_sums)) else {}),
            }
        )


def _packed_sums(sums: Mapping[int, Floats]) -> dict[int, bytes]:
    return {block: block_sums.astype("<f8").tobytes() for block, block_sums in sums.items()}


def _read_sums(message: Reader, trials: int, blocks: list[int]) -> dict[int, Floats]:
    """Decode sums of tr P: block, by its first slot → (R,); blocks: those that must be there."""
    given = message.map("trace_sums") if message.has("trace_sums") else {}
    if set(given) != set(blocks):
        raise message.malformed(f"trace_sums of blocks {shown(list(given))}", f"those of {blocks}")
    sums = {}
    for block in blocks:
        value = given[block]
        if not isinstance(value, bytes) or len(value) != 8 * trials:
            raise message.malformed(f"trace_sums of block {block}", f"{8 * trials} bytes a block")
        sums[block] = np.frombuffer(value, "<f8").astype(np.float64)
        if not (np.isfinite(sums[block]).all() and (sums[block] >= 0.0).all()):
            raise message.malformed(
                f"trace_sums of block {block} with a number below 0, or not finite", "sums of traces"
            )
    return sums


def read_report(message: Reader, first: int, extent: Extent, blocks: Blocks, window: int = 0) -> Report:
    """Decode a receiver's telemetry, which must begin at slot `first`.

    blocks: of its digests; window: by how many slots its packets may be late.
    """
    c, (n, trials) = message.span(first, extent.slots, extent.batch), extent.shape
    action = message.array("action", "u1", (c, trials))
    if action.size and int(action.max()) > max(Action):
        raise message.malformed(f"action {int(action.max())}", f"actions from 0 to {int(max(Action))}")
    late, used = (
        message.counts(name, "<u2", (c, trials), window) if message.has(name) else None
        for name in ("late", "late_used")
    )
    if used is not None and (late is None or (used > late).any()):
        raise message.malformed("more in late_used than in late", "at most as many late packets used as arrived")
    ended = blocks.ended(first, first + c)
    return Report(
        first,
        message.finite("x_hat", (c, n, trials)),
        action,
        _covariances(message, (c, n, n, extent.recorded)),
        message.finite("trace", (c, 2)),
        late,
        read_digests(message, trials, ended),
        used,
        _read_sums(message, trials, ended if extent.recorded < trials else []),
    )


def _covariances(message: Reader, shape: tuple[int, ...]) -> Floats:
    """Decode covariances, (…, n, n, R). Digests cover their upper triangles only, so the lower ones must agree with them."""
    P = message.finite("P", shape)
    place = asymmetry(P)
    if place is not None:
        *before, i, j, r = place
        other = (*before, j, i, r)
        raise message.malformed(
            f"P with {P[place]} at {list(place)} and {P[other]} at {list(other)}",
            "covariances, which are symmetric except for rounding",
        )
    return P


def leaving(k: int, belief: Belief) -> bytes:
    """Encode a receiver's final belief before an outage that begins with slot k."""
    return pack({"k": k, "leaves": True, "x_hat": belief.x_hat.tobytes(), "P": belief.P.tobytes()})


def is_leaving(message: Reader) -> bool:
    """Whether a receiver's telemetry is its final belief before an outage."""
    return message.has("leaves")


def read_leaving(message: Reader, extent: Extent) -> tuple[int, Belief]:
    """Decode the slot before which a receiver leaves, and its belief."""
    n, trials = extent.shape
    x_hat, P = message.finite("x_hat", extent.shape), _covariances(message, (n, n, trials))
    return message.integer("k", 0, extent.slots), Belief(x_hat, P, np.zeros(trials, np.uint8))


@dataclass(frozen=True)
class Journal:
    """The router's journal over c slots."""

    first: int
    count: int
    links: Mapping[str, Account]

    def pack(self) -> bytes:
        """Encode it as a message."""
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


def read_journal(message: Reader, first: int, windows: Mapping[str, int], extent: Extent) -> Journal:
    """Decode a journal, which must begin at slot `first` and have every receiver in it; windows: receiver → its window."""
    c, trials = message.span(first, extent.slots, extent.batch), extent.trials
    links: dict[str, Account] = {}
    for name, window in windows.items():
        link = message.nested("links").nested(name)
        reasons = link.nested("lost")
        if set(link.map("lost")) != set(REASONS):
            raise message.malformed(
                f"{name} lost for {shown(list(link.map('lost')))}", f"the reasons {sorted(REASONS)}"
            )
        links[name] = Account(
            link.flags("delivered", (c, trials)),
            {reason: reasons.counts(reason, "<u4", (c,), trials) for reason in REASONS},
            link.counts("late", "<u2", (c, trials), window) if link.has("late") else None,
            link.counts("bursts", "<u4", (COUNTED_BURSTS,), c * trials),
            link.counts("delays", "<u4", (window + 2,), c * trials),
            link.counts("unsent", "<u4", (c,), trials) if link.has("unsent") else None,
        )
        _check_account(message, name, links[name], window)
    return Journal(first, c, links)


def _check_account(message: Reader, name: str, link: Account, window: int) -> None:
    """Check that every packet has one fate: delivered in its slot, lost, not sent, or, if packets may be late, under way."""
    trials = link.delivered.shape[1]
    fates = np.count_nonzero(link.delivered, axis=1) + sum(counts.astype(np.int64) for counts in link.lost.values())
    fates += 0 if link.unsent is None else link.unsent.astype(np.int64)
    wrong = (fates > trials) if window else (fates != trials)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise message.malformed(
            f"{int(fates[row])} fates of {name}'s packets of slot {message.integer('k') + row}", f"{trials} fates"
        )
    if int(link.delays.sum(dtype=np.int64)) > link.delivered.size:
        raise message.malformed(f"more delays than packets of {name}", f"at most {link.delivered.size}")


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
