"""Each benchmark runs to its end with small sizes, and prints what can be read."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
COLUMNS = {"what", "measured", "yardstick", "at_least", "aim", "holds"}
NUMBER = r"-?[\d,]*\.?\d+"


def quick(name: str, *words: str) -> str:
    """What a benchmark prints with small sizes."""
    command = [sys.executable, str(BENCHMARKS / f"{name}.py"), "--quick", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.thorough
def test_the_kernels_are_compared_with_numpy() -> None:
    """Two lines for each of four cases, and how much faster the first is."""
    output = quick("kernels")
    assert len(re.findall(r"^    numpy.* [\d,]+ ns a trial-slot, +[\d.]+ times PCG64$", output, re.MULTILINE)) >= 4
    assert len(re.findall(r" times PCG64$", output, re.MULTILINE)) == 8
    assert len(re.findall(r"^    [\d.]+ times as fast$", output, re.MULTILINE)) == 4


@pytest.mark.thorough
def test_the_latency_is_that_of_the_real_router() -> None:
    """Small peers that follow the protocol exchange all packets through it, and through raw Zenoh."""
    [line] = quick("latency", "--json").splitlines()
    row = json.loads(line)
    assert row.keys() == COLUMNS
    assert re.fullmatch(f"median {NUMBER} µs, 99 % {NUMBER} µs", row["measured"])
    assert re.fullmatch(r"raw Zenoh: median [\d,]+ µs, 99 % [\d,]+ µs", row["yardstick"])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "line"),
    [
        pytest.param("montecarlo", r"^\(c\) two workers against one, .*: [\d.]+ times as fast", id="montecarlo"),
        pytest.param(
            "links", r"^    gilbert-elliott +router +\d+ µs a slot, .* [\d,]+ slots/s, [\d.]+ times slower$", id="links"
        ),
        pytest.param("scale", r"^ +10 +2 +1 +[\d,]+ +[\d,]+ +[\d,]+ +[\d.]+ +[\d.]+  \w+ +[\d.]+ +\d+$", id="scale"),
        pytest.param(
            "connections",
            r"^ +1 trials, two routers, with certificates: +[\d,]+ slots/s; ratio [\d.]+$",
            id="connections",
        ),
        pytest.param(
            "transport",
            r"^report of 100 slots, 1.7 MB: straight, a Unix socket: [\d,]+ µs of the processor a message$",
            id="transport",
        ),
        pytest.param(
            "compare",
            r"^theory, 2000 slots, 20 at a time: independent [\d.]+ µs a slot, chain [\d.]+ µs a slot$",
            id="compare",
        ),
    ],
)
def test_a_benchmark_runs_to_its_end(name: str, line: str) -> None:
    """The line that it measures last is there."""
    assert re.search(line, quick(name), re.MULTILINE)
