"""`evedrop wire`: opens a wire, carries out its events, and ends it in order.

Source: docs/wire.md.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from evedrop.output import warn
from evedrop.results.folder import make_private
from evedrop.signals import stop_on_signals
from evedrop.wire.conductor import WireConductor
from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import WirePlan
from evedrop.wire.relay import WireRelay


def run_wire(plan: WirePlan, out: Path, *, seconds: float | None = None, say: Callable[[str], None] = print) -> int:
    """Run a wire until a signal, or for some seconds; returns the exit status.

    out: its results folder, which may be that of an earlier start; say: for a line about each side and each event.
    """
    make_private(out)
    with (
        stop_on_signals() as stop,
        WireJournal(out, plan) as journal,
        WireRelay(plan, journal, warn) as relay,
        WireConductor(plan, relay, say),
    ):
        for name, endpoints in relay.endpoints.items():
            say(f"{name} {' '.join(endpoints)}")
        stop.wait(seconds)
    return 0
