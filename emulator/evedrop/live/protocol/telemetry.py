"""Messages about what processes did: the true states, the receivers' beliefs, the journal of every packet's fate, decisions.

They go to the recorder, and in a closed loop to the controller: its data, its decisions and its reports.

Source: docs/protocol.md, messages and closed loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.live.protocol.codec import Reader, binary, pack, shown
from evedrop.live.protocol.record_messages import RecordFormat, packed
from evedrop.model.digest import DIGEST_BYTES, Blocks, Digests
from evedrop.model.links.loss_model import REASONS
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Flags, asymmetry, packed_flags
from evedrop.model.slot.link import COUNTED_BURSTS, Account
from evedrop.model.slot.records import LinkSlots, ReceiverSlots, SensorSlots


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
    silent: bool | None = None
    """Whether the sensor may send nothing in a slot; None: not known."""
    watched: bool | None = None
    """Whether the sensor watches its acknowledgements; None: not known."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the states of a slot, (n, R)."""
        return self.n, self.trials

    @property
    def axes(self) -> dict[str, int]:
        """Axis of a record → its length."""
        return {"n": self.n, "R": self.trials, "S": self.recorded, "m": self.inputs, "F": len(REASONS)}


@cache
def sensor_format(extent: Extent) -> RecordFormat[SensorSlots]:
    """How messages carry the sensor's records."""
    depending = {
        **dict.fromkeys(("u", "failed"), bool(extent.inputs)),
        "true": extent.measures,
        **dict.fromkeys(("statistic", "watermark"), extent.monitored),
        "sent": extent.silent,
        "alarms": extent.watched,
    }
    absent, present = ([name for name, there in depending.items() if there is kind] for kind in (False, True))
    return RecordFormat(SensorSlots, extent.axes, absent, present)


@cache
def receiver_format(extent: Extent, window: int) -> RecordFormat[ReceiverSlots]:
    """How messages carry a receiver's records; window: by how many slots its packets may be late."""
    late = ("late", "late_used")
    most = {"action": int(max(Action)), **dict.fromkeys(late, window)}
    absent, present = ((), (*late, "trace")) if window else (late, ("trace",))
    return RecordFormat(ReceiverSlots, extent.axes, absent, present, most)


@cache
def link_format(extent: Extent, window: int) -> RecordFormat[LinkSlots]:
    """How messages carry the records of a receiver's link; window: as for the receiver."""
    most = {"lost": extent.trials, "unsent": extent.trials, "late": window}
    return RecordFormat(LinkSlots, extent.axes, () if window else ("late",), ("late",) if window else (), most)


def held(k: int) -> bytes:
    """Encode the sensor's telemetry that it holds before slot k."""
    return pack({"k": k, "held": True})


def is_held(message: Reader) -> bool:
    """Whether the sensor's telemetry says that it holds."""
    return message.has("held")


def truth(slots: SensorSlots) -> bytes:
    """Encode the sensor's telemetry."""
    return pack({"k": slots.first, "c": slots.count, **packed(slots)})


def read_truth(message: Reader, first: int, extent: Extent) -> SensorSlots:
    """Decode the sensor's telemetry, which must begin at slot `first`."""
    return sensor_format(extent).read(message, first, message.span(first, extent.slots, extent.batch))


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
    """A receiver's telemetry over some slots."""

    slots: ReceiverSlots
    digests: Mapping[int, Digests]
    """Block, by its first slot → digests, (R, 16), of the blocks that ended in these slots."""
    trace_sums: Mapping[int, Floats] = field(default_factory=dict)
    """Block, by its first slot → sum of tr P over its slots, (R,), of the same blocks; none if all trials are recorded."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack(
            {
                "k": self.slots.first,
                "c": self.slots.count,
                **packed(self.slots),
                "digests": _packed_blocks(self.digests, "u1"),
                **({"trace_sums": _packed_blocks(self.trace_sums, "<f8")} if self.trace_sums else {}),
            }
        )


def _packed_blocks(numbers: Mapping[int, NDArray[Any]], dtype: str) -> dict[int, memoryview]:
    """Numbers of each block, of this type, as a field to be packed."""
    return {block: binary(of_block, dtype) for block, of_block in numbers.items()}


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
    slots = receiver_format(extent, window).read(message, first, message.span(first, extent.slots, extent.batch))
    if slots.late is not None and slots.late_used is not None and (slots.late_used > slots.late).any():
        raise message.malformed("more in late_used than in late", "at most as many late packets used as arrived")
    _check_symmetric(message, slots.P)
    ended = blocks.ended(first, first + slots.count)
    return Report(
        slots,
        read_digests(message, extent.trials, ended),
        _read_sums(message, extent.trials, ended if extent.recorded < extent.trials else []),
    )


def _check_symmetric(message: Reader, P: Floats) -> None:
    """Check covariances, (…, n, n, R). Digests cover their upper triangles only, so the lower ones must agree with them."""
    place = asymmetry(P)
    if place is not None:
        *before, i, j, r = place
        other = (*before, j, i, r)
        raise message.malformed(
            f"P with {P[place]} at {list(place)} and {P[other]} at {list(other)}",
            "covariances, which are symmetric except for rounding",
        )


def leaving(k: int, belief: Belief) -> bytes:
    """Encode a receiver's final belief before an outage that begins with slot k."""
    return pack({"k": k, "leaves": True, "x_hat": binary(belief.x_hat, "<f8"), "P": binary(belief.P, "<f8")})


def is_leaving(message: Reader) -> bool:
    """Whether a receiver's telemetry is its final belief before an outage."""
    return message.has("leaves")


def read_leaving(message: Reader, extent: Extent) -> tuple[int, Belief]:
    """Decode the slot before which a receiver leaves, and its belief."""
    n, trials = extent.shape
    x_hat, P = message.finite("x_hat", extent.shape), message.finite("P", (n, n, trials))
    _check_symmetric(message, P)
    return message.integer("k", 0, extent.slots), Belief(x_hat, P, np.zeros(trials, np.uint8))


@dataclass(frozen=True)
class Journal:
    """The router's journal over c slots."""

    first: int
    count: int
    links: Mapping[str, Account]

    def pack(self) -> bytes:
        """Encode it as a message."""
        links = {
            name: {
                **packed(link.slots),
                "bursts": binary(link.bursts, "<u4"),
                "delays": binary(link.delays, "<u4"),
            }
            for name, link in self.links.items()
        }
        return pack({"k": self.first, "c": self.count, "links": links})


def read_journal(message: Reader, first: int, windows: Mapping[str, int], extent: Extent) -> Journal:
    """Decode a journal, which must begin at slot `first` and have every receiver in it; windows: receiver → its window."""
    c, trials = message.span(first, extent.slots, extent.batch), extent.trials
    links: dict[str, Account] = {}
    for name, window in windows.items():
        link = message.nested("links").nested(name)
        links[name] = Account(
            link_format(extent, window).read(link, first, c),
            link.counts("bursts", "<u4", (COUNTED_BURSTS,), c * trials),
            link.counts("delays", "<u4", (window + 2,), c * trials),
        )
        _check_account(message, name, links[name], window)
    return Journal(first, c, links)


def _check_account(message: Reader, name: str, link: Account, window: int) -> None:
    """Check that every packet has one fate: delivered in its slot, lost, not sent, or, if packets may be late, under way.

    Its delay must be one that this fate can have: a receiver that is away misses packets in their slots and later ones.
    """
    slots = link.slots
    trials = slots.delivered.shape[1]
    delivered = slots.delivered.sum(axis=1)
    fates = delivered + slots.lost.sum(axis=1, dtype=np.int64) + slots.unsent
    wrong = (fates > trials) if window else (fates != trials)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise message.malformed(
            f"{int(fates[row])} fates of {name}'s packets of slot {message.integer('k') + row}", f"{trials} fates"
        )
    in_time, *within, after = link.delays.tolist()
    delays = [in_time, sum(within), after]
    lost = dict(zip(REASONS, slots.lost.sum(axis=0, dtype=np.int64).tolist(), strict=True))
    away, later = lost["down"] + lost["paused"], slots.delivered.size - sum(fates.tolist()) + lost["underway"]
    missed = min(max(in_time - sum(delivered.tolist()), 0), away)
    expected = [sum(delivered.tolist()) + missed, later + away - missed, lost["late"]]
    if delays != expected:
        raise message.malformed(
            f"delays of {name}'s packets for {delays} in their slots, within the window and after it",
            f"those of {expected}",
        )


def known(name: str, k: int, x: Floats) -> bytes:
    """Encode the state that the controller acts on in slot k, (n, R); name: `x_hat` for an estimate, `x` for the true state."""
    return pack({"k": k, name: binary(x, "<f8")})


def read_known(message: Reader, name: str, k: int, shape: tuple[int, int]) -> Floats:
    """Decode the state that the controller acts on, (n, R), which must be that of slot k."""
    message.slot(k)
    return message.finite(name, shape)


def decided(k: int, u: Floats, failed: Flags) -> bytes:
    """Encode the inputs (m, R) from slot k on, and where the decision failed, (R,), so that the previous inputs stay."""
    fields = {"k": k, "u": binary(u, "<f8")}
    if failed.any():
        fields["failed"] = binary(packed_flags(failed), "u1")
    return pack(fields)


def read_decided(message: Reader, k: int, shape: tuple[int, int]) -> tuple[Floats, Flags]:
    """Decode the inputs (m, R), which must be from slot k on, and where the decision failed."""
    message.slot(k)
    u, trials = message.finite("u", shape), shape[1]
    return u, message.flags("failed", (trials,)) if message.has("failed") else np.zeros(trials, np.bool_)


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
        seconds, digests = binary(self.seconds, "<f8"), _packed_blocks(self.digests, "u1")
        return pack({"k": self.first, "c": self.count, "seconds": seconds, "digests": digests})


def read_decisions(message: Reader, first: int, extent: Extent, blocks: Blocks, period: int) -> Decisions:
    """Decode the controller's telemetry, which must begin at slot `first`, with a decision every `period` slots."""
    c = message.span(first, extent.slots, extent.batch + period)
    if (first + c) % period and first + c != extent.slots:
        raise message.malformed(f"slots to {first + c}", f"all slots of each decision, which holds for {period}")
    made = len(range(-(-first // period) * period, first + c, period))
    seconds = message.finite("seconds", (made,))
    if seconds.size and float(seconds.min()) < 0.0:
        raise message.malformed(f"seconds of {float(seconds.min()):g}", "numbers of at least 0")
    return Decisions(first, c, seconds, read_digests(message, extent.trials, blocks.ended(first, first + c)))
