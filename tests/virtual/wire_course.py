"""What must hold of a simulated wire to which nothing happens: when messages arrive, and as what; cuts, reasons and counts.

Source: docs/maintainers/simulated-world.md; docs/wire/results.md.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import zenoh
from pyarrow import csv

from evedrop.results.wire_summary import WIRE_SUMMARY_FILE
from evedrop.virtual.world import EPOCH
from evedrop.wire.plan import WirePlan
from evedrop.wire.records import PARQUET
from evedrop.wire.timeline import moment_at, times
from tests.virtual.wire_programs import Course, Message

Row = Mapping[str, Any]
_ROUNDED, _SOON = 1e-5, 0.7
"""Seconds by which a message may seem early, since times are rounded, and which it may take besides its delay."""
_AROUND = 0.15
"""Seconds around an event in which a message may be on either side of it."""
_BEFORE_CUTS = frozenset({"overflow", "too_large", "looped", "too_many_keys", "underway"})
_LATE = frozenset({"underway", "congested", "held_up", "refused"})
"""Fates that may change after a summary has counted the first one."""


def wrong_arrivals(course: Course, of_message: Mapping[Message, list[Row]]) -> Iterator[str]:
    """Messages that arrive before their delay is over, or much later, or with another content."""
    for at, message, content in course.arrived:
        sent = course.contents.get((message.key, message.size), content)
        if sent != content:
            yield f"{message} was sent as {sent}, and arrived as {content}"
            return
        if len(rows := of_message.get(message, [])) == 1:
            due = rows[0]["time"] - EPOCH + rows[0]["delay"]
            if not due - _ROUNDED <= at <= due + _SOON:
                yield f"{message} arrived at {at:.3f} s, and by the journal it was due at {due:.3f} s"
                return


def wrong_order(plan: WirePlan, course: Course, rows: Iterable[Row]) -> Iterator[str]:
    """Keys of links that keep the order whose messages overtake each other."""
    arrived = {message: at for at, message, _ in reversed(course.arrived)}
    streams = defaultdict[tuple[str, str], list[tuple[int, float]]](list)
    for row in rows:
        if (
            row["link"] is None
            or row["n"] is None
            or row["kind"] not in {"put", "delete"}
            or row["fate"] != "delivered"
        ):
            continue
        link = plan.named(row["link"])
        message = Message("put", link.target, row["key"], row["size"])
        if link.ordered and message in arrived:
            streams[link.name, row["key"]].append((row["n"], arrived[message]))
    for (name, key), places in streams.items():
        moments = [at for _, at in sorted(places)]
        if moments != sorted(moments):
            yield f"messages of {key} overtake each other on {name}, which keeps their order"


def wrong_cuts(plan: WirePlan, rows: Iterable[Row], begun: float, changed: Collection[str]) -> Iterator[str]:
    """Messages that a cut must lose and does not, and those that are cut without one; changed: links that operators change.

    begun: when the start of these rows began, in seconds since 1970.
    """
    moments, wrong = times(plan), list[Row]()
    for row in rows:
        at = row["time"] - begun
        if row["link"] is None or row["link"] in changed or row["reason"] in _BEFORE_CUTS:
            continue
        if any(abs(at - moment) < _AROUND for moment in moments):
            continue
        cut = row["link"] in moment_at(plan, max(0.0, at)).cut and not plan.is_lossless(zenoh.KeyExpr(row["key"]))
        if cut is not (row["reason"] == "cut"):
            wrong.append(row)
    if wrong:
        what = wrong[0]["reason"] or wrong[0]["fate"]
        yield f"{len(wrong)} messages are cut wrongly: that at {wrong[0]['time'] - begun:.2f} s on {wrong[0]['link']} is {what}"


def wrong_reasons(plan: WirePlan, rows: Iterable[Row], changed: Collection[str], *, joined: bool) -> Iterator[str]:
    """Reasons that nothing in the wire's file can have; joined: whether a router outside joins two sides."""
    rated = {link.name for link in plan.links if "rate" in link.settings}
    rated |= {str(event.link) for event in plan.events if event.settings is not None and "rate" in event.settings}
    for row in rows:
        reason, large = row["reason"], row["size"] > plan.largest
        if (
            (reason == "overflow" and row["link"] not in rated and row["link"] not in changed)
            or (reason == "looped" and not joined)
            or (reason == "too_large" and not large)
            or (large and row["link"] is not None and reason not in {"too_large", *_BEFORE_CUTS})
        ):
            yield f"a message of {row['size']} bytes is {reason} on {row['link']}"
            return


def wrong_rates(plan: WirePlan, rows: Iterable[Row], changed: Collection[str]) -> Iterator[str]:
    """Links that send faster than their rate: those without a delay, whose settings do not change."""
    changed = {*changed, *(str(event.link) for event in plan.events if event.settings is not None)}
    for link in plan.links:
        if "rate" not in link.settings or link.settings.get("delay") is not None or link.name in changed:
            continue
        sent = sorted(
            (row["time"] + row["delay"], row["size"])
            for row in rows
            if row["link"] == link.name
            and row["fate"] == "delivered"
            and not plan.is_lossless(zenoh.KeyExpr(row["key"]))
        )
        for (before, _), (after, size) in pairwise(sent):
            if after - before < size / float(link.settings["rate"]) - 1e-3:
                yield f"{link.name} sends {size} bytes {after - before:.4f} s after others"
                break


def wrong_counts(folder: Path, rows: Iterable[Row], *, sampled: bool) -> Iterator[str]:
    """Entries of the summary that are not those of the rows of its start; sampled: whether it has some of the delays only."""
    summary = json.loads((folder / WIRE_SUMMARY_FILE).read_text())
    of_link = defaultdict[str | None, list[Row]](list)
    for row in rows:
        of_link[row["link"]].append(row)
    if summary["unlinked"] != len(of_link[None]):
        yield f"the summary has {summary['unlinked']} messages without a link, and the journal {len(of_link[None])}"
    for name, link in summary["links"].items():
        mine = of_link[name]
        delays = [row["delay"] for row in mine if row["fate"] == "delivered"]
        wanted: dict[str, Any] = {
            "lost_by": dict(Counter(row["reason"] for row in mine if row["fate"] == "lost")),
            "dropped_by": dict(Counter(row["reason"] for row in mine if row["fate"] == "dropped")),
            "bytes": sum(row["size"] for row in mine),
            "again": sum(bool(row["again"]) for row in mine if row["fate"] == "delivered"),
        }
        for entry, value in wanted.items():
            if link[entry] != value:
                yield f"{entry} of {name} is {link[entry]}, and by the journal {value}"
        for level, value in {} if sampled or not delays else link["delays"].items():
            of_rows = float(np.quantile(delays, float(level), method="inverted_cdf"))
            if not math.isclose(value, of_rows, abs_tol=1e-9):
                yield f"the delay of {name} at {level} is {value}, and by the journal {of_rows}"
        least, most = (_longest_gap(mine, late) for late in (False, True))
        if not least <= link["gap_messages"] <= most:
            yield f"gap_messages of {name} is {link['gap_messages']}, and by the journal {least} to {most}"


def wrong_csv(path: Path, rows: Sequence[Row]) -> Iterator[str]:
    """The first value of an exported journal that is not the one of the journal's row."""
    plain = {
        field.name: field.type.value_type if pa.types.is_dictionary(field.type) else field.type for field in PARQUET
    }
    options = csv.ConvertOptions(column_types=plain, strings_can_be_null=True, quoted_strings_can_be_null=False)
    exported = csv.read_csv(path, convert_options=options).to_pylist()
    if len(exported) != len(rows):
        yield f"{path.name} has {len(exported)} rows, and the journal {len(rows)}"
    for row, wanted in zip(exported, rows, strict=False):
        if row != wanted:
            names = [name for name in wanted if row.get(name) != wanted[name]]
            yield f"{path.name} has {names[0]} = {row.get(names[0])!r}, and the journal {wanted[names[0]]!r}"
            return


def _longest_gap(rows: Iterable[Row], late: bool) -> int:
    """The most messages of a key in a row that were not delivered; late: whether those whose fate may have changed count."""
    gap, missing = 0, Counter[tuple[str, str]]()
    for row in rows:
        if row["key"] is not None:
            stream = (row["key"], "put" if row["kind"] == "delete" else row["kind"])
            arrives = row["fate"] == "delivered" or (row["reason"] in _LATE and not late)
            missing[stream] = 0 if arrives else missing[stream] + 1
            gap = max(gap, missing[stream])
    return gap
