"""Whether the results of a live run are those of the same trials in memory, however it ended.

Source: docs/results.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import pyarrow as pa

from evedrop.results.crash_proof_tables import last_round, metrics_path
from evedrop.virtual.metrics import unlike_digests, unlike_memory, unlike_rows
from evedrop.virtual.reference import RunReference
from evedrop.virtual.whole import missing_rows


def wrong_tables(
    tables: Mapping[str, pa.Table], summary: Mapping[str, Any], reference: RunReference, done: bool
) -> Iterator[str]:
    """What is wrong with the tables of a run, and with the metrics of its summary, by its tables.

    done: whether it ended well.
    """
    for name, table in tables.items():
        yield from reference.wrong_rows(name, table, int(summary["slots"]))
    if tables["slots"].num_rows:
        yield from (f"there is no table {name}" for name in sorted(reference.tables.keys() - tables.keys()))
    yield from missing_rows(tables, summary, reference, done)
    yield from unlike_digests(summary, tables["digests"])
    yield from unlike_rows(summary, tables, reference.shards)


def wrong_summary(summary: Mapping[str, Any], reference: RunReference, done: bool) -> Iterator[str]:
    """What is wrong with a summary: packets that are unaccounted for; in a run that ended well, whatever is not as in memory."""
    unexplained = [name for name, link in summary["links"].items() if link["unexplained"]]
    if unexplained:
        yield f"packets to {', '.join(unexplained)} are unexplained"
    for name, link in summary["links"].items():
        in_bursts = sum(length * count for length, count in enumerate(link["bursts"] or (), start=1))
        if in_bursts > link["lost_by"].get("lost", 0):
            yield f"the bursts of {name} have {in_bursts} packets, and its losses are {link['lost_by']}"
    if done:
        if summary["ended"] != "complete":
            yield f"the run ended well, and its summary says {summary['ended']}"
        yield from unlike_memory(summary, reference.summary, reference.shards)
        recorded = _recorded(
            len({key[2] for key in reference.tables["trials"]}), int(summary["trials"]), reference.shards
        )
        for name, verification in summary["verification"].items():
            if verification["recomputed_trials"] != recorded:
                yield f"{verification['recomputed_trials']} trials of {name} were verified, of {recorded} that processes recorded"


def _recorded(trials: int, of: int, shards: int) -> int:
    """How many trials the recorders of all shards record: one without a recorded trial records its first nevertheless."""
    bounds = [of * number // shards for number in range(shards + 1)]
    return sum(max(1, min(trials, stop) - start) for start, stop in pairwise(bounds))


def wrong_outages(
    summary: Mapping[str, Any], reference: RunReference, reconnected: frozenset[tuple[str, int]]
) -> Iterator[str]:
    """What is wrong with a summary's `outages`; reconnected: process and slot of those that the run told of."""
    complete, slots = summary["ended"] == "complete", int(reference.summary["slots"])
    listed = summary["outages"]
    for process, slot in sorted(reconnected - {(entry["process"], entry["slot"]) for entry in listed}):
        yield f"the run told of an outage of {process} at slot {slot}, and the summary lists none"
    for entry in listed:
        if complete and (entry["until"] is None or not entry["slot"] <= entry["until"] <= slots):
            yield f"an outage of {entry['process']} at slot {entry['slot']} until {entry['until']}, in a run that is complete"
        if entry["seconds"] < 0.0:
            yield f"an outage of {entry['seconds']} s"


def lost_rows(folder: Path) -> Iterator[str]:
    """Rows of a run that was cut short which are not there, although metrics of them are.

    The first metrics are written when their rows are, and before these count.
    """
    try:
        slots = json.loads(metrics_path(folder).read_text("utf-8"))["slots"]
    except (OSError, ValueError):
        return
    rows = last_round(folder)
    if slots and not (folder / "summary.json").exists() and (not rows.at or 0 < rows.slots < slots):
        yield f"there are metrics of {slots} slots, and rows of {rows.slots}"
