"""Memory of a run's processes, of its launcher and of `evedrop report`, and whether it stays the same over many slots.

    python benchmarks/memory.py [--quick]

Private memory is what a process has for itself: its pages that no other process shares (Private_* of /proc/PID/smaps_rollup).
The growth is that from the second quarter of the slots to the last, each by its median, because queues fill and empty. It does
not include the final tables. Peaks are the largest resident memory (VmHWM of /proc/PID/status), libraries included: the
launcher has its peak when it makes the page of the run, as `evedrop report` does again.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from subprocess import PIPE

from live_run import measured, slots_on_disk, started
from processes import processes_of
from table import Row, judged, run_alone

_POLL_SECONDS = 0.1
_PEAK_SECONDS = 0.01
_FLAT = 10.0  # MB in a million slots, which is ten bytes a slot: less than one number of each slot kept forever
_PEAK = 150.0  # MB
_MORE = 15.0  # MB that a peak may be above that of a short run
_PEERS = frozenset({"sensor", "legitimate", "eavesdropper"})
_BARE = """
import msgpack, numpy, sys, zenoh
sys.path.insert(0, {folder!r})
from zenoh_peers import session_of
with session_of("router", "tcp/127.0.0.1:0"):
    print(flush=True)
    sys.stdin.read()
"""


@dataclass
class Looks:
    """Private memory of the processes of one run, each time it was looked at."""

    total: int
    """The slots of the run."""
    slots: list[int] = field(default_factory=list)
    """How many slots were on disk."""
    megabytes: list[dict[str, float]] = field(default_factory=list)
    """Process → MB."""
    roles: dict[str, str] = field(default_factory=dict)
    """Process → its role."""

    def look(self, process: subprocess.Popen[bytes], out: Path) -> None:
        """Look again and again until all slots are on disk."""
        while process.poll() is None and (slots := slots_on_disk(out)) < self.total:
            megabytes = dict[str, float]()
            for usage in processes_of(process.pid):
                try:
                    megabytes[usage.name] = usage.private
                except OSError:
                    continue
                self.roles[usage.name] = usage.role
            if slots:
                self.slots.append(slots)
                self.megabytes.append(megabytes)
            time.sleep(_POLL_SECONDS)

    @property
    def largest(self) -> tuple[float, str]:
        """The most that a peer had at any time, and its name."""
        return max((size, name) for look in self.megabytes for name, size in look.items() if self.roles[name] in _PEERS)

    @property
    def quarters(self) -> tuple[list[dict[str, float]], list[dict[str, float]]] | None:
        """What was seen in the second quarter of the slots and in the last; None if there was no look in one of them."""
        # Peers leave before the last slots are on disk: a look that misses one of them is not compared.
        all_there = max((len(sizes) for sizes in self.megabytes), default=0)
        looks = [
            (slots / self.total, sizes)
            for slots, sizes in zip(self.slots, self.megabytes, strict=True)
            if len(sizes) == all_there
        ]
        before = [sizes for fraction, sizes in looks if 0.25 <= fraction < 0.5]
        after = [sizes for fraction, sizes in looks if fraction >= 0.75]
        return (before, after) if before and after else None

    @property
    def growth(self) -> dict[str, float]:
        """Process → MB in a million slots, from the median of the second quarter of the slots to that of the last.

        Raises RuntimeError if there were too few looks.
        """
        if self.quarters is None:
            raise RuntimeError(f"{self.total} slots were over before memory was looked at twice; run more slots")
        before, after = self.quarters
        apart = 0.5 * self.total / 1e6
        return {
            name: (median(sizes[name] for sizes in after) - median(sizes[name] for sizes in before)) / apart
            for name in after[0]
        }


def bare_interpreter() -> float:
    """Private MB of an interpreter with numpy and a session of Zenoh, next to another one that shares its libraries."""
    command = [sys.executable, "-c", _BARE.format(folder=str(Path(__file__).parent))]
    with ExitStack() as stack:
        pair = [stack.enter_context(subprocess.Popen(command, stdin=PIPE, stdout=PIPE)) for _ in range(2)]
        for interpreter in pair:
            assert interpreter.stdout is not None
            interpreter.stdout.readline()
        return processes_of(pair[0].pid)[0].private


def peak_of(process: subprocess.Popen[bytes]) -> float:
    """The largest resident memory of a process until it ends, in MB."""
    peak = 0.0
    while process.poll() is None:
        lines = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii", errors="replace").splitlines()
        peak = max([peak, *(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM"))])
        time.sleep(_PEAK_SECONDS)
    return peak


def peaks(slots: int) -> dict[str, float]:
    """The peaks of `evedrop run` with these slots (of the launcher), and of `evedrop report` of its results, in MB."""
    with started("eavesdroppers", "--pace", "0", "--slots", str(slots)) as (process, out):
        launcher = peak_of(process)
        command = [sys.executable, "-m", "evedrop", "report", str(out)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as report:
            return {"the launcher of `evedrop run`": launcher, "`evedrop report`": peak_of(report)}


def rows(quick: bool) -> Iterator[Row]:
    """The largest peer, the growth of every process, and the peaks of the launcher and of a report."""
    slots = 3_000 if quick else 2_000_000
    # A small run is slowed down, more and more, until a busy machine finds time to look at it.
    for pace in ("0.0005", "0.002", "0.008") if quick else ("0",):
        looks = Looks(slots)
        measured("eavesdroppers", "--pace", pace, "--slots", str(slots), watch=looks.look)
        if looks.quarters:
            break
    size, name = looks.largest
    yield Row(
        "private memory of a peer, one trial, the largest",
        f"{size:.0f} MB ({name})",
        f"an interpreter with numpy and a Zenoh session: {bare_interpreter():.0f} MB",
        "30 MB",
        "25 MB",
        judged(size <= 30, size <= 25),
    )
    growth = looks.growth
    name = max(growth, key=lambda process: growth[process])
    yield Row(
        f"growth of private memory over {slots:,} slots, the largest of {len(growth)} processes",
        f"{growth[name]:.1f} MB in 10⁶ slots ({name})",
        "none",
        f"flat: below {_FLAT:.0f} MB in 10⁶ slots",
        "the same",
        judged(growth[name] < _FLAT, growth[name] < _FLAT),
    )
    few, many = (300, 3_000) if quick else (1_000, 1_000_000)
    of_few = peaks(few)
    for name, peak in peaks(many).items():
        flat = peak - of_few[name] <= _MORE
        yield Row(
            f"peak of {name}, {many:,} slots",
            f"{peak:.0f} MB",
            f"with {few:,} slots: {of_few[name]:.0f} MB",
            f"{_PEAK:.0f} MB, and flat: at most {_MORE:.0f} MB above {few:,} slots",
            "the same",
            judged(flat and peak <= _PEAK, flat and peak <= _PEAK),
        )


if __name__ == "__main__":
    run_alone(rows)
