"""How long a whole comparison takes, what the Bayesian eavesdropper costs compared with the smart one, and theory behind chains.

    python benchmarks/compare.py [--quick]

Processor seconds where two things are compared, in turns, so that a busy machine slows both; wall seconds of the comparison.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path

from evedrop import compare
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Trajectory
from evedrop.model.receiver import Reception
from evedrop.model.schemes import scheme_of
from evedrop.model.slot.link import Link
from evedrop.model.streams import Batch
from evedrop.scenario.loading import load
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import expectations_of
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.workers import usable_cores

MARGINAL = "bayesian"
"""The shipped scenario that all of it is measured on: two states, marginally stable."""
BURSTS = {"legitimate.link": {"loss": {"model": "gilbert-elliott", "p": 0.05, "r": 0.3}}, "expect": []}


def whole(trials: int, slots: int) -> None:
    """Wall seconds of all schemes against all adversaries."""
    workers = usable_cores()
    with tempfile.TemporaryDirectory() as folder:
        started = time.monotonic()
        comparison = compare(MARGINAL, trials=trials, slots=slots, out=Path(folder) / "run", plan=Plan(workers=workers))
        seconds = time.monotonic() - started
    played = sum(cell.ratio is not None for scheme in comparison.schemes.values() for cell in scheme.cells.values())
    print(f"compare, {trials} trials of {slots} slots, {workers} workers: {seconds:.1f} s for {played} pairs")


def steps(trials: int, slots: int, rounds: int) -> None:
    """Microseconds a slot of the Bayesian and of the smart eavesdropper, on the same packets."""
    scenario = load(MARGINAL, {"slots": slots, "expect": []})
    heard = packets(scenario, Batch(slots, trials, 0))
    taken: dict[str, list[float]] = {"smart": [], "bayesian": []}
    for _ in range(rounds):
        for strategy, times in taken.items():
            times.append(read(scenario, strategy, Batch(slots, trials, 0), heard))
    ratio = statistics.median(a / b for a, b in zip(taken["bayesian"], taken["smart"], strict=True))
    each = ", ".join(f"{name} {statistics.median(times):.0f} µs a slot" for name, times in taken.items())
    print(f"reading packets, {trials} trials of {slots} slots: {each}; bayesian is {ratio:.1f} times smart")


def packets(scenario: Scenario, batch: Batch) -> list[Reception]:
    """What arrives at an eavesdropper in every slot."""
    keys, process = StreamKeys.from_scenario(scenario), scenario.process.process
    scheme = scheme_of(process, scenario.encoding.spec)
    encoder = scheme.encoder(keys.secret(scheme.secret_streams), batch)
    trajectory = Trajectory(process, keys.process, batch)
    schedule = scenario.schedule("smart")
    fates = Link(schedule, "smart", keys.link("smart", schedule), batch).fates(range(batch.slots)).in_time
    receptions = []
    for k in range(batch.slots):
        x = trajectory.advance()
        receptions.append(Reception(fates[k], encoder.encode(k, x, trajectory.predicted).z))
    return receptions


def read(scenario: Scenario, strategy: str, batch: Batch, heard: list[Reception]) -> float:
    """Microseconds of the processor a slot."""
    keys = StreamKeys.from_scenario(scenario).eavesdropper(strategy, strategy, {})
    receiver = STRATEGIES[strategy](Knowledge(scenario.process.process, scenario.encoding.mu_d, {}, keys), batch)
    belief, started = receiver.prior(), time.process_time()
    for k, packet in enumerate(heard):
        belief = receiver.step(k, belief, packet)
    return (time.process_time() - started) / len(heard) * 1e6


def theory(slots: int, rounds: int) -> None:
    """Microseconds a slot of the legitimate estimator's theory, behind a chain and behind independent losses."""
    taken: dict[str, list[float]] = {"independent": [], "chain": []}
    for _ in range(rounds):
        for name, changes in (("independent", {}), ("chain", BURSTS)):
            expected = expectations_of(load(MARGINAL, {"slots": slots, **changes}))["legitimate"]
            started = time.process_time()
            stream = expected.stream()
            for _ in range(slots // 20):  # as a recorder asks for them, some slots at a time
                stream.next_traces(20)
            taken[name].append((time.process_time() - started) / slots * 1e6)
    each = ", ".join(f"{name} {statistics.median(times):.2f} µs a slot" for name, times in taken.items())
    print(f"theory, {slots} slots, 20 at a time: {each}")


def main(quick: bool) -> None:
    """All of it."""
    rounds = 1 if quick else 5
    whole(20 if quick else 200, 200 if quick else 2000)
    steps(1000, 300 if quick else 2000, rounds)
    theory(2000 if quick else 20_000, rounds)


if __name__ == "__main__":
    main("--quick" in sys.argv)
