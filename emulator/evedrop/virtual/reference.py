"""What a run must come to: the same trials in memory, and the fates that the link model decides there.

The campaign of faults on real processes judges by it, too. Source: docs/results.md.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from evedrop.live.launch.gathering import shards_of
from evedrop.model.digest import block_starts
from evedrop.model.links.loss_model import Fate
from evedrop.model.slot.link import Fates
from evedrop.results.reading import Results
from evedrop.results.summary_file import summary_text
from evedrop.scenario.tables import Scenario
from evedrop.score.scorekeeper import RunOutcome
from evedrop.simulate.montecarlo import Merger, Plan, simulate
from evedrop.simulate.simulation import Mode, Simulation
from evedrop.simulate.trials import TrialsTask, carry_out

KEYS: Mapping[str, tuple[str, ...]] = {
    "slots": ("slot", "peer"),
    "trials": ("slot", "peer", "trial"),
    "inputs": ("slot", "trial"),
    "journal": ("slot", "link"),
    "digests": ("peer", "trial", "block"),
}
"""Table → what names a row of it."""
_COUNTS = {"slots": "trials", "journal": "offered"}  # of how many trials a row is
_ROUNDED = 1e-9  # of metrics that a live run adds up in another order
_CANCELLED = (
    1e-7  # of a standard error, which is a difference of sums: of itself, or of the mean if all trials are equal
)
_SHOWN = 3  # rows that are wrong, of a table

Row = Mapping[str, Any]


@dataclass(frozen=True)
class RunReference:
    """Rows by their keys, and the summary in memory."""

    scenario: Scenario
    summary: Mapping[str, Any]
    tables: Mapping[str, Mapping[tuple[Any, ...], Row]]
    folder: Path | None = None
    """The results in memory."""
    status: int = 0
    """The exit status of a run with these results: 1 if an expectation of the scenario fails."""

    @property
    def shards(self) -> int:
        """In how many shards the run is."""
        return self.scenario.shards

    def of_folders(self, folder: Path) -> Mapping[Path, RunReference]:
        """The folders in which a run has left its results → what those must come to: one, or that of each shard.

        Once the run has a summary, its own tables are complete, and those of shards may be removed.
        """
        merged = (folder / "summary.json").exists()
        shards = [] if merged else [shard for shard in shards_of(self.scenario, folder) if shard.folder.is_dir()]
        if not shards:
            return {folder: self} if folder.is_dir() else {}
        with tempfile.TemporaryDirectory() as memory:
            return {shard.folder: in_memory(shard.scenario, Path(memory, shard.name)) for shard in shards}

    def after(self, slot: int, earlier: RunReference) -> RunReference:
        """The rows of a slot and later ones, and earlier rows of another: a link that changes later may be one without theory."""
        rows = {
            key: row if row["slot"] >= slot else earlier.tables["slots"][key]
            for key, row in self.tables["slots"].items()
        }
        return replace(self, tables={**self.tables, "slots": rows})

    def of_states(self, count: int) -> RunReference:
        """What is known where only so many states are: no digests if there are fewer than slots.

        Receivers may have told of the last block while its rows, and states, were still to come.
        """
        known = {name: rows for name, rows in self.tables.items() if name != "digests"}
        return self if count >= self.scenario.slots else replace(self, tables=known)

    def wrong_rows(self, name: str, table: pa.Table, whole: int | None = None) -> Iterator[str]:
        """Rows of a table on disk that differ from those that are right; rows that must not be there.

        whole: the slots that all shards have done, whose rows must be of all trials; None for the whole run.
        """
        expected, wrong = self.tables.get(name), 0
        if expected is None:
            return
        seen = set[tuple[Any, ...]]()
        for row in table.to_pylist():
            key = _key(name, row)
            wanted = expected.get(key)
            why = (
                "twice"
                if key in seen
                else "must not be there"
                if wanted is None
                else _difference(
                    name, row, wanted, self.shards > 1 and whole is not None and row.get("slot", 0) >= whole
                )
            )
            seen.add(key)
            if why is not None:
                wrong += 1
                if wrong <= _SHOWN:
                    yield f"{name} {key}: {why}"
        if wrong > _SHOWN:
            yield f"{name}: {wrong} wrong rows in all"


def in_memory(scenario: Scenario, folder: Path) -> RunReference:
    """The same trials in memory, whose results come into a folder.

    Raises ValueError if its tables are not whole: the judge misses only rows that are there.
    """
    simulate(scenario, folder, lambda _: None, Plan(workers=1))
    results = Results.read(folder)
    tables = {name: _rows(name, table) for name, table in tables_of(results, journal=False)}
    slots, peers = scenario.slots, len(scenario.receivers)
    expected = {"slots": slots * peers, "trials": slots * peers * scenario.record_trials}
    if "inputs" in tables:
        expected["inputs"] = slots * scenario.record_trials
    blocks = sum(len(block_starts(slots, scenario.outage_bounds(name))) for name in scenario.digested)
    expected["digests"] = blocks * scenario.trials
    wrong = [
        f"{name} has {len(tables[name])} rows, not {count}"
        for name, count in expected.items()
        if len(tables[name]) != count
    ]
    if wrong:
        raise ValueError(f"the same trials in memory are not whole: {'; '.join(wrong)}")
    journal = {_key("journal", row): row for row in journal_rows(scenario)}
    status = min(1, results.typed_summary.failed_expectations)
    return RunReference(scenario, results.summary, {**tables, "journal": journal}, folder, status)


def summary_until(scenario: Scenario, slots: int) -> Mapping[str, Any]:
    """The summary in memory of a run that was cut short after some slots."""
    first, done = scenario.first_trial, 0
    task = TrialsTask(scenario.model_dump(mode="json"), first, first + scenario.trials, Mode.EXACT)

    def count(more: int) -> None:
        nonlocal done
        done += more

    result = carry_out(task, count, lambda: done >= slots * scenario.trials, stops=(slots,))
    summary = Merger.of(scenario, Mode.EXACT, [result]).summary(RunOutcome(0.0, f"slot {slots}"))
    cut_short: dict[str, Any] = json.loads(summary_text(summary))
    return cut_short


def tables_of(results: Results, journal: bool = True) -> Iterator[tuple[str, pa.Table]]:
    """The tables of a results folder that there are."""
    for name in KEYS:
        if name != "journal" or journal:
            table = getattr(results, name)
            if table is not None:
                yield name, table


def _key(name: str, row: Row) -> tuple[Any, ...]:
    return tuple(row[column] for column in KEYS[name])


def _rows(name: str, table: pa.Table) -> dict[tuple[Any, ...], Row]:
    return {_key(name, row): row for row in table.to_pylist()}


def _difference(name: str, row: Row, wanted: Row, fewer: bool) -> str | None:
    """Why a row is not the one that it must be; None if it is. fewer: it may be of some trials only."""
    counts = _COUNTS.get(name)
    if fewer and counts is not None and row[counts] < wanted[counts]:
        return None  # some shards were cut short: of fewer trials
    for column, value in row.items():
        expected = wanted[column]
        if name == "slots":
            if "quantile" in column and value is None:  # in a live run
                continue
            same = _near(value, expected, _ROUNDED)
            if column == "standard_error" and not same:
                same = _near(value, expected, _CANCELLED, _CANCELLED * (wanted["mean_squared_error"] or 0.0))
        else:
            same = repr(value) == repr(expected)  # to the last bit, NaN and −0 included
        if not same:
            return f"{column} is {value}, not {expected}"
    return None


def _near(value: Any, expected: Any, rounded: float, least: float = 1e-300) -> bool:
    """Whether two numbers are the same but for rounding; where there is nothing it is None or NaN.

    rounded: the relative difference that there may be; least: the absolute one.
    """
    if _nothing(value) or _nothing(expected):
        return _nothing(value) and _nothing(expected)
    if isinstance(value, float) and isinstance(expected, float):
        return value == expected or math.isclose(value, expected, rel_tol=rounded, abs_tol=least)
    return bool(value == expected)


def _nothing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


_LOSSES = ("lost", "corrupted", "overflow", "cut", "late", "down", "paused", "underway")
_DELIVERED, _UNSENT = Fate.DELIVERED.value, Fate.UNSENT.value


def journal_rows(scenario: Scenario) -> Iterator[dict[str, Any]]:
    """The rows of `journal.parquet` for all slots and links of a scenario, whose trials are simulated for it."""
    numbers = range(scenario.first_trial, scenario.first_trial + scenario.trials)
    for chunk in Simulation(scenario, numbers).chunks():
        for name, receiver in chunk.receivers.items():
            for row in range(len(receiver.error)):
                yield {"slot": chunk.first + row, "link": name, **_row(receiver.fates, row)}


def _row(fates: Fates, row: int) -> dict[str, Any]:
    """The counts of one slot of one link, and the mask of the trials whose packet arrived in that slot."""
    codes = [int(code) for code in fates.codes[row]]
    delays = [0] * len(codes) if fates.delays is None else [int(delay) for delay in fates.delays[row]]
    mask = bytearray(-(-len(codes) // 8))
    counts = dict.fromkeys(_LOSSES, 0)
    offered = delivered = late = 0
    for trial, (code, delay) in enumerate(zip(codes, delays, strict=True)):
        if code == _UNSENT:
            continue
        offered += 1
        if code != _DELIVERED:
            counts[Fate(code).name.lower()] += 1
        elif delay:
            late += 1
        else:
            delivered += 1
            mask[trial // 8] |= 1 << trial % 8
    by_reason = {f"lost_by_{reason}": count for reason, count in counts.items()}
    lost = sum(counts.values())
    return {"offered": offered, "delivered": delivered, "late": late, "lost": lost, **by_reason,
            "delivered_mask": bytes(mask)}  # fmt: skip
