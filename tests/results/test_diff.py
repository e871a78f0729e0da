"""Where two runs part: the first slot, trial and receiver, with both values."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from evedrop.cli.api import montecarlo
from evedrop.errors import UsageError
from evedrop.results.diff import difference
from evedrop.results.reading import Results, as_of
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Results]:
    """A run and others that differ from it in one respect."""
    folder = tmp_path_factory.mktemp("runs")
    changed: dict[str, dict[str, Any]] = {
        "whole": {},
        "again": {},
        "shorter": {"slots": 300},
        "weaker": {"eavesdroppers__smart__link__quality": 0.89},
        "other seed": {"seed": 12, "slots": 600},
        "later trials": {"first_trial": 2, "trials": 4},
        "far trials": {"first_trial": 100, "trials": 2},
        "recorded": {"record_trials": 6},
        "recorded and weaker": {"record_trials": 6, "eavesdroppers__smart__link__quality": 0.89},
    }
    return {
        name: montecarlo("eavesdroppers", out=folder / name, **{"slots": 600, "trials": 6, **changes})
        for name, changes in changed.items()
    }


def test_equal_runs_have_no_difference(runs: dict[str, Results]) -> None:
    """The same scenario twice; 6 trials of 4 receivers in 3 blocks."""
    result = difference(runs["whole"], runs["again"])
    assert result.same
    assert result.text == "no difference in 72 blocks: legitimate, naive, smart, suspicious"


def test_a_shorter_run_is_the_beginning_of_a_longer_one(runs: dict[str, Results]) -> None:
    """Blocks cut short are not compared by digest, and the text says so, and that there is more in one run."""
    for pair in (("whole", "shorter"), ("shorter", "whole")):
        result = difference(*(runs[name] for name in pair))
        assert result.same, result.text
        assert result.text.endswith(
            " (24 blocks in one run only) (24 blocks not compared, since a run may lack slots of them)"
        )
    cut = replace(runs["whole"], summary={**runs["whole"].summary, "ended": "interrupted"})
    assert difference(cut, cut).text.endswith("suspicious (24 blocks not compared, since a run may lack slots of them)")


def test_later_trials_are_compared_by_number(runs: dict[str, Results]) -> None:
    """Trials 2 to 5 alone are those of the whole run."""
    result = difference(runs["whole"], runs["later trials"])
    assert result.same
    assert result.text.startswith("no difference in 48 blocks")


def test_the_first_difference_is_named_with_both_values(runs: dict[str, Results]) -> None:
    """Slot, trial and receiver are those that a plain search through the tables finds."""
    a, b = runs["recorded"].trials.to_pylist(), runs["recorded and weaker"].trials.to_pylist()
    order = ("slot", "trial", "peer")
    pairs = zip(*(sorted(rows, key=lambda row: tuple(row[key] for key in order)) for rows in (a, b)), strict=True)
    first, other = next((x, y) for x, y in pairs if x["x_hat"] != y["x_hat"] or x["action"] != y["action"])
    result = difference(runs["recorded"], runs["recorded and weaker"])
    assert not result.same
    assert first["peer"] == "smart"
    assert result.text.startswith(f"first difference: slot {first['slot']}, trial {first['trial']}, smart: ")
    for name in ("action", "x_hat", "P"):
        assert (f"{name} {first[name]} against {other[name]}" in result.text) == (first[name] != other[name])


def test_a_difference_in_a_trial_that_is_not_recorded_is_placed(runs: dict[str, Results]) -> None:
    """Without rows, the digests still say which trial and which 256 slots, and what to do."""
    recorded = difference(runs["recorded"], runs["recorded and weaker"]).text
    trial = int(recorded.split("trial ")[1].split(",")[0])
    result = difference(runs["whole"], runs["weaker"])
    assert not result.same
    if trial:
        assert f"smart differs in trial {trial} within slots 0 to 255, not recorded" in result.text
        assert f"--first-trial {trial}" in result.text
    else:
        assert result.text.startswith("first difference: slot ")


def test_another_seed_differs_at_once(runs: dict[str, Results]) -> None:
    """Slot 0 of the first trial, and the values of both runs are told."""
    result = difference(runs["whole"], runs["other seed"])
    assert result.text.startswith("first difference: slot 0, trial 0, legitimate: ")
    assert " against " in result.text


def test_runs_without_a_trial_in_common_are_not_equal(runs: dict[str, Results]) -> None:
    """Nothing to compare is not the same as no difference."""
    result = difference(runs["whole"], runs["far trials"])
    assert not result.same
    assert "in common" in result.text


def test_a_run_cut_short_before_its_first_block_is_compared_by_its_rows(
    runs: dict[str, Results], tmp_path: Path
) -> None:
    """A run that ended at slot 20 has no digest; its recorded rows are compared, and the first difference is named."""
    short = tmp_path / "short"
    shutil.copytree(runs["whole"].folder, short)
    for name in ("trials", "digests"):
        table = pq.read_table(short / f"{name}.parquet")
        kept = table.filter(pc.less(table["slot"], 20)) if name == "trials" else table.slice(0, 0)
        pq.write_table(kept, short / f"{name}.parquet")
    difference_found = difference(Results.read(short), runs["again"])
    assert difference_found.same, difference_found.text
    assert difference_found.text.startswith("no difference in 80 rows of recorded trials; ")
    other = difference(Results.read(short), runs["other seed"])
    assert not other.same
    assert other.text.startswith("first difference: slot 0")


def test_a_folder_without_results_is_refused(tmp_path: Path, runs: dict[str, Results]) -> None:
    """No folder, an empty one, a broken summary and a broken table each say what is wrong."""
    with pytest.raises(UsageError, match="not a results folder"):
        Results.read(tmp_path / "nowhere")
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(UsageError, match="is not JSON"):
        Results.read(tmp_path)
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(UsageError, match="is not a run summary"):
        Results.read(tmp_path)
    (tmp_path / "summary.json").write_text((next(iter(runs.values())).folder / "summary.json").read_text())
    (tmp_path / "slots.parquet").write_text("PAR1")
    with pytest.raises(UsageError, match=r"slots\.parquet cannot be read"):
        _ = Results.read(tmp_path).slots


def test_only_the_changed_eavesdropper_has_another_digest(runs: dict[str, Results]) -> None:
    """Changing one eavesdropper's link changes no number of anybody else."""
    peers, others = (runs[name].summary["peers"] for name in ("whole", "weaker"))
    assert {name for name in peers if peers[name]["digest"] != others[name]["digest"]} == {"smart"}


def test_recorded_trials_are_those_asked_for(runs: dict[str, Results]) -> None:
    """`record_trials` trials from `first_trial` on, each with every slot of every receiver."""
    assert sorted(pc.unique(runs["recorded"].trials["trial"]).to_pylist()) == list(range(6))
    assert sorted(pc.unique(runs["later trials"].trials["trial"]).to_pylist()) == [2]
    assert runs["recorded"].trials.num_rows == 6 * 600 * 4


def rewritten(results: Results, folder: Path, table: str, change: Callable[[pa.Table], pa.Table]) -> Results:
    """A copy of a results folder with one table changed."""
    shutil.copytree(results.folder, folder)
    path = folder / f"{table}.parquet"
    pq.write_table(change(pq.read_table(path)), path)
    return Results.read(folder)


OTHER = {
    "a column less": ("trials", lambda table: table.drop_columns(["P"]), "differs in P"),
    "another type": (
        "trials",
        lambda table: table.set_column(0, "slot", table["slot"].cast("int32")),
        "differs in slot",
    ),
    "no lists": ("trials", lambda table: table.set_column(7, "x", table["slot"]), "differs in x"),
    "other columns": ("digests", lambda _: pa.table({"a": [1]}), "differs in peer, trial, block, digest"),
    "digests of an older version": (
        "digests",
        lambda table: table.set_column(3, "digest", pa.array([bytes(32)] * table.num_rows, pa.binary(32))),
        "its digests have 32 bytes, and those of this version, which cover other bytes, have 16: they cannot be compared",
    ),
    "empty cells": (
        "trials",
        lambda table: table.set_column(0, "slot", pa.array([None] * table.num_rows, pa.int64())),
        "has empty cells in slot",
    ),
}
"""What was done to a table → which table, how, and the expected message."""


@pytest.mark.parametrize("case", OTHER)
def test_a_table_of_another_version_is_refused(case: str, runs: dict[str, Results], tmp_path: Path) -> None:
    """Other columns, other types and empty cells: one line with the table, what differs, and a remedy."""
    table, change, message = OTHER[case]
    other = rewritten(runs["recorded"], tmp_path / "other", table, change)
    with pytest.raises(UsageError, match=message) as told:
        difference(runs["recorded"], other)
    assert str(told.value).startswith(f"{other.folder / table}.parquet ")
    assert "\n" not in str(told.value)


def test_other_tables_of_a_run_with_older_digests_can_be_read(runs: dict[str, Results], tmp_path: Path) -> None:
    """Only what needs its digests is refused, whichever of the two runs is the older one."""
    older = rewritten(runs["whole"], tmp_path / "older", *OTHER["digests of an older version"][:2])
    assert older.slots.equals(runs["whole"].slots)
    assert older.trials.equals(runs["whole"].trials)
    assert older.typed_summary.peers["smart"] == runs["whole"].typed_summary.peers["smart"]
    for pair in ((older, runs["whole"]), (runs["whole"], older), (older, older)):
        with pytest.raises(
            UsageError, match=r"older/digests\.parquet is not a table of this version .*; run the scenario"
        ):
            difference(*pair)


def test_runs_of_different_processes_differ(runs: dict[str, Results], tmp_path: Path) -> None:
    """One state against two: the first row is different, and no more is made of it."""
    changes: dict[str, Any] = {"process__A": [[1.0]], "process__Q": [[1e-3]], "process__initial_covariance": [[1.0]]}
    other = montecarlo("eavesdroppers", slots=600, trials=6, out=tmp_path / "one", **changes)
    result = difference(runs["whole"], other)
    assert not result.same
    assert result.text.startswith("first difference: slot 0, trial 0, legitimate: ")


def test_what_a_detector_says_is_compared(tmp_path: Path) -> None:
    """Watermark and statistic of recorded trials row by row, and those of all trials by the digest of the summary.

    Not with the digest of other trials.
    """
    loop: dict[str, Any] = {"trials": 3, "expect": []}
    original = montecarlo("replay-attack", out=tmp_path / "a", **loop)
    again = montecarlo("replay-attack", out=tmp_path / "b", **loop)
    assert difference(original, again).same
    fewer = montecarlo("replay-attack", out=tmp_path / "fewer", **{**loop, "trials": 2})
    assert fewer.summary["integrity"]["digest"] != original.summary["integrity"]["digest"]
    assert difference(original, fewer).same
    changed = shutil.copytree(tmp_path / "b", tmp_path / "changed")
    summary = json.loads((changed / "summary.json").read_text(encoding="utf-8"))
    summary["integrity"]["digest"] = "0" * 64
    (changed / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    result = difference(original, Results.read(changed))
    assert not result.same
    assert result.text.startswith("the digest of integrity differs, in trials not recorded; record all trials")
    lacking = replace(Results.read(changed), summary={**summary, "ended": f"killed{as_of('slot 0 in shard 1')}"})
    assert difference(original, lacking).same
    rows = original.inputs
    assert rows is not None
    place = rows.column_names.index("statistic")
    raised = pc.add(rows["statistic"], pc.cast(pc.greater(rows["slot"], 30), pa.float64()))
    pq.write_table(rows.set_column(place, "statistic", raised), changed / "inputs.parquet")
    result = difference(original, Results.read(changed))
    assert result.text.startswith("first difference: slot 31, trial 0, controller: statistic ")


def test_a_block_of_a_run_that_ended_early_may_go_beyond_its_slots(runs: dict[str, Results], tmp_path: Path) -> None:
    """Its receivers were ahead of the slots that all have reported, and had finished a block of which the other has a part."""
    early = rewritten(
        runs["whole"], tmp_path / "early", "digests", lambda digests: digests.filter(pc.less(digests["block"], 512))
    )
    early = replace(early, summary={**early.summary, "slots": 300, "ended": "interrupted"})
    for pair in ((early, runs["shorter"]), (runs["shorter"], early)):
        result = difference(*pair)
        assert result.same, result.text
        assert result.text.startswith("no difference in 24 blocks")


def test_studies_of_covariances_have_nothing_to_compare(tmp_path: Path) -> None:
    """They have neither digests nor rows of trials, so they are not called different."""
    study = montecarlo("eavesdroppers", out=tmp_path / "study", plan=Plan(Mode.COVARIANCE_ONLY), slots=20, trials=4)
    with pytest.raises(UsageError, match="has neither digests nor recorded trials"):
        difference(study, study)
