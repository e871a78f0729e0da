import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from evedrop import load_results, montecarlo, run
from evedrop.cli.commands.view import _recording
from evedrop.cli.main import status_of
from evedrop.errors import UsageError
from evedrop.results.reading import Results
from evedrop.score.verdict import distance_text, times_text
from evedrop.show.view.recording import ViewRecording
from evedrop.show.view.scene_slots import replay
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from tests.show.view.read_back import events, lane, rows

SLOTS = 120
EVE = {"eve": {"strategy": "naive", "link": {"quality": 0.7}}}


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
    np.testing.assert_allclose([shown[k][0] for k in above], [0.5 * np.log10(expected[k]) for k in above], rtol=1e-12)


def test_the_view_of_a_run_in_progress_shows_the_slots_that_all_its_tables_have(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although its tables grow while they are read, one after the other."""
    read_table, reads = Results._table, 0

    def growing(self: Results, name: str, schema_like: Callable[[pa.Schema], pa.Schema]) -> pa.Table:
        nonlocal reads
        reads += 1
        return read_table(self, name, schema_like).filter(pc.field("slot") < 60 + 10 * reads)

    monkeypatch.setattr(Results, "_table", growing)
    path = replay(study, tmp_path / "r.rrd")
    assert reads == 2
    assert max(rows(path, "error/naive", "Scalars:scalars")) == 69


@pytest.mark.parametrize("wanted", [("--picture", "p.png"), ("--video", "v.gif")], ids=["picture", "video"])
def test_a_slot_is_chosen_before_the_recording_that_must_have_it(
    wanted: tuple[str, str], study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run in progress may have more slots than its recording; none of these is drawn."""
    folder, calls = shutil.copytree(study, tmp_path / "run", ignore=shutil.ignore_patterns("*.rrd")), list[str]()
    monkeypatch.setattr("evedrop.show.view.telling_slot.telling_slot", lambda _: calls.append("slot"))
    monkeypatch.setattr("evedrop.show.view.scene_slots.replay", lambda *_: calls.append("recording"))
    monkeypatch.setattr("evedrop.show.view.picture.picture_apart", lambda *_: [])
    monkeypatch.setattr("evedrop.show.view.video.video_apart", lambda *_: [])
    assert status_of(["view", str(folder), wanted[0], str(tmp_path / wanted[1])]) == 0
    assert calls == ["slot", "recording"]


def test_the_view_of_an_interrupted_study_names_the_trials_that_it_has(tmp_path: Path) -> None:
    """And not those that its scenario plans."""
    folder = montecarlo("eavesdroppers", trials=3, slots=512, out=tmp_path / "study").folder
    texts = {name: (folder / name).read_text(encoding="utf-8") for name in ("scenario.toml", "summary.json")}
    assert "trials = 3\n" in texts["scenario.toml"]
    (folder / "scenario.toml").write_text(texts["scenario.toml"].replace("trials = 3\n", "trials = 4000\n"))
    (folder / "summary.json").write_text(texts["summary.json"].replace('"complete"', '"interrupted"'))
    path = replay(folder)
    title = rows(path, "title", "TextDocument:text")
    assert all(text.endswith("means of 3 trials, everything else: the first of them") for (text,) in title.values())
    assert events(path)[0][-1].endswith("; curves of errors and tr P: means of 3 trials")


def test_distances_and_ratio_of_the_verdict_so_far_are_of_all_trials(tmp_path: Path) -> None:
    """As the table has them; of several trials, distances of some states are not known."""
    folder = montecarlo("eavesdroppers", trials=3, slots=512, out=tmp_path / "study").folder
    text = (folder / "summary.json").read_text(encoding="utf-8")
    (folder / "summary.json").write_text(text.replace('"complete"', '"interrupted"'))  # without a verdict at its end
    title = rows(replay(folder), "title", "TextDocument:text")
    table = [row for row in load_results(folder).slots.to_pylist() if row["slot"] >= 256]
    ours, smart = (
        float(np.mean([row["mean_squared_error"] for row in table if row["peer"] == name]))
        for name in ("legitimate", "smart")
    )
    said = title[511][0].replace("\\", "")
    off = (
        f"the estimator is {distance_text(ours**0.5)} off, the best eavesdropper (smart) {distance_text(smart**0.5)}: "
    )
    assert f"{off}{times_text(smart / ours)}" in said
    folder = montecarlo("vehicle", trials=3, slots=512, out=tmp_path / "of two units").folder
    title = rows(replay(folder), "title", "TextDocument:text")
    said = title[max(k for k in title if k < 511)][0].replace("\\", "")
    assert re.search(
        r"the best eavesdropper \(smart\) has [0-9,.]+ × (\[.*\] )?the estimator's squared error, so far", said
    )


@pytest.mark.parametrize(
    ("scheme", "live"),
    [
        ("scheduled", False),
        ("withholding", False),
        ("scheduled", True),
        pytest.param("withholding", True, marks=pytest.mark.long),
    ],
    ids=["scheduled in memory", "withholding in memory", "scheduled live", "withholding live"],
)
def test_silence_is_shown_as_silence(scheme: str, live: bool, tmp_path: Path) -> None:
    """In the sensor's lane and in every receiver's, and nowhere else: as the tables have it."""
    changes: dict[str, Any] = {"encoding": {"scheme": scheme, "threshold": 3}, "eavesdroppers": EVE, "slots": SLOTS}
    if scheme == "withholding":
        changes["encoding"] = {"scheme": scheme, "state_probability": 0.5}
    else:
        changes["acknowledgements"] = {"link": {"quality": 0.9}}
    if live:
        results = run("eavesdroppers", trials=2, out=tmp_path / "run", view="web", **changes)
        recording = results.folder / "recording.rrd"
    else:
        results = montecarlo("eavesdroppers", trials=2, out=tmp_path / "run", **changes)
        recording = replay(results.folder)
    last = rows(recording, "title", "TextDocument:text")[SLOTS - 1]
    assert results.verdict is not None
    assert str(last[0]).replace("\\", "").startswith(f"#### {results.verdict.sentence}\n")
    table = [row for row in results.trials.to_pylist() if row["trial"] == 0]
    kinds = {"nothing": "silent"}
    for peer, path in (("legitimate", "1_legitimate"), ("eve", "2_eve")):
        its = sorted((row for row in table if row["peer"] == peer), key=lambda row: row["slot"])
        sent = [kinds.get(row["sent"], row["sent"]) for row in its]
        assert 10 < sent.count("silent") < SLOTS - 10
        assert lane(recording, "packets/0_sent", SLOTS) == sent
        done = ["silent" if word == "silent" else row["action"] for word, row in zip(sent, its, strict=True)]
        assert lane(recording, f"packets/{path}", SLOTS) == done
        assert {"silent", "dropped", "state"} <= set(done)


def test_nothing_recorded_is_said(tmp_path: Path) -> None:
    """A study of covariances alone has no trial to show, and says so."""
    montecarlo("eavesdroppers", trials=2, slots=10, out=tmp_path / "run", plan=Plan(Mode.COVARIANCE_ONLY))
    with pytest.raises(UsageError, match="no recorded trial"):
        replay(tmp_path / "run")


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_a_recording_that_is_cut_short_is_not_kept(
    error: type[BaseException], study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C, or any error: it would be shown ever after as that of the whole run."""
    shutil.copytree(study, tmp_path / "run", ignore=shutil.ignore_patterns("*.rrd"))

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(ViewRecording, "note", fail)
    monkeypatch.setattr(ViewRecording, "conclude", fail)
    with pytest.raises(error):
        replay(tmp_path / "run")
    assert not [*(tmp_path / "run").glob("*.rrd*")]


def test_a_folder_that_cannot_be_written_is_told(study: Path, tmp_path: Path) -> None:
    """In one line, with what to do."""
    with pytest.raises(UsageError, match=r"cannot be written \(No such file or directory\); make the folder writable"):
        replay(study, tmp_path / "missing" / "run.rrd")


def test_a_finished_run_in_a_folder_that_may_only_be_read_is_shown(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a recording elsewhere; one in a writable folder stays there, and is the one that is shown again."""
    run = tmp_path / "run"
    shutil.copytree(study, run, ignore=shutil.ignore_patterns("*.rrd"))
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert _recording(run, tmp_path, finished=True) == tmp_path / "recording.rrd"
    assert not (run / "recording.rrd").exists()
    monkeypatch.undo()
    assert _recording(run, tmp_path, finished=False) == tmp_path / "recording.rrd"
    assert not (run / "recording.rrd").exists()
    kept = _recording(run, tmp_path, finished=True)
    written = kept.stat().st_mtime_ns
    assert kept == run / "recording.rrd" == _recording(run, tmp_path, finished=True)
    assert kept.stat().st_mtime_ns == written


def one_action(table: pa.Table) -> pa.Table:
    """Every action another word."""
    words = pa.array(["guessed"] * table.num_rows).dictionary_encode().cast(pa.dictionary(pa.int8(), pa.string()))
    return table.set_column(table.schema.get_field_index("action"), "action", words)


OTHER: dict[str, tuple[str, Callable[[pa.Table], pa.Table], str]] = {
    "other columns": ("trials", lambda table: table.drop_columns(["x_hat"]), "differs in x_hat"),
    "slots cut short": ("slots", lambda table: table.slice(0, 40), "do not have the same slots of"),
    "an unknown action": ("trials", one_action, "unknown action guessed"),
}


@pytest.mark.parametrize("case", OTHER)
def test_tables_that_do_not_fit_are_refused(case: str, study: Path, tmp_path: Path) -> None:
    """A table of another version, one cut short, and unknown words: one line, and no recording is left."""
    name, change, message = OTHER[case]
    folder = tmp_path / "run"
    shutil.copytree(study, folder, ignore=shutil.ignore_patterns("*.rrd"))
    pq.write_table(change(pq.read_table(folder / f"{name}.parquet")), folder / f"{name}.parquet")
    with pytest.raises(UsageError, match=message) as told:
        replay(folder)
    assert "\n" not in str(told.value)
    assert not (folder / "recording.rrd").exists()


def test_another_process_is_refused(study: Path, tmp_path: Path) -> None:
    """Tables of two states with a scenario of one: the message comes at once; a recording would never be finished."""
    changes: dict[str, Any] = {"process__A": [[1.0]], "process__Q": [[1e-3]], "process__initial_covariance": [[1.0]]}
    folder = montecarlo("eavesdroppers", trials=2, slots=SLOTS, out=tmp_path / "run", **changes).folder
    shutil.copy(study / "trials.parquet", folder)
    with pytest.raises(UsageError, match=r"trials\.parquet has 2 states and scenario\.toml 1; run the scenario again"):
        replay(folder)
