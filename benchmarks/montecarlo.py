"""How fast trials are simulated, as ratios that hold on any machine, measured in one run.

    python benchmarks/montecarlo.py [--quick]

(a) the paper's study, 1000 trials × 86 400 slots × 9 values of μ_d, covariance only, by two workers;
(b) the full simulation over numpy drawing as many uniforms and normals, on one core, and where the rest goes;
(c) the full simulation against a loop over trials with filterpy's KalmanFilter (`pip install filterpy==1.4.5`);
(d) two workers against one.

Times of one core are processor times, medians of several rounds. `--quick` takes a twentieth of the slots in (a) and says so.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from evedrop.loading import checked
from evedrop.memory.montecarlo import Plan, simulate
from evedrop.memory.simulation import Mode, Simulation
from evedrop.model.digest import DIGEST_BYTES, BeliefLog
from evedrop.scenario import Scenario
from evedrop.streams import Batch, BlockReader
from evedrop.studies.sweep import sweep_over

TRIALS = 2000  # side by side, as many as a worker takes at once
ROUNDS = 5

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
    """Take no news."""


def study(quick: bool) -> None:
    """(a)."""
    slots = 86_400 // (20 if quick else 1)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "microgrid.toml"
        file.write_text(MICROGRID)
        grid = {"encoding.state_probability": [round(0.1 * i, 1) for i in range(1, 10)]}
        plan = Plan(Mode.COVARIANCE_ONLY, workers=2)
        before = os.times()
        seconds = elapsed(
            lambda: sweep_over(file, {"slots": slots, "trials": 1000}, grid, Path(folder) / "out", silent, plan)
        )
        after = os.times()
    cpu = sum(after[:4]) - sum(before[:4])
    shortened = " (--quick: a twentieth of the paper's slots)" if quick else ""
    print(f"(a) 1000 trials × {slots:,} slots × 9 μ_d, covariance only, 2 workers{shortened}:")
    print(
        f"    {seconds:.1f} s, {cpu:.1f} s of processor, {cpu / (9000 * slots) * 1e9:.0f} ns a trial-slot; wanted: 40 s"
    )


def full(scenario: Scenario) -> None:
    """All slots of a batch, nothing written."""
    for _ in Simulation(scenario, range(TRIALS)).chunks():
        pass


def without_hashing(_: BeliefLog, __: int) -> np.ndarray[Any, Any]:
    """Digests of nobody."""
    return np.zeros((TRIALS, DIGEST_BYTES), np.uint8)


def drawn_by_numpy(slots: int) -> None:
    """γ, γᵉ, ν and both noises of two states, by PCG64."""
    random = np.random.Generator(np.random.PCG64(1))
    for _ in range(slots):
        random.random((3, TRIALS))
        random.standard_normal((4, TRIALS))


def drawn_by_us(slots: int) -> None:
    """The same from our own streams, addressed and reproducible."""
    batch = Batch(slots, TRIALS)
    uniform, normal = BlockReader(bytes(32), batch, 3), BlockReader(bytes(31) + b"1", batch, 4)
    for reader, draw in ((uniform, uniform.uniforms), (normal, normal.normals)):
        k = 0
        while k < slots:
            block = reader.block(k)
            draw(block)
            k = block.stop


def against_numpy(slots: int) -> float:
    """(b). Nanoseconds a trial-slot of the full simulation."""
    scenario = vehicle(slots, TRIALS)
    times: dict[str, list[float]] = {"full": [], "hashed": [], "numpy": [], "streams": []}
    for _ in range(ROUNDS):
        times["hashed"].append(processor_time(lambda: full(scenario)))
        with patch.object(BeliefLog, "_digest", without_hashing):
            times["full"].append(processor_time(lambda: full(scenario)))
        times["numpy"].append(processor_time(lambda: drawn_by_numpy(slots)))
        times["streams"].append(processor_time(lambda: drawn_by_us(slots)))
    cost = {name: statistics.median(of) / slots / TRIALS * 1e9 for name, of in times.items()}
    ratios = [one / other for one, other in zip(times["full"], times["numpy"], strict=True)]
    base = cost["numpy"]
    print(
        f"(b) full simulation, legitimate and one smart eavesdropper, {TRIALS} trials × {slots} slots, hashing excluded:"
    )
    print(
        f"    {cost['full']:.0f} ns a trial-slot, {statistics.median(ratios):.2f} times numpy's PCG64 drawing "
        f"3 uniforms and 4 normals ({base:.0f} ns); wanted: 6 or less"
    )
    rest = cost["full"] - cost["streams"]
    print(
        f"    of these, in units of numpy's: {cost['streams'] / base:.2f} our own streams (AES, and an inverse "
        f"distribution function that is the same everywhere), {rest / base:.2f} states, packets and two estimators with "
        f"their covariances, kept for results and digests; hashing would add {(cost['hashed'] - cost['full']) / base:.2f}"
    )
    return cost["full"]


def against_filterpy(ours: float, slots: int) -> None:
    """(c)."""
    try:
        from filterpy.kalman import KalmanFilter  # type: ignore # noqa: PLC0415 - an extra
    except ImportError:
        print("(c) filterpy is not installed (pip install filterpy==1.4.5): not measured")
        return
    process = vehicle(slots, 1).process.process
    random = np.random.default_rng(1)
    trials = 3

    def loop() -> None:
        for _ in range(trials):
            filters = []
            for _ in range(2):
                one = KalmanFilter(dim_x=2, dim_z=2, dim_u=2)
                one.F, one.Q, one.H, one.B = process.A, process.Q, np.eye(2), np.eye(2)
                one.R, one.P = np.zeros((2, 2)), process.initial_covariance
                filters.append(one)
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

    theirs = statistics.median(processor_time(loop) for _ in range(ROUNDS)) / slots / trials * 1e9
    print(
        f"(c) a loop over trials with filterpy: {theirs:,.0f} ns a trial-slot, {theirs / ours:.0f} times ours; wanted: 100"
    )


def two_workers(slots: int) -> None:
    """(d)."""
    scenario = vehicle(slots, 8000)
    ratios, costs = [], []
    for _ in range(3):
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
        f"(d) two workers against one, 8000 trials × {slots} slots, start to last row: {statistics.median(ratios):.2f} "
        f"times as fast ({shown}), for {statistics.median(costs):.2f} times the processor time; wanted: 1.8 on two idle "
        f"cores (load now {os.getloadavg()[0]:.1f})"
    )


def main(quick: bool) -> None:
    """All of it."""
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before the start")
    cost = against_numpy(500 if quick else 2000)
    against_filterpy(cost, 1000)
    two_workers(500 if quick else 2000)
    study(quick)


if __name__ == "__main__":
    main("--quick" in sys.argv)
