"""Results folders of runs that did not complete are read as far as they go."""

from __future__ import annotations

import json
from pathlib import Path

from evedrop import montecarlo
from evedrop.results.reading import Results
from tests.disturbed import LOOP, disturbed


def test_inputs_are_there_although_the_metrics_are_older(tmp_path: Path) -> None:
    """Those of before the first slot have no controller; a run that is killed soon after has rows."""
    scenario = tmp_path / "loop.toml"
    scenario.write_text(disturbed(5, more=LOOP.format("period = 1")), encoding="utf-8")
    montecarlo(scenario, out=tmp_path / "out")
    path = tmp_path / "out" / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "controller": None}))
    inputs = Results.read(tmp_path / "out").inputs
    assert inputs is not None
    assert len(inputs) == 5
