"""The outages of a summary, held against the faults of the case and against what the run told while it went on.

Source: docs/results.md, outages.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tests.faults.hosts import host_of
from tests.faults.kinds import CONFUSED, EVERYBODY, Fault

_ROUTERS = ("router", "relay")
_CUTTING = ("flap", "cut", "silence", "stop", CONFUSED)
_LAG_SECONDS = 0.3
"""By which events of the run may be late: later events of slots to come prove that the run was not over when a fault struck."""


def unexplained_outages(
    listed: Sequence[Mapping[str, Any]],
    told: Sequence[Mapping[str, Any]],
    struck: Mapping[Fault, float],
    slots: int,
    complete: bool,
) -> Iterator[str]:
    """The entries of a summary's `outages` that no fault explains, and a fault that has none.

    told: the run's events, each with the time `at` which it came; struck: when each fault hit something; slots: of the whole run.
    """
    for entry in listed:
        if not _explained(str(entry["process"]), struck, complete):
            yield f"an outage of {entry['process']} at slot {entry['slot']}, and no fault caused one"
    for fault, at in struck.items():
        killed = fault.kind == "kill" and fault.target == "router" and _went_on(told, at, slots)
        if complete and killed and not {entry["process"] for entry in listed} & {*_ROUTERS, "recorder"}:
            yield "the router was killed in the middle of the run, and the summary lists no outage"


def _explained(process: str, struck: Mapping[Fault, float], complete: bool) -> bool:
    """Whether a fault can have cut a process off. Routers, and the recorder, stand for all that were connected to them.

    To a recorder whose own connection flaps, the others are back one after the other, and no longer all at once.
    """
    for fault in struck:
        if fault.kind in _CUTTING and host_of(fault.target):
            if complete:
                continue  # the processes on a host talk with their router directly
            return True  # and end with the connection of their host
        if fault.kind in _CUTTING and (
            fault.target in (process, EVERYBODY, "recorder") or process in (*_ROUTERS, "recorder")
        ):
            return True
        if fault.kind not in _CUTTING and fault.target not in ("results", "cleaner"):
            return True  # whatever ends may be missed first
    return False


def _went_on(told: Sequence[Mapping[str, Any]], struck: float, slots: int) -> bool:
    """Whether the run had begun when a fault struck, and slots were still to come well after it."""
    begun = any(event["event"] in ("started", "progress") and event["at"] < struck for event in told)
    return begun and any(
        event["event"] == "progress" and event["at"] > struck + _LAG_SECONDS and 0 < event["done"] < slots - 1
        for event in told
    )
