"""Tables of shards as one: what one writer of all trials writes, however the rows of each came and however few fit at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.live.launch.gathering import Gathered, Journals, Recorded, Statistics, _accused, _events
from evedrop.model.links.loss_model import REASONS
from evedrop.model.slot.records import LinkSlots, ReceiverSlots, SensorSlots
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import RunEvent
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.score.slots import Slots
from evedrop.score.sums import slot_sums, squared_errors
from tests.examples import examples

SCENARIO = load("eavesdroppers")
NAMES = SCENARIO.receivers
N, SLOTS, TRIALS, RECORDED = 2, 40, 11, 5


def slots_of(seed: int) -> Slots:
    """What a run of all trials might have been."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(SLOTS, N, TRIALS))
    receivers, links = {}, {}
    for name in NAMES:
        action = rng.integers(0, 4, (SLOTS, TRIALS)).astype(np.uint8)
        delivered = action > 0
        P = rng.random((SLOTS, N, N, TRIALS))
        receivers[name] = ReceiverSlots(0, x + rng.normal(size=x.shape), action, P, rng.random((SLOTS, 2)))
        links[name] = link_of(0, delivered)
    return Slots(SensorSlots(0, x, rng.random((SLOTS, TRIALS)) < 0.5), receivers, links)


def link_of(first: int, delivered: np.ndarray) -> LinkSlots:
    """A link that loses what it does not deliver."""
    lost = np.zeros((len(delivered), len(REASONS)), np.uint32)
    lost[:, 0] = np.count_nonzero(~delivered, axis=1)
    return LinkSlots(first, delivered, lost, np.zeros(len(delivered), np.uint32))


def part_of(whole: Slots, rows: slice, trials: slice, recorded: int) -> Slots:
    """Some slots of some of its trials, the first `recorded` trials in full."""
    receivers, links = {}, {}
    for name, receiver in whole.receivers.items():
        some = receiver.rows(rows).part(trials)
        trace = np.einsum("kiir->kr", some.P)
        sums = np.stack([trace.sum(axis=1), (trace * trace).sum(axis=1)], axis=1)
        receivers[name] = replace(some, P=some.P[..., :recorded], trace=sums)
        links[name] = link_of(rows.start, whole.links[name].delivered[rows, trials])
    return Slots(whole.sensor.rows(rows).part(trials), receivers, links)


def write(folder: Path, whole: Slots, trials: slice, recorded: int, ends: Sequence[int]) -> None:
    """The tables of some trials, of slots that came in parts with these ends; none at all without a part."""
    folder.mkdir()
    if not ends:
        return
    with ResultsWriter(folder, SCENARIO) as writer:
        for first, end in zip([0, *ends], ends, strict=False):
            part = part_of(whole, slice(first, end), trials, recorded)
            errors = {name: squared_errors(part.sensor.x, receiver.x_hat) for name, receiver in part.receivers.items()}
            for name, receiver in part.receivers.items():
                sums = slot_sums(errors[name], receiver.action, receiver.trace)
                writer.slot_rows(first, name, sums, np.arange(first, end) / 7.0)
            writer.trial_rows(part, errors, 100 + trials.start)
            writer.journal_rows(part)


def gathered(
    folder: Path, shards: Sequence[Path], sizes: Sequence[int], at_once: int
) -> Iterator[tuple[str, pa.Table]]:
    """The tables of the run, put together this number of slots at a time."""
    folder.mkdir()
    with ResultsWriter(folder, SCENARIO):
        pass
    made: dict[str, Gathered] = {
        "slots": Statistics(NAMES),
        "trials": Recorded(NAMES, range(100, 100 + RECORDED), 6 + 2 * N + N * N),
        "journal": Journals(NAMES, sizes),
    }
    for name, writer in made.items():
        writer.slots_at_once = at_once
        writer.write([shard / f"{name}.parquet" for shard in shards], folder / f"{name}.parquet")
        yield name, pq.read_table(folder / f"{name}.parquet")


def sorted_rows(table: pa.Table) -> pa.Table:
    """By slot, receiver and trial."""
    by = "link" if "link" in table.column_names else "peer"
    keys = ["slot", "who", *(["trial"] if "trial" in table.column_names else [])]
    plain = table.append_column("who", table[by].cast(pa.string())).drop_columns([by])
    for i, field in enumerate(plain.schema):
        if pa.types.is_dictionary(field.type):
            plain = plain.set_column(i, field.name, plain[field.name].cast(pa.string()))
    return plain.sort_by([(key, "ascending") for key in keys])


def same(table: pa.Table, wanted: pa.Table) -> None:
    """Check that two tables have the same rows, numbers of statistics within rounding."""
    assert table.schema == wanted.schema
    table, wanted = sorted_rows(table), sorted_rows(wanted)
    for name in wanted.column_names:
        if name in ("mean_squared_error", "mean_trace_covariance", "standard_error"):
            np.testing.assert_allclose(table[name].to_numpy(), wanted[name].to_numpy(), rtol=1e-12, err_msg=name)
        else:
            assert table[name].to_pylist() == wanted[name].to_pylist(), name


ends = st.lists(st.integers(1, SLOTS - 1), max_size=6, unique=True).map(lambda some: [*sorted(some), SLOTS])


in_parts = given(
    cut=st.integers(1, TRIALS - 1), first=ends, second=ends, at_once=st.integers(1, 50), seed=st.integers(0, 9)
)


@pytest.mark.thorough
@settings(max_examples=examples(16))
@in_parts
def test_two_shards_are_the_whole(cut: int, first: list[int], second: list[int], at_once: int, seed: int) -> None:
    """Wherever the trials are cut, in whatever parts their slots came, and however many slots fit into memory."""
    check_two_shards(cut, first, second, at_once, seed)


@pytest.mark.long
@settings(max_examples=100)
@in_parts
def test_two_shards_are_the_whole_in_many_parts(
    cut: int, first: list[int], second: list[int], at_once: int, seed: int
) -> None:
    """The same with more examples."""
    check_two_shards(cut, first, second, at_once, seed)


def check_two_shards(cut: int, first: list[int], second: list[int], at_once: int, seed: int) -> None:
    """Check that the tables of two shards, put together, have the rows of the whole run."""
    whole = slots_of(seed)
    with TemporaryDirectory() as name:
        folder = Path(name)
        write(folder / "whole", whole, slice(0, TRIALS), RECORDED, [SLOTS])
        write(folder / "1", whole, slice(0, cut), min(cut, RECORDED), first)
        write(folder / "2", whole, slice(cut, TRIALS), max(1, RECORDED - cut), second)
        shards, sizes = [folder / "1", folder / "2"], [cut, TRIALS - cut]
        for table, actual in gathered(folder / "run", shards, sizes, at_once):
            same(actual, pq.read_table(folder / "whole" / f"{table}.parquet"))


@pytest.mark.parametrize("missing", [[], [13]], ids=["killed", "cut short"])
def test_a_shard_that_came_to_less_leaves_the_others_as_they_are(tmp_path: Path, missing: list[int]) -> None:
    """The rows of slots that one shard did not come to are of the others' trials, and its bits are 0."""
    whole = slots_of(1)
    write(tmp_path / "1", whole, slice(0, 4), 4, [SLOTS])
    write(tmp_path / "2", whole, slice(4, TRIALS), 1, missing)
    tables = dict(gathered(tmp_path / "run", [tmp_path / "1", tmp_path / "2"], [4, TRIALS - 4], 9))
    here = missing[0] if missing else 0
    for row in tables["slots"].to_pylist():
        assert row["trials"] == (TRIALS if row["slot"] < here else 4)
    for row in tables["journal"].to_pylist():
        flags = whole.links[row["link"]].delivered[row["slot"]].copy()
        flags[slice(TRIALS if row["slot"] < here else 4, None)] = False
        assert row["offered"] == (TRIALS if row["slot"] < here else 4)
        assert row["delivered_mask"] == np.packbits(flags, bitorder="little").tobytes()
    trials = tables["trials"].to_pylist()
    assert len(trials) == len(NAMES) * (4 * SLOTS + here)


def test_a_run_has_the_events_of_the_shard_that_came_farthest() -> None:
    """In their order, and each as often as the scenario has it: one may have two notes of the same words in a slot."""
    note = RunEvent(3, "look", "scenario")
    events = [note, RunEvent(3, "cut smart", "scenario"), note, RunEvent(9, "heal smart", "scenario")]
    nothing = summary_of(SCENARIO, RunTally.nothing(SCENARIO, 1), dict.fromkeys(SCENARIO.digested), RunOutcome(1.0))
    parts = {number: replace(nothing, events=events[:count]) for number, count in ((1, 2), (2, 4), (3, 0))}
    assert _events(parts) == events
    assert not _events({})


def test_a_receiver_that_one_shard_accuses_is_accused_in_the_whole_run() -> None:
    """Otherwise the summary of a run that its contradiction ended would call its metrics verified."""
    outcomes = (RunOutcome(1.0), RunOutcome(1.0, "smart contradicts router", accused=("smart", "router")))
    nothing, digests = RunTally.nothing(SCENARIO, 1), dict.fromkeys(SCENARIO.digested)
    parts = {number: summary_of(SCENARIO, nothing, digests, outcome) for number, outcome in enumerate(outcomes, 1)}
    assert _accused(parts) == ("smart",)
    assert _accused({1: parts[1]}) == ()
