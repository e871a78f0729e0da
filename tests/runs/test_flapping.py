"""Connections that flap: cut again and again and back at once. Nothing wrong gets into the results, and nothing is lost."""

from __future__ import annotations

import random
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from emulator.runs.ports import free_port
from tests.by_hand import as_if_undisturbed, by_hand
from tests.proxy import cable
from tests.runs.test_recovery import scenario_in

SLOTS = 1500
SEEDS = 50
GAPS = (0.0, 0.01, 0.03, 0.1)
OTHERS = """
[eavesdroppers.naive]
strategy = "naive"
link = { quality = 0.9 }
[eavesdroppers.suspicious]
strategy = "suspicious"
use_state = 0.8
use_innovation = 0.2
link = { quality = 0.9 }
[eavesdroppers.second]
strategy = "smart"
link = { quality = 0.7 }
"""


def flaps(seed: int, bursts: int = 2) -> list[float]:
    """Seconds to wait before each cut: some bursts of 5 to 20."""
    rng = random.Random(seed)  # noqa: S311 - no secret
    waits: list[float] = []
    for _ in range(bursts):
        count = rng.randint(5, 20)
        waits += [rng.uniform(0.2, 0.6), *(rng.choice(GAPS) for _ in range(count - 1))]
    return waits


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, SEEDS))])
def test_connections_that_flap_change_nothing(seed: int, tmp_path: Path) -> None:
    """All connections with the router are cut in bursts and back at once: digests and links are those in memory."""
    _, scenario = scenario_in(tmp_path, slots=SLOTS, pace=0.002, more=OTHERS)
    port = free_port()
    with ExitStack() as stack:
        wire = stack.enter_context(cable(port))
        run = stack.enter_context(by_hand(scenario, tmp_path, f"tcp/127.0.0.1:{port}"))
        run.write(**dict.fromkeys(("sensor", *scenario.receivers, "observer"), wire.endpoint))
        run.start()
        run.running(more_than=100)
        for wait in flaps(seed):
            time.sleep(wait)  # when it is cut is what is tested
            wire.flap()
        assert set(run.statuses().values()) == {0}
        as_if_undisturbed(run.summary, scenario, tmp_path / "memory")
        assert run.summary["outages"]
