"""Every golden block of docs/protocol.md, against the program, in both directions."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.errors import MalformedMessage
from evedrop.kernels.elementary import normal_quantile
from evedrop.live.network import operator
from evedrop.live.network.access import grants
from evedrop.live.protocol import closed_loop as loop_wire
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import commands, envelope, packets, telemetry
from evedrop.live.protocol.brief import read_brief
from evedrop.live.protocol.brief_closed_loop import Wiring
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.whereabouts import Whereabouts, read_whereabouts
from evedrop.model.digest import BeliefLog, Blocks, RunDigest
from evedrop.model.flag_bits import packed_flags
from evedrop.model.receiver import Belief, Reception
from evedrop.model.slot.account import COUNTED_BURSTS, Account
from evedrop.model.slot.link import Change
from evedrop.model.slot.transit import Late
from evedrop.streams import Stream, normals, root_of_seed, stream_key, uniforms

TEXT = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text(encoding="utf-8")
GOLDEN: dict[str, str] = dict(re.findall(r"^```golden ([^\n]+)\n(.*?)^```$", TEXT, re.S | re.M))
MESSAGES = [name for name in GOLDEN if "\nbytes " in GOLDEN[name]]
KEY = "evedrop/golden"
Encode = Callable[[dict[str, Any], dict[str, Any]], bytes]
Decode = Callable[[dict[str, Any], dict[str, Any], bytes], dict[str, Any]]


def parts_of(block: str) -> tuple[dict[str, Any], dict[str, Any], bytes]:
    """Shape, value and bytes of a message's golden block."""
    found = re.fullmatch(r"(?:shape (.*?)\n)?value (.*)\nbytes (.*)", block, re.S)
    assert found is not None, block
    shape, value, raw = found.groups()
    return json.loads(shape or "{}"), json.loads(value), bytes.fromhex(raw)


def flags(rows: Any) -> np.ndarray:
    """Flags of zeros and ones."""
    return np.array(rows, np.bool_)


def heard_of(shape: dict[str, Any], gamma: Any, z: Any) -> Reception:
    """What a receiver gets: payloads of the trials that receive one, 0 in the others."""
    full = np.zeros((shape["n"], shape["trials"]))
    full[:, flags(gamma)] = np.array(z, float).reshape(shape["n"], -1)
    return Reception(flags(gamma), full)


def packets_of(heard: Reception) -> dict[str, Any]:
    """The same as values: z of the trials that received, and nothing in the others."""
    assert not heard.z[:, ~heard.gamma].any()
    return {"gamma": heard.gamma.astype(int).tolist(), "z": heard.z[:, heard.gamma].tolist()}


SLOTS = 100_000
"""Of the run that all golden messages could be of."""


def extent_of(shape: dict[str, Any]) -> telemetry.Extent:
    """What messages of a shape are held to."""
    return telemetry.Extent(SLOTS, 1024, shape["n"], shape["trials"], shape.get("recorded", 1), shape.get("inputs", 0))


def encode_delivery(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the router makes it."""
    mask = packed_flags(flags(value["gamma"])).tobytes()
    late = tuple(Late(one["k"], heard_of(shape, one["gamma"], one["z"])) for one in value.get("late", ()))
    return packets.delivery(value["k"], mask, np.array(value["z"], float).tobytes(), late)


def decode_delivery(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As a receiver reads it."""
    arrival = packets.read_delivery(wire.Reader(KEY, raw), value["k"], (shape["n"], shape["trials"]))
    late = [{"k": one.k, **packets_of(one.heard)} for one in arrival.late]
    return {"k": value["k"], **packets_of(arrival.heard), **({"late": late} if late else {})}


def encode_report(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As a receiver makes it."""
    x_hat, P, trace = (np.array(value[name], float) for name in ("x_hat", "P", "trace"))
    action = np.array(value["action"], np.uint8)
    late, used = (np.array(value[name], np.uint16) if name in value else None for name in ("late", "late_used"))
    return telemetry.Report(value["k"], x_hat, action, P, trace, late, digests_of(value), used).pack()


def decode_report(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    window = shape.get("window", 0)
    report = telemetry.read_report(wire.Reader(KEY, raw), value["k"], extent_of(shape), Blocks(SLOTS), window)
    columns = {name: getattr(report, name).tolist() for name in ("x_hat", "action", "P", "trace")}
    digests = {str(block): [bytes(one).hex() for one in rows] for block, rows in report.digests.items()}
    late = {name: column.tolist() for name in ("late", "late_used") if (column := getattr(report, name)) is not None}
    return {"k": report.first, "c": report.count, **columns, **late, "digests": digests}


def encode_truth(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the sensor makes it."""
    steered = (np.array(value["u"], float), flags(value["failed"])) if "u" in value else (None, None)
    return telemetry.Truth(value["k"], np.array(value["x"], float), flags(value["nu"]), None, None, *steered).pack()


def decode_truth(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    inputs = shape.get("inputs", 0)
    truth = telemetry.read_truth(wire.Reader(KEY, raw), value["k"], extent_of(shape))
    found = {"k": truth.first, "c": truth.count, "x": truth.x.tolist(), "nu": truth.nu.astype(int).tolist()}
    if not inputs:
        return found
    assert truth.u is not None
    assert truth.failed is not None
    return {**found, "u": truth.u.tolist(), "failed": truth.failed.astype(int).tolist()}


def decode_known(name: str) -> Decode:
    """As the controller reads it."""

    def decode(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
        x = loop_wire.read_known(wire.Reader(KEY, raw), name, value["k"], (shape["n"], shape["trials"]))
        return {"k": value["k"], name: x.tolist()}

    return decode


def decode_over(raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    message = wire.Reader(KEY, raw)
    assert wire.is_over(message)
    dropped = wire.read_over(message)
    return {"over": True, **({"misdelivered": dropped} if dropped else {})}


def decode_envelope(key: str, raw: bytes) -> dict[str, Any]:
    """As a reader of that key, and as a reader of no other."""
    assert envelope.payload_of(key + "n", raw) is None
    payload = envelope.payload_of(key, raw)
    assert payload is not None
    return {"key": envelope.named_in(raw), "message": {"k": wire.Reader(KEY, payload).integer("k")}}


def decode_decided(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the sensor reads it."""
    u, failed = loop_wire.read_decided(wire.Reader(KEY, raw), value["k"], (shape["inputs"], shape["trials"]))
    return {"k": value["k"], "u": u.tolist(), "failed": failed.astype(int).tolist()}


def digests_of(value: dict[str, Any]) -> dict[int, np.ndarray]:
    """Digests of values."""
    return {
        int(block): np.array([list(bytes.fromhex(one)) for one in rows], np.uint8)
        for block, rows in value["digests"].items()
    }


def encode_decisions(_shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the controller makes it."""
    return loop_wire.Decisions(value["k"], value["c"], np.array(value["seconds"], float), digests_of(value)).pack()


def decode_decisions(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    extent = extent_of({"n": 1, **shape})
    found = loop_wire.read_decisions(wire.Reader(KEY, raw), value["k"], extent, Blocks(SLOTS), shape["period"])
    digests = {str(block): [bytes(one).hex() for one in rows] for block, rows in found.digests.items()}
    return {"k": found.first, "c": found.count, "seconds": found.seconds.tolist(), "digests": digests}


def encode_journal(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the router makes it."""
    accounts = {}
    for name, link in value["links"].items():
        lost = {reason: np.array(counts, np.uint32) for reason, counts in link["lost"].items()}
        late = np.array(link["late"], np.uint16) if "late" in link else None
        bursts = np.zeros(COUNTED_BURSTS, np.uint32)
        bursts[: len(link["bursts"])] = link["bursts"]
        delays = np.array(link["delays"], np.uint32)
        accounts[name] = Account(flags(link["delivered"]), lost, late, bursts, delays)
    return telemetry.Journal(value["k"], value["c"], accounts).pack()


def decode_journal(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    journal = telemetry.read_journal(wire.Reader(KEY, raw), value["k"], shape["windows"], extent_of({"n": 1, **shape}))
    links = {
        name: {
            "delivered": link.delivered.astype(int).tolist(),
            "lost": {reason: counts.tolist() for reason, counts in link.lost.items()},
            **({} if link.late is None else {"late": link.late.tolist()}),
            "bursts": np.trim_zeros(link.bursts, "b").tolist(),
            "delays": link.delays.tolist(),
        }
        for name, link in journal.links.items()
    }
    return {"k": journal.first, "c": journal.count, "links": links}


def decode_whereabouts(_shape: dict[str, Any], _value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    where = read_whereabouts(wire.Reader(KEY, raw), SLOTS)
    return {"k": where.slot, "waits": list(where.waits)}


def decode_refusal(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it from the sensor, who refuses what an eavesdropper wrote."""
    message = wire.Reader(KEY, raw)
    assert wire.is_refusal(message)
    refusal = wire.read_refusal(message, "sensor")
    assert refusal.at_fault == ("eve",)
    assert str(refusal) == f"malformed message on {value['refuses']}: {value['why']} (refused by sensor)"
    return {name: message.text(name) for name in value}


def encode_leaving(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As a receiver makes it."""
    belief = Belief(np.array(value["x_hat"]), np.array(value["P"]), np.zeros(shape["trials"], np.uint8))
    return telemetry.leaving(value["k"], belief)


def decode_leaving(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    message = wire.Reader(KEY, raw)
    assert telemetry.is_leaving(message)
    k, belief = telemetry.read_leaving(message, extent_of(shape))
    return {"k": k, "x_hat": belief.x_hat.tolist(), "P": belief.P.tolist()}


def decode_barrier(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As router and receivers read it."""
    message = wire.Reader(KEY, raw)
    assert packets.is_barrier(message)
    return {"k": message.slot(value["k"]), "hold": message.flag("hold")}


def decode_resend(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the router reads it."""
    message = wire.Reader(KEY, raw)
    assert packets.is_resend(message)
    number, done, first = packets.read_resend(message, SLOTS)
    return {"n": number, "again": done, "k": first}


def decode_held(_shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    message = wire.Reader(KEY, raw)
    assert telemetry.is_held(message)
    return {"k": message.slot(value["k"]), "held": message.flag("held")}


def control_of(value: dict[str, Any]) -> commands.Command:
    """A command with these fields."""

    def changes(of: list[dict[str, Any]]) -> tuple[Change, ...]:
        return tuple(Change(one["at"], one.get("settings"), one.get("cut")) for one in of)

    match value:
        case {"do": "start"}:
            return commands.Start()
        case {"do": "end"}:
            return commands.End()
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


def decode_packet(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the router reads it."""
    z = packets.read_uplink(wire.Reader(KEY, raw), value["k"], (shape["n"], shape["trials"]))
    return {"k": value["k"], "z": z.tolist()}


def decode_acknowledgement(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the router and the sensor read it."""
    gamma = packets.read_acknowledgement(wire.Reader(KEY, raw), value["k"], shape["trials"])
    return {"k": value["k"], "gamma": gamma.astype(int).tolist()}


def decode_request(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the observer reads it."""
    request = operator.read_request(KEY, raw)
    return {name: found for name in ("do", "event", "slots") if (found := getattr(request, name)) is not None}


def encode_answer(shape: dict[str, Any], value: dict[str, Any]) -> bytes:
    """As the observer makes it."""
    refused = tuple(value.get("refused", ()))
    return operator.Answer(value.get("k"), value.get("said", ""), refused, value.get("status")).pack()


def decode_answer(shape: dict[str, Any], value: dict[str, Any], raw: bytes) -> dict[str, Any]:
    """As the operator reads it."""
    answer = operator.read_answer(KEY, raw)
    if answer.refused:
        return {"refused": list(answer.refused)}
    return {"k": answer.slot, "said": answer.said} if answer.status is None else {"status": answer.status}


CODECS: dict[str, tuple[Encode, Decode]] = {
    "packet": (lambda _shape, value: packets.uplink(value["k"], np.array(value["z"])), decode_packet),
    "delivery": (encode_delivery, decode_delivery),
    "acknowledgement": (
        lambda _shape, value: packets.acknowledgement(value["k"], flags(value["gamma"])),
        decode_acknowledgement,
    ),
    "progress": (
        lambda _shape, value: wire.progress(value["k"]),
        lambda _shape, _value, raw: {"k": wire.read_progress(KEY, raw, SLOTS)},
    ),
    "control": (lambda _shape, value: control_of(value).pack(), decode_control),
    "resend": (lambda _shape, value: packets.resend(value["n"], value["again"], value["k"]), decode_resend),
    "barrier": (lambda _shape, value: packets.barrier(value["k"]), decode_barrier),
    "held": (lambda _shape, value: telemetry.held(value["k"]), decode_held),
    "leaving": (encode_leaving, decode_leaving),
    "request": (lambda _shape, value: operator.Request(**value).pack(), decode_request),
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
        lambda _shape, value: wire.over(value.get("misdelivered", 0)),
        lambda _shape, _value, raw: decode_over(raw),
    ),
    "envelope": (
        lambda _shape, value: envelope.enclosed(value["key"], wire.pack(value["message"])),
        lambda _shape, value, raw: decode_envelope(value["key"], raw),
    ),
    "whereabouts": (lambda _shape, value: Whereabouts(value["k"], tuple(value["waits"])).pack(), decode_whereabouts),
    "refusal": (lambda _shape, value: wire.refusal(value["refuses"], value["why"]), decode_refusal),
}


def test_the_document_has_every_block() -> None:
    """Every kind of message is there, and everything else that is pinned: a renamed block is not silently skipped."""
    assert {name.split(",")[0] for name in MESSAGES} == set(CODECS)
    others = {"brief", "keys", "words", "uniforms", "normals", "far words", "quantile", "digest"}
    assert set(GOLDEN) - set(MESSAGES) == others


@pytest.mark.parametrize("name", MESSAGES)
def test_message_encodes_to_these_bytes(name: str) -> None:
    """The values of a golden block give exactly its bytes."""
    shape, value, raw = parts_of(GOLDEN[name])
    assert CODECS[name.split(",", maxsplit=1)[0]][0](shape, value).hex(" ") == raw.hex(" ")


@pytest.mark.parametrize("name", MESSAGES)
def test_bytes_decode_to_these_values(name: str) -> None:
    """The bytes of a golden block give exactly its values."""
    shape, value, raw = parts_of(GOLDEN[name])
    assert CODECS[name.split(",", maxsplit=1)[0]][1](shape, value, raw) == value


@pytest.mark.parametrize("name", [name for name in MESSAGES if name != "envelope"])
def test_cut_message_is_refused(name: str) -> None:
    """A golden message without its last byte is malformed, and the error shows where it came from and its bytes."""
    shape, value, raw = parts_of(GOLDEN[name])
    with pytest.raises(MalformedMessage, match=f"malformed message on {KEY}.*{raw[:4].hex(' ')}"):
        CODECS[name.split(",", maxsplit=1)[0]][1](shape, value, raw[:-1])


def test_brief_is_read_and_written_as_documented(tmp_path: Path) -> None:
    """The golden brief reads, and writes back to the same text."""
    path = tmp_path / "eve.json"
    path.write_text(GOLDEN["brief"])
    path.chmod(0o600)
    brief = read_brief(path, "eavesdropper")
    assert (brief.flow.window, brief.flow.batch, brief.model.state_probability) == (64, 16, 0.6)
    (tmp_path / "again").mkdir()
    assert brief.write(tmp_path / "again").read_text().strip() == GOLDEN["brief"].strip()


def test_keys_of_streams() -> None:
    """Roots and stream keys derive as documented."""
    golden = json.loads(GOLDEN["keys"])
    root = root_of_seed(golden["seed"])
    secret = stream_key(root, "secret")
    found = {"seed": golden["seed"], "root": root.hex(), "secret": secret.hex()}
    found |= {name: stream_key(root, name).hex() for name in ("process", "link/legitimate", "coin/eve")}
    found |= {name: stream_key(secret, name).hex() for name in ("schedule", "noise")}
    assert found == golden


def golden_words() -> dict[str, np.ndarray]:
    """The golden words: "slot trial" → (m,)."""
    golden = json.loads(GOLDEN["words"])
    key = stream_key(root_of_seed(golden["seed"]), golden["stream"])
    drawn = Stream(key, range(2), golden["per_trial"]).words(range(2))
    return {f"{k} {r}": drawn[k, r] for k in range(2) for r in range(2)}


def test_words_uniforms_and_normals() -> None:
    """The first words of a stream, and what becomes of them, to the last bit."""
    raw = golden_words()
    golden = json.loads(GOLDEN["words"])
    assert {name: [f"{word:016x}" for word in row.tolist()] for name, row in raw.items()} == {
        name: golden[name] for name in raw
    }
    assert {name: uniforms(row).tolist() for name, row in raw.items()} == json.loads(GOLDEN["uniforms"])
    assert {name: normals(row).tolist() for name, row in raw.items()} == json.loads(GOLDEN["normals"])


def test_words_far_away() -> None:
    """Counters of large slots and trials are as documented."""
    golden = json.loads(GOLDEN["far words"])
    key = stream_key(root_of_seed(golden["seed"]), golden["stream"])
    k, r = golden["slot"], golden["trial"]
    drawn = Stream(key, range(r, r + 1), golden["per_trial"]).words(range(k, k + 1))
    assert [f"{word:016x}" for word in drawn[0, 0].tolist()] == golden["words"]


def test_quantiles() -> None:
    """Φ⁻¹ in its centre and both kinds of tails, to the last bit."""
    u, value = zip(*json.loads(GOLDEN["quantile"]), strict=True)
    assert normal_quantile(np.array(u)).tolist() == list(value)


def test_digest() -> None:
    """Block digests and the receiver's digest are as documented."""
    golden = json.loads(GOLDEN["digest"])
    gamma, x_hat = np.array(golden["gamma"], np.uint8), np.array(golden["x_hat"])
    P = np.array(golden["P"]).reshape(3, 2, 2, 2)
    log = BeliefLog(2, 2, 3)
    blocks = [log.add(k, Belief(x_hat[k], P[k], gamma[k])) for k in range(3)]
    assert blocks[:2] == [None, None]
    assert blocks[2] is not None
    first, digests = blocks[2]
    assert first == 0
    assert [bytes(row).hex() for row in digests] == golden["blocks"]
    whole = RunDigest()
    whole.add({first: digests})
    assert whole.hexadecimal == golden["receiver"]


def test_table_of_keys_is_the_access_table() -> None:
    """The writer and the reader of each key, as the document's table has them and as the router grants them."""
    receivers = ("legitimate", "eve")
    prefix = f"evedrop/{'r'}/"
    documented: dict[tuple[str, str], set[str]] = {}
    everybody = {"sensor": ["sensor"], "router": ["router"], "observer": ["observer"], "receiver": list(receivers)}
    everybody |= {"legitimate": ["legitimate"], "controller": ["controller"]}
    rows = re.findall(r"^\| (`[a-z]+(?:/.*?)?`.*?) \| (.*?) \| (.*?) \| (.*?) \|$", TEXT.split("## A run")[0], re.M)
    assert len(rows) == 14
    for paths, _, writers, readers in rows:
        for path in re.findall(r"`(.*?)`", paths):
            names = [*receivers, "sensor", "router", "observer", "controller"] if "<process>" in path else receivers
            for name in names if "<" in path else [""]:
                key = prefix + re.sub(r"<\w+>", name, path)
                for what, who in (("writes", writers), ("reads", readers)):
                    own = "that" in who and ("receiver" in who or "process" in who)
                    users = {name or path.split("/")[-1]} if own else {u for u in everybody if re.search(u, who)}
                    documented.setdefault((what, key), set()).update(users - {"router"})
    granted: dict[tuple[str, str], set[str]] = {}
    loops = [Wiring("estimate", True), Wiring("truth", True)]
    for grant in (grant for loop in loops for grant in grants("r", receivers, loop)):
        for what, given in (("writes", (*grant.writes, grant.token)), ("reads", (*grant.reads, *grant.watches))):
            for key in filter(None, given):
                granted.setdefault((what, key), set()).add(grant.process)
    keys = RunKeys("r")
    no_row = {
        ("writes", keys.control("observer")),
        ("reads", keys.control("observer")),
        ("reads", keys.alive("observer")),
    }
    assert {entry: users for entry, users in documented.items() if users and entry not in no_row} == granted
    for loop in (None, Wiring("estimate", False)):
        legitimate = next(grant for grant in grants("r", receivers, loop) if grant.process == "legitimate")
        assert keys.input not in legitimate.reads, "the inputs are for an estimator that is to know them"
    assert {grant.process: grant.asks for grant in grants("r", receivers) if grant.asks} == {
        "operator": (keys.control("observer"),)
    }
    assert {grant.process: grant.answers for grant in grants("r", receivers) if grant.answers} == {
        "observer": (keys.control("observer"),)
    }
