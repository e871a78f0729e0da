"""What a run over ssh promises in addition to all others. Source: docs/hosts.md, how it ends."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.faults.hosts import host_of
from tests.faults.kinds import SIGNALS, Fault

_HALF_A_MINUTE = 30.0
_BUSY_SECONDS = 15.0
"""By which a run on a busy machine may end later than it promises."""
_HOST = re.compile(r"\bhost ([a-z][a-z0-9_-]*)")


def unlike_first_line(line: str, fatal: Sequence[Fault], hosts: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """What is wrong with the first line of a run that failed, if it names a host: then it also names a process that was there.

    fatal: the faults that may have ended the run; hosts: host → its processes.
    """
    named = _HOST.search(line)
    if named is None:
        return
    host = named[1]
    if not any(host_of(fault.target) == host for fault in fatal):
        yield f"the failure names host {host}, which nothing disturbed: {line}"
    elif not any(re.search(rf"\b{process}\b", line.partition("host ")[0]) for process in hosts[host]):
        yield f"the failure names host {host} and no process on it: {line}"


def unlike_refusal(line: str, fatal: Sequence[Fault], folders: Sequence[Path]) -> Iterator[str]:
    """What is wrong with a run that ended with status 2: a host could not be used, one line names it, and nothing was started."""
    disturbed = {host_of(fault.target) for fault in fatal} - {""}
    if not any(line.startswith(f"evedrop: host {host}: ") for host in disturbed):
        yield f"status 2, and the first line names none of host {', '.join(sorted(disturbed)) or '(none)'}: {line}"
    for folder in folders:
        yield f"status 2, and there are results in {folder.name}"


def ended_late(
    told: Sequence[Mapping[str, Any]], ended: float, hits: Mapping[Fault, float], slots: int
) -> Iterator[str]:
    """Whether a run whose host hangs ended within half a minute of its last slot, or of a signal to its launcher.

    told: its events, each with the time `at` which it came; ended: when its launcher ended; slots: of the whole run.
    """
    if not any(fault.is_ignored for fault in hits):
        return
    last = [event["at"] for event in told if event["event"] == "progress" and event["done"] >= slots]
    signalled = [at for fault, at in hits.items() if fault.kind in SIGNALS and fault.target == "launcher"]
    begun = min([*last[:1], *signalled], default=ended)
    if ended - max(begun, *hits.values()) > _HALF_A_MINUTE + _BUSY_SECONDS:
        yield f"the run ended {ended - begun:.0f} s after its last slot or a signal, although half a minute is promised"
