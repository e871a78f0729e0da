"""Sweeps: grids, every combination of them, and each point what a study of its own gives."""

from __future__ import annotations

import itertools
import json
import shlex
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.cli.api import montecarlo
from evedrop.errors import ScenarioError, UsageError
from evedrop.model.metrics import expectable_metrics
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import silent
from evedrop.scenarios import shipped
from evedrop.show.report.closing import sweep_table
from evedrop.show.report.writing import write_report
from evedrop.show.view.palette import paper_inks
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode, Simulation
from evedrop.studies.sweep import grid_of, sweep_over
from tests.conftest import Evedrop
from tests.examples import examples
from tests.golden.pages import Golden
from tests.pages import checked, downloads

decimals = st.decimals(-1000, 1000, places=3, allow_nan=False, allow_infinity=False)
steps = st.decimals("0.001", 50, places=3)


@given(decimals, steps, st.integers(0, 400), st.booleans())
@settings(deadline=None, max_examples=examples(200))
def test_a_range_has_both_ends_and_decimal_values(first: Decimal, step: Decimal, count: int, down: bool) -> None:
    """first:last:step gives first + i·step as a decimal fraction reads, no value more and none less."""
    step = -step if down else step
    last = first + count * step
    (values,) = grid_of([f"key={first}:{last}:{step}"]).values()
    assert values == [float(first + i * step) for i in range(count + 1)]


@given(st.integers(-50, 50), st.integers(1, 9), st.integers(0, 30))
@settings(deadline=None, max_examples=examples(50))
def test_a_range_of_whole_numbers_is_whole(first: int, step: int, count: int) -> None:
    """Slots and trials can be swept; an end between two steps is left out."""
    (values,) = grid_of([f"key={first}:{first + count * step + step - 1}:{step}"]).values()
    assert values == list(range(first, first + count * step + 1, step))
    assert all(type(value) is int for value in values)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("k=1,2.5,true", [1, 2.5, True]),
        ("k=smart,naive", ["smart", "naive"]),
        ("k=smart, 3", ["smart", 3]),
        ('k="a,b",c', ['"a', 'b"', "c"]),
        ('k="a:b","c"', ["a:b", "c"]),
        ("k=[[1.0,0.1],[0.0,1.0]],[[1.0,0.2],[0.0,1.0]]", [[[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.2], [0.0, 1.0]]]),
        ("k=5", [5]),
    ],
)
def test_lists_are_read_as_toml(text: str, values: list[object]) -> None:
    """Numbers, words, quoted words, and matrices, whose commas do not part them."""
    assert grid_of([text]) == {"k": values}


@pytest.mark.parametrize(
    "texts",
    [
        ["slots"],
        ["=1,2"],
        ["slots="],
        ["slots= "],
        ["a=1", "a=2"],
        ["a=5:1:1"],
        ["a=1:5:-1"],
        ["a=1:5:0"],
        ["a=1:nan:1"],
        ["a=1:inf:1"],
        ["a=1:2"],
        ["a=1:2:x"],
        ["a=0:1:1e-9"],
        ["a=0:1e999999:1e-999999"],
        ["a=0:1:0.001", "b=0:1:0.01"],
    ],
    ids=str,
)
def test_what_is_no_grid_is_refused(texts: list[str], golden: Golden) -> None:
    """One line that names the option."""
    with pytest.raises(UsageError) as told:
        grid_of(texts)
    assert str(told.value).startswith("--over")
    assert "\n" not in str(told.value)
    golden("sweep", told.value)


@pytest.mark.parametrize("texts", ["seed=0,0", "seed=1,2,1.0", "encoding.state_probability=[0.5],[0.5]"])
def test_a_repeated_value_is_refused(texts: str, tmp_path: Path) -> None:
    """Its rows would be taken for those of one point, and the sweep for one that was interrupted."""
    with pytest.raises(UsageError, match="is given 2 times; give each value once"):
        sweep_over("eavesdroppers", {}, grid_of([texts]), tmp_path / "out", lambda _: None, Plan())
    assert not (tmp_path / "out").exists()


_BERNOULLI = {"model": "bernoulli", "quality": 0.2}


@pytest.mark.parametrize(
    ("earlier", "later", "values"),
    [
        ("legitimate.link.quality", "legitimate.link", [{"quality": 0.2}]),
        ("legitimate.link.quality", "legitimate.link.loss", [_BERNOULLI]),
        ("legitimate.link.quality", "legitimate", [{"link": {"quality": 0.2}}]),
    ],
)
def test_a_key_that_a_later_one_sets_again_is_refused(
    earlier: str, later: str, values: list[Any], tmp_path: Path
) -> None:
    """The table would show values that had no effect. The other way round, both have one, or nothing is left of the first."""
    grid: dict[str, list[Any]] = {earlier: [0.5, 0.9], later: values}
    with pytest.raises(UsageError, match=f"{later} sets {earlier}, too, whose values would have no effect"):
        sweep_over("eavesdroppers", {}, grid, tmp_path / "out", lambda _: None, Plan())
    assert not (tmp_path / "out").exists()


def test_keys_of_a_table_and_of_an_entry_in_it_can_be_varied_together(tmp_path: Path) -> None:
    """If the table comes first, its other entries are those of each of its values. A loss and a quality exclude each other."""
    changes = {"slots": 2, "trials": 2, "expect": []}
    grid: dict[str, list[Any]] = {
        "legitimate.link": [{"quality": 0.2}, {"quality": 0.9}],
        "legitimate.link.corrupt": [0.0, 1.0],
    }
    table = sweep_over("eavesdroppers", changes, grid, tmp_path / "out", lambda _: None, Plan(workers=1))
    assert table["peer"].to_pylist().count("legitimate") == 4
    other = {"legitimate.link.loss.quality": [0.1], "legitimate.link.quality": [0.2]}
    for keys in (other, dict(reversed(other.items()))):
        with pytest.raises(UsageError, match="would have no effect"):
            sweep_over("eavesdroppers", changes, keys, tmp_path / "no", lambda _: None, Plan())


def test_the_values_of_a_sweep_are_set_after_all_changes(tmp_path: Path) -> None:
    """Also if a change of the same entry came before one of the table around it."""
    changes = {
        "slots": 2,
        "trials": 2,
        "expect": [],
        "legitimate.link.quality": 0.5,
        "legitimate.link": {"quality": 0.7},
    }
    grid = {"legitimate.link.quality": [0.0, 1.0]}
    table = sweep_over("eavesdroppers", changes, grid, tmp_path / "out", lambda _: None, Plan(workers=1))
    rows = [row for row in table.to_pylist() if row["peer"] == "legitimate"]
    assert [row["received_fraction"] for row in rows] == [0.0, 1.0]


def test_values_of_different_kinds_are_text_in_the_table(evedrop: Evedrop) -> None:
    """A number and a list: the table, plot and page are made, and the values read as TOML."""
    changes = {"slots": 2, "trials": 3, "expect": []}
    grid = {"encoding.state_probability": [0.5, [0.25, 0.75]]}
    table = sweep_over("eavesdroppers", changes, grid, evedrop.folder / "out", lambda _: None, Plan(workers=1))
    assert list(dict.fromkeys(table["encoding.state_probability"].to_pylist())) == ["0.5", "[0.25, 0.75]"]
    write_report(evedrop.folder / "out")
    assert "0.5,[0.25, 0.75]" in " ".join(checked(evedrop.folder / "out").texts)


def test_seeds_that_no_column_of_numbers_holds_are_text_in_the_table(evedrop: Evedrop) -> None:
    """Seeds have up to 256 bits: the points are not lost, and the page repeats them."""
    seeds = [7, 2**64]
    changes = {"slots": 2, "trials": 3, "expect": []}
    table = sweep_over(
        "eavesdroppers", changes, {"seed": seeds}, evedrop.folder / "out", lambda _: None, Plan(workers=1)
    )
    assert list(dict.fromkeys(table["seed"].to_pylist())) == [str(seed) for seed in seeds]
    write_report(evedrop.folder / "out")
    assert f"seed=7,{seeds[1]}" in " ".join(checked(evedrop.folder / "out").texts)


GRID = {"encoding.state_probability": [0.3, 0.6, 0.9], "eavesdroppers.smart.link.quality": [0.5, 0.9]}
CHANGES = {"slots": 12, "trials": 620}


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[pa.Table, Path]:
    """A small sweep by two workers, and its folder."""
    folder = tmp_path_factory.mktemp("sweep") / "run"
    return sweep_over("eavesdroppers", CHANGES, GRID, folder, lambda _: None, Plan(workers=2)), folder


def test_every_combination_has_a_row_for_every_peer(swept: tuple[pa.Table, Path]) -> None:
    """In the order of the grid, and nothing else."""
    rows = swept[0].to_pylist()
    peers = ("legitimate", "naive", "suspicious", "smart")
    expected = [(*point, peer) for point in itertools.product(*GRID.values()) for peer in peers]
    assert [(*(row[key] for key in GRID), row["peer"]) for row in rows] == expected
    assert {row["trials"] for row in rows} == {620}


@pytest.mark.long
def test_a_sweep_without_a_house_has_none_of_its_metrics(swept: tuple[pa.Table, Path]) -> None:
    """Neither columns nor a plot."""
    table, folder = swept
    assert "sold_energy" not in table.column_names
    assert not (folder / "household.png").exists()


def test_a_point_is_a_study_of_its_own(swept: tuple[pa.Table, Path], tmp_path: Path) -> None:
    """Metrics, verdicts and digests of each point are those of `montecarlo` with the same entries, to the bit."""
    rows = {(*(row[key] for key in GRID), row["peer"]): row for row in swept[0].to_pylist()}
    for i, point in enumerate(itertools.product(*GRID.values())):
        changes: dict[str, Any] = {key.replace(".", "__"): value for key, value in zip(GRID, point, strict=True)}
        alone = montecarlo(
            "eavesdroppers", **{**CHANGES, **changes}, out=tmp_path / str(i), plan=Plan(workers=1)
        ).summary
        for name, peer in alone["peers"].items():
            row = rows[(*point, name)]
            assert row["digest"] == peer["digest"]
            assert row["infinite_variance"] == peer["infinite_variance"]
            for metric in expectable_metrics():
                assert row[metric] == peer[metric]
            for metric, error in peer["standard_errors"].items():
                assert row[f"{metric}_standard_error"] == error
            assert row["mean_squared_error_z"] == peer["z"]["mean_squared_error"]
            assert {"fraction": row["rare_fraction"], "trials": row["rare_trials"]} == peer["rare_events"]
            for level, value in peer["error_quantiles"].items():
                assert row[f"error_quantile_{level}"] == value
            verdict = alone["secrecy"].get(name, {}).get("verdict", {})
            assert (row["verdict"], row["times"]) == (verdict.get("outcome"), verdict.get("times"))
            assert (row["verdict"] is None) is (name == "legitimate")


def test_the_folder_has_table_description_and_plot(swept: tuple[pa.Table, Path]) -> None:
    """The table as it was returned, what was swept, and a drawing with something on it."""
    from matplotlib.image import imread

    table, folder = swept
    assert pq.read_table(folder / "sweep.parquet").equals(table)
    described = json.loads((folder / "sweep.json").read_text())
    assert described == {"scenario": "eavesdroppers", "changes": CHANGES, "over": GRID, "mode": "exact"}
    ink = (imread(folder / "sweep.png")[:, :, :3].min(axis=2) < 0.9).mean()
    assert 0.005 < ink < 0.5
    assert (folder / "sweep.pdf").read_bytes().startswith(b"%PDF")


def test_the_results_reference_has_every_column_of_a_sweep(swept: tuple[pa.Table, Path]) -> None:
    """Each column between backquotes in docs/results.md, and each entry of sweep.json."""
    table, folder = swept
    text = (Path(__file__).parents[2] / "docs" / "results.md").read_text(encoding="utf-8")
    part = text.partition("## Sweeps")[2].partition("\n## ")[0]
    names = {*table.column_names, *json.loads((folder / "sweep.json").read_text())} - set(list(GRID)[1:])
    assert {name for name in names if f"`{name}`" not in part} == set()


@pytest.mark.thorough
def test_words_whole_numbers_and_other_modes_can_be_swept(tmp_path: Path) -> None:
    """A strategy and slots, covariance-only: the actual trace stands in its own column; the plot is drawn, and the page made."""
    grid: dict[str, list[Any]] = {"eavesdroppers.smart.strategy": ["smart", "naive"], "slots": [10, 20]}
    plan = Plan(Mode.COVARIANCE_ONLY, workers=1)
    table = sweep_over("eavesdroppers", {"trials": 5}, grid, tmp_path / "run", lambda _: None, plan)
    assert table.num_rows == 2 * 2 * 4
    assert table["mean_squared_error"].null_count == table.num_rows
    assert table["mean_actual_trace_covariance"].null_count == table["digest"].null_count - table.num_rows == 0
    assert (tmp_path / "run" / "sweep.png").is_file()
    write_report(tmp_path / "run")
    page = checked(tmp_path / "run")
    facts = {"date", "machine", "operating system", "commit", "python", "numpy", "evedrop"} & set(page.texts)
    assert (page.tags["svg"], page.tags["tr"]) == (2, 1 + 2 * 2 * 4 + 1 + len(facts))
    assert not downloads(page), "a built-in scenario needs no file"
    command = "evedrop sweep eavesdroppers --over eavesdroppers.smart.strategy=smart,naive --over slots=10,20"
    assert f"{command} --trials 5 --covariance-only" in page.texts
    assert "? cannot tell yet at all 4 points" in page.texts
    assert "4 points of eavesdroppers.smart.strategy, slots · 10 to 20 slots · 5 trials" in page.texts
    colours = paper_inks([row["peer"] for row in table.to_pylist()], {"smart": "smart", "naive": "naive"})
    inks = {f"fill: none; stroke: {colour}; stroke-width: 2" for colour in colours.values()}
    assert inks & {*page.values("style")}, "there are no error bars"


def test_an_application_that_the_mode_leaves_out_is_not_drawn(tmp_path: Path) -> None:
    """Without states a house has no energies: the sweep of docs/errata.md, microgrid."""
    grid: dict[str, list[Any]] = {"encoding.state_probability": [0.1, 0.5]}
    changes = {"trials": 2, "slots": 20, "eavesdroppers.bayesian.strategy": "smart"}
    plan = Plan(Mode.COVARIANCE_ONLY, workers=1)
    table = sweep_over("microgrid", changes, grid, tmp_path / "run", lambda _: None, plan)
    assert "bought_energy" not in table.column_names
    assert {path.name for path in (tmp_path / "run").glob("*.png")} == {"sweep.png"}


@pytest.mark.thorough
def test_the_page_of_a_sweep_over_a_file_has_the_file(tmp_path: Path) -> None:
    """A reader can repeat the sweep with it; the page says which files of the scenario are missing."""
    text = shipped()["eavesdroppers"].read_text()
    for scenario, missing in ((text, False), (f'secret_file = "secret"\n{text}', True)):
        (tmp_path / "mine.toml").write_text(scenario)
        (tmp_path / "secret").write_bytes(bytes(32))
        folder = tmp_path / f"run-{missing}"
        changes = {"trials": 2, "slots": 2}
        sweep_over(tmp_path / "mine.toml", changes, {"seed": [1, 2]}, folder, lambda _: None, Plan(workers=1))
        write_report(folder)
        page = checked(folder)
        assert downloads(page) == {"scenario.toml": scenario}
        assert any(line.startswith("evedrop sweep scenario.toml --over seed=1,2") for line in page.texts)
        assert any("do not travel" in line for line in page.texts) == missing


@pytest.mark.thorough
def test_the_page_quotes_all_values_of_an_entry_if_one_needs_it(tmp_path: Path) -> None:
    """The command line reads them together, so that a comma in a title does not part it."""
    values = ["a, b", "c"]
    sweep_over(
        "vehicle", {"trials": 2, "slots": 2}, {"title": values}, tmp_path / "run", lambda _: None, Plan(workers=1)
    )
    write_report(tmp_path / "run")
    command = next(text for text in checked(tmp_path / "run").texts if text.startswith("evedrop sweep"))
    words = shlex.split(command)
    assert grid_of([words[words.index("--over") + 1]]) == {"title": values}


BASE = ("sweep", "eavesdroppers", "--slots", "20", "--out", "run")


@pytest.mark.thorough
def test_the_command_prints_what_it_wrote(evedrop: Evedrop) -> None:
    """--json is the table as strict JSON and nothing else; without it, a table for people."""
    done = evedrop(*BASE, "--over", "encoding.state_probability=0.2:0.4:0.2", "--trials", "12", "--json")
    assert (done.status, done.err) == (0, "")
    rows = json.loads(done.out, parse_constant=pytest.fail)
    assert rows == pq.read_table(evedrop.folder / "run" / "sweep.parquet").to_pylist()
    assert {row["encoding.state_probability"] for row in rows} == {0.2, 0.4}
    done = evedrop(*BASE[:-1], "other", "--over", "encoding.state_probability=0.2", "--trials", "12")
    assert (done.status, done.err) == (0, "")
    for words in ("encoding.state_probability", "legitimate", "smart", "other/sweep.parquet"):
        assert words in done.out


@pytest.mark.thorough
def test_the_ratio_is_that_of_the_second_half_of_each_trial(tmp_path: Path) -> None:
    """Against errors of every slot: after the transient, with a standard error for the two together; none for the estimator."""
    changes = {"trials": 40, "slots": 121, "expect": []}
    grid = {"encoding.state_probability": [0.3, 0.7]}
    table = sweep_over("eavesdroppers", changes, grid, tmp_path / "sweep", lambda _: None, Plan(workers=1))
    for row in table.to_pylist():
        if row["peer"] == "legitimate":
            assert (row["ratio"], row["ratio_standard_error"], row["ratio_from"]) == (None, None, None)
            continue
        made = load("eavesdroppers", {**changes, "encoding.state_probability": row["encoding.state_probability"]})
        errors = {
            name: np.concatenate([chunk.receivers[name].error for chunk in Simulation(made, range(40)).chunks()])[61:]
            for name in ("legitimate", row["peer"])
        }
        theirs, ours = errors[row["peer"]].sum(axis=0), errors["legitimate"].sum(axis=0)
        assert row["ratio_from"] == 61
        assert row["ratio"] == pytest.approx(theirs.sum() / ours.sum(), rel=1e-9)
        left_out = (theirs.sum() - theirs) / (ours.sum() - ours)
        jackknife = np.sqrt(39 / 40 * ((left_out - left_out.mean()) ** 2).sum())
        assert row["ratio_standard_error"] == pytest.approx(jackknife, rel=0.25)
    assert "times the error" in [column.heading for column in sweep_table(table.to_pylist(), tuple(grid)).columns]


def test_a_column_that_the_first_point_lacks_is_kept(tmp_path: Path) -> None:
    """The error against the true state, of the point whose sensor measures; the first one's sensor sees the state."""
    noise = {"noise": [[1, 0], [0, 1]]}
    measuring = {**noise, "output_matrix": [[1, 0]], "measurement_noise": [[1]]}
    identity = [[1.0, 0.0], [0.0, 1.0]]
    changes = {"slots": 20, "trials": 3, "process.Q": identity, "process.initial_covariance": identity}
    table = sweep_over("measured", changes, {"plant": [noise, measuring]}, tmp_path, silent, Plan(workers=1))
    times = [row["true_times"] for row in table.to_pylist() if row["peer"] != "legitimate"]
    half = len(times) // 2
    assert times[:half] == [None] * half
    assert None not in times[half:]


def test_an_application_that_draws_nothing_leaves_no_file(tmp_path: Path) -> None:
    """A heated room has columns in the table of a sweep, and no picture."""
    changes: dict[str, Any] = {"trials": 2}
    table = sweep_over("heated-room", changes, {"slots": [8, 12]}, tmp_path / "run", lambda _: None, Plan(workers=1))
    assert "discomfort" in table.column_names
    assert {path.stem for path in (tmp_path / "run").iterdir()} == {"sweep"}


def test_a_date_is_refused_where_the_entry_takes_none(tmp_path: Path) -> None:
    """TOML has dates."""
    with pytest.raises(ScenarioError, match="title"):
        sweep_over("numerical", {}, grid_of(["title=2024-01-01,2024-01-02"]), tmp_path / "s", lambda _: None, Plan())
