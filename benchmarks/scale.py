"""How live runs grow: deliveries a second and memory, against trials, receivers and shards. A table and a picture.

    python benchmarks/scale.py [--quick] [PICTURE]

About seven minutes, `--quick` one. A delivery is one packet's fate at one receiver in one trial, counted once its slot is in the
results. Rates are those of the steady part of a run, without the start, the end and the merging of shards. Memory is the
largest sum of all processes' resident memory; shared pages count once for each process. Compare numbers within one table, not
between tables: other load on the machine affects them all, and is printed above and below each table.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from live_run import measured, scenario_file, slots_on_disk
from processes import processes_of

from evedrop.show.view.figure_style import GREY, panels
from evedrop.show.view.palette import RESERVE, hexadecimal

_POLL_SECONDS = 0.03
_STEADY = 0.2  # from this part of the slots on
_STRATEGIES = ("naive", "suspicious", "smart")
COLOURS = tuple(map(hexadecimal, RESERVE))


@dataclass(frozen=True)
class Grid:
    """What is measured."""

    trials: tuple[int, ...]
    receivers: tuple[int, ...]
    shards: tuple[int, ...]
    """Of runs over the second number of receivers; the others are not split."""
    seconds: float
    """Each run's, about."""

    @property
    def points(self) -> Iterator[tuple[int, int, int]]:
        """Trials, receivers and shards of each run."""
        for trials, receivers, shards in product(self.trials, self.receivers, self.shards):
            if shards == 1 or (shards <= trials and receivers == self.receivers[1]):
                yield trials, receivers, shards


FULL = Grid((1, 10, 100, 1000, 4000), (1, 4, 16), (1, 2, 4), 8.0)
QUICK = Grid((1, 10), (1, 2), (1,), 0.1)


@dataclass(frozen=True)
class MeasuredRun:
    """One run."""

    trials: int
    receivers: int
    shards: int
    slots: int
    slots_per_second: float
    megabytes: float
    cores: float
    """Processor seconds of all processes, a second."""
    busiest: str
    """The kind of process that used most of it."""
    fraction: float
    """The part of a core that one such process used."""

    @property
    def rate(self) -> float:
        """Deliveries a second."""
        return self.slots_per_second * self.trials * self.receivers

    @property
    def cost(self) -> float:
        """Microseconds of processor a delivery, of all processes together."""
        return self.cores / self.rate * 1e6


def changes_of(slots: int, trials: int, receivers: int, shards: int) -> dict[str, Any]:
    """The shipped scenario `eavesdroppers` with as many receivers, of its three strategies in turn."""
    eavesdroppers: dict[str, Any] = {}
    for i in range(receivers - 1):
        strategy = _STRATEGIES[i % len(_STRATEGIES)]
        eavesdroppers[f"{strategy}-{i}"] = {"strategy": strategy, "link": {"quality": 0.9}}
        if strategy == "suspicious":
            eavesdroppers[f"{strategy}-{i}"] |= {"use_state": 0.8, "use_innovation": 0.3}
    return {"slots": slots, "trials": trials, "shards": shards, "pace": 0.0, "eavesdroppers": eavesdroppers}


def measure(trials: int, receivers: int, shards: int, seconds: float) -> MeasuredRun:
    """Run one point of the grid and watch it."""
    expected = 60e-6 + 11e-6 * receivers + trials * (0.3e-6 + 0.075e-6 * receivers)  # a slot, on two cores of 2024
    return _measure(trials, receivers, shards, max(6000 if trials < 100 else 40, int(seconds / expected)))


def _measure(trials: int, receivers: int, shards: int, slots: int) -> MeasuredRun:
    looks: list[tuple[float, float, dict[str, list[float]]]] = []
    told: list[tuple[float, int]] = []

    def watch(process: subprocess.Popen[bytes], out: Path) -> None:
        folders = [out / "shards" / str(1 + i) for i in range(shards)] if shards > 1 else [out]
        while process.poll() is None:
            looks.append((time.monotonic(), *look(process.pid)))
            told.append((time.monotonic(), min(slots_on_disk(folder) for folder in folders)))
            time.sleep(_POLL_SECONDS)

    with tempfile.TemporaryDirectory() as folder:
        measured(scenario_file(folder, changes_of(slots, trials, receivers, shards)), watch=watch)
    steady = [(at, done) for at, done in told if done >= _STEADY * slots]
    if not steady or steady[0][1] == (last := max(steady, key=lambda moment: moment[1]))[1]:
        return _measure(trials, receivers, shards, 4 * slots)  # it was over before it was looked at twice
    begin, done = steady[0]
    end = next(at for at, now in steady if now == last[1])
    used = processor_seconds(looks, begin, end)
    busiest = max(used, key=lambda kind: max(used[kind]))
    return MeasuredRun(
        *(trials, receivers, shards, slots),
        slots_per_second=(last[1] - done) / (end - begin),
        megabytes=max(resident for _, resident, _ in looks),
        cores=sum(map(sum, used.values())) / (end - begin),
        busiest=busiest,
        fraction=max(used[busiest]) / (end - begin),
    )


def look(launcher: int) -> tuple[float, dict[str, list[float]]]:
    """Resident megabytes of a command and its children together; role → processor seconds so far, by process id."""
    resident, seconds = 0.0, dict[str, list[float]]()
    for usage in processes_of(launcher):
        resident += usage.resident
        seconds.setdefault(usage.role, []).append(usage.cpu_seconds)
    return resident, seconds


def processor_seconds(
    looks: list[tuple[float, float, dict[str, list[float]]]], begin: float, end: float
) -> dict[str, list[float]]:
    """Role → what each of them used between two times."""
    inside = [seconds for at, _, seconds in looks if begin <= at <= end]
    first, last = inside[0], inside[-1]
    return {
        kind: [after - before for before, after in zip(first[kind], last[kind], strict=False)]
        for kind in last
        if kind in first
    }


def exponent(points: list[tuple[float, float]]) -> float:
    """The exponent of the power law that fits points best, by least squares of logarithms."""
    x, y = np.log(np.array(points).T)
    return float(np.polyfit(x, y, 1)[0])


def named(power: float) -> str:
    """Growth in a word."""
    words = ("falling", "constant", "slower than linear", "linear", "faster than linear")
    return words[int(np.searchsorted((-0.1, 0.1, 0.9, 1.1), power))]


def growth(runs: list[MeasuredRun]) -> None:
    """Growth along each axis, and what a slot costs."""
    alone = [run for run in runs if run.shards == 1]
    axes = {"trials": sorted({run.trials for run in alone}), "receivers": sorted({run.receivers for run in alone})}
    print("\ngrowth without shards, exponents of a power law between two sizes:")
    for axis, sizes in axes.items():
        other = "receivers" if axis == "trials" else "trials"
        for fixed in axes[other]:
            line = [run for run in alone if getattr(run, other) == fixed]
            for low, high in pairwise(sizes):
                ends = [run for run in line if getattr(run, axis) in (low, high)]
                rate = exponent([(getattr(run, axis), run.rate) for run in ends])
                memory = exponent([(getattr(run, axis), run.megabytes) for run in ends])
                print(
                    f"    {axis} {low:>4} to {high:>4}, {fixed:>4} {other}: deliveries/s {rate:5.2f} ({named(rate)}), "
                    f"memory {memory:5.2f} ({named(memory)})"
                )
    if len(alone) > 4:
        terms = np.array([[1.0, run.receivers, run.trials, run.trials * run.receivers] for run in alone])
        for subject, values, unit in (
            ("a slot costs", [1e6 * run.cores / run.slots_per_second for run in alone], "µs of processor"),
            ("memory is", [run.megabytes for run in alone], "MB"),
        ):
            weights = 1.0 / np.array(values)  # relative errors
            fit, *_ = np.linalg.lstsq(terms * weights[:, None], np.ones(len(alone)), rcond=None)
            off = float(np.max(np.abs(terms @ fit * weights - 1.0)))
            print(
                f"{subject} about {fit[0]:.3g} + {fit[1]:.3g} · receivers + {fit[2]:.3g} · trials + {fit[3]:.3g} · trials · "
                f"receivers {unit}, within {100 * off:.0f} %"
            )


def draw(runs: list[MeasuredRun], picture: Path) -> None:
    """Three panels: deliveries a second and memory against trials, and what shards change."""
    receivers = sorted({run.receivers for run in runs})
    with panels(picture, 3, 13.0, 4.2) as (speed, memory, gain):
        for colour, count in zip(COLOURS, receivers, strict=False):
            line = [run for run in runs if run.shards == 1 and run.receivers == count]
            word = f"{count} receiver" + ("s" if count > 1 else "")
            for axes, values in ((speed, [run.rate for run in line]), (memory, [run.megabytes for run in line])):
                axes.loglog([run.trials for run in line], values, "o-", color=colour, markersize=4, label=word)
        low, first = min(run.trials for run in runs), min(run.rate for run in runs if run.shards == 1)
        high = max(run.trials for run in runs)
        speed.loglog([low, high], [first, first * high / low], ":", color=GREY, linewidth=1.0, label="linear")
        speed.set_ylim(top=2.5 * max(run.rate for run in runs))
        many = [run for run in runs if run.receivers == receivers[1]]
        for colour, trials in zip(COLOURS, sorted({run.trials for run in many if run.trials > 1}), strict=False):
            line = [run for run in many if run.trials == trials]
            base = _alone(many, trials)
            gain.plot(
                [run.shards for run in line],
                [run.rate / base for run in line],
                "o-",
                color=colour,
                markersize=4,
                label=f"{trials:,} trials",
            )
        gain.axhline(1.0, color=GREY, linewidth=1.0)
        gain.set_ylim(0.0, 1.25 * max(run.rate / _alone(many, run.trials) for run in many))
        gain.set_xticks(sorted({run.shards for run in runs}))
        for axes, title, x in (
            (speed, "Deliveries a second, 1 shard", "trials"),
            (memory, "Memory of all processes, MB, 1 shard", "trials"),
            (gain, f"Rate over that of 1 shard, {many[0].receivers} receivers", "shards"),
        ):
            axes.set_title(title)
            axes.set_xlabel(x)
            axes.legend()
        for which in (memory.yaxis.set_major_formatter, memory.yaxis.set_minor_formatter):
            which(lambda value, _: f"{value:,.0f}" if f"{value:g}"[0] in "1257" else "")


def _alone(runs: list[MeasuredRun], trials: int) -> float:
    """The rate of this number of trials in one shard."""
    return next(run.rate for run in runs if run.shards == 1 and run.trials == trials)


def load_now() -> str:
    """How busy the machine is."""
    return " ".join(f"{load:.1f}" for load in os.getloadavg())


def main(quick: bool, picture: Path | None) -> None:
    """All of it."""
    grid = QUICK if quick else FULL
    print(f"{os.cpu_count()} cores, load before: {load_now()}")
    print("trials  receivers  shards    slots   slots/s  deliveries/s   µs each  cores used  busiest process      MB")
    runs = []
    for point in grid.points:
        run = measure(*point, grid.seconds)
        runs.append(run)
        print(
            f"{run.trials:>6} {run.receivers:>10} {run.shards:>7} {run.slots:>8,} {run.slots_per_second:>9,.0f} "
            f"{run.rate:>13,.0f} {run.cost:>9.3f} {run.cores:>11.2f}  {run.busiest:<11} {run.fraction:.2f} "
            f"{run.megabytes:>9,.0f}",
            flush=True,
        )
    growth(runs)
    print(f"load after: {load_now()}")
    if picture is not None:
        draw(runs, picture)


if __name__ == "__main__":
    pictures = [Path(word) for word in sys.argv[1:] if not word.startswith("--")]
    main("--quick" in sys.argv, pictures[0] if pictures else None)
