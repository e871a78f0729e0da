"""Whether the results of a live run are those of the same trials in memory, however it ended.

Source: docs/results.md.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import pyarrow as pa

from evedrop.names import CONTROLLER
from evedrop.results.crash_proof_tables import last_round, metrics_path
from evedrop.virtual.metrics import unlike_digests, unlike_memory, unlike_rows
from evedrop.virtual.reference import KEYS, RunReference


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
    yield from _uncounted(tables["slots"], summary)
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
    for name in ("scenario", "seed", "first_trial"):
        if summary[name] != reference.summary[name]:
            yield f"{name} is {summary[name]}, not {reference.summary[name]}"
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
    summary: Mapping[str, Any],
    reference: RunReference,
    reconnected: frozenset[tuple[str, int]],
    seconds: float = math.inf,
) -> Iterator[str]:
    """What is wrong with a summary's `outages`; reconnected: process and slot of those that the run told of.

    seconds: that the run took.
    """
    complete, slots = summary["ended"] == "complete", int(reference.summary["slots"])
    listed = summary["outages"]
    for process, slot in sorted(reconnected - {(entry["process"], entry["slot"]) for entry in listed}):
        yield f"the run told of an outage of {process} at slot {slot}, and the summary lists none"
    for entry in listed:
        if complete and (entry["until"] is None or not entry["slot"] <= entry["until"] <= slots):
            yield f"an outage of {entry['process']} at slot {entry['slot']} until {entry['until']}, in a run that is complete"
        if not 0.0 <= entry["seconds"] <= seconds:
            yield f"an outage of {entry['seconds']} s in a run of {seconds:.1f} s"
        if (entry.get("shard") is None) != (reference.shards == 1):
            yield f"an outage of {entry['process']} in shard {entry.get('shard')} of {reference.shards}"


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


_SHOWN = 2


def missing_rows(
    tables: Mapping[str, pa.Table], summary: Mapping[str, Any], reference: RunReference, complete: bool
) -> Iterator[str]:
    """The rows of a folder that are missing: of slots below the summary's `slots`, of all its trials.

    reference: the rows of the whole run; the folder may be that of one of its shards.
    """
    slots = int(summary["slots"])
    trials = range(int(summary["first_trial"]), int(summary["first_trial"]) + int(summary["trials"]))
    for name, wanted in reference.tables.items():
        if name not in tables:
            if slots or name != "inputs":  # before its first slot, a run has no account of its controller
                yield f"there is no table {name}"
            continue
        there = set(zip(*(tables[name][column].to_pylist() for column in KEYS[name]), strict=True))
        if name == "digests":
            due = {key for key in wanted if key[1] in trials and _ended(key, wanted, reference, slots, complete)}
        else:
            at = KEYS[name].index("trial") if "trial" in KEYS[name] else None
            due = {key for key in wanted if key[0] < slots and (at is None or key[at] in trials)}
        lacking = sorted(due - there)
        if lacking:
            shown = ", ".join(map(str, lacking[:_SHOWN]))
            yield f"{name} lacks {len(lacking)} of {len(due)} rows of the {slots} slots that are done: {shown} …"
    recorded = len({key[2] for key in reference.tables["trials"]})
    yield from _uneven(
        tables, slots, recorded > int(reference.summary["trials"]) * (reference.shards - 1) // reference.shards
    )


def _uncounted(table: pa.Table, summary: Mapping[str, Any]) -> Iterator[str]:
    """A slot of which all trials of all receivers have rows, although the summary says that it was not reached."""
    columns = (table[name].to_pylist() for name in ("slot", "trials"))
    whole = sum(row == (summary["slots"], summary["trials"]) for row in zip(*columns, strict=True))
    if whole == len(summary["peers"]):
        yield f"all trials have rows of slot {summary['slots']}, and the summary has {summary['slots']} slots"


def _ended(
    key: tuple[Any, ...], wanted: Mapping[tuple[Any, ...], Any], reference: RunReference, slots: int, complete: bool
) -> bool:
    """Whether a block of digests had ended when these slots were done."""
    peer, trial, block = key
    if peer == CONTROLLER and not complete:  # its reports may come later than the slots that are joined
        return False
    ends = [other for name, number, other in wanted if (name, number) == (peer, trial) and other > block]
    return min(ends, default=int(reference.summary["slots"])) <= slots


def _uneven(tables: Mapping[str, pa.Table], slots: int, all_recorded: bool) -> Iterator[str]:
    """Slots beyond those of the summary, which only some shards have reached: every table has them for every receiver.

    all_recorded: whether some trial of every shard is recorded.
    """
    ends = {}
    for name, column in (("slots", "peer"), ("journal", "link"), ("trials", "peer")):
        rows = zip(tables[name]["slot"].to_pylist(), tables[name][column].to_pylist(), strict=True)
        ends[name] = Counter(key for key in rows if key[0] >= slots)
    if ends["slots"].keys() != ends["journal"].keys():
        yield "slots and journal have rows of different slots beyond those that all trials have"
    if (all_recorded and ends["trials"].keys() != ends["slots"].keys()) or len({*_by_slot(ends["trials"])}) > len(
        {slot for slot, _ in ends["trials"]}
    ):
        yield "trials has rows of different slots, or of some receivers only, beyond those that all trials have"


def _by_slot(counts: Mapping[tuple[int, str], int]) -> Iterator[tuple[int, int]]:
    for (slot, _), count in counts.items():
        yield slot, count
