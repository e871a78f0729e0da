"""Messages, both ways, over all shapes; what is refused, and how."""

from __future__ import annotations

import contextlib

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from emulator.errors import EvedropError, Gap, MalformedMessage, RunError
from emulator.network import wire
from emulator.run.joined import Joiner

FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
SLOTS = st.integers(0, 2**40)
SIZES = st.integers(1, 19)


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 4), SIZES)
def test_packet(data: st.DataObject, k: int, n: int, trials: int) -> None:
    """A packet reads back bit by bit, negative zeros and subnormal numbers included."""
    z = data.draw(arrays(float, (n, trials), elements=FINITE))
    assert wire.read_uplink("u", wire.uplink(k, z), k, (n, trials)).tobytes() == z.tobytes()


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 4), SIZES)
def test_delivery(data: st.DataObject, k: int, n: int, trials: int) -> None:
    """A receiver gets γ, and z of exactly the trials that received; of the others not a bit is in the message."""
    z = data.draw(arrays(float, (n, trials), elements=FINITE))
    gamma = data.draw(arrays(bool, trials))
    raw = wire.delivery(k, wire.packed_flags(gamma).tobytes(), z[:, gamma].tobytes())
    found, heard = wire.read_delivery("d", raw, k, (n, trials))
    assert np.array_equal(found, gamma)
    assert heard.tobytes() == np.where(gamma, z, 0.0).tobytes()
    assert len(msgpack.unpackb(raw).get("z", b"")) == 8 * n * gamma.sum()


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 3), SIZES, st.integers(1, 5))
def test_truth(data: st.DataObject, k: int, n: int, trials: int, count: int) -> None:
    """Truth reads back."""
    x = data.draw(arrays(float, (count, n, trials), elements=FINITE))
    nu = data.draw(arrays(bool, (count, trials)))
    found = wire.read_truth("t", wire.Truth(k, x, nu).pack(), k, (n, trials))
    assert (found.first, found.count, found.x.tobytes()) == (k, count, x.tobytes())
    assert np.array_equal(found.nu, nu)


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 3), SIZES, st.integers(1, 5))
def test_report(data: st.DataObject, k: int, n: int, trials: int, count: int) -> None:
    """A report reads back, with any number of blocks' digests."""
    recorded = data.draw(st.integers(1, trials))
    report = wire.Report(
        k,
        data.draw(arrays(float, (count, n, trials), elements=FINITE)),
        data.draw(arrays(np.uint8, (count, trials), elements=st.integers(0, 3))),
        data.draw(arrays(float, (count, n, n, recorded), elements=FINITE)),
        data.draw(arrays(float, (count, 2), elements=FINITE)),
        {b: data.draw(arrays(np.uint8, (trials, 32))) for b in data.draw(st.sets(st.integers(0, 2**24), max_size=2))},
    )
    found = wire.read_report("r", report.pack(), k, (n, trials), recorded)
    for name in ("x_hat", "action", "P", "trace"):
        assert getattr(found, name).tobytes() == getattr(report, name).tobytes()
    assert {b: d.tobytes() for b, d in found.digests.items()} == {b: d.tobytes() for b, d in report.digests.items()}
    assert found.count == count


@settings(deadline=None)
@given(st.data(), SLOTS, SIZES, st.integers(1, 5))
def test_journal(data: st.DataObject, k: int, trials: int, count: int) -> None:
    """A journal reads back, receiver by receiver, reason by reason."""
    names = ("legitimate", "eve", "mallory")
    delivered = {name: data.draw(arrays(bool, (count, trials))) for name in names}
    lost = {name: {"lost": (~flags).sum(axis=1).astype(np.uint32)} for name, flags in delivered.items()}
    found = wire.read_journal("j", wire.Journal(k, count, delivered, lost).pack(), k, names, trials)
    for name in names:
        assert np.array_equal(found.delivered[name], delivered[name])
        assert np.array_equal(found.lost[name]["lost"], lost[name]["lost"])


READERS = {
    "packet": lambda raw: wire.read_uplink("key", raw, 0, (2, 3)),
    "delivery": lambda raw: wire.read_delivery("key", raw, 0, (2, 3)),
    "progress": lambda raw: wire.read_progress("key", raw),
    "control": lambda raw: wire.read_control("key", raw),
    "truth": lambda raw: wire.read_truth("key", raw, 0, (2, 3)),
    "report": lambda raw: wire.read_report("key", raw, 0, (2, 3), 1),
    "journal": lambda raw: wire.read_journal("key", raw, 0, ("a", "b"), 3),
}
FIELDS = ("k", "c", "z", "x", "nu", "gamma", "x_hat", "action", "P", "trace", "digests", "links", "do")
LINK = st.dictionaries(st.sampled_from(["delivered", "lost"]), st.one_of(st.just(1), st.binary(max_size=9)))
VALUES = st.one_of(
    st.integers(-3, 2**63 - 1),
    st.sampled_from([None, True, 0.5, "", "start", [], {}, float("nan")]),
    st.sampled_from([0, 1, 4, 6, 8, 16, 24, 48, 80]).map(bytes),
    st.binary(max_size=9),
    st.dictionaries(st.sampled_from(["a", "b", 0]), st.one_of(LINK, st.just(bytes(96))), max_size=3),
)


@settings(deadline=None)
@given(
    st.sampled_from(sorted(READERS)),
    st.one_of(st.binary(max_size=60), st.dictionaries(st.sampled_from(FIELDS), VALUES)),
)
def test_anything_else_is_an_error_of_ours(name: str, raw: bytes | dict[str, object]) -> None:
    """Whatever arrives, a reader gives values or raises one of the two errors of messages: no other gets through."""
    payload = raw if isinstance(raw, bytes) else msgpack.packb(raw)
    with contextlib.suppress(MalformedMessage, Gap):
        READERS[name](payload)


def test_errors_say_what_was_found_where_and_what_to_do() -> None:
    """A malformed message shows key, found, expected and the bytes; a gap both slots; either ends with a remedy."""
    with pytest.raises(MalformedMessage) as malformed:
        wire.read_uplink("evedrop/r/uplink", wire.uplink(0, np.zeros((2, 2))), 0, (2, 3))
    assert str(malformed.value).startswith(
        "malformed message on evedrop/r/uplink: z of 32 bytes; expected 48 bytes, <f8 of shape (2, 3). Its 40 bytes: 82 a1 6b"
    )
    with pytest.raises(Gap) as gap:
        wire.read_uplink("evedrop/r/uplink", wire.uplink(7, np.zeros((2, 3))), 6, (2, 3))
    assert "gap on evedrop/r/uplink: slot 7 arrived where slot 6 was due" in str(gap.value)
    assert issubclass(Gap, RunError)
    assert issubclass(MalformedMessage, RunError)
    assert issubclass(RunError, EvedropError)


@pytest.mark.parametrize("value", [4, 255])
def test_unknown_actions_are_refused(value: int) -> None:
    """An action beyond the documented four is malformed."""
    report = wire.Report(
        0, np.zeros((1, 1, 1)), np.full((1, 1), value, np.uint8), np.zeros((1, 1, 1, 1)), np.zeros((1, 2)), {}
    )
    with pytest.raises(MalformedMessage, match=f"action {value}; expected actions from 0 to 3"):
        wire.read_report("key", report.pack(), 0, (1, 1), 1)


def test_a_journal_without_a_receiver_is_refused() -> None:
    """Every receiver must be in every journal message."""
    raw = wire.Journal(0, 1, {"a": np.ones((1, 3), bool)}, {"a": {"lost": np.zeros(1, np.uint32)}}).pack()
    with pytest.raises(MalformedMessage, match="b = None; expected a map b"):
        READERS["journal"](raw)


@pytest.mark.parametrize("reasons", [[], ["eaten"], ["lost", "eaten"]])
def test_a_journal_with_other_reasons_is_refused(reasons: list[str]) -> None:
    """A journal gives every reason of the links and no other: columns of messages must fit together."""
    counts = {reason: np.zeros(1, np.uint32) for reason in reasons}
    raw = wire.Journal(0, 1, dict.fromkeys("ab", np.ones((1, 3), bool)), dict.fromkeys("ab", counts)).pack()
    with pytest.raises(MalformedMessage, match=r"a lost for \[.*\]; expected the reasons \['lost'\]"):
        READERS["journal"](raw)


TELEMETRY = {
    "truth": lambda k: wire.Truth(k, np.zeros((2, 1, 3)), np.zeros((2, 3), bool)).pack(),
    "report": lambda k: wire.Report(
        k, np.zeros((2, 1, 3)), np.zeros((2, 3), np.uint8), np.zeros((2, 1, 1, 1)), np.zeros((2, 2)), {}
    ).pack(),
    "journal": lambda k: wire.Journal(
        k, 2, {"a": np.ones((2, 3), bool)}, {"a": {"lost": np.zeros(2, np.uint32)}}
    ).pack(),
}


@pytest.mark.parametrize("second", [0, 1, 3, 4])
@pytest.mark.parametrize("what", TELEMETRY)
def test_observer_notices_gaps_and_doubles(what: str, second: int) -> None:
    """Truth, report or journal that does not begin where the last one ended is a gap."""
    joiner = Joiner(("a",), (1, 3), 1)
    take = {
        "truth": lambda raw: joiner.truth("key", raw),
        "report": lambda raw: joiner.report("a", "key", raw),
        "journal": lambda raw: joiner.journal("key", raw),
    }[what]
    take(TELEMETRY[what](0))
    with pytest.raises(Gap, match=f"gap on key: slot {second} arrived where slot 2 was due"):
        take(TELEMETRY[what](second))
    take(TELEMETRY[what](2))
