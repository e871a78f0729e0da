"""The tally of a shard is data: it comes back the same, and bytes in the file run nothing."""

from __future__ import annotations

import os
import pickle
import stat
from pathlib import Path

import pytest

from evedrop.errors import RunError
from evedrop.results.shard_score import dump_score, load_score, packed
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import tasks_of


class Evil:
    """An object that runs a command where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return os.mkdir, (str(self.path),)


def short(name: str) -> Scenario:
    """A shipped scenario, with few slots and trials."""
    return load(name, {"slots": 12, "trials": 5, "record_trials": 1, "expect": []})


@pytest.mark.parametrize("name", ["eavesdroppers", "microgrid", "measured", "acknowledged"])
def test_totals_come_back(name: str, tmp_path: Path) -> None:
    """With a controller, an application, a filter, acknowledgements; the file is private, and an empty folder has no tally."""
    scenario = short(name)
    (task,) = tasks_of(scenario, Mode.EXACT, 1)
    run_tally = task.carry_out(lambda _: None, lambda: False).blocks[0].run_tally
    dump_score(run_tally, tmp_path, scenario)
    (file,) = tmp_path.iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert packed(load_score(tmp_path, scenario)) == packed(run_tally)
    assert packed(load_score(tmp_path / "none", scenario)) == packed(RunTally.nothing(scenario, 5))


def test_a_file_of_somebody_else_runs_nothing(tmp_path: Path) -> None:
    """A pickle is refused in a sentence, as are bytes without a tally."""
    scenario = short("eavesdroppers")
    for content in (pickle.dumps(Evil(tmp_path / "ran")), b"", packed(5), packed([1])):
        (tmp_path / "score").write_bytes(content)
        with pytest.raises(RunError, match=r"score is damaged \(.*run again"):
            load_score(tmp_path, scenario)
    assert not (tmp_path / "ran").exists()
