"""The golden blocks of the pages, and the functions of the program that each of them describes.

`bytes` are in hexadecimal, with spaces anywhere; `00*N` is N zero bytes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import convert, to_builtins

from evedrop.live.network import operator
from evedrop.live.protocol import codec, commands, packets, telemetry
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import telemetry as loop_wire
from evedrop.live.protocol.commands import ProcessStatus, read_process_status
from evedrop.live.protocol.notices import EndReport, Progress, RefusalNotice
from evedrop.live.protocol.requests import REQUESTS, RunStatus, read_request
from evedrop.model.digest import Blocks
from evedrop.model.receiver import Belief, Reception
from evedrop.model.slot.link import COUNTED_BURSTS, Account, Change
from evedrop.model.slot.link_core import Arrivals, Late
from evedrop.model.slot.records import LinkSlots, PacketSlots, ReceiverSlots, SensorSlots

DOCS = Path(__file__).parents[3] / "docs"
PAGES = {
    name: (DOCS / name).read_text(encoding="utf-8")
    for name in ("protocol.md", "numerical-spec.md", "random-streams.md", "digests.md")
}
MORE = (Path(__file__).parent / "more_golden.md").read_text(encoding="utf-8")
"""Blocks of further messages, which no page needs."""
BLOCKS: list[tuple[str, str]] = re.findall(
    r"^```golden ([^\n]+)\n(.*?)^```$", "\n".join([*PAGES.values(), MORE]), re.S | re.M
)
GOLDEN: dict[str, str] = dict(BLOCKS)
MESSAGES = [name for name in GOLDEN if "\nbytes " in GOLDEN[name]]
KEY = "evedrop/golden"
Encode = Callable[[dict[str, Any], dict[str, Any]], bytes]
Decode = Callable[[dict[str, Any], dict[str, Any], bytes], dict[str, Any]]


def parts_of(block: str) -> tuple[dict[str, Any], dict[str, Any], bytes]:
    """Shape, value and bytes of a message's golden block."""
    match = re.fullmatch(r"(?:shape (.*?)\n)?value (.*)\nbytes (.*)", block, re.S)
    assert match is not None, block
    shape, value, raw = match.groups()
    written = re.sub(r"\b00\*(\d+)", lambda zeros: "00" * int(zeros[1]), raw)
    return json.loads(shape or "{}"), json.loads(value), bytes.fromhex(written)


def flags(rows: Any) -> np.ndarray:
    """Flags of zeros and ones."""
    return np.array(rows, np.bool_)


def heard_of(shape: dict[str, Any], gamma: Any, z: Any) -> Reception:
    """What a receiver gets in a slot: payloads of the trials that receive one, 0 in the others."""
    full = np.zeros((shape["n"], shape["trials"]))
    full[:, flags(gamma)] = np.array(z, float).reshape(shape["n"], -1)
    return Reception(flags(gamma), full)


def packets_of(gamma: np.ndarray, z: np.ndarray) -> dict[str, Any]:
    """The same as values: z of the trials that received, and nothing in the others."""
    assert not z[:, ~gamma].any()
    return {"gamma": gamma.astype(int).tolist(), "z": z[:, gamma].tolist()}


SLOTS = 100_000
"""The slots of a run to which all golden messages could belong."""


def extent_of(shape: dict[str, Any]) -> telemetry.Extent:
    """What messages of a shape are held to."""
    return telemetry.Extent(SLOTS, 1024, shape["n"], shape["trials"], shape.get("recorded", 1), shape.get("inputs", 0))


def encode_delivery(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the router makes it."""
    heard = [heard_of(shape, gamma, z) for gamma, z in zip(value["gamma"], value["z"], strict=True)]
    late: dict[int, tuple[Late, ...]] = {}
    for entry in value.get("late", ()):
        row = entry["at"] - value["k"]
        late[row] = (*late.get(row, ()), Late(entry["k"], heard_of(shape, entry["gamma"], entry["z"])))
    gamma, z = (np.array([getattr(of_slot, name) for of_slot in heard]) for name in ("gamma", "z"))
    return packets.delivery(range(value["k"], value["k"] + value["c"]), Arrivals(gamma, z, None, late))


def decode_delivery(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As a receiver reads it."""
    arrivals = packets.read_delivery(wire.Reader(KEY, raw), value["k"], (shape["n"], shape["trials"]), most=64)
    late = [
        {"at": value["k"] + row, "k": part.k, **packets_of(part.heard.gamma, part.heard.z)}
        for row, parts in arrivals.late.items()
        for part in parts
    ]
    of_slots = [packets_of(gamma, z) for gamma, z in zip(arrivals.gamma, arrivals.z, strict=True)]
    columns = {name: [of_slot[name] for of_slot in of_slots] for name in ("gamma", "z")}
    return {"k": value["k"], "c": len(of_slots), **columns, **({"late": late} if late else {})}


def encode_report(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As a receiver makes it."""
    x_hat, P, trace = (np.array(value[name], float) for name in ("x_hat", "P", "trace"))
    action = np.array(value["action"], np.uint8)
    late, used = (np.array(value[name], np.uint16) if name in value else None for name in ("late", "late_used"))
    sums = {int(block): np.array(trace_sum, float) for block, trace_sum in value.get("trace_sums", {}).items()}
    slots = ReceiverSlots(value["k"], x_hat, action, P, trace, late, used)
    return telemetry.Report(slots, digests_of(value), sums).pack()


def decode_report(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    window = shape.get("window", 0)
    report = telemetry.read_report(wire.Reader(KEY, raw), value["k"], extent_of(shape), Blocks(SLOTS), window)
    slots = report.slots
    columns = {name: getattr(slots, name).tolist() for name in ("x_hat", "action", "P", "trace")}
    digests = {str(block): [bytes(digest).hex() for digest in rows] for block, rows in report.digests.items()}
    late = {name: column.tolist() for name in ("late", "late_used") if (column := getattr(slots, name)) is not None}
    sums = {str(block): trace_sum.tolist() for block, trace_sum in report.trace_sums.items()}
    more = {"trace_sums": sums} if sums else {}
    return {"k": slots.first, "c": slots.count, **columns, **late, "digests": digests, **more}


def encode_truth(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the sensor makes it."""
    steered = (np.array(value["u"], float), flags(value["failed"])) if "u" in value else (None, None)
    return telemetry.truth(
        SensorSlots(value["k"], np.array(value["x"], float), flags(value["nu"]), None, None, *steered)
    )


def decode_truth(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    inputs = shape.get("inputs", 0)
    truth = telemetry.read_truth(wire.Reader(KEY, raw), value["k"], extent_of(shape))
    fields = {"k": truth.first, "c": truth.count, "x": truth.x.tolist(), "nu": truth.nu.astype(int).tolist()}
    if not inputs:
        return fields
    assert truth.u is not None
    assert truth.failed is not None
    return {**fields, "u": truth.u.tolist(), "failed": truth.failed.astype(int).tolist()}


def decode_known(name: str) -> Decode:
    """As the controller reads it."""

    def decode(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
        x = loop_wire.read_known(wire.Reader(KEY, raw), name, value["k"], (shape["n"], shape["trials"]))
        return {"k": value["k"], name: x.tolist()}

    return decode


def decode_over(raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    report = EndReport.read(wire.Reader(KEY, raw))
    assert report is not None
    return {"over": True, **({"misdelivered": report.misdelivered} if report.misdelivered else {})}


def decode_envelope(key: str, raw: bytes) -> dict[str, Any]:
    """As a reader of that key, and as a reader of no other."""
    assert codec.payload_of(key + "n", raw) is None
    payload = codec.payload_of(key, raw)
    assert payload is not None
    return {"key": codec.named_in(raw), "message": {"k": wire.Reader(KEY, payload).integer("k")}}


def decode_decided(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the sensor reads it."""
    u, failed = loop_wire.read_decided(wire.Reader(KEY, raw), value["k"], (shape["inputs"], shape["trials"]))
    return {"k": value["k"], "u": u.tolist(), "failed": failed.astype(int).tolist()}


def digests_of(value: dict[str, Any]) -> dict[int, np.ndarray]:
    """Digests of values."""
    return {
        int(block): np.array([list(bytes.fromhex(digest)) for digest in rows], np.uint8)
        for block, rows in value["digests"].items()
    }


def encode_decisions(_shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the controller makes it."""
    return loop_wire.Decisions(value["k"], value["c"], np.array(value["seconds"], float), digests_of(value)).pack()


def decode_decisions(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    extent = extent_of({"n": 1, **shape})
    decisions = loop_wire.read_decisions(wire.Reader(KEY, raw), value["k"], extent, Blocks(SLOTS), shape["period"])
    digests = {str(block): [bytes(digest).hex() for digest in rows] for block, rows in decisions.digests.items()}
    return {"k": decisions.first, "c": decisions.count, "seconds": decisions.seconds.tolist(), "digests": digests}


def encode_journal(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the router makes it."""
    accounts = {}
    for name, link in value["links"].items():
        lost, unsent = (np.array(link[column], np.uint32) for column in ("lost", "unsent"))
        late = np.array(link["late"], np.uint16) if "late" in link else None
        bursts = np.zeros(COUNTED_BURSTS, np.uint32)
        bursts[: len(link["bursts"])] = link["bursts"]
        slots = LinkSlots(value["k"], flags(link["delivered"]), lost, unsent, late)
        accounts[name] = Account(slots, bursts, np.array(link["delays"], np.uint32))
    return telemetry.Journal(value["k"], value["c"], accounts).pack()


def decode_journal(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    journal = telemetry.read_journal(wire.Reader(KEY, raw), value["k"], shape["windows"], extent_of({"n": 1, **shape}))
    links = {
        name: {
            "delivered": link.slots.delivered.astype(int).tolist(),
            "lost": link.slots.lost.tolist(),
            "unsent": link.slots.unsent.tolist(),
            **({} if link.slots.late is None else {"late": link.slots.late.tolist()}),
            "bursts": np.trim_zeros(link.bursts, "b").tolist(),
            "delays": link.delays.tolist(),
        }
        for name, link in journal.links.items()
    }
    return {"k": journal.first, "c": journal.count, "links": links}


def decode_process_status(_shape: dict[str, Any], _value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    status = read_process_status(wire.Reader(KEY, raw), SLOTS)
    return {"k": status.slot, "waits": list(status.waits)}


def decode_refusal(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it from the sensor; the recorder refuses messages that an eavesdropper wrote."""
    message = wire.Reader(KEY, raw)
    refusal = RefusalNotice.read(message, "sensor")
    assert refusal is not None
    assert refusal.at_fault == ("eve",)
    assert str(refusal) == f"malformed message on {value['refuses']}: {value['why']} (refused by sensor)"
    return {name: message.text(name) for name in value}


def encode_leaving(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As a receiver makes it."""
    belief = Belief(np.array(value["x_hat"]), np.array(value["P"]), np.zeros(shape["trials"], np.uint8))
    return telemetry.leaving(value["k"], belief)


def decode_leaving(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    message = wire.Reader(KEY, raw)
    assert telemetry.is_leaving(message)
    k, belief = telemetry.read_leaving(message, extent_of(shape))
    return {"k": k, "x_hat": belief.x_hat.tolist(), "P": belief.P.tolist()}


def decode_barrier(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As router and receivers read it."""
    message = wire.Reader(KEY, raw)
    assert packets.is_barrier(message)
    return {"k": message.slot(value["k"]), "hold": message.fields["hold"]}


def decode_resend(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the router reads it."""
    message = wire.Reader(KEY, raw)
    assert packets.is_resend(message)
    number, done, first = packets.read_resend(message, SLOTS)
    return {"n": number, "again": done, "k": first}


def decode_held(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    message = wire.Reader(KEY, raw)
    assert telemetry.is_held(message)
    return {"k": message.slot(value["k"]), "held": message.fields["held"]}


def control_of(value: dict[str, Any]) -> commands.ControlCommand:
    """A command with these fields."""

    def changes(of: list[dict[str, Any]]) -> tuple[Change, ...]:
        return tuple(Change(change["at"], change.get("settings"), change.get("cut")) for change in of)

    match value:
        case {"do": "start"}:
            return commands.Start()
        case {"do": "end"}:
            return commands.EndRun()
        case {"do": "abandon", "why": why}:
            return commands.Abandon(why)
        case {"do": "go", "k": k, "absent": absent, "until": until}:
            return commands.Go(k, tuple(absent), until)
        case {"do": "again", "n": n, "k": k, "links": links}:
            return commands.Again(n, k, {name: changes(of) for name, of in links.items()})
        case {"do": "change", "link": link, "changes": of}:
            return commands.LinkChange(link, changes(of))
    raise AssertionError(value)


def decode_control(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the process reads it to which it is sent."""
    to = {"again": "router", "change": "router"}.get(value["do"], "sensor")
    message = wire.Reader(f"{KEY}/control/{to}", raw)
    assert commands.read_command(message, commands.Bounds(SLOTS)) == control_of(value)
    return value


def encode_packet(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the sensor makes it."""
    return packets.uplink(PacketSlots(value["k"], np.array(value["z"], float)))


def decode_packet(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the router reads it."""
    carried = packets.packet_format(shape["n"], shape["trials"])
    slots = packets.read_uplink(wire.Reader(KEY, raw), value["k"], carried, most=64)
    return {"k": slots.first, "c": slots.count, "z": slots.z.tolist()}


def decode_acknowledgement(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the router and the sensor read it."""
    gamma = packets.read_acknowledgement(wire.Reader(KEY, raw), value["k"], shape["trials"])
    return {"k": value["k"], "gamma": gamma.astype(int).tolist()}


def encode_request(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the operator makes it."""
    return REQUESTS[value["do"]](**{name: field for name, field in value.items() if name != "do"}).pack()


def decode_request(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the recorder reads it."""
    request = read_request(KEY, raw)
    return dict(to_builtins(request))


def encode_answer(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the recorder makes it."""
    refused = tuple(value.get("refused", ()))
    status = convert(value["status"], RunStatus) if "status" in value else None
    return operator.Answer(value.get("k"), value.get("effect"), refused, status).pack()


def decode_answer(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the operator reads it."""
    answer = operator.read_answer(KEY, raw)
    if answer.refused:
        return {"refused": list(answer.refused)}
    return {"k": answer.slot, "effect": answer.effect} if answer.status is None else to_builtins(answer)


CODECS: dict[str, tuple[Encode, Decode]] = {
    "packet": (encode_packet, decode_packet),
    "delivery": (encode_delivery, decode_delivery),
    "acknowledgement": (
        lambda _shape, value: packets.acknowledgement(value["k"], flags(value["gamma"])),
        decode_acknowledgement,
    ),
    "progress": (
        lambda _shape, value: Progress(value["k"]).pack(),
        lambda _shape, _value, raw: {"k": Progress.read(KEY, raw, SLOTS).k},
    ),
    "control": (lambda _shape, value: control_of(value).pack(), decode_control),
    "resend": (lambda _shape, value: packets.resend(value["n"], value["again"], value["k"]), decode_resend),
    "barrier": (lambda _shape, value: packets.barrier(value["k"]), decode_barrier),
    "held": (lambda _shape, value: telemetry.held(value["k"]), decode_held),
    "leaving": (encode_leaving, decode_leaving),
    "request": (encode_request, decode_request),
    "answer": (encode_answer, decode_answer),
    "truth": (encode_truth, decode_truth),
    "report": (encode_report, decode_report),
    "journal": (encode_journal, decode_journal),
    "estimate": (
        lambda _shape, value: loop_wire.known("x_hat", value["k"], np.array(value["x_hat"])),
        decode_known("x_hat"),
    ),
    "state": (lambda _shape, value: loop_wire.known("x", value["k"], np.array(value["x"])), decode_known("x")),
    "input": (
        lambda _shape, value: loop_wire.decided(value["k"], np.array(value["u"]), flags(value["failed"])),
        decode_decided,
    ),
    "decisions": (encode_decisions, decode_decisions),
    "over": (
        lambda _shape, value: EndReport(value.get("misdelivered", 0)).pack(),
        lambda _shape, _value, raw: decode_over(raw),
    ),
    "envelope": (
        lambda _shape, value: codec.enclosed(value["key"], wire.pack(value["message"])),
        lambda _shape, value, raw: decode_envelope(value["key"], raw),
    ),
    "process-status": (
        lambda _shape, value: ProcessStatus(value["k"], tuple(value["waits"])).pack(),
        decode_process_status,
    ),
    "refusal": (lambda _shape, value: RefusalNotice.of(value["refuses"], value["why"]).pack(), decode_refusal),
}
