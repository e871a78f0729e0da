"""Whether the tables of a results folder have every row up to the slot at which its run ended, early or not.

Source: docs/results.md, while a run goes on: the tables agree with each other, wherever the writer was stopped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import pyarrow as pa

from evedrop.virtual.reference import KEYS, RunReference

_SHOWN = 2
_BY_TRIAL = ("trials", "inputs", "digests")
_CONTROLLER = "controller"


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


def _ended(
    key: tuple[Any, ...], wanted: Mapping[tuple[Any, ...], Any], reference: RunReference, slots: int, complete: bool
) -> bool:
    """Whether a block of digests had ended when these slots were done."""
    peer, trial, block = key
    if peer == _CONTROLLER and not complete:  # its reports may come later than the slots that are joined
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
