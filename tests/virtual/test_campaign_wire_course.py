"""The judge of simulated wires sees messages at wrong times, of wrong contents or wrongly cut, and summaries that are wrong."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from pyarrow import csv

from evedrop.results.wire_summary import WireSummary
from evedrop.wire import journal_csv, publications
from evedrop.wire.file import wire_of
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.relay import WireRelay
from evedrop.wire.running_link import _CUT, RunningLink
from evedrop.wire.send_queue import SendQueue
from tests.virtual.wire_cases import SimulatedWireCase
from tests.virtual.wire_course import wrong_order, wrong_reasons
from tests.virtual.wire_draws import ENDPOINTS
from tests.virtual.wire_programs import Content, Course, Message, WireProgram

_FILE = f"""
seed = 7

[side.robot]
listen = "{ENDPOINTS["robot"]}"

[side.base]
listen = "{ENDPOINTS["base"]}"

[[link]]
name = "up"
from = "robot"
to = "base"
quality = 0.6
delay = {{ model = "constant", value = "700 ms" }}

[[link]]
name = "down"
from = "base"
to = "robot"
ordered = true
rate = "2 kB/s"
queue = 2000
"""
_CUTS = """
[[event]]
from = 1.0
to = 2.0
cut = "up"

[[event]]
from = 1.5
to = 2.5
partition = ["robot", "base"]
"""
_PROGRAMS = (
    WireProgram("base", ("listen **", "publish base/data")),
    WireProgram("robot", ("listen **", "publish robot/data", "delete robot/del", "named robot/named")),
)
PLAIN = SimulatedWireCase(5, (), 1, 4.0, _FILE, _PROGRAMS, ())
CUT = replace(PLAIN, file=_FILE + _CUTS)
SENT, DECIDED, APPLIED, PUBLISHED = SendQueue.send, RunningLink._decide, WireRelay.apply, publications.publish


def _at_once(queue: SendQueue, _: float, *rest: Any, **more: Any) -> None:
    SENT(queue, 0.0, *rest, **{**more, "order": None})


def _later(queue: SendQueue, delay: float, *rest: Any, **more: Any) -> None:
    SENT(queue, 2.0 * delay + 0.5 if delay else delay, *rest, **more)


def _uncut(relay: WireRelay, moment: Any) -> None:
    APPLIED(relay, replace(moment, cut=frozenset()))


def _cut_at_times(link: RunningLink, stream: Any) -> Any:
    decide = DECIDED(link, stream)

    def decided(now: float, size: int) -> Any:
        at, code, delay, again = decide(now, size)
        return (at, _CUT, 0.0, False) if at % 3 == 1 else (at, code, delay, again)

    return decided


def _put_all(session: Any, sample: Any, congestion: Any, copies: int) -> None:
    whole = bytes(sample.payload) + bytes(sample.attachment or b"")
    for _ in range(copies):
        session.put(sample.key_expr, whole, congestion_control=congestion, allowed_destination=publications.REMOTE)


@pytest.mark.parametrize("case", [PLAIN, CUT], ids=["plain", "cut"])
def test_a_wire_that_keeps_its_promises_is_no_miss(case: SimulatedWireCase) -> None:
    """With delays, losses, an order, a rate, and cuts."""
    assert case.play().misses == ()


@pytest.mark.parametrize(
    ("case", "place", "name", "mistake", "miss"),
    [
        (PLAIN, SendQueue, "send", _at_once, "and by the journal it was due at"),
        (PLAIN, SendQueue, "send", _later, "and by the journal it was due at"),
        (CUT, WireRelay, "apply", _uncut, "messages are cut wrongly"),
        (PLAIN, RunningLink, "_decide", _cut_at_times, "messages are cut wrongly"),
        (PLAIN, publications, "publish", _put_all, "and arrived as Content(deletes=False"),
        (PLAIN, RunningLink, "_wait", lambda *_: 0.0, "down sends"),
    ],
)
def test_a_mistake_of_the_wire_is_seen(
    case: SimulatedWireCase,
    place: Any,
    name: str,
    mistake: Callable[..., Any],
    miss: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Though receivers get as many messages as the journal says."""
    monkeypatch.setattr(place, name, mistake)
    misses = case.play().misses
    assert any(miss in found for found in misses), misses


@pytest.mark.parametrize(
    ("entries", "miss"),
    [
        ({"lost_by": {"corrupted": 5}}, "lost_by of up is"),
        ({"bytes": 1}, "bytes of up is 1"),
        ({"again": 777}, "again of up is 777"),
        ({"delays": {"0.5": 9e9}}, "the delay of up at 0.5 is"),
        ({"gap_messages": 999}, "gap_messages of up is 999"),
    ],
    ids=lambda entries: next(iter(entries)) if isinstance(entries, dict) else "",
)
def test_a_summary_that_counts_wrongly_is_seen(
    entries: dict[str, Any], miss: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the journal has the right numbers."""

    def text(summary: WireSummary) -> str:
        values = summary.as_dict()
        values["links"]["up"].update(entries)
        return json.dumps({**values, "unlinked": 55})

    monkeypatch.setattr(WireSummary, "text", property(text))
    misses = PLAIN.play().misses
    assert any(miss in found for found in misses), misses
    assert any("the summary has 55 messages without a link" in found for found in misses), misses


def test_an_export_with_other_numbers_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though it has as many rows as the journal."""

    def write(folder: Path, file: Path) -> int:
        table = pa.concat_tables(one.cast(journal_csv._PLAIN) for one in journal_tables(folder))
        place = journal_csv._PLAIN.get_field_index("size")
        field = journal_csv._PLAIN.field("size")
        csv.write_csv(table.set_column(place, field, pa.array([7] * len(table), field.type)), file)
        return len(table)

    monkeypatch.setattr(journal_csv, "write_journal_csv", write)
    assert any("rows.csv has size = 7" in miss for miss in PLAIN.play().misses)


def test_messages_that_overtake_each_other_are_seen() -> None:
    """On a link that keeps their order."""
    course = Course()
    rows: list[dict[str, Any]] = [
        {"link": "down", "n": n, "kind": "put", "fate": "delivered", "key": "base/data", "size": size}
        for n, size in enumerate((8, 9))
    ]
    for at, size in ((1.0, 9), (2.0, 8)):
        course.arrived.append((at, Message("put", "robot", "base/data", size), Content(False, size, 0)))
    plan = wire_of(tomllib.loads(_FILE))
    assert [*wrong_order(plan, course, rows)] == [
        "messages of base/data overtake each other on down, which keeps their order"
    ]
    assert not [*wrong_order(plan, course, [{**row, "n": 1 - row["n"]} for row in rows])]


@pytest.mark.parametrize(
    ("link", "reason", "size", "missed"),
    [
        ("down", "overflow", 8, False),
        ("up", "overflow", 8, True),
        ("up", "looped", 8, True),
        ("up", "too_large", 8, True),
        ("up", "too_large", 2**40, False),
        ("up", None, 2**40, True),
        ("up", None, 8, False),
    ],
)
def test_a_reason_that_nothing_can_have_is_seen(link: str, reason: str | None, size: int, missed: bool) -> None:
    """Only one link has a rate, and no router joins the sides."""
    rows = [{"link": link, "reason": reason, "size": size}]
    plan = wire_of(tomllib.loads(_FILE))
    assert [*wrong_reasons(plan, rows, (), joined=False)] == (
        [f"a message of {size} bytes is {reason} on {link}"] if missed else []
    )
