"""Every reader of messages, in one table: what it is given, and what it makes of a message. Used by tests and by fuzzing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgpack
import numpy as np

from evedrop.live.network import operator
from evedrop.live.protocol import commands, packets, telemetry
from evedrop.live.protocol import telemetry as loop_wire
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.notices import Progress, RefusalNotice
from evedrop.live.protocol.requests import LinkStatus, RunStatus, StepRequest, read_request
from evedrop.model.digest import Blocks
from evedrop.model.links.loss_model import REASONS
from evedrop.model.receiver import Belief, Reception
from evedrop.model.slot.link import COUNTED_BURSTS, Account, Change
from evedrop.model.slot.link_core import Arrivals, Late
from evedrop.model.slot.records import LinkSlots, PacketSlots, ReceiverSlots, SensorSlots
from evedrop.scenario.progress_events import RunEvent

SLOTS, N, TRIALS, RECORDED, WINDOW, INPUTS, PERIOD = 40, 2, 3, 1, 2, 1, 4
SHAPE = (N, TRIALS)
EXTENT = telemetry.Extent(SLOTS, 8, N, TRIALS, RECORDED, INPUTS, measures=True, monitored=True)
BLOCKS = Blocks(SLOTS, [6])
K = 4
"""The slot that is due everywhere."""


def delays_of(slots: LinkSlots, window: int) -> np.ndarray:
    """Delays that packets with these fates may have, as a journal has them.

    Those that a receiver misses are in time, and those under way one slot late, whatever becomes of them.
    """
    lost = dict(zip(REASONS, slots.lost.sum(axis=0).tolist(), strict=True))
    under_way = slots.delivered.size - slots.delivered.sum() - slots.lost.sum() - slots.unsent.sum() + lost["underway"]
    within = [under_way, *[0] * (window - 1)] if window else []
    return np.array([slots.delivered.sum() + lost["down"] + lost["paused"], *within, lost["late"]], np.uint32)


def _on(path: str, read: Callable[[Reader], Any]) -> tuple[str, Callable[[bytes], Any]]:
    key = f"evedrop/r1/{path}"
    return key, lambda payload: read(Reader(key, payload))


def _commanded(process: str, receivers: tuple[str, ...] | None = None) -> tuple[str, Callable[[bytes], Any]]:
    return _on(f"control/{process}", lambda m: commands.read_command(m, commands.Bounds(SLOTS, receivers)))


READERS: Mapping[str, tuple[str, Callable[[bytes], Any]]] = {
    "packet": _on("uplink", lambda m: packets.read_uplink(m, K, packets.packet_format(*SHAPE, header=1), 8)),
    "resend": _on("uplink", lambda m: packets.is_resend(m) and packets.read_resend(m, SLOTS)),
    "barrier": _on("uplink", lambda m: packets.is_barrier(m) and m.slot(K)),
    "delivery": _on("downlink/eve", lambda m: packets.read_delivery(m, K, SHAPE, 1, WINDOW, 8)),
    "acknowledgement": _on("ack/sent", lambda m: packets.read_acknowledgement(m, K, TRIALS)),
    "estimate": _on("estimate", lambda m: loop_wire.read_known(m, "x_hat", K, SHAPE)),
    "state": _on("state", lambda m: loop_wire.read_known(m, "x", K, SHAPE)),
    "input": _on("input", lambda m: loop_wire.read_decided(m, K, (INPUTS, TRIALS))),
    "progress": ("evedrop/r1/progress/eve", lambda raw: Progress.read("evedrop/r1/progress/eve", raw, K).k),
    "control": _commanded("eve"),
    "go": _commanded("sensor", ("eve", "recorder")),
    "change": _commanded("router", ("eve", "legitimate")),
    "again": _commanded("router", ("eve", "legitimate")),
    "request": ("evedrop/r1/control/recorder", lambda raw: read_request("evedrop/r1/control/recorder", raw)),
    "answer": ("evedrop/r1/control/recorder", lambda raw: operator.read_answer("evedrop/r1/control/recorder", raw)),
    "status": ("evedrop/r1/control/recorder", lambda raw: operator.read_answer("evedrop/r1/control/recorder", raw)),
    "truth": _on("telemetry/sensor", lambda m: telemetry.read_truth(m, K, EXTENT)),
    "held": _on("telemetry/sensor", lambda m: telemetry.is_held(m) and m.slot(K)),
    "leaving": _on("telemetry/eve", lambda m: telemetry.read_leaving(m, EXTENT)),
    "report": _on("telemetry/eve", lambda m: telemetry.read_report(m, K, EXTENT, BLOCKS, WINDOW)),
    "decisions": _on("telemetry/controller", lambda m: loop_wire.read_decisions(m, K, EXTENT, BLOCKS, PERIOD)),
    "journal": _on("journal", lambda m: telemetry.read_journal(m, K, {"legitimate": 0, "eve": WINDOW}, EXTENT)),
    "process-status": _on("telemetry/eve", lambda m: commands.read_process_status(m, SLOTS)),
    "refusal": _on("telemetry/eve", lambda m: RefusalNotice.read(m, "eve")),
}
"""What is read → the key it comes on, and its reader, of the bytes within the envelope. A reader gives values or raises
MalformedMessage or Gap; either names the key."""


def _accounts() -> dict[str, Account]:
    lost, unsent = np.zeros((2, len(REASONS)), np.uint32), np.zeros(2, np.uint32)
    delivered, bursts = np.ones((2, TRIALS), bool), np.zeros(COUNTED_BURSTS, np.uint32)

    def account(window: int) -> Account:
        late = np.zeros((2, TRIALS), np.uint16) if window else None
        slots = LinkSlots(K, delivered, lost, unsent, late)
        return Account(slots, bursts, delays_of(slots, window))

    return {"legitimate": account(0), "eve": account(WINDOW)}


_z, _header, _flags = np.arange(6.0).reshape(SHAPE), np.ones((1, TRIALS), np.int64), np.array([True, False, True])
_late = {0: (Late(3, Reception(_flags, _z, _header)),)}
_arrivals = Arrivals(_flags[None], _z[None], _header[None], _late, {0: _z})
_digests = {0: np.zeros((TRIALS, 16), np.uint8)}
EXAMPLES: Mapping[str, bytes] = {
    "packet": packets.uplink(PacketSlots(K, _z[None], _header[None], _flags[None], _z[None])),
    "resend": packets.resend(2, 6, 4),
    "barrier": packets.barrier(K),
    "delivery": packets.delivery(range(K, K + 1), _arrivals),
    "acknowledgement": packets.acknowledgement(K, _flags),
    "estimate": loop_wire.known("x_hat", K, _z),
    "state": loop_wire.known("x", K, _z),
    "input": loop_wire.decided(K, _z[:1], _flags),
    "progress": Progress(K).pack(),
    "control": commands.EndRun().pack(),
    "go": commands.Go(K, ("eve",), 9).pack(),
    "change": commands.LinkChange("eve", (Change(4, cut=True), Change(9, {"loss": {}}))).pack(),
    "again": commands.Again(1, K, {"eve": (Change(4, cut=True),)}).pack(),
    "request": StepRequest(3).pack(),
    "answer": operator.Answer(3, "done").pack(),
    "status": operator.Answer(status=RunStatus(
        K, SLOTS, 9.0, "held", {"eve": True}, {"eve": LinkStatus.of(4, 2)}, [RunEvent(2, "cut eve", "scenario")])).pack(),
    "truth": telemetry.truth(SensorSlots(K, np.ones((2, *SHAPE)), np.ones((2, 3), bool), None, None, np.ones((2, 1, 3)),
                             np.ones((2, 3), bool), np.ones((2, *SHAPE)), np.ones((2, 3)), np.ones((2, 1, 3)))),
    "held": telemetry.held(K),
    "leaving": telemetry.leaving(K, Belief(_z, np.ones((N, N, TRIALS)), np.zeros(TRIALS, np.uint8))),
    "report": telemetry.Report(
        ReceiverSlots(K, np.ones((2, *SHAPE)), np.ones((2, TRIALS), np.uint8), np.ones((2, N, N, 1)), np.ones((2, 2)),
                      np.ones((2, TRIALS), np.uint16), np.ones((2, TRIALS), np.uint16)),
        _digests, {0: np.ones(TRIALS)}).pack(),
    "decisions": loop_wire.Decisions(K, 4, np.ones(1), _digests).pack(),
    "journal": telemetry.Journal(K, 2, _accounts()).pack(),
    "process-status": commands.ProcessStatus(K, ("evedrop/r1/uplink",)).pack(),
    "refusal": RefusalNotice.of("evedrop/r1/downlink/eve", "no k").pack(),
}  # fmt: skip
"""A message that each reader takes, to begin with."""


def fields_of(name: str) -> dict[str, Any]:
    """The fields of an example."""
    fields: dict[str, Any] = msgpack.unpackb(EXAMPLES[name], strict_map_key=False)
    return fields
