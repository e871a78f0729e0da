"""The references of scenario and results: complete, and with examples that are right."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from pydantic import BaseModel

from evedrop.cli.api import montecarlo
from evedrop.model.receiver import ACTIONS
from evedrop.results import crash_proof_tables as growing
from evedrop.results.crash_proof_tables import BATCH_BYTES, TableStream, Unfinished, finish
from evedrop.results.folder import UNFINISHED
from evedrop.results.reading import Results
from evedrop.results.tables import DIGESTS, JOURNAL
from evedrop.scenario.expect import ExpectTable
from evedrop.scenario.loading import checked, parse
from evedrop.scenario.tables import Scenario

DOCS = Path(__file__).parents[2] / "docs"
TABLES = [ExpectTable, Scenario]


def words(page: str) -> set[str]:
    """What a page has between backquotes."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return {word for quoted in re.findall(r"`([^`\n]+)`", text) for word in re.split(r"[^\w.]+", quoted)}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """A small run."""
    return montecarlo("eavesdroppers", slots=30, trials=12, out=tmp_path_factory.mktemp("run") / "run")


def examples(page: str) -> list[str]:
    """The TOML blocks of a page."""
    return re.findall(r"```toml\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def test_every_example_of_the_scenario_reference_is_right() -> None:
    """The first TOML block is a whole scenario; the tables of each other block can take the place of its own."""
    base, *others = examples("scenario.md")
    assert parse(base, "docs/scenario.md").slots
    others += examples("eavesdroppers.md")
    assert len(others) >= 5
    for block in others:
        tables = tomllib.loads(base) | tomllib.loads(block)
        if set(tables["eavesdroppers"]) != {"naive", "suspicious", "smart"}:  # those that it names are gone
            tables["expect"] = []
        assert checked(tables, f"docs/scenario.md, {block}").slots


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__)
def test_the_scenario_reference_has_every_entry(table: type[BaseModel]) -> None:
    """No field of a table is left out."""
    tables = {
        "process",
        "plant",
        "controller",
        "encoding",
        "legitimate",
        "eavesdroppers",
        "expect",
    }  # they are headings
    assert {name for name in table.model_fields if name not in tables} - words("scenario.md") - {"quality"} == set()
    assert "link.quality" in words("scenario.md")


def test_the_results_reference_has_every_column(results: Results) -> None:
    """Every column of every table, every action, every entry of the summary."""
    documented = words("results.md") | words("metrics.md")
    for names in (results.slots.column_names, results.trials.column_names, JOURNAL.names, DIGESTS.names, ACTIONS):
        assert set(names) - documented == set()
    summary = results.summary
    for part in (summary, summary["peers"]["smart"], summary["links"]["smart"], summary["secrecy"]["smart"]):
        assert set(part) - documented == set()
    assert set(summary["expectations"][0]) <= documented


def test_tables_have_a_row_for_everything(results: Results) -> None:
    """Slots times receivers, and times recorded trials; what is in both tables agrees."""
    assert results.slots.num_rows == results.trials.num_rows == 30 * 4
    assert set(results.trials["action"].to_pylist()) <= set(ACTIONS)
    for row in results.trials.to_pylist():
        error = sum((x - x_hat) ** 2 for x, x_hat in zip(row["x"], row["x_hat"], strict=True))
        assert row["squared_error"] == pytest.approx(error, rel=1e-12)
        assert row["trace_covariance"] == pytest.approx(row["P"][0] + row["P"][3], rel=1e-12)
        assert (row["action"] == "misled") <= (row["sent"] == "innovation" and row["peer"] != "legitimate")


def masks(rows: int, width: int) -> list[np.ndarray]:
    """Columns of a journal whose masks count up."""
    mask = (np.arange(rows * width) % 251).astype(np.uint8).reshape(rows, width)
    return [np.arange(rows), np.zeros(rows, np.int8), *(np.full(rows, 8 * width) for _ in JOURNAL.names[2:-1]), mask]


def journal(folder: Path, parts: list[list[np.ndarray]]) -> pq.ParquetFile:
    """The Parquet file of a journal that was written in a round for each part."""
    unfinished = Unfinished(folder)
    stream = TableStream(folder / UNFINISHED / "journal-0.arrows", JOURNAL, {"link": ("legitimate",)})
    for columns in parts:
        stream.add(columns)
        unfinished.round("", 0, {"journal": stream})
    stream.close()
    unfinished.close()
    finish(folder)
    return pq.ParquetFile(folder / "journal.parquet")


@pytest.mark.long
def test_wide_rows_are_not_held_back_by_their_number(tmp_path: Path) -> None:
    """A journal of 300 000 trials: no row group is larger than it should be."""
    file = journal(tmp_path, [masks(100, 37_500) for _ in range(20)])
    sizes = [file.metadata.row_group(i).num_rows * 37_500 for i in range(file.num_row_groups)]
    assert sum(sizes) == 2000 * 37_500
    assert max(sizes) <= BATCH_BYTES


def test_narrow_rows_are_put_together(tmp_path: Path) -> None:
    """Many small rounds are few row groups."""
    file = journal(tmp_path, [masks(100, 1) for _ in range(700)])
    assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [32_800, 32_800, 4_400]


def test_rows_that_come_at_once_are_parted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """More bytes than a row group's offsets can count are several row groups, and read back as they were."""
    monkeypatch.setattr(growing, "BATCH_BYTES", 1000)
    columns = masks(10, 400)
    assert journal(tmp_path, [columns]).num_row_groups >= 5
    table = pq.read_table(tmp_path / "journal.parquet")
    assert table["slot"].to_pylist() == list(range(10))
    assert table["delivered_mask"].to_pylist() == [row.tobytes() for row in columns[-1]]


def test_a_summary_is_replaced_as_a_whole(results: Results) -> None:
    """A half-written summary can never be read, and no temporary file is left."""
    assert [path.name for path in results.folder.glob("summary*")] == ["summary.json"]
    assert Results.read(str(results.folder)).summary == results.summary
