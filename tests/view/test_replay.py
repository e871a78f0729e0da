import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from read_back import rows

from emulator import load_results, montecarlo
from emulator.errors import UsageError
from emulator.runs.montecarlo import Plan
from emulator.runs.simulation import Mode
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


def one_action(table: pa.Table) -> pa.Table:
    """Every action another word."""
    words = pa.array(["guessed"] * table.num_rows).dictionary_encode().cast(pa.dictionary(pa.int8(), pa.string()))
    return table.set_column(table.schema.get_field_index("action"), "action", words)


OTHER: dict[str, tuple[str, Callable[[pa.Table], pa.Table], str]] = {
    "other columns": ("trials", lambda table: table.drop_columns(["x_hat"]), "differs in x_hat"),
    "slots cut short": ("slots", lambda table: table.slice(0, 40), "not the same slots of"),
    "an unknown action": ("trials", one_action, "unknown action guessed"),
}


@pytest.mark.parametrize("what", OTHER)
def test_tables_that_do_not_fit_are_refused(what: str, study: Path, tmp_path: Path) -> None:
    """A table of another version, one cut short, and words that nobody knows: one line, and no recording is left."""
    name, change, said = OTHER[what]
    folder = tmp_path / "run"
    shutil.copytree(study, folder, ignore=shutil.ignore_patterns("*.rrd"))
    pq.write_table(change(pq.read_table(folder / f"{name}.parquet")), folder / f"{name}.parquet")
    with pytest.raises(UsageError, match=said) as told:
        replay(folder)
    assert "\n" not in str(told.value)
    assert not (folder / "recording.rrd").exists()


def test_another_process_is_refused(study: Path, tmp_path: Path) -> None:
    """The tables of two states beside a scenario of one: a line at once, where a recording would never be finished."""
    one = {"process__A": [[1.0]], "process__Q": [[1e-3]], "process__initial_covariance": [[1.0]]}
    folder = montecarlo("eavesdroppers", trials=2, slots=SLOTS, out=tmp_path / "run", **one).folder
    shutil.copy(study / "trials.parquet", folder)
    with pytest.raises(UsageError, match=r"trials\.parquet has 2 states and scenario\.toml 1; run the scenario again"):
        replay(folder)
