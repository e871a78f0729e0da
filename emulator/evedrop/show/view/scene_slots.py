"""A run in the view's form: its scene at the start, and its slots, as they are scored or from the tables of its results.

From the tables the recording is made of a run without a view, or of a run in memory. In a closed loop, the slots include the
plant's inputs and disturbances and the curves of applications, of the trial that the view shows. Texts have only letters of the
viewer's font: others would end a headless viewer, which then draws no picture. Rerun is imported only when a recording is
opened.

Source: docs/view.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from evedrop.errors import UsageError
from evedrop.model.acknowledgements import AckChannel
from evedrop.model.process import Floats
from evedrop.model.receiver import ACTION_OF, INNOVATION, NOTHING, Action, Codes, Flags
from evedrop.model.slot.link import Change
from evedrop.model.slot.records import ReceiverSlots, SensorSlots
from evedrop.model.streams import Batch, root_of_seed
from evedrop.names import LEGITIMATE
from evedrop.results.folder import private_replacement
from evedrop.results.reading import Results
from evedrop.scenario.application import APPLICATIONS, ControlledPlant, Sketch
from evedrop.scenario.closed_loop import controlled_plant, labels, monitor_of
from evedrop.scenario.recorded import recorded
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import Scenario
from evedrop.score.links import ack_channel_of
from evedrop.score.scorekeeper import Scored
from evedrop.score.slots import Slots
from evedrop.show.view.scene import AckScene, AttackSpan, Moved, PeerSlots, Scene, SceneSlots, Shown
from evedrop.system.output import warn

if TYPE_CHECKING:
    from evedrop.show.view.recording import ViewRecording


_UNKNOWN = re.compile(
    "[^ -~\u00a1-\u0148\u014a-\u02af\u0386\u0388-\u038a\u038c\u038e-\u03a1\u03a3-\u03ce\u0400-\u045f"  # Latin, Greek, Cyrillic
    "−≤≥≈₀ₖ→←∞∑·…–—„“”‘’‰€‖∂\u0302]"
)


def drawable(text: str) -> str:
    """The text with a question mark for each letter that the viewer's font may lack."""
    return _UNKNOWN.sub("?", text)


@final
class LoopValues:
    """Follows one trial of a closed loop, whose slots come in order, and gives the view its values."""

    def __init__(self, loop: ControlledPlant, scenario: Scenario) -> None:
        self._plant, self._disturbances = loop.plant, loop.disturbances
        feeds = [APPLICATIONS[name].feed(loop, table) for name, table in scenario.applications.items()]
        self._feeds = [feed for feed in feeds if feed is not None]
        self._next = 0

    @classmethod
    def of(cls, scenario: Scenario) -> LoopValues | None:
        """An instance for the trial that the view shows; None without a controller."""
        loop = controlled_plant(scenario)
        return None if loop is None else cls(loop, scenario)

    def take(self, sensor: SensorSlots, estimates: Mapping[str, Floats]) -> Moved:
        """The view's values of the next slots, from the sensor in this trial alone, and estimates as deviations, (c, n)."""
        applied = sensor.applied
        assert sensor.u is not None and applied is not None  # noqa: S101, PT018 - there is a controller
        limited = self._limited(sensor.u)
        first, self._next = self._next, self._next + len(limited)
        values = np.hstack([self._disturbances[first : self._next], limited])
        curves: dict[str, Floats] = {}
        for feed in self._feeds:
            if sensor.statistic is not None:
                curves |= feed.take_monitored(first, sensor)
            curves |= feed.take(first, self._limited(applied), estimates)
        return Moved(values, curves)

    def _limited(self, u: Floats) -> Floats:
        """The inputs u (c, m, 1) within their limits, (c, m)."""
        return self._plant.limited(u[:, :, 0].T).T


@final
class AckFates:
    """Follows the acknowledgements of one trial, whose slots come in order.

    They follow from who received which packet, and from the channel's random numbers, which the seed gives.
    """

    def __init__(self, scenario: Scenario, trial: int, unknown_links: Collection[str] = ()) -> None:
        """unknown_links: as in `open_recording`."""
        spec = ack_channel_of(scenario) if _acknowledges(scenario, unknown_links) else None
        key = StreamKeys(root_of_seed(scenario.seed), b"").acknowledgements
        self._channel = None if spec is None else AckChannel(spec, key, Batch(scenario.slots, 1, trial))
        self._jammer = LEGITIMATE if spec is None or spec.jammer is None else spec.jammer

    def take(self, first: int, sent: Flags | None, actions: Mapping[str, Codes]) -> Codes | None:
        """`AckFate` of the next slots, (c,); None without acknowledgements. sent (c,); actions: receiver → `Action`, (c,)."""
        if self._channel is None:
            return None
        gamma, gamma_e = (actions[name][:, None] != Action.LOST for name in (LEGITIMATE, self._jammer))
        fates = [
            self._channel.fates(first + row, None if sent is None else sent[row : row + 1], gamma[row], gamma_e[row])
            for row in range(len(gamma))
        ]
        return np.concatenate(fates)


def _acknowledges(scenario: Scenario, unknown_links: Collection[str]) -> bool:
    """Whether there are acknowledgements whose fates can be known: a hijacked sensor heeds them by the quality of a link."""
    acks = scenario.acknowledgements
    return acks is not None and not (acks.attack == "hijack" and acks.jammer in unknown_links)


def attacked_scene(scenario: Scenario, unknown_links: Collection[str] = ()) -> dict[str, Any]:
    """The entries of `Scene` for attacks; empty without. unknown_links: as in `open_recording`."""
    entries: dict[str, Any] = {}
    if scenario.acknowledgements is not None and _acknowledges(scenario, unknown_links):
        entries["acknowledgements"] = AckScene(scenario.acknowledgements.attack, scenario.acknowledgements.jammer)
    plan, last = monitor_of(scenario), scenario.slots
    spans = []
    if plan is not None and plan.attack is not None:
        words = {"replay": "measurements are a recording", "replace": "measurements are replaced"}
        text = words.get(plan.attack, "measurements are attacked")
        spans += [AttackSpan(text, first, min(stop, last)) for first, stop in plan.spans]
    for name, changes in scenario.timeline.changes.items():
        began = None
        for change in (*changes, Change(last, cut=False)):
            if change.cut and began is None:
                began = change.at
            elif change.cut is False and began is not None:
                spans.append(AttackSpan("", began, min(change.at, last), name))
                began = None
    return {**entries, "spans": tuple(sorted(spans, key=lambda span: span.first))}


def driven_scene(scenario: Scenario) -> dict[str, Any]:
    """The entries of `Scene` for a plant with a controller; empty without."""
    plant, process, loop = scenario.plant, scenario.process, controlled_plant(scenario)
    if plant is None or loop is None:
        return {}
    drawings = (APPLICATIONS[name].drawing(loop, table) for name, table in scenario.applications.items())
    return {
        "states": tuple(map(drawable, labels(process.states, process.units))),
        "moving": tuple(map(drawable, (*loop.disturbance_labels, *labels(plant.inputs, plant.input_units)))),
        "panels": tuple(
            replace(panel, title=drawable(panel.title))
            for name, table in scenario.applications.items()
            for panel in APPLICATIONS[name].panels(loop, table)
        ),
        "drawing": next(map(_drawable, filter(None, drawings)), None),
    }


def _drawable(sketch: Sketch) -> Sketch:
    """The same drawing, in letters of the viewer's font."""
    levels = (replace(level, name=drawable(level.name)) for level in sketch.levels)
    flows = (replace(flow, positive=drawable(flow.positive), negative=drawable(flow.negative)) for flow in sketch.flows)
    return replace(sketch, levels=tuple(levels), flows=tuple(flows))


def open_recording(
    scenario: Scenario,
    run: str,
    path: Path,
    warn: Callable[[str], None] = warn,
    words: Mapping[str, str] | None = None,
    unknown_links: Collection[str] = (),
    *,
    trials: int | None = None,
    live: bool = False,
) -> ViewRecording:
    """Begin the run's recording on disk.

    run: its name; warn: as in ViewRecording; words: receiver → the name of its scheme or strategy, if not that of the scenario;
    unknown_links: receivers whose link has a quality that is not that of the scenario, and unknown; trials: how many there are,
    if not those of the scenario; live: as in ViewRecording.
    """
    from evedrop.show.view.recording import ViewRecording  # noqa: PLC0415 - saves 0.3 s and 100 MB in a run without a view

    quality = scenario.quality
    described = {
        LEGITIMATE: scenario.encoding.scheme,
        **{name: table.strategy for name, table in scenario.eavesdroppers.items()},
    }
    receivers = [
        Shown(
            name,
            "legitimate" if name == LEGITIMATE else "eavesdropper",
            {**described, **(words or {})}[name],
            None if name in unknown_links else quality[name],
        )
        for name in scenario.receivers
    ]
    ways = {name: scenario.link(name).model.ways for name in scenario.receivers if name not in unknown_links}
    scene = Scene(
        title=drawable(scenario.title),
        run=run,
        slots=scenario.slots,
        trials=scenario.trials if trials is None else trials,
        n=len(scenario.process.A),
        pace=scenario.pace,
        receivers=tuple(receivers),
        noise=float(np.trace(scenario.process.process.Q)),
        units=tuple(map(drawable, scenario.process.units or ())),
        ways={name: ways for name, ways in ways.items() if ways is not None},
        growth=_growth(scenario),
        slot_seconds=scenario.slot_seconds,
        of_estimate=scenario.measures,
        **driven_scene(scenario),
        **attacked_scene(scenario, unknown_links),
    )
    return ViewRecording(path, scene, warn, live=live)


def _growth(scenario: Scenario) -> float:
    """As in `Scene`, by the largest eigenvalue."""
    largest = float(np.abs(np.linalg.eigvals(np.array(scenario.process.A))).max())
    return scenario.slots * max(0.0, math.log10(max(largest, 1.0)))


@final
class ShownTrial:
    """The trial that the view shows, whose slots come in order."""

    def __init__(self, scenario: Scenario, trial: int, unknown_links: Collection[str] = ()) -> None:
        """unknown_links: as in `open_recording`."""
        self.around = np.array(scenario.process.around)
        """The reference from which states are deviations, (n,)."""
        self.loop_values = LoopValues.of(scenario)
        self._ack_fates = AckFates(scenario, trial, unknown_links)

    def scored(self, slots: Slots, scored: Mapping[str, Scored]) -> SceneSlots:
        """Some slots for the view: the first recorded trial, in absolute values, and means over all trials."""
        peers = {
            name: PeerSlots(
                slots.first,
                x_hat=receiver.x_hat[:, :, 0] + self.around,
                P=receiver.P[:, :, :, 0],
                action=receiver.action[:, 0],
                squared_error=np.asarray(scored[name].squared_error.mean(axis=1)),
                standard_error=scored[name].sums.standard_errors,
                trace=_sums(receiver)[:, 0] / slots.trials,
                theoretical_trace=scored[name].expected,
            )
            for name, receiver in slots.receivers.items()
        }
        sensor = slots.sensor.part(slice(0, 1))
        estimates = {name: receiver.x_hat[:, :, 0] for name, receiver in slots.receivers.items()}
        return self.slots(sensor, sensor.x[:, :, 0] + self.around, estimates, peers)

    def slots(
        self, sensor: SensorSlots, x: Floats, estimates: Mapping[str, Floats], peers: Mapping[str, PeerSlots]
    ) -> SceneSlots:
        """Some slots for the view; sensor: in this trial alone; x: true states, (c, n); estimates: as deviations, (c, n)."""
        moved = None if self.loop_values is None else self.loop_values.take(sensor, estimates)
        sent = None if sensor.sent is None else sensor.sent[:, 0]
        acknowledged = self._ack_fates.take(sensor.first, sent, {name: peer.action for name, peer in peers.items()})
        return SceneSlots(sensor.first, x, sensor.nu[:, 0], peers, moved, sent, acknowledged)


_CHUNK = 1000  # slots recorded at once


def replay(folder: Path, path: Path | None = None) -> Path:
    """Write the recording of a results folder to a path, by default its recording.rrd; returns the path.

    Raises UsageError if the folder's tables cannot be read, or hold no recorded trial.
    """
    results = Results.read(folder)
    looked_at = recorded(folder)
    scenario = looked_at.scenario
    path = folder / "recording.rrd" if path is None else path
    # Each table once, and the trials first: those of a run in progress grow, and later ones have at least the same slots.
    trials, slots, inputs = results.trials, results.slots, results.inputs
    peers = {name: _peer(folder, trials, slots, name) for name in scenario.receivers}
    sensor = _sensor(trials, inputs, scenario.receivers[0])
    x = sensor.x[:, :, 0]
    if not len(x):
        raise UsageError(f"{folder} has no recorded trial to show; run it again, for example in the exact mode")
    _check_shapes(folder, len(scenario.process.A), x, peers)
    trial = ShownTrial(scenario, int(pc.min(trials["trial"]).as_py()), looked_at.unknown_links)
    if trial.loop_values is not None and (sensor.u is None or len(sensor.u) != len(x)):
        raise UsageError(f"{folder}: inputs.parquet does not have the slots of trials.parquet; run the scenario again")
    try:
        # One that is cut short would be shown ever after as that of the whole run.
        with private_replacement(path, lasting=False) as unfinished:
            recording = open_recording(
                scenario,
                folder.name,
                unfinished,
                words=looked_at.words,
                unknown_links=looked_at.unknown_links,
                trials=pc.max(slots["trials"]).as_py(),  # an interrupted study has fewer than its scenario
            )
            with closing(recording):
                _record(recording, results, sensor, peers, trial)
            if recording.failure is not None:
                raise OSError(recording.failure)
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror or error}); make the folder writable") from error
    return path


def _record(
    recording: ViewRecording, results: Results, sensor: SensorSlots, peers: Mapping[str, PeerSlots], trial: ShownTrial
) -> None:
    """Add all slots, events and the verdict; sensor and peers: in absolute values."""
    for first in range(0, len(sensor.x), _CHUNK):
        rows = slice(first, min(first + _CHUNK, len(sensor.x)))
        some, beliefs = sensor.rows(rows), {name: peer.rows(rows) for name, peer in peers.items()}
        deviations = {name: peer.x_hat - trial.around for name, peer in beliefs.items()}
        recording.add(trial.slots(some, some.x[:, :, 0], deviations, beliefs))
    for event in results.events:
        recording.note(event.slot, "INFO", event.line)
    if results.remark is None:
        recording.conclude(results.typed_summary.verdict)


def _check_shapes(folder: Path, n: int, x: Floats, peers: Mapping[str, PeerSlots]) -> None:
    """Raise UsageError unless the tables hold the same slots of every receiver, of a process with n states."""
    if x.shape[1] != n:
        raise UsageError(
            f"{folder}: trials.parquet has {x.shape[1]} states and scenario.toml {n}; run the scenario again"
        )
    for name, peer in peers.items():
        if {len(x)} != {len(column) for column in (peer.x_hat, peer.squared_error)}:
            raise UsageError(f"{folder}: its tables do not have the same slots of {name}; run the scenario again")


def _first_trial(trials: pa.Table, name: str) -> pa.Table:
    """The rows of a receiver's first recorded trial, slot by slot."""
    rows = trials.filter(pc.field("peer") == name)
    if rows.num_rows:
        rows = rows.filter(pc.field("trial") == pc.min(rows["trial"]))
    return rows.sort_by("slot")


def _sensor(trials: pa.Table, inputs: pa.Table | None, name: str) -> SensorSlots:
    """The sensor in the first recorded trial, with states in absolute values; name: any receiver."""
    rows = _first_trial(trials, name)
    words = rows["sent"].cast(pa.string()).to_pylist()
    nu = np.array([word == INNOVATION for word in words], np.bool_)[:, None]
    sent = np.array([word != NOTHING for word in words], np.bool_)[:, None]
    sensor = SensorSlots(0, _matrix(rows["x"])[..., None], nu, sent)
    if inputs is None or not inputs.num_rows:
        return sensor
    inputs = inputs.filter(pc.field("trial") == pc.min(inputs["trial"])).sort_by("slot").slice(0, rows.num_rows)
    monitored = "statistic" in inputs.schema.names
    return replace(
        sensor,
        u=_matrix(inputs["u"])[..., None],
        statistic=inputs["statistic"].to_numpy()[:, None] if monitored else None,
        watermark=_matrix(inputs["watermark"])[..., None] if monitored else None,
    )


def _sums(receiver: ReceiverSlots) -> Floats:
    """The sums of traces over all trials, (c, 2)."""
    assert receiver.trace is not None  # noqa: S101 - of slots that are complete
    return receiver.trace


def _peer(folder: Path, trials: pa.Table, slots: pa.Table, name: str) -> PeerSlots:
    rows = _first_trial(trials, name)
    means = slots.filter(pc.field("peer") == name).sort_by("slot").slice(0, rows.num_rows)
    x_hat, P = _matrix(rows["x_hat"]), _matrix(rows["P"])
    n = x_hat.shape[1] if x_hat.ndim == 2 else 0
    words = rows["action"].cast(pa.string()).to_pylist()
    unknown = sorted(set(words) - ACTION_OF.keys())
    if unknown:
        raise UsageError(f"{folder}: trials.parquet has the unknown action {unknown[0]}; run the scenario again")
    return PeerSlots(
        0,
        x_hat=x_hat,
        P=P.reshape(-1, n, n),
        action=np.array([ACTION_OF[word] for word in words], np.uint8),
        squared_error=means["mean_squared_error"].to_numpy(),
        standard_error=means["standard_error"].to_numpy(),
        trace=means["mean_trace_covariance"].to_numpy(),
        theoretical_trace=means["theoretical_trace_covariance"].to_numpy(),
    )


def _matrix(column: pa.ChunkedArray) -> Floats:
    """A column of lists of equal length as an array, (rows, length)."""
    flat: Floats = (
        pa.concat_arrays([chunk.flatten() for chunk in column.chunks]).to_numpy() if len(column) else np.empty(0)
    )
    return flat.reshape(len(column), column.type.list_size)
