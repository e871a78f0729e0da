"""The exact simulation of trials with the C kernels and with numpy, side by side, over PCG64 drawing as many numbers.

    python benchmarks/kernels.py [--quick]
    python benchmarks/kernels.py --json [--quick]     # the rows of `make bench`, with the kernels in use alone

Each measurement is a process of its own, of one thread, and the kernels take turns, so that a busy machine slows both. Times are
processor times, medians of several rounds; the ratios hold on any machine. One line for each case:

- legitimate, smart and naive, two states, 2000 trials: states, packets, beliefs and their digests;
- the same with scores, verdicts and histograms, as `evedrop montecarlo` keeps them;
- the same with one trial, as a live run has it;
- 50 states, 20 trials.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from table import Row, judged, load, run_alone

from evedrop.model.kernels.choice import KERNELS
from evedrop.names import KERNELS_VARIABLE
from evedrop.scenario.loading import checked
from evedrop.scenario.tables import Scenario
from evedrop.simulate.simulation import Mode, Simulation
from evedrop.simulate.trials import TrialsTask, carry_out

ROUNDS = 5
Case = tuple[str, int, int, int]
"""A name, the states, the trials side by side, and the slots."""


def cases(quick: bool) -> list[Case]:
    """What is measured."""
    part = 16 if quick else 1
    return [
        ("simulated", 2, 2000 // part, 512 // part),
        ("simulated and scored", 2, 2000 // part, 512 // part),
        ("one trial", 2, 1, 8192 // part),
        ("50 states", 50, 20 // min(part, 4), 96 // part),
    ]


def scenario_of(n: int, trials: int, slots: int) -> Scenario:
    """A legitimate estimator, a smart and a naive eavesdropper."""
    A = np.eye(n) + 0.05 * np.diag(np.ones(n - 1), 1)
    tables: dict[str, Any] = {
        "title": "kernels",
        "slots": slots,
        "trials": trials,
        "process": {"A": A.tolist(), "Q": (1e-3 * np.eye(n)).tolist(), "initial_covariance": np.eye(n).tolist()},
        "encoding": {"scheme": "innovation", "state_probability": 0.3},
        "legitimate": {"link": {"quality": 0.9}},
        "eavesdroppers": {name: {"strategy": name, "link": {"quality": 0.9}} for name in ("smart", "naive")},
    }
    return checked(tables, "kernels")


def processor_time(work: Callable[[], object]) -> float:
    """Seconds of the processor."""
    start = time.process_time()
    work()
    return time.process_time() - start


def drawn(n: int, trials: int, slots: int) -> None:
    """ν, the γ of three links, and two noises of n states, by PCG64."""
    random = np.random.Generator(np.random.PCG64(1))
    for _ in range(slots):
        random.random((4, trials))
        random.standard_normal((2 * n, trials))


def simulated(scenario: Scenario) -> None:
    """All slots of all trials, with their digests."""
    for _ in Simulation(scenario, range(scenario.trials)).chunks():
        pass


def scored(scenario: Scenario) -> None:
    """The same, and what `evedrop montecarlo` keeps of them."""
    carry_out(
        TrialsTask(scenario.model_dump(mode="json"), 0, scenario.trials, Mode.EXACT), lambda _: None, lambda: False
    )


def measured(quick: bool) -> dict[str, Any]:
    """In a process of its own: the kernels in use, and of each case the seconds of the simulation and of PCG64."""
    measurements: dict[str, Any] = {"kernels": KERNELS, "cases": {}}
    for name, n, trials, slots in cases(quick):
        scenario = scenario_of(n, trials, slots)
        work = scored if "scored" in name else simulated
        work(scenario_of(n, trials, max(1, slots // 16)))  # so that nothing is imported while it counts
        drawn(n, 1, 1)
        both = partial(work, scenario), partial(drawn, n, trials, slots)
        measurements["cases"][name] = [processor_time(work_of) for work_of in both]
    return measurements


def child(kernels: str, quick: bool) -> dict[str, Any]:
    """Measure with some kernels, in a process of one thread."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment.pop(KERNELS_VARIABLE, None)
    if kernels:
        environment[KERNELS_VARIABLE] = kernels
    command = [sys.executable, __file__, "--measure", *(["--quick"] if quick else [])]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    measurements: dict[str, Any] = json.loads(done.stdout)
    return measurements


def against_random_numbers(rounds: Sequence[dict[str, Any]], case: Case) -> tuple[float, float, float]:
    """Nanoseconds a trial-slot of a case and of PCG64, and the ratio."""
    name, _, trials, slots = case
    times = [measurements["cases"][name] for measurements in rounds]
    ours, theirs = (statistics.median(column) / trials / slots * 1e9 for column in zip(*times, strict=True))
    return ours, theirs, statistics.median(seconds / bare for seconds, bare in times)


def rows(quick: bool) -> Iterator[Row]:
    """The exact simulation of two states and of fifty, with the kernels that are in use."""
    two, *_, fifty = cases(quick)
    rounds = [child("", quick) for _ in range(1 if quick else ROUNDS)]
    ours, bare, ratio = against_random_numbers(rounds, two)
    yield Row(
        f"Monte Carlo, exact, with digests: legitimate, smart and naive, n = 2, {two[2]} trials",
        f"{ours:,.0f} ns a trial-slot, {ratio:.2f} × PCG64",
        f"PCG64 drawing the same numbers: {bare:,.0f} ns",
        "4 × PCG64",
        "2.5 × PCG64",
        judged(ratio <= 4, ratio <= 2.5),
    )
    ours, _, _ = against_random_numbers(rounds, fifty)
    cubic = fifty[1] ** 3  # ns at a billion operations a second
    yield Row(
        f"the same with n = {fifty[1]}, {fifty[2]} trials",
        f"{ours / 1e6:.3f} ms a trial-slot",
        f"n³ operations at 1 Gflop/s: {cubic / 1e6:.3f} ms",
        "0.3 ms",
        f"{cubic / 1e6:.3f} ms",
        judged(ours <= 0.3e6, ours <= cubic),
    )


def main(quick: bool) -> None:
    """Both kinds of kernels in turns, and what each case takes."""
    print(f"{os.cpu_count()} cores, load {load()} before the start")
    rounds = [[child(kernels, quick) for kernels in ("", "numpy")] for _ in range(1 if quick else ROUNDS)]
    for case in cases(quick):
        name, _, trials, slots = case
        print(f"{name}, {trials} trials × {slots} slots:")
        for of_kernels in zip(*rounds, strict=True):
            each, _, ratio = against_random_numbers(of_kernels, case)
            print(f"    {of_kernels[0]['kernels']:<46} {each:>12,.0f} ns a trial-slot, {ratio:>8.2f} times PCG64")
        gain = statistics.median(two["cases"][name][0] / compiled["cases"][name][0] for compiled, two in rounds)
        print(f"    {gain:.2f} times as fast")


if __name__ == "__main__":
    if "--measure" in sys.argv:
        print(json.dumps(measured("--quick" in sys.argv)))
    elif "--json" in sys.argv:
        run_alone(rows)
    else:
        main("--quick" in sys.argv)
