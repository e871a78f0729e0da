"""Where two runs diverge: the first slot, trial and receiver that differ, with both values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import pyarrow as pa
import pyarrow.compute as pc

from evedrop.counting import counted
from evedrop.errors import UsageError
from evedrop.model.digest import BLOCK_SLOTS
from evedrop.names import CONTROLLER
from evedrop.results.reading import METRICS_AS_OF, Results

_COMPARED = ("sent", "action", "x", "x_hat", "P")
_INPUTS = ("u", "d", "failed", "watermark", "statistic")


@dataclass(frozen=True)
class RunDifference:
    """The first difference between two runs, if there is one."""

    same: bool
    text: str


def difference(a: Results, b: Results) -> RunDifference:
    """Compare all that the receivers received and estimated, trial by trial, for the trials and receivers that both runs have.

    Raises UsageError if a run has nothing of the kind.
    """
    blocks_a, blocks_b = _blocks(a), _blocks(b)
    for run, blocks in ((a, blocks_a), (b, blocks_b)):
        if not blocks and not len(run.trials):
            raise UsageError(
                f"{run.folder} has neither digests nor recorded trials, as a study of covariances only or a run of few slots "
                "that ended early; give a run that has"
            )
    ends_a, ends_b = _ends(a, blocks_a), _ends(b, blocks_b)
    common = [
        (peer, trial, block)
        for peer, trial, block in blocks_a.keys() & blocks_b.keys()
        if (end := ends_a.get((peer, block))) is not None and end == ends_b.get((peer, block))
    ]
    first = _first(a, b)
    if not common and first is None:
        return _by_rows_alone(a, b)
    unequal = sorted(
        (block, trial, peer)
        for peer, trial, block in common
        if blocks_a[peer, trial, block] != blocks_b[peer, trial, block]
    )
    in_both = len(blocks_a.keys() & blocks_b.keys())
    apart = {
        "in one run only": len(blocks_a) + len(blocks_b) - 2 * in_both,
        "not compared, since a run may lack slots of them": in_both - len(common),
    }
    rest = "".join(f" ({counted(count, 'block')} {which})" for which, count in apart.items() if count)
    if first is not None and (not unequal or first.slot < unequal[0][0] + BLOCK_SLOTS):
        return RunDifference(False, first.text + rest)
    if not unequal:
        other = _unequal_digests(a, b)
        if other:
            remedy = "record all trials in both runs to see the slot and the values"
            return RunDifference(
                False, f"the digest of {' and of '.join(other)} differs, in trials not recorded; {remedy}{rest}"
            )
        peers = ", ".join(sorted({peer for peer, _, _ in common}))
        return RunDifference(True, f"no difference in {counted(len(common), 'block')}: {peers}{rest}")
    block, trial, peer = unequal[0]
    slots = f"slots {block} to {ends_a[peer, block] - 1}"
    remedy = f"record it with --first-trial {trial} --trials 1 in both runs to see the slot and the values"
    return RunDifference(False, f"{peer} differs in trial {trial} within {slots}, not recorded; {remedy}{rest}")


def _by_rows_alone(a: Results, b: Results) -> RunDifference:
    """The answer for runs without a whole block in common, whose recorded rows do not differ: one may have ended early."""
    keys = ["slot", "trial", "peer"]
    count = _plain(a.trials, keys).join(_plain(b.trials, keys), keys, join_type="inner").num_rows
    if not count:
        return RunDifference(
            False, "the runs have no slot of a recorded trial and receiver in common; compare runs of one scenario"
        )
    return RunDifference(
        True,
        f"no difference in {counted(count, 'row')} of recorded trials; the runs have no whole block of {BLOCK_SLOTS} slots in "
        "common",
    )


def _unequal_digests(a: Results, b: Results) -> list[str]:
    """The entries of the summaries whose digests differ although both are of the same slots and trials.

    A summary whose metrics are of earlier slots than its rows may lack trials in its digests: those of a shard that was killed.
    """
    first, second = a.summary, b.summary
    if any(METRICS_AS_OF in str(summary.get("ended")) for summary in (first, second)):
        return []
    if any(first.get(name) != second.get(name) for name in ("slots", "trials", "first_trial")):
        return []
    digests = [
        {name: entry["digest"] for name, entry in summary.items() if isinstance(entry, dict) and entry.get("digest")}
        for summary in (first, second)
    ]
    return sorted(name for name in digests[0].keys() & digests[1].keys() if digests[0][name] != digests[1][name])


def _ends(results: Results, blocks: Iterable[tuple[str, int, int]]) -> dict[tuple[str, int], int]:
    """(Receiver, first slot of a block) → the slot after the block: a multiple of 256, the next block, or the run's end.

    Without the last block of a run that ended early, if it may go beyond the run's slots: a receiver may have been ahead of them.
    """
    slots, complete = int(results.summary["slots"]), results.remark is None
    starts: dict[str, set[int]] = {}
    for peer, _, block in blocks:
        starts.setdefault(peer, set()).add(block)
    ends = {}
    for peer, of_peer in starts.items():
        *earlier, last = sorted(of_peer)
        natural = (last // BLOCK_SLOTS + 1) * BLOCK_SLOTS
        if complete or natural <= slots:
            ends[peer, last] = min(natural, slots)
        for block, after in pairwise([*earlier, last]):
            ends[peer, block] = min((block // BLOCK_SLOTS + 1) * BLOCK_SLOTS, after)
    return ends


def _blocks(results: Results) -> dict[tuple[str, int, int], bytes]:
    columns = results.digests.to_pydict()
    keys = zip(columns["peer"], columns["trial"], columns["block"], strict=True)
    return dict(zip(keys, columns["digest"], strict=True))


@dataclass(frozen=True)
class _Row:
    slot: int
    text: str


def _first(a: Results, b: Results) -> _Row | None:
    """The first recorded row of a receiver or the controller that differs."""
    row = _first_row(a.trials, b.trials, ("slot", "trial", "peer"), _COMPARED)
    inputs = (a.inputs, b.inputs)
    if inputs[0] is None or inputs[1] is None:
        return row
    compared = [name for name in _INPUTS if name in inputs[0].schema.names and name in inputs[1].schema.names]
    steered = _first_row(inputs[0], inputs[1], ("slot", "trial"), compared)
    # The decision in a slot follows from the estimate after it.
    return steered if steered is not None and (row is None or steered.slot < row.slot) else row


def _first_row(a: pa.Table, b: pa.Table, keys: Sequence[str], compared: Sequence[str]) -> _Row | None:
    order = [(key, "ascending") for key in keys]
    tables = [_plain(table, (*keys, *compared)).sort_by(order) for table in (a, b)]
    joined = tables[0].join(tables[1], [*keys], join_type="inner", right_suffix="_b")
    unequal = None
    for name in compared:
        differs = pc.not_equal(joined[name], joined[f"{name}_b"])
        unequal = differs if unequal is None else pc.or_(unequal, differs)
    rows = joined.filter(unequal).sort_by(order).slice(0, 1).to_pylist()
    if not rows:
        return None
    row = rows[0]
    values = "; ".join(
        f"{name} {_shown(row[name])} against {_shown(row[f'{name}_b'])}"
        for name in compared
        if row[name] != row[f"{name}_b"]
    )
    return _Row(
        row["slot"],
        f"first difference: slot {row['slot']}, trial {row['trial']}, {row.get('peer', CONTROLLER)}: {values}",
    )


def _plain(table: pa.Table, names: Sequence[str]) -> pa.Table:
    """Columns that can be joined and compared: strings instead of dictionaries, bytes instead of lists of numbers."""
    columns = {}
    for name in names:
        column = table[name]
        if pa.types.is_dictionary(column.type):
            column = column.cast(pa.string())
        elif pa.types.is_fixed_size_list(column.type):
            column = _as_bytes(column)
        columns[name] = column
    return pa.table(columns)


def _as_bytes(column: pa.ChunkedArray) -> pa.Array:
    width = 8 * column.type.list_size
    if not column.num_chunks:
        return pa.array([], pa.binary())
    values = pa.concat_arrays([chunk.flatten() for chunk in column.chunks]).to_numpy()
    return pa.FixedSizeBinaryArray.from_buffers(pa.binary(width), len(column), [None, pa.py_buffer(values)]).cast(
        pa.binary()
    )


def _shown(value: str | bytes | bool) -> str:
    if not isinstance(value, bytes):
        return str(value)
    numbers = memoryview(value).cast("d").tolist()
    return "[" + ", ".join(repr(number) for number in numbers) + "]"
