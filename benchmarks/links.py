"""Speed of the loss models: of their fates alone, and of a live run behind each. Prints tables; about ten minutes.

    python benchmarks/links.py [--quick]      # --quick: two models live, within seconds

Machines are noisy: every model is measured in turn, over and over, and the median is quoted next to that of `bernoulli`.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

from live_run import measured, scenario_file
from processes import watch_cpu

from evedrop.model.links import LOSS_MODELS, loss_of
from evedrop.model.streams import Batch, BlockReader, root_of_seed, stream_key

WALK = [[0, 120.0, 0.0], [100_000, -60.0, 200.0]]
RADIO = {"model": "distance", "sender": [0, 0], "reference_snr": 80.0, "exponent": 3.0, "threshold": 10.0}
SPECS: dict[str, dict[str, Any]] = {
    "bernoulli": {"model": "bernoulli", "quality": 0.9},
    "gilbert-elliott": {"model": "gilbert-elliott", "p": 0.05, "r": 0.5, "good": 0.01, "bad": 0.9},
    "markov, 3 states": {
        "model": "markov",
        "transitions": [[0.98, 0.02, 0.0], [0.05, 0.9, 0.05], [0.0, 0.1, 0.9]],
        "loss": [0.0, 0.2, 0.9],
    },
    "markov, 64 states": {
        "model": "markov",
        "transitions": [[(1 + (i * j) % 7) / sum(1 + (i * k) % 7 for k in range(64)) for j in range(64)] for i in range(64)],
        "loss": [i / 63 for i in range(64)],
    },
    "pattern": {"model": "pattern", "outcomes": "1101"},
    "trace": {"model": "trace", "outcomes": "1101011110" * 10_000},
    "trace, random start": {"model": "trace", "outcomes": "1101011110" * 10_000, "random_start": True},
    "distance, fading": {**RADIO, "receiver": [120.0, 0.0]},
    "distance, shadowed, moving": {**RADIO, "receiver": WALK, "shadowing": 6.0, "shadowing_block": 100},
    "distance, all drawn again in every slot": {**RADIO, "receiver": WALK, "shadowing": 6.0},
}  # fmt: skip
KEY = stream_key(root_of_seed(1), "link/eve")


def fates_alone(trials: int, slots: int, chunk: int, rounds: int) -> None:
    """Microseconds a slot of drawing uniforms and deciding fates, some slots at a time."""
    taken: dict[str, list[float]] = {name: [] for name in SPECS}
    for _ in range(rounds):
        for name, spec in SPECS.items():
            loss = loss_of(spec)
            reader = BlockReader(KEY, Batch(slots, trials), loss.uniforms_per_slot)
            start = time.perf_counter()
            for first in range(0, slots, chunk):
                loss.fates(first, reader.uniforms(range(first, min(first + chunk, slots))))
            taken[name].append((time.perf_counter() - start) / slots * 1e6)
    print(f"fates alone, {trials} trials, {chunk} slots at a time, µs a slot:")
    for name, times in taken.items():
        print(f"    {name:<30} {statistics.median(times):8.2f}")


def live(trials: int, slots: int, rounds: int, names: Sequence[str]) -> None:
    """What the router of a run computes for a slot, four receivers behind one model, and slots a second of the whole.

    The whole run has theory in it, too: for chains more of it than for independent losses, for the others none.
    """
    speeds: dict[str, list[float]] = {name: [] for name in names}
    costs: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(rounds):
        for name in names:
            speed, cost = run(SPECS[name], trials, slots)
            speeds[name].append(speed)
            costs[name].append(cost / slots * 1e6)
    print(f"live, {trials} trials, four receivers:")
    most = []
    for name in names:
        slower = statistics.median(b / a for a, b in zip(speeds[name], speeds["bernoulli"], strict=True))
        dearer = statistics.median(a / b for a, b in zip(costs[name], costs["bernoulli"], strict=True))
        most.append(dearer)
        print(
            f"    {name:<30} router {statistics.median(costs[name]):6.0f} µs a slot, {dearer:.2f} times bernoulli's; "
            f"the whole run {statistics.median(speeds[name]):8,.0f} slots/s, {slower:.2f} times slower"
        )
    print(f"    no model makes the router more than {max(most):.2f} times slower than bernoulli")


def run(spec: dict[str, Any], trials: int, slots: int) -> tuple[float, float]:
    """Slots a second of one live run, and the seconds its router computed."""
    links = {"legitimate": {"link": {"loss": spec}}}
    names = ("naive", "suspicious", "smart")
    eavesdroppers: dict[str, dict[str, Any]] = {name: {"strategy": name, "link": {"loss": spec}} for name in names}
    eavesdroppers["suspicious"] |= {"use_state": 0.8, "use_innovation": 0.1}
    used: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        file = scenario_file(folder, {**links, "eavesdroppers": eavesdroppers, "slots": slots, "trials": trials})
        summary = measured(file, watch=lambda process, _: used.update(watch_cpu(process)))
    return float(summary["slots_per_second"]), used["router"]


def main(quick: bool) -> None:
    """All of it."""
    assert {spec["model"] for spec in SPECS.values()} == set(LOSS_MODELS)
    rounds = 3 if quick else 9
    fates_alone(1, 8192, 256, rounds)
    fates_alone(1000, 520, 104, rounds)
    if quick:
        live(1, 500, 1, ("bernoulli", "gilbert-elliott"))
    else:
        live(1, 20_000, 5, tuple(SPECS))
        live(1000, 3_000, 5, tuple(SPECS))


if __name__ == "__main__":
    main("--quick" in sys.argv)
