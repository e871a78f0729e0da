"""Merges the results folders of a run's shards into one, as the run would have written it without shards.

A shard is a contiguous range of the run's trials, with a scenario and a results folder of its own. Trials are concatenated and
counts added. Means over all trials are computed from the shards' means, so they agree with an unsharded run's within rounding;
digests, fates, recorded trials and everything else kept by trial are the same to the bit.

Tables are merged some slots at a time, so that a long run's tables fit into memory. The rows of each receiver are in order of
slots, but the receivers alternate as they did in the run. A merged table has, for every few thousand slots, one receiver after
the other, like the table of an unsharded run that reports that many at once.

Source: docs/performance.md, shards.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from msgspec import structs
from numpy.typing import NDArray

from evedrop.errors import UsageError
from evedrop.model.digest import DIGEST_BYTES, Digests, RunDigest, block_starts
from evedrop.names import LEGITIMATE
from evedrop.results.crash_proof_tables import parquet_or_stream, parquet_writer
from evedrop.results.ending import noted
from evedrop.results.folder import make_private, private_replacement
from evedrop.results.reading import Results, as_of
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.shard_score import load_score
from evedrop.results.summary_file import write_summary
from evedrop.results.tables import DIGESTS, NULLABLE
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.progress_events import ConnectionOutage, RunEvent
from evedrop.scenario.tables import Scenario
from evedrop.score.expectations_held import replay_of
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.score.summary import Summary
from evedrop.system.world import world

SHARDS_FOLDER = "shards"  # in the results folder, until the shards are merged


@dataclass(frozen=True)
class Shard:
    """A range of the trials of a run."""

    number: int
    """Number of the shard, from 1 on, in order of trials."""
    scenario: Scenario
    """The run's scenario, with only these trials."""
    folder: Path
    """Its own results folder."""

    @property
    def name(self) -> str:
        """Name of the folder of its logs, in the run's log folder."""
        return f"shard-{self.number}"

    @property
    def trials(self) -> range:
        """The shard's trials, by their numbers in the scenario."""
        first = self.scenario.first_trial
        return range(first, first + self.scenario.trials)

    def of_run(self, text: object) -> str:
        """A message of the shard as one of the run: names the shard, and its logs by their path in the run's folder."""
        trials = self.trials
        which = f"trial {trials[0]}" if len(trials) == 1 else f"trials {trials[0]} to {trials[-1]}"
        return f"shard {self.number} ({which}): " + re.sub(r"(?<![\w/])logs/", f"logs/{self.name}/", str(text))


def shards_of(scenario: Scenario, folder: Path) -> list[Shard]:
    """The shards of a run, as equal as possible; a shard without a recorded trial records its first trial nevertheless."""
    trials, recorded, count = scenario.trials, scenario.record_trials, scenario.shards
    bounds = [trials * i // count for i in range(count + 1)]
    tables = scenario.model_dump(mode="json")
    made = []
    for number, start in enumerate(bounds[:-1], 1):
        own = {
            "trials": bounds[number] - start,
            "first_trial": scenario.first_trial + start,
            "record_trials": max(1, min(recorded - start, bounds[number] - start)),
            "shards": 1,
        }
        made.append(Shard(number, Scenario.model_validate({**tables, **own}), folder / SHARDS_FOLDER / str(number)))
    return made


_RECORDING = "recording.rrd"


def gather(scenario: Scenario, folder: Path, shards: Sequence[Shard], started: float | None, how: str) -> Summary:
    """Fill a run's folder from those of its shards, which are then removed if they can be; returns the run's summary.

    started: when the first shard began, by the monotonic clock, if one did; how: as in `RunOutcome`. Raises OSError if the folder
    cannot be written; the shards' folders are then unchanged.
    """
    write_resolved(folder, scenario)
    with ResultsWriter(folder, scenario) as writer:
        digests = {name: _digest(scenario, name, shards, writer) for name in scenario.digested}
    for name, gathered in _tables(scenario, shards).items():
        gathered.write([shard.folder / f"{name}.parquet" for shard in shards], folder / f"{name}.parquet")
    wall = 0.0 if started is None else world().monotonic() - started
    parts = _summaries(shards)
    scores = [_score(shard, parts) for shard in shards]
    run_tally = RunTally.merged(scores)
    replay = replay_of(folder, scenario)
    ending = RunOutcome(
        wall,
        noted(how, _age_of_metrics(shards, scores, parts)),
        replay,
        events=_events(parts),
        outages=_outages(parts),
        accused=_accused(parts),
        misdelivered=_misdelivered(parts),
    )
    # All have rows of these, also where metrics are earlier.
    slots = min(parts[shard.number].slots if shard.number in parts else 0 for shard in shards)
    summary = replace(summary_of(scenario, run_tally, digests, ending), slots=slots)
    write_summary(folder, summary)
    with suppress(OSError):  # the results are complete: what cannot be moved or removed stays with its shard
        _tidy(folder, shards)
    return summary


def _tables(scenario: Scenario, shards: Sequence[Shard]) -> dict[str, Gathered]:
    """Table → the object that merges it."""
    n, receivers, first = len(scenario.process.A), scenario.receivers, scenario.first_trial
    recorded = range(first, first + scenario.record_trials)
    tables: dict[str, Gathered] = {
        "slots": Statistics(receivers),
        "trials": Recorded(receivers, recorded, 6 + 2 * n + n * n),
        "journal": Journals(receivers, [shard.scenario.trials for shard in shards]),
    }
    if scenario.controller is not None and scenario.plant is not None:
        plant = scenario.plant
        tables["inputs"] = Recorded((), recorded, 4 + len(plant.inputs) + len(plant.disturbances))
    return tables


def _digest(scenario: Scenario, name: str, shards: Sequence[Shard], writer: ResultsWriter) -> str | None:
    """Write the digests of one process, and return its digest of the run; None if some blocks are missing."""
    blocks = [_blocks(shard, name) for shard in shards]
    for block in sorted(set(chain.from_iterable(blocks))):
        for shard, own in zip(shards, blocks, strict=True):
            if block in own:
                writer.digest_rows(shard.trials.start, {name: {block: own[block]}})
    digest = RunDigest()
    for own in blocks:
        if sorted(own) != block_starts(scenario.slots, scenario.outage_bounds(name)):
            return None
        digest.add(own)
    return digest.hexadecimal


def _blocks(shard: Shard, name: str) -> dict[int, Digests]:
    """First slot of a block → digests of the shard's trials, (R, 16), of one peer."""
    batches = parquet_or_stream(shard.folder, "digests")
    table = pa.Table.from_batches(batches, DIGESTS).filter(pc.field("peer") == name)
    starts, values = table["block"].to_numpy(), b"".join(table["digest"].to_pylist())
    digests = np.frombuffer(values, np.uint8).reshape(-1, DIGEST_BYTES)
    return {int(start): digests[starts == start] for start in np.unique(starts)}


def _score(shard: Shard, summaries: Mapping[int, Summary]) -> RunTally:
    """The tally of a shard's trials; an empty one if the disk became full before the rows of the tally counted."""
    score = load_score(shard.folder, shard.scenario)
    rows = summaries[shard.number].slots if shard.number in summaries else 0
    return score if score.tallies[LEGITIMATE].done <= rows else RunTally.nothing(shard.scenario, shard.scenario.trials)


def _age_of_metrics(shards: Sequence[Shard], scores: Sequence[RunTally], summaries: Mapping[int, Summary]) -> str:
    """What `ended` adds about shards whose recorders were killed after their last metrics."""
    earlier = [
        f"slot {score.tallies[LEGITIMATE].done} in shard {shard.number}"
        for shard, score in zip(shards, scores, strict=True)
        if shard.number in summaries and score.tallies[LEGITIMATE].done < summaries[shard.number].slots
    ]
    return as_of(", ".join(earlier)) if earlier else ""


def _events(summaries: Mapping[int, Summary]) -> Sequence[RunEvent]:
    """The events of the shard that came farthest: all have the scenario's, in the same order."""
    return max((summary.events for summary in summaries.values()), key=len, default=())


def _outages(summaries: Mapping[int, Summary]) -> list[ConnectionOutage]:
    """The outages of all shards, each with its shard, in order of slots."""
    outages = [
        structs.replace(outage, shard=shard) for shard, summary in summaries.items() for outage in summary.outages
    ]
    return sorted(outages, key=lambda outage: outage.slot)


def _accused(summaries: Mapping[int, Summary]) -> tuple[str, ...]:
    """The receivers that a shard's recorder accuses: each shard has a recorded trial, and it verified none of theirs."""
    verified = [entry for summary in summaries.values() for entry in (summary.verification or {}).items()]
    return tuple(name for name, verification in verified if not verification.recomputed_trials)


def _misdelivered(summaries: Mapping[int, Summary]) -> dict[str, int]:
    """Process → messages that it dropped, in all shards together."""
    counts: Counter[str] = Counter()
    for summary in summaries.values():
        counts.update(summary.misdelivered)
    return dict(counts)


def _summaries(shards: Sequence[Shard]) -> dict[int, Summary]:
    """Number → summary, of the shards that have written one."""
    summaries_ = {}
    for shard in shards:
        with suppress(UsageError):
            summaries_[shard.number] = Results.read(shard.folder).typed_summary
    return summaries_


def _tidy(folder: Path, shards: Sequence[Shard]) -> None:
    """Keep the logs of the shards, and the recording of the first; the rest is in the run's own tables."""
    for shard in shards:
        make_private(folder / "logs")
        with suppress(FileNotFoundError):
            world().disk.replace(shard.folder / "logs", folder / "logs" / shard.name)
    with suppress(FileNotFoundError):
        world().disk.replace(shards[0].folder / _RECORDING, folder / _RECORDING)
    world().disk.remove_tree(shards[0].folder.parent)


_BYTES = 4 * 2**20
_ROWS = 65_536


class Gathered(ABC):
    """Merges a table of all shards into that of the run: the base class."""

    def __init__(self, receivers: Sequence[str], row_bytes: float) -> None:
        """receivers: empty for a table without a column of receivers; row_bytes: approximate size of a row."""
        self.receivers = pa.array(receivers)
        self.by = "peer"
        """Name of the column of the receivers."""
        self.slots_at_once = max(1, int(min(_ROWS, _BYTES / row_bytes)) // max(1, len(receivers)))

    def write(self, sources: Sequence[Path], table: Path) -> None:
        """Merge the tables of the shards, in order, and replace the empty table of the run with the result."""
        schema = pq.read_schema(table)
        rows = [_Rows(source, schema, self) for source in sources]
        with (
            private_replacement(table) as unfinished,
            parquet_writer(unfinished, schema) as writer,
        ):
            first, parts = 0, [reader.below(self.slots_at_once) for reader in rows]
            while any(part.num_rows for part in parts):
                writer.write_table(self._one(first, parts, schema))
                first += self.slots_at_once
                parts = [reader.below(first + self.slots_at_once) for reader in rows]

    def codes(self, table: pa.Table) -> NDArray[np.int64]:
        """The index of the receiver of every row; 0 for a table without receivers."""
        if not len(self.receivers):
            return np.zeros(table.num_rows, np.int64)
        indices = pc.index_in(table[self.by].cast(pa.string()), value_set=self.receivers)
        codes: NDArray[np.int64] = indices.to_numpy().astype(np.int64)
        return codes

    @abstractmethod
    def _one(self, first: int, parts: Sequence[pa.Table], schema: pa.Schema) -> pa.Table:
        """Merge the rows of the slots from `first` on; parts: the rows of each shard."""

    def _places(self, first: int, part: pa.Table) -> NDArray[np.int64]:
        """The places of the rows in an array with one place for each receiver and slot."""
        slots: NDArray[np.int64] = part["slot"].to_numpy()
        return self.codes(part) * self.slots_at_once + (slots - first)

    def _rows_of(self, first: int, places: NDArray[np.int64], columns: dict[str, Any], schema: pa.Schema) -> pa.Table:
        """The rows of some places, from columns of all places."""
        named = (places // self.slots_at_once).astype(np.int8)
        own = {
            "slot": pa.array(first + places % self.slots_at_once),
            self.by: pa.DictionaryArray.from_arrays(pa.array(named), self.receivers),
        }
        arrays = []
        for field in schema:
            values = own.get(field.name)
            if values is None:
                values = columns[field.name][places]
                values = pa.array(values, field.type, from_pandas=field.name in NULLABLE)
            arrays.append(values)
        return pa.Table.from_arrays(arrays, schema=schema)


@final
class _Rows:
    """A table of one shard, read in order of slots; it ends early if its writer was killed."""

    def __init__(self, path: Path, schema: pa.Schema, gathered: Gathered) -> None:
        self._gathered = gathered
        self._held: pa.Table = schema.empty_table()
        self._reach = np.zeros(max(1, len(gathered.receivers)), np.int64)
        self._batches = parquet_or_stream(path.parent, path.stem, gathered.slots_at_once * len(self._reach))

    def below(self, end: int) -> pa.Table:
        """The rows of all slots below `end` that have not been returned before."""
        parts = [self._held]
        while int(self._reach.min()) < end and (batch := next(self._batches, None)) is not None:
            part = pa.Table.from_batches([batch])
            np.maximum.at(self._reach, self._gathered.codes(part), part["slot"].to_numpy() + 1)
            parts.append(part)
        held = pa.concat_tables(parts)
        due = pc.less(held["slot"], end)
        self._held = held.filter(pc.invert(due))
        return held.filter(due)


@final
class Statistics(Gathered):
    """Merges statistics of slots: means are weighted by the number of trials, and standard errors pooled."""

    # Taken from any shard: theory, which is the same in all, and quantiles, which a live run does not have.
    _TAKEN = ("theoretical", "error_quantile", "trace_quantile")

    def __init__(self, receivers: Sequence[str]) -> None:
        super().__init__(receivers, 200.0)

    @np.errstate(invalid="ignore", divide="ignore", over="ignore")
    def _one(self, first: int, parts: Sequence[pa.Table], schema: pa.Schema) -> pa.Table:
        size = len(self.receivers) * self.slots_at_once
        names = [field.name for field in schema if field.name not in ("slot", self.by, "trials", "standard_error")]
        columns: dict[str, Any] = {name: np.zeros(size) for name in names}
        total, spread = np.zeros(size), np.zeros(size)
        rows = [(self._places(first, part), part, part["trials"].to_numpy()) for part in parts]
        for places, part, trials in rows:
            total[places] += trials
            for name in names:
                values = part[name].to_numpy()
                if name.startswith(self._TAKEN):
                    columns[name][places] = values
                elif name.endswith("_fraction"):
                    columns[name][places] += np.rint(values * trials)
                else:
                    columns[name][places] += values * trials
        for name in names:
            if not name.startswith(self._TAKEN):
                columns[name] /= total
        for places, part, trials in rows:
            inner = np.where(trials > 1, part["standard_error"].to_numpy() ** 2 * trials * (trials - 1.0), 0.0)
            between = part["mean_squared_error"].to_numpy() - columns["mean_squared_error"][places]
            spread[places] += inner + trials * between**2
        columns["standard_error"] = np.where(total > 1, np.sqrt(spread / (total - 1.0) / total), np.nan)
        columns["trials"] = total.astype(np.int64)
        return self._rows_of(first, np.flatnonzero(total), columns, schema)


@final
class Journals(Gathered):
    """Merges journals of slots and links: counts are added, and bit masks concatenated."""

    def __init__(self, receivers: Sequence[str], trials: Sequence[int]) -> None:
        """trials: how many each shard has."""
        super().__init__(receivers, 100.0 + sum(trials))
        self.by = "link"
        self._trials = trials

    def _one(self, first: int, parts: Sequence[pa.Table], schema: pa.Schema) -> pa.Table:
        size = len(self.receivers) * self.slots_at_once
        names = [field.name for field in schema if field.name not in ("slot", self.by, "delivered_mask")]
        columns: dict[str, Any] = {name: np.zeros(size, np.int64) for name in names}
        there, flags = np.zeros(size, np.bool_), np.zeros((size, sum(self._trials)), np.uint8)
        start = 0
        for part, trials in zip(parts, self._trials, strict=True):
            places = self._places(first, part)
            there[places] = True
            for name in names:
                columns[name][places] += part[name].to_numpy()
            masks = np.frombuffer(b"".join(part["delivered_mask"].to_pylist()), np.uint8)
            masks = masks.reshape(len(places), -(-trials // 8))
            flags[places, start : start + trials] = np.unpackbits(masks, axis=1, count=trials, bitorder="little")
            start += trials
        places = np.flatnonzero(there)
        packed = np.packbits(flags[places], axis=1, bitorder="little")
        masks = np.empty(size, object)
        masks[places] = [row.tobytes() for row in packed]
        return self._rows_of(first, places, {**columns, "delivered_mask": masks}, schema)


@final
class Recorded(Gathered):
    """Merges the recorded trials, each in full."""

    def __init__(self, receivers: Sequence[str], trials: range, numbers: int) -> None:
        """trials: the recorded ones; numbers: how many numbers a row has."""
        super().__init__(receivers, len(trials) * 8.0 * numbers)
        self._trials = trials

    def _one(self, first: int, parts: Sequence[pa.Table], schema: pa.Schema) -> pa.Table:
        rows = pa.concat_tables(parts)
        rows = rows.filter(pc.less(rows["trial"], self._trials.stop)).unify_dictionaries().combine_chunks()
        order = np.lexsort((rows["trial"].to_numpy(), self._places(first, rows)))
        return rows.take(pa.array(order)).cast(schema)
