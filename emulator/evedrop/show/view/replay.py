"""Makes the recording of a run without a view, or of a run in memory, from the tables of its results."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from operator import itemgetter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from evedrop.errors import UsageError
from evedrop.model.integrity.monitor import MonitoredSlots
from evedrop.model.process import Floats
from evedrop.model.receiver import ACTION_OF, INNOVATION, NOTHING, Flags
from evedrop.results.reading import Results
from evedrop.scenario.loading.recorded import recorded
from evedrop.show.view.scene import PeerSlots, SceneSlots
from evedrop.show.view.scored_slots import loop_values_of, open_recording

_CHUNK = 1000  # slots recorded at once


def replay(folder: Path, path: Path | None = None) -> Path:
    """Write the recording of a results folder to a path, by default its recording.rrd; returns the path.

    Raises UsageError if the folder's tables cannot be read, or hold no recorded trial.
    """
    results = Results.read(folder)
    looked_at = recorded(folder)
    scenario = looked_at.scenario
    path = folder / "recording.rrd" if path is None else path
    peers = {name: _peer(results, name) for name in scenario.receivers}
    x, nu, sent = _truth(results, scenario.receivers[0])
    if not len(x):
        raise UsageError(f"{folder} has no recorded trial to show; run it again, for example in the exact mode")
    _check_shapes(folder, len(scenario.process.A), x, peers)
    inputs, monitored, loop_values = _inputs(results), _monitored(results), loop_values_of(scenario)
    if loop_values is not None and len(inputs) != len(x):
        raise UsageError(f"{folder}: inputs.parquet does not have the slots of trials.parquet; run the scenario again")
    around = np.array(scenario.process.around)
    recording = open_recording(
        scenario, folder.name, path, words=looked_at.words, unknown_links=looked_at.unknown_links
    )
    with closing(recording):
        for first in range(0, len(x), _CHUNK):
            rows = slice(first, min(first + _CHUNK, len(x)))
            deviations = {name: peer.x_hat[rows] - around for name, peer in peers.items()}
            some = None if monitored is None else monitored.rows(rows)
            moved = None if loop_values is None else loop_values.take(inputs[rows], deviations, some)
            shown = {name: peer.mapped(itemgetter(rows)) for name, peer in peers.items()}
            recording.add(SceneSlots(first, x[rows], nu[rows], shown, moved, sent[rows]))
        for event in results.events:
            recording.note(event.slot, "INFO", event.line)
    if recording.failure is not None:
        path.unlink(missing_ok=True)
        raise UsageError(f"{path} cannot be written ({recording.failure}); make the folder writable")
    return path


def _check_shapes(folder: Path, n: int, x: Floats, peers: Mapping[str, PeerSlots]) -> None:
    """Raise UsageError unless the tables hold the same slots of every receiver, of a process with n states."""
    if x.shape[1] != n:
        raise UsageError(
            f"{folder}: trials.parquet has {x.shape[1]} states and scenario.toml {n}; run the scenario again"
        )
    for name, peer in peers.items():
        if {len(x)} != {len(column) for column in (peer.x_hat, peer.squared_error)}:
            raise UsageError(f"{folder}: its tables do not have the same slots of {name}; run the scenario again")


def _first_trial(results: Results, name: str) -> pa.Table:
    """The rows of a receiver's first recorded trial, slot by slot."""
    rows = results.trials.filter(pc.field("peer") == name)
    if rows.num_rows:
        rows = rows.filter(pc.field("trial") == pc.min(rows["trial"]))
    return rows.sort_by("slot")


def _truth(results: Results, name: str) -> tuple[Floats, Flags, Flags]:
    """True states, ν, and whether a packet was sent, in the first recorded trial; name: any receiver."""
    rows = _first_trial(results, name)
    words = rows["sent"].cast(pa.string()).to_pylist()
    nu = np.array([word == INNOVATION for word in words], np.bool_)
    return _matrix(rows["x"]), nu, np.array([word != NOTHING for word in words], np.bool_)


def _inputs(results: Results) -> Floats:
    """Inputs of the first recorded trial, (slots, m); empty without a controller."""
    rows = results.inputs
    if rows is None or not rows.num_rows:
        return np.empty((0, 0))
    return _matrix(rows.filter(pc.field("trial") == pc.min(rows["trial"])).sort_by("slot")["u"])


def _monitored(results: Results) -> MonitoredSlots | None:
    """Watermark and detector of the first recorded trial; None without them."""
    rows = results.inputs
    if rows is None or not rows.num_rows or "statistic" not in rows.schema.names:
        return None
    rows = rows.filter(pc.field("trial") == pc.min(rows["trial"])).sort_by("slot")
    return MonitoredSlots(rows["statistic"].to_numpy()[:, None], _matrix(rows["watermark"])[:, :, None])


def _peer(results: Results, name: str) -> PeerSlots:
    rows = _first_trial(results, name)
    means = results.slots.filter(pc.field("peer") == name).sort_by("slot").slice(0, rows.num_rows)
    x_hat, P = _matrix(rows["x_hat"]), _matrix(rows["P"])
    n = x_hat.shape[1] if x_hat.ndim == 2 else 0
    words = rows["action"].cast(pa.string()).to_pylist()
    unknown = sorted(set(words) - ACTION_OF.keys())
    if unknown:
        raise UsageError(
            f"{results.folder}: trials.parquet has the unknown action {unknown[0]}; run the scenario again"
        )
    return PeerSlots(
        x_hat=x_hat,
        P=P.reshape(-1, n, n),
        action=np.array([ACTION_OF[word] for word in words], np.uint8),
        squared_error=means["mean_squared_error"].to_numpy(),
        standard_error=means["standard_error"].to_numpy(),
        trace=means["mean_trace_covariance"].to_numpy(),
        expected_trace=means["expected_trace_covariance"].to_numpy(),
    )


def _matrix(column: pa.ChunkedArray) -> Floats:
    """A column of lists of equal length as an array, (rows, length)."""
    flat: Floats = (
        pa.concat_arrays([chunk.flatten() for chunk in column.chunks]).to_numpy() if len(column) else np.empty(0)
    )
    return flat.reshape(len(column), column.type.list_size)
