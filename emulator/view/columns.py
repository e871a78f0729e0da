"""Slots as columns of the recording: the data of each panel, and its style."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes
from evedrop.view import driven, lanes, paths, plane
from evedrop.view.column import Column, scalars
from evedrop.view.events import Event, Watcher
from evedrop.view.lanes import Lane
from evedrop.view.palette import GROUND, TRUTH, TRUTH_CURVE, colour, dim
from evedrop.view.scene import PeerSlots, Scene, SceneSlots


@final
class Columns:
    """Turns the slots of a run, in order, into columns.

    Scalars and lanes are complete; the plane has only its frames.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._floor = _floor(scene)
        self._last: dict[str, int] = {}
        self._frame = plane.Frame()
        every = plane.stride(scene)
        self._trails = {name: plane.Trail(every) for name in (paths.TRUTH, *(r.name for r in scene.receivers))}
        self._watchers = {shown.name: Watcher(shown, scene) for shown in scene.receivers}

    def of(self, slots: SceneSlots) -> list[Column]:
        """The columns of the next slots."""
        k = np.arange(slots.first, slots.first + slots.count)
        columns: list[Column] = []
        if self._scene.n == 1:
            columns.append(scalars(f"{paths.PLANE}/{paths.TRUTH}", k, slots.x[:, 0]))
        else:
            columns.extend(self._truth(k, slots))
        self._lane(paths.lane(self._scene, -1), lanes.SENT, k, lanes.sent(slots.nu, slots.sent), columns)
        for i, shown in enumerate(self._scene.receivers):
            peer = slots.peers[shown.name]
            columns.extend(self._curves(shown.name, k, peer))
            columns.extend(self._estimate(shown.name, k, peer))
            legitimate = shown.role == "legitimate"
            words = lanes.LEGITIMATE if legitimate else lanes.EAVESDROPPER
            # The legitimate estimator knows every type, and is never misled.
            types = np.zeros_like(slots.nu) if legitimate else slots.nu
            codes = lanes.received(peer.action, types, slots.sent)
            self._lane(paths.lane(self._scene, i), words, k, codes, columns)
            events = self._watchers[shown.name].watch(slots.first, codes)
            if events:
                columns.append(lines(shown.name, events))
        if slots.moved is not None:
            columns.extend(driven.columns(self._scene, k, slots, slots.moved))
        return columns

    def _curves(self, name: str, k: NDArray[np.int64], peer: PeerSlots) -> Iterator[Column]:
        curves = ((paths.ERROR, peer.squared_error), (paths.TRACE, peer.trace), (paths.THEORY, peer.expected_trace))
        for kind, values in curves:
            known = ~np.isnan(values)  # there is no theory for some links
            if known.any():
                yield scalars(paths.curve(kind, name), k[known], self._log10(values[known]))

    def _log10(self, values: Floats) -> Floats:
        """log10, with everything below the floor raised to it: a state that was received is known exactly."""
        with np.errstate(invalid="ignore"):
            logarithms: Floats = np.log10(np.maximum(values, self._floor))
        return logarithms

    def _truth(self, k: NDArray[np.int64], slots: SceneSlots) -> Iterator[Column]:
        at = plane.frames(self._scene, slots.first, slots.count)
        positions = plane.on_plane(slots.x)
        yield from self._moving(paths.TRUTH, k, positions, at)
        everybody = np.stack([positions, *(plane.on_plane(peer.x_hat) for peer in slots.peers.values())])
        boxes = self._frame.boxes(everybody.min(axis=0), everybody.max(axis=0), at)
        if len(at):
            yield Column(paths.FRAME, k[at], rr.LineStrips2D.columns(strips=boxes))

    def _estimate(self, name: str, k: NDArray[np.int64], peer: PeerSlots) -> Iterator[Column]:
        if self._scene.n == 1:
            yield scalars(f"{paths.PLANE}/{name}", k, peer.x_hat[:, 0])
            return
        at = plane.frames(self._scene, int(k[0]), len(k))
        yield from self._moving(name, k, plane.on_plane(peer.x_hat), at)
        if len(at):
            shapes = plane.ellipses(peer.x_hat[at], peer.P[at])
            yield Column(paths.ellipse(name), k[at], rr.LineStrips2D.columns(strips=shapes))

    def _moving(
        self, name: str, k: NDArray[np.int64], positions: plane.Points, at: NDArray[np.intp]
    ) -> Iterator[Column]:
        pieces = self._trails[name].pieces(positions, at)
        if len(at):
            yield Column(paths.trail(name), k[at], rr.LineStrips2D.columns(strips=pieces))
            yield Column(paths.point(name), k[at], rr.Points2D.columns(positions=positions[at]))

    def _lane(
        self,
        path: str,
        lane: Lane,
        k: NDArray[np.int64],
        codes: Codes,
        columns: list[Column],
    ) -> None:
        before = self._last.get(path)
        changed = np.empty(len(codes), np.bool_)
        changed[0] = before is None or int(codes[0]) != before
        np.not_equal(codes[1:], codes[:-1], out=changed[1:])
        at = np.flatnonzero(changed)
        self._last[path] = int(codes[-1])
        if len(at):
            words = [lane.words[code] for code in codes[at].tolist()]
            columns.append(Column(path, k[at], rr.StateChange.columns(state=words)))


def lines(name: str, events: list[Event]) -> Column:
    """Event lines as a column."""
    k = np.array([event.k for event in events], np.int64)
    texts, levels = [event.text for event in events], [event.level for event in events]
    return Column(paths.events(name), k, rr.TextLog.columns(text=texts, level=levels))


# Where slots share a pixel: the mean of logarithms would be far below the logarithm of the mean.
_LARGEST = rr.components.AggregationPolicy.Max


def log_styles(to: rr.RecordingStream, scene: Scene) -> None:
    """Log names and colours of everything, once."""
    driven.log_styles(to, scene)
    _log_lane_style(to, paths.lane(scene, -1), lanes.SENT)
    for i, shown in enumerate(scene.receivers):
        bright, label = colour(i), shown.name
        to.log(
            paths.curve(paths.ERROR, shown.name),
            rr.SeriesLines(names=label, colors=bright, widths=1.5, aggregation_policy=_LARGEST),
            static=True,
        )
        to.log(
            paths.curve(paths.TRACE, shown.name),
            rr.SeriesLines(
                names=label, colors=bright, widths=1.5, interpolation_mode="StepAfter", aggregation_policy=_LARGEST
            ),
            static=True,
        )
        to.log(
            paths.curve(paths.THEORY, shown.name),
            rr.SeriesLines(names=f"{label}, theory", colors=dim(bright, 0.6), widths=1.0, aggregation_policy=_LARGEST),
            static=True,
        )
        _log_lane_style(
            to, paths.lane(scene, i), lanes.LEGITIMATE if shown.role == "legitimate" else lanes.EAVESDROPPER
        )
        if scene.n == 1:
            to.log(f"{paths.PLANE}/{shown.name}", rr.SeriesLines(names=label, colors=bright, widths=1.5), static=True)
        else:
            _log_moving_style(to, shown.name, bright, radius=5.0, order=30.0 - i)
    if scene.n == 1:
        to.log(
            f"{paths.PLANE}/{paths.TRUTH}",
            rr.SeriesLines(names="truth", colors=TRUTH_CURVE, widths=2.5),
            static=True,
        )
    else:
        _log_moving_style(to, paths.TRUTH, TRUTH, radius=3.5, order=40.0)
        # Invisible: it is there for the panel to fit to.
        to.log(paths.FRAME, rr.LineStrips2D.from_fields(colors=[GROUND], radii=rr.Radius.ui_points(0.1)), static=True)


def _log_moving_style(
    to: rr.RecordingStream, name: str, bright: tuple[int, int, int], *, radius: float, order: float
) -> None:
    pixels = rr.Radius.ui_points
    to.log(
        paths.trail(name),
        rr.LineStrips2D.from_fields(colors=[dim(bright, 0.55)], radii=pixels(0.9), draw_order=order - 20.0),
        static=True,
    )
    to.log(
        paths.ellipse(name),
        rr.LineStrips2D.from_fields(colors=[bright], radii=pixels(0.9), draw_order=order - 10.0),
        static=True,
    )
    to.log(
        paths.point(name),
        rr.Points2D.from_fields(colors=[bright], radii=pixels(radius), draw_order=order),
        static=True,
    )


def _log_lane_style(to: rr.RecordingStream, path: str, lane: Lane) -> None:
    # Blank labels: a slot is too narrow for a word, and the panel's title says what the colours mean.
    style = rr.StateConfiguration(values=lane.words, labels=[" "] * len(lane.words), colors=lane.colours)
    to.log(path, style, static=True)


def _floor(scene: Scene) -> float:
    """Smallest value of a curve: a decade below one step's noise, or two for a mean over trials with and without errors."""
    decades = 1 if scene.trials == 1 else 2
    return float(10.0 ** (np.floor(np.log10(scene.noise)) - decades))
