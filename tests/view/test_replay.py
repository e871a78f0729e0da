from pathlib import Path

import numpy as np
import pytest
from read_back import rows

from emulator import load_results, montecarlo
from emulator.errors import UsageError
from emulator.run.montecarlo import Plan
from emulator.run.simulation import Mode
from emulator.view.replay import replay

SLOTS = 120


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small study in memory, of two trials from the fourth on."""
    folder = tmp_path_factory.mktemp("study") / "run"
    montecarlo("eavesdroppers", trials=2, first_trial=3, slots=SLOTS, out=folder)
    return folder


def test_recording_of_a_study_holds_its_curves(study: Path) -> None:
    """A run made in memory gets the recording that a live run would have: errors averaged over its trials."""
    path = replay(study)
    table = load_results(study).slots.to_pylist()
    expected = {row["slot"]: row["mean_squared_error"] for row in table if row["peer"] == "naive"}
    shown = rows(path, "error/naive", "Scalars:scalars")
    above = [k for k in range(SLOTS) if expected[k] > 1e-2]
    assert len(above) > SLOTS / 2
    np.testing.assert_allclose([shown[k][0] for k in above], [np.log10(expected[k]) for k in above], rtol=1e-12)


def test_nothing_recorded_is_said(tmp_path: Path) -> None:
    """A study of covariances alone has no trial to show, and says so."""
    montecarlo("eavesdroppers", trials=2, slots=10, out=tmp_path / "run", plan=Plan(Mode.COVARIANCE_ONLY))
    with pytest.raises(UsageError, match="no recorded trial"):
        replay(tmp_path / "run")
