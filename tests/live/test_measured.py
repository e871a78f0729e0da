"""The scenario `measured`, live and in memory: a filtering sensor whose Q is singular, and the whole suite of eavesdroppers."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from evedrop.cli.api import run
from evedrop.results.diff import difference
from evedrop.results.reading import Results
from evedrop.scenario.loading import checked
from evedrop.scenario.progress_events import silent
from evedrop.scenarios import shipped
from evedrop.simulate.montecarlo import Plan, simulate
from tests.builders import digests_of


@pytest.mark.thorough
def test_a_live_run_is_the_one_in_memory(tmp_path: Path) -> None:
    """Digests of all receivers, and every number of the tables."""
    tables = tomllib.loads(shipped()["measured"].read_text(encoding="utf-8"))
    scenario = checked({**tables, "slots": 120, "trials": 3, "expect": []}, "measured")
    live = run(scenario, out=tmp_path / "live")
    simulate(scenario, tmp_path / "memory", silent, Plan(workers=1))
    memory = Results.read(tmp_path / "memory")
    assert live.summary["ended"] == "complete"
    assert len(digests_of(live)) == 7
    assert digests_of(live) == digests_of(memory)
    assert difference(live, memory).same
