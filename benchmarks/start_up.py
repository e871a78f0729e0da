"""The time from the start of the command until the first slot is in the results.

    python benchmarks/start_up.py [--quick]

The clock starts before the interpreter of `evedrop run` does. It stops when `unfinished/rounds` in the results folder says that
rows of a slot are on disk (docs/results.md).
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Iterator

from live_run import slots_on_disk, started
from table import Row, judged, run_alone

_LIMITS = {"off": 1.2, "web": 1.5}
_AIM = 0.8
_POLL_SECONDS = 0.002


def first_slot(view: str) -> float:
    """Seconds from the command to the first slot, in a run as fast as it goes."""
    start = time.monotonic()
    with started("eavesdroppers", "--pace", "0", "--slots", "2000", "--view", view) as (process, out):
        while not slots_on_disk(out) and not (out / "summary.json").exists() and process.poll() is None:
            time.sleep(_POLL_SECONDS)
        return time.monotonic() - start


def help_seconds() -> float:
    """Seconds that `evedrop --help` takes, which loads almost nothing."""
    start = time.monotonic()
    subprocess.run([sys.executable, "-m", "evedrop", "--help"], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - start


def rows(quick: bool) -> Iterator[Row]:
    """Without a view and with the web view."""
    for view, limit in _LIMITS.items():
        pairs = [(first_slot(view), help_seconds()) for _ in range(1 if quick else 7)]
        seconds, least = (statistics.median(column) for column in zip(*pairs, strict=True))
        yield Row(
            f"from the command to the first slot in the results, view {view}",
            f"{seconds:.2f} s",
            f"`evedrop --help`: {least:.2f} s",
            f"{limit} s",
            f"{_AIM} s",
            judged(seconds <= limit, seconds <= _AIM),
        )


if __name__ == "__main__":
    run_alone(rows)
