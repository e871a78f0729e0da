"""Every golden block of the pages, against the program, in both directions."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.network.access import grants
from evedrop.live.protocol.brief import Wiring, read_brief
from evedrop.live.protocol.keys import RunKeys
from evedrop.model.digest import BlockDigests, RunDigest
from evedrop.model.kernels.elementary import normal_quantile
from evedrop.model.receiver import Beliefs
from evedrop.model.streams import Stream, normals, root_of_seed, stream_key, uniforms
from tests.live.protocol.golden import BLOCKS, CODECS, GOLDEN, KEY, MESSAGES, PAGES, parts_of


def test_the_document_has_every_block() -> None:
    """Every kind of message is there, and everything else that is pinned: a renamed block is not silently skipped."""
    assert {name.split(",")[0] for name in MESSAGES} == set(CODECS)
    assert len(BLOCKS) == len(GOLDEN), "two blocks have the same name"
    shown = re.findall(r"^```golden (\w[\w-]*)", PAGES["protocol.md"], re.M)
    assert set(CODECS) - {"state"} == set(shown) - {"brief"}, "a state has the form of an estimate"
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
    """The golden brief reads, and writes back with the same entries in the same order."""
    path = tmp_path / "eve.json"
    path.write_text(GOLDEN["brief"])
    path.chmod(0o600)
    brief = read_brief(path, "eavesdropper")
    assert (brief.flow.window, brief.flow.batch, brief.model.state_probability) == (64, 16, 0.6)
    (tmp_path / "again").mkdir()
    again = json.loads(brief.write(tmp_path / "again").read_text())
    assert json.dumps(again) == json.dumps(json.loads(GOLDEN["brief"]))


def test_keys_of_streams() -> None:
    """Roots and stream keys derive as documented."""
    golden = json.loads(GOLDEN["keys"])
    root = root_of_seed(golden["seed"])
    secret = stream_key(root, "secret")
    streams = {"seed": golden["seed"], "root": root.hex(), "secret": secret.hex()}
    streams |= {name: stream_key(root, name).hex() for name in ("process", "link/legitimate", "coin/eve")}
    streams |= {name: stream_key(secret, name).hex() for name in ("schedule", "noise")}
    assert streams == golden


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
    digests = BlockDigests(2, 3).add(range(3), Beliefs(x_hat, P, gamma))
    assert list(digests) == [0]
    assert [bytes(row).hex() for row in digests[0]] == golden["blocks"]
    whole = RunDigest()
    whole.add(digests)
    assert whole.hexadecimal == golden["receiver"]


def test_table_of_keys_is_the_access_table() -> None:
    """The writer and the reader of each key, as the document's table has them and as the router grants them."""
    receivers = ("legitimate", "eve")
    prefix = f"evedrop/{'r'}/"
    documented: dict[tuple[str, str], set[str]] = {}
    everybody = {"sensor": ["sensor"], "router": ["router"], "recorder": ["recorder"], "receiver": list(receivers)}
    everybody |= {"legitimate": ["legitimate"], "controller": ["controller"]}
    rows = re.findall(
        r"^\| (`[a-z]+(?:/.*?)?`.*?) \| (.*?) \| (.*?) \| (.*?) \|$", PAGES["protocol.md"].split("## A run")[0], re.M
    )
    assert len(rows) == 14
    for paths, _, writers, readers in rows:
        for path in re.findall(r"`(.*?)`", paths):
            names = [*receivers, "sensor", "router", "recorder", "controller"] if "<process>" in path else receivers
            for name in names if "<" in path else [""]:
                key = prefix + re.sub(r"<\w+>", name, path)
                for right, who in (("writes", writers), ("reads", readers)):
                    own = "that" in who and ("receiver" in who or "process" in who)
                    users = {name or path.split("/")[-1]} if own else {u for u in everybody if re.search(u, who)}
                    documented.setdefault((right, key), set()).update(users - {"router"})
    granted: dict[tuple[str, str], set[str]] = {}
    loops = [Wiring("estimate", True), Wiring("truth", True)]
    for grant in (grant for loop in loops for grant in grants("r", receivers, loop)):
        for right, given in (("writes", (*grant.writes, grant.token)), ("reads", (*grant.reads, *grant.watches))):
            for key in filter(None, given):
                granted.setdefault((right, key), set()).add(grant.process)
    keys = RunKeys("r")
    no_row = {
        ("writes", keys.control("recorder")),
        ("reads", keys.control("recorder")),
        ("reads", keys.alive("recorder")),
    }
    assert {entry: users for entry, users in documented.items() if users and entry not in no_row} == granted
    for loop in (None, Wiring("estimate", False)):
        legitimate = next(grant for grant in grants("r", receivers, loop) if grant.process == "legitimate")
        assert keys.input not in legitimate.reads, "the inputs are for an estimator that is to know them"
    assert {grant.process: grant.asks for grant in grants("r", receivers) if grant.asks} == {
        "operator": (keys.control("recorder"),)
    }
    assert {grant.process: grant.answers for grant in grants("r", receivers) if grant.answers} == {
        "recorder": (keys.control("recorder"),)
    }
