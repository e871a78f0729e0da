"""How fast trials are simulated, as ratios that hold on any machine, measured in one run.

    python benchmarks/montecarlo.py [--quick]

(a) the paper's study, 1000 trials × 86 400 slots × 9 values of μ_d, covariance only, by two workers: projected from two parts
    of its slots, because what does not depend on the slots, such as the start of the workers, is paid once;
(b) the full simulation against a loop over trials with filterpy's KalmanFilter (`pip install filterpy==1.4.5`);
(c) two workers against one.

benchmarks/kernels.py compares the full simulation with the drawing of as many random numbers. Times of one core are processor
times, medians of several rounds.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from processes import children_seconds
from table import Row, judged, load, run_alone

from evedrop.scenario.loading import checked
from evedrop.scenario.loading import load as load_scenario
from evedrop.scenario.tables import Scenario
from evedrop.simulate.montecarlo import Plan, simulate
from evedrop.simulate.simulation import Mode, Simulation
from evedrop.studies.sweep import sweep_over

COMMAND_SCENARIO = "eavesdroppers"
TRIALS = 2000  # side by side, as many as a worker takes at once
ROUNDS = 5
PAPER_SLOTS = 86_400
STUDY_TRIALS = 1000

MICROGRID = """
title = "microgrid"
slots = 86400
[process]
A = [[1.0, 0.0], [0.0, 1.0]]
Q = [[1e-5, 0.0], [0.0, 1e-5]]
initial_covariance = [[1e-5, 0.0], [0.0, 1e-5]]
[encoding]
scheme = "innovation"
state_probability = 0.5
[legitimate]
link = { quality = 0.6 }
[eavesdroppers.smart]
strategy = "smart"
link = { quality = 0.6 }
"""


def vehicle(slots: int, trials: int) -> Scenario:
    """Two states, a legitimate estimator, one smart eavesdropper."""
    tables: dict[str, Any] = {
        "title": "two states",
        "slots": slots,
        "trials": trials,
        "process": {
            "A": [[1.0, 0.05], [0.0, 1.0]],
            "Q": [[1e-3, 0.0], [0.0, 1e-4]],
            "initial_covariance": [[1.0, 0.0], [0.0, 0.01]],
        },
        "encoding": {"scheme": "innovation", "state_probability": 0.3},
        "legitimate": {"link": {"quality": 0.9}},
        "eavesdroppers": {"smart": {"strategy": "smart", "link": {"quality": 0.9}}},
    }
    return checked(tables, "two states")


def processor_time(work: Callable[[], None]) -> float:
    """Seconds of this core."""
    start = time.process_time()
    work()
    return time.process_time() - start


def elapsed(work: Callable[[], object]) -> float:
    """Seconds on the clock."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def silent(_: object) -> None:
    """Ignore an event."""


def study(slots: int) -> float:
    """Seconds of the paper's study with some number of slots."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "microgrid.toml"
        file.write_text(MICROGRID, encoding="utf-8")
        grid = {"encoding.state_probability": [round(0.1 * i, 1) for i in range(1, 10)]}
        plan = Plan(Mode.COVARIANCE_ONLY, workers=2)
        out = Path(folder) / "out"
        return elapsed(lambda: sweep_over(file, {"slots": slots, "trials": STUDY_TRIALS}, grid, out, silent, plan))


def projected(few: int, less: float, many: int, more: float) -> float:
    """Seconds of all slots, from those of few and of many, on a straight line; in proportion if the many took no longer."""
    if more <= less:
        return more / many * PAPER_SLOTS
    return more + (more - less) / (many - few) * (PAPER_SLOTS - many)


def rows(quick: bool) -> Iterator[Row]:
    """(a), and the whole command."""
    few, many = (PAPER_SLOTS // part for part in ((400, 100) if quick else (20, 5)))
    pairs = [(study(few), study(many)) for _ in range(1 if quick else 3)]
    seconds = statistics.median(projected(few, less, many, more) for less, more in pairs)
    yield Row(
        f"the paper's study, {STUDY_TRIALS} trials × {PAPER_SLOTS:,} slots × 9 points, two workers, projected from "
        f"{few:,} and {many:,} slots",
        f"{seconds:.1f} s",
        f"measured, {many:,} slots: {statistics.median(more for _, more in pairs):.1f} s",
        "40 s",
        "20 s",
        judged(seconds <= 40, seconds <= 20),
    )
    yield command_over_pcg64(*((100, 100, 1) if quick else (2000, 2000, 5)))


def command_over_pcg64(slots: int, trials: int, rounds: int) -> Row:
    """The processor time of a whole command, with start, results and report, over PCG64 drawing as many random numbers."""
    scenario = load_scenario(COMMAND_SCENARIO)
    # ν, a γ of each receiver, and the noises of process and encoding.
    uniforms, normals = 1 + len(scenario.receivers), 2 * len(scenario.process.A)

    def draw() -> None:
        random = np.random.Generator(np.random.PCG64(1))
        for _ in range(slots):
            random.random((uniforms, trials))
            random.standard_normal((normals, trials))

    options = ("--slots", str(slots), "--trials", str(trials), "--workers", "1")
    pairs = [(command_time("montecarlo", COMMAND_SCENARIO, *options), processor_time(draw)) for _ in range(rounds)]
    ours, bare = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratio = statistics.median(whole / drawn for whole, drawn in pairs)
    return Row(
        f"the whole command `evedrop montecarlo {COMMAND_SCENARIO} {' '.join(options)}`, processor time",
        f"{ours:.2f} s, {ratio:.1f} × PCG64",
        f"PCG64 drawing the same numbers: {bare:.2f} s",
        "5 × PCG64",
        "3 × PCG64",
        judged(ratio <= 5, ratio <= 3),
    )


def command_time(*words: str) -> float:
    """The processor seconds of a command of Evedrop and of all processes that it started."""
    with tempfile.TemporaryDirectory() as folder:
        before = children_seconds()
        command = [sys.executable, "-m", "evedrop", *words, "--out", str(Path(folder) / "run")]
        status = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False).returncode
    if status not in {0, 1}:  # 1: an expectation of the scenario was not met
        raise RuntimeError(f"{' '.join(command)} ended with status {status}")
    return children_seconds() - before


def full(scenario: Scenario) -> None:
    """All slots of a batch, nothing written."""
    for _ in Simulation(scenario, range(TRIALS)).chunks():
        pass


def against_filterpy(slots: int, rounds: int) -> None:
    """(b)."""
    try:
        from filterpy.kalman import KalmanFilter  # type: ignore # noqa: PLC0415 - an extra
    except ImportError:
        print("(b) filterpy is not installed (pip install filterpy==1.4.5): not measured")
        return
    process = vehicle(slots, 1).process.process
    random = np.random.default_rng(1)
    trials = 3

    def loop() -> None:
        for _ in range(trials):
            filters = []
            for _ in range(2):
                kalman = KalmanFilter(dim_x=2, dim_z=2, dim_u=2)
                kalman.F, kalman.Q, kalman.H, kalman.B = process.A, process.Q, np.eye(2), np.eye(2)
                kalman.R, kalman.P = np.zeros((2, 2)), process.initial_covariance
                filters.append(kalman)
            legitimate, smart = filters
            x = random.standard_normal((2, 1))
            nothing = np.zeros((2, 2))
            for _ in range(slots):
                w = 0.03 * random.standard_normal((2, 1))
                x = process.A @ x + w
                state, gamma, gamma_e = random.random(3) < (0.3, 0.9, 0.9)
                if gamma and not state:
                    legitimate.predict(u=w, Q=nothing)
                else:
                    legitimate.predict()
                if gamma and state:
                    legitimate.update(x)
                smart.predict()
                if gamma_e and state:
                    smart.update(x)

    theirs = statistics.median(processor_time(loop) for _ in range(rounds)) / slots / trials * 1e9
    scenario = vehicle(slots, TRIALS)
    ours = statistics.median(processor_time(lambda: full(scenario)) for _ in range(rounds)) / slots / TRIALS * 1e9
    print(
        f"(b) a loop over trials with filterpy: {theirs:,.0f} ns a trial-slot, {theirs / ours:.0f} times ours; wanted: 100"
    )


def two_workers(slots: int, trials: int, rounds: int) -> None:
    """(c)."""
    scenario = vehicle(slots, trials)
    ratios, costs = [], []
    for _ in range(rounds):
        taken, spent = [], []
        for workers in (1, 2):
            with tempfile.TemporaryDirectory() as folder:
                before = sum(os.times()[:4])
                out, plan = Path(folder) / "run", Plan(workers=workers)
                taken.append(elapsed(partial(simulate, scenario, out, silent, plan)))
                spent.append(sum(os.times()[:4]) - before)
        ratios.append(taken[0] / taken[1])
        costs.append(spent[1] / spent[0])
    shown = ", ".join(f"{ratio:.2f}" for ratio in ratios)
    print(
        f"(c) two workers against one, {trials} trials × {slots} slots, start to last row: {statistics.median(ratios):.2f} "
        f"times as fast ({shown}), for {statistics.median(costs):.2f} times the processor time; wanted: 1.8 on two idle "
        f"cores (load now {load()})"
    )


def main(quick: bool) -> None:
    """All of it."""
    print(f"{os.cpu_count()} cores, load {load()} before the start")
    for row in rows(quick):
        print(f"(a) {row.what}: {row.measured} ({row.yardstick}); wanted: {row.at_least}")
    against_filterpy(100 if quick else 1000, 1 if quick else ROUNDS)
    two_workers(*((100, 2000, 1) if quick else (2000, 8000, 3)))


if __name__ == "__main__":
    if "--json" in sys.argv:
        run_alone(rows)
    else:
        main("--quick" in sys.argv)
