"""The metrics of a summary, held against the rows of its tables and against the summary of the same trials in memory.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pyarrow as pa

from evedrop.model.checks import MOST_SLOTS
from evedrop.score.summary import Verification

_ROUNDED = 1e-9
"""Relative difference of metrics that a live run adds up in another order."""
_OF_CLOCK = frozenset({"wall_seconds", "slots_per_second", "mean_solve_seconds", "longest_solve_seconds", "replay"})
"""Entries that the clock or the folder decides."""
_OF_A_LIVE_RUN = frozenset({"mode", "ended", "outages", "verification", "misdelivered"})
"""Entries that say what only a live run can do."""
_ERRORS = ("mean_squared_error", "mean_trace_covariance")
_FRACTIONS = ("received_fraction", "used_fraction")
_MEANS = (*_ERRORS, *_FRACTIONS)


def unlike_memory(summary: Mapping[str, Any], wanted: Mapping[str, Any], shards: int = 1) -> Iterator[str]:
    """The entries of a complete run's summary that differ from those of the same trials in memory.

    shards: of the run; a decision covers all trials in memory, and those of one shard in the run.
    """
    controller = wanted.get("controller")
    if controller is not None:
        wanted = {**wanted, "controller": {**controller, "decisions": _decisions(controller, wanted["slots"], shards)}}
    summary = {**summary, "events": _repeatable(summary["events"], wanted["events"])}
    for name, value in wanted.items():
        if name not in _OF_A_LIVE_RUN:
            yield from _differences(name, summary.get(name), value)
    for name in summary.keys() - wanted.keys() - _OF_A_LIVE_RUN:
        yield f"the summary has {name}, and in memory it has not"


def unlike_prefix(summary: Mapping[str, Any], wanted: Mapping[str, Any], *, all_recorded: bool) -> Iterator[str]:
    """The entries of a run that was cut short that differ from those of the same slots in memory; wanted: these.

    Its events may be those before the next slot, too, and a controller may end before it has told how long its last decisions
    took. all_recorded: whether all trials are; of others, tr P of each is known at the end of a block only, as is its standard
    error.
    """
    slots, controller = wanted["slots"], wanted.get("controller")
    events = [event for event in summary["events"] if event["slot"] < slots or event in wanted["events"]]
    if controller is not None:
        counted = max(summary["controller"]["decisions"], _decisions(controller, slots, 1))
        summary = {**summary, "controller": {**summary["controller"], "decisions": counted}}
    for line in unlike_memory({**summary, "events": events}, wanted):
        if all_recorded or ".standard_errors.mean_trace_covariance is None" not in line:
            yield line


def wrong_course(
    summary: Mapping[str, Any], wanted: Mapping[str, Verification], seconds: float, confused: float
) -> Iterator[str]:
    """The entries that say how a live run went, and are not so; wanted: what is verified of each receiver.

    seconds: that the run took; confused: how many messages arrived as those of another key.
    """
    if summary["mode"] != "live":
        yield f"the mode of a live run is {summary['mode']}"
    wall = summary["wall_seconds"]
    if not 0.0 <= wall <= seconds:
        yield f"wall_seconds is {wall}, and the run took {seconds:.1f} s"
    if (dropped := sum(summary["misdelivered"].values())) > confused:
        yield f"the summary has {dropped} messages of other keys, and {confused:.0f} were confused"
    for name, entry in summary["verification"].items():
        if entry["recomputed_trials"]:
            for part in ("verified", "own_word"):
                if [*entry[part]] != [*getattr(wanted[name], part)]:
                    yield f"{part} of {name} is {entry[part]}"


def _decisions(controller: Mapping[str, Any], slots: int, shards: int) -> int:
    """How many decisions there are in some slots: one in each period, in every shard."""
    return shards * -(-slots // int(controller["period"]))


def _repeatable(
    events: Sequence[Mapping[str, Any]], wanted: Sequence[Mapping[str, Any]]
) -> Sequence[Mapping[str, Any]]:
    """The events of a run that it has again when it is repeated; wanted: those of its repetition.

    Of what an operator did, these are the changes of links, which are then the scenario's; not pauses and steps.
    """
    if all(event["by"] != "operator" for event in events):
        return events
    again = [(event["slot"], event["event"]) for event in wanted]
    kept = [event for event in events if event["by"] != "operator" or (event["slot"], event["event"]) in again]
    same_events = sorted((event["slot"], event["event"]) for event in kept) == sorted(again)
    return wanted if same_events else kept


def _differences(place: str, value: Any, wanted: Any) -> Iterator[str]:
    if place.rpartition(".")[2] in _OF_CLOCK:
        return
    if isinstance(wanted, Mapping) and isinstance(value, Mapping):
        for name in sorted({*wanted, *value}):
            yield from _differences(f"{place}.{name}", value.get(name), wanted.get(name))
    elif isinstance(wanted, list) and isinstance(value, list) and len(wanted) == len(value):
        for number, (item, other) in enumerate(zip(value, wanted, strict=True)):
            yield from _differences(f"{place}.{number}", item, other)
    elif not same(value, wanted):
        yield f"{place} is {value}, and in memory {wanted}"


def same(value: Any, wanted: Any) -> bool:
    """Whether two entries are equal, numbers within rounding."""
    if isinstance(value, bool) or isinstance(wanted, bool):
        return value is wanted
    if isinstance(value, (int, float)) and isinstance(wanted, (int, float)):
        if math.isnan(value) or math.isnan(wanted):
            return math.isnan(value) and math.isnan(wanted)
        return math.isclose(value, wanted, rel_tol=_ROUNDED, abs_tol=1e-12)
    return bool(value == wanted)


def slots_of_metrics(summary: Mapping[str, Any], shards: int = 1) -> int | None:
    """The slot before which all rows count in the metrics of a summary; None if it has none, or they cannot be told.

    A run that was killed has metrics of an earlier moment than its rows, and says so; of a run in shards, only those of some
    shards are. Otherwise the metrics of shards cover all rows, however far each shard came.
    """
    earlier = re.search(r"the metrics are as of slot (\d+)", str(summary["ended"]))
    if shards > 1:
        begun = any(link["offered"] for link in summary["links"].values())
        return MOST_SLOTS if begun and not earlier else None
    slots = int(earlier.group(1)) if earlier else int(summary["slots"])
    return slots or None


def unlike_rows(summary: Mapping[str, Any], tables: Mapping[str, pa.Table], shards: int = 1) -> Iterator[str]:
    """The metrics of receivers and links that are not those of the rows, which may be of a run that ended early."""
    slots = slots_of_metrics(summary, shards)
    if slots is None:
        return
    means, links = _means(tables["slots"], slots), _accounts(tables["journal"], slots)
    without = [name for name in summary["peers"] if name not in means or name not in links]
    if without:
        yield f"the metrics are of {slots} slots, and the tables have no rows of {', '.join(without)}"
        return
    controller = summary.get("controller")
    if controller is not None and shards == 1 and controller["decisions"] > _decisions(controller, slots, shards):
        yield f"the controller has decided {controller['decisions']} times, once in {controller['period']} of {slots} slots"
    latecomers = {name: account["late"] for name, account in links.items()}
    for name, peer in summary["peers"].items():
        mean, late = means[name], latecomers[name]
        for metric in _MEANS:
            # A late packet counts as received, and perhaps as used, when it arrives; rows of slots have none of them.
            least = mean[metric] / mean["trials"]
            most = least + (late / mean["trials"] if metric in _FRACTIONS else 0.0)
            value = peer[metric]
            fits = (
                not math.isfinite(least)
                if value is None
                else same(value, least) or same(value, most) or least < value < most
            )
            if not fits:
                yield f"{metric} of {name} is {value}, and by the rows of slots {least}"
    for name, link in summary["links"].items():
        account = links[name]
        offered, lost_by = account["offered"], account["lost_by"]
        if link["offered"] != offered:
            yield f"{link['offered']} packets were offered to {name}'s link, and by the rows of the journal {offered}"
        # What the journal calls late was under way, and is lost, if the run ended before it came.
        came = {**link["lost_by"], "underway": link["lost_by"].get("underway", 0) - lost_by.get("underway", 0)}
        cut_off = came.pop("underway")
        rest = {reason: count for reason, count in lost_by.items() if reason != "underway"}
        if came != rest or not 0 <= cut_off <= latecomers[name]:
            yield f"losses of {name}'s link are {link['lost_by']}, and by the rows of the journal {lost_by}"
        if sum(link["lost_by"].values()) != link["lost"] or link["delivered"] + link["lost"] != offered:
            yield f"the account of {name}'s link does not add up: {link}"


def unlike_digests(summary: Mapping[str, Any], digests: pa.Table) -> Iterator[str]:
    """The receivers whose digest in a summary is not that of the rows of digests, which must be complete then."""
    for name, peer in summary["peers"].items():
        if peer["digest"] is None:
            continue
        blocks: dict[int, list[bytes]] = defaultdict(list)
        for row in sorted(digests.to_pylist(), key=lambda row: (row["block"], row["trial"])):
            if row["peer"] == name:
                blocks[row["block"]].append(row["digest"])
        whole = b"".join(
            b"".join(of_trial) for of_trial in zip(*(blocks[start] for start in sorted(blocks)), strict=False)
        )
        of_rows = hashlib.sha256(whole).hexdigest()
        if of_rows != peer["digest"]:
            yield f"the digest of {name} is {peer['digest'][:12]}, and by the rows of digests {of_rows[:12]}"


def _means(slots: pa.Table, end: int) -> dict[str, dict[str, float]]:
    """Receiver → metric → its sum over slots and trials; and the number of these, as `trials`."""
    sums: dict[str, dict[str, float]] = defaultdict(lambda: dict.fromkeys((*_MEANS, "trials"), 0.0))
    for row in slots.select(["slot", "peer", "trials", *_MEANS]).to_pylist():
        if row["slot"] < end:
            sums_of_peer = sums[row["peer"]]
            sums_of_peer["trials"] += row["trials"]
            for metric in _MEANS:
                sums_of_peer[metric] += row[metric] * row["trials"]
    return sums


def _accounts(journal: pa.Table, end: int) -> dict[str, dict[str, Any]]:
    """Link → entries of its account, and how many packets were late, by the rows of the journal."""
    sums: dict[str, Counter[str]] = defaultdict(Counter)
    names = [name for name in journal.column_names if name not in ("slot", "link", "delivered_mask")]
    for row in journal.select(["slot", "link", *names]).to_pylist():
        if row["slot"] < end:
            for name in names:
                sums[row["link"]][name] += row[name]
    reasons = [name.removeprefix("lost_by_") for name in names if name.startswith("lost_by_")]
    return {
        link: {
            "offered": account["offered"],
            "late": account["late"],
            "lost_by": {reason: account[f"lost_by_{reason}"] for reason in reasons if account[f"lost_by_{reason}"]},
        }
        for link, account in sums.items()
    }
