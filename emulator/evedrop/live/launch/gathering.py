"""Merges the results folders of a run's shards into one, as the run would have written it without shards.

Trials are concatenated and counts added. Means over all trials are computed from the shards' means, so they agree with an
unsharded run's within rounding; digests, fates, recorded trials and everything else kept by trial are the same to the bit.

Source: docs/scale.md, shards.
"""

from __future__ import annotations

import os
import shutil
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from evedrop.errors import UsageError
from evedrop.live.launch.gathered_tables import Gathered, Journals, Recorded, Statistics
from evedrop.live.launch.shard import Shard
from evedrop.model.digest import DIGEST_BYTES, Digests, RunDigest, block_starts
from evedrop.names import LEGITIMATE
from evedrop.results.ending import noted
from evedrop.results.folder import make_private
from evedrop.results.growing_tables import parquet_or_stream
from evedrop.results.reading import Results, as_of
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.shard_score import load_score
from evedrop.results.writer import DIGESTS, ResultsWriter, write_summary
from evedrop.scenario.progress_events import ConnectionOutage, RunEvent
from evedrop.scenario.tables import Scenario
from evedrop.score.expectations_held import replay_of
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.score.summary import Summary

_RECORDING = "recording.rrd"


def gather(scenario: Scenario, folder: Path, shards: Sequence[Shard], started: float | None, how: str) -> Summary:
    """Fill a run's folder from those of its shards, which are then removed; returns the run's summary.

    started: when the first shard began, by the monotonic clock, if one did; how: as in `RunOutcome`. Raises OSError if the folder
    cannot be written; the shards' folders are then unchanged.
    """
    write_resolved(folder, scenario)
    with ResultsWriter.of(folder, scenario) as writer:
        digests = {name: _digest(scenario, name, shards, writer) for name in scenario.digested}
    for name, gathered in _tables(scenario, shards).items():
        gathered.write([shard.folder / f"{name}.parquet" for shard in shards], folder / f"{name}.parquet")
    wall = 0.0 if started is None else time.monotonic() - started
    scores = [load_score(shard.folder, shard.scenario) for shard in shards]
    run_tally = RunTally.merged(scores)
    replay = replay_of(folder, scenario)
    parts = _summaries(shards)
    ending = RunOutcome(
        wall,
        noted(how, _age_of_metrics(shards, scores, parts)),
        replay,
        events=_events(parts),
        outages=_outages(parts),
        misdelivered=_misdelivered(parts),
    )
    summary = summary_of(scenario, run_tally, digests, ending)
    write_summary(folder, summary)
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


def _age_of_metrics(shards: Sequence[Shard], scores: Sequence[RunTally], summaries: Mapping[int, Summary]) -> str:
    """What `ended` adds about shards whose recorders were killed after their last metrics."""
    earlier = [
        f"slot {score.tallies[LEGITIMATE].done} in shard {shard.number}"
        for shard, score in zip(shards, scores, strict=True)
        if shard.number in summaries and score.tallies[LEGITIMATE].done < summaries[shard.number].slots
    ]
    return as_of(", ".join(earlier)) if earlier else ""


def _events(summaries: Mapping[int, Summary]) -> list[RunEvent]:
    """The events of all shards: each once, in order of slots."""
    found = dict.fromkeys(event for summary in summaries.values() for event in summary.events)
    return sorted(found, key=lambda one: one.slot)


def _outages(summaries: Mapping[int, Summary]) -> list[ConnectionOutage]:
    """The outages of all shards, each with its shard, in order of slots."""
    found = [replace(one, shard=shard) for shard, summary in summaries.items() for one in summary.outages]
    return sorted(found, key=lambda one: one.slot)


def _misdelivered(summaries: Mapping[int, Summary]) -> dict[str, int]:
    """Process → messages that it dropped, in all shards together."""
    found: Counter[str] = Counter()
    for summary in summaries.values():
        found.update(summary.misdelivered)
    return dict(found)


def _summaries(shards: Sequence[Shard]) -> dict[int, Summary]:
    """Number → summary, of the shards that have written one."""
    found = {}
    for shard in shards:
        with suppress(UsageError):
            found[shard.number] = Results.read(shard.folder).typed_summary
    return found


def _tidy(folder: Path, shards: Sequence[Shard]) -> None:
    """Keep the logs of the shards, and the recording of the first; the rest is in the run's own tables."""
    for shard in shards:
        make_private(folder / "logs")
        with suppress(FileNotFoundError):
            os.replace(shard.folder / "logs", folder / "logs" / shard.name)
    with suppress(FileNotFoundError):
        os.replace(shards[0].folder / _RECORDING, folder / _RECORDING)
    shutil.rmtree(shards[0].folder.parent)
