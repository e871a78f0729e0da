"""The panels of two dimensions, recorded at the view's frames: the plane of the first two states, and the map of receivers.

The plane shows truth, estimates with their recent paths, and the reported covariance ellipses. It follows the truth and the
legitimate estimator. An eavesdropper that is farther away is an arrow at the border.

The map, for links whose losses depend on distance, is drawn by Evedrop: Rerun's own map would load its tiles from another host.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.model.links.way import Way
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.show.view.attacks import Attacks, cut_off, lane_count
from evedrop.show.view.column import Column, line_strips
from evedrop.show.view.lanes import ErrorDistance
from evedrop.show.view.palette import GROUND, LABEL, TRUTH, Colour, dim
from evedrop.show.view.panels.curves import times_of
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import TRUTH_NAME, Scene, SceneSlots, Shown

_PLANE_PATH = "plane"
_FRAME = f"{_PLANE_PATH}/Frame"
_HEADING, _SCALE = f"{_PLANE_PATH}/{TRUTH_NAME}/heading", f"{_PLANE_PATH}/Scale"
_ATTACKS, _ATTACKED = f"{_PLANE_PATH}/{TRUTH_NAME}/attacks", f"{_PLANE_PATH}/{TRUTH_NAME}/attacked"
_TRAIL = 30
_TRUTH_TRAIL = 130


@final
class StatePlane(ViewPanel):
    """The plane of the first two states, recorded only at the view's frames. Recorded but not shown for a closed loop."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._frame, every = Frame(), stride(scene)
        self._moves = TruthDirection()
        self._distance = ErrorDistance(scene)
        self._attacks, self._marks = Attacks(scene), AttackMarks()
        self._trails = {name: Trail(every) for name in (TRUTH_NAME, *(shown.name for shown in scene.receivers))}

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for two states or more."""
        return scene.n > 1

    def views(self) -> Iterator[PlacedView]:
        """One view, on the right."""
        if self.scene.moving:
            return
        trails: dict[str, rrb.VisibleTimeRanges] = {
            _trail(shown.name): self._past(_TRAIL) for shown in self.scene.receivers
        }
        trails[_trail(TRUTH_NAME)] = self._past(_TRUTH_TRAIL)
        view = rrb.Spatial2DView(
            name="State plane   ellipses: 2σ reported",
            origin=_PLANE_PATH,
            contents=["$origin/**", *(f"- /{path}" for path in self._of_the_scene())],
            background=list(GROUND),
            overrides=trails,  # type: ignore[arg-type]
        )
        yield PlacedView(view, "right")
        past = dict.fromkeys((_trail(TRUTH_NAME), _ATTACKS), trails[_trail(TRUTH_NAME)])
        yield PlacedView(
            rrb.Spatial2DView(
                name=self.scene.what_happens,
                origin=_PLANE_PATH,
                contents=[_FRAME, f"{_PLANE_PATH}/{TRUTH_NAME}/**", f"{_SCALE}/**"],
                background=list(GROUND),
                overrides=past,  # type: ignore[arg-type]
            ),
            "truth",
        )
        for shown in self.scene.receivers:
            yield PlacedView(self._world(shown, trails), "worlds")

    def _of_the_scene(self) -> list[str]:
        """The paths that only the scene shows."""
        return [_HEADING, _SCALE, _ATTACKS, _ATTACKED, *map(_off, self._trails), *map(_cut, self._trails)]

    def _world(self, shown: Shown, trails: Mapping[str, rrb.VisibleTimeRanges]) -> rrb.Spatial2DView:
        """The world as a receiver believes it: its estimate, path and ellipse, over the faded truth."""
        name, faded = shown.name, [dim(TRUTH)]
        shown_paths = [_trail(name), _ellipse(name), _point(name), _off(name), _cut(name)]
        overrides = {
            _trail(TRUTH_NAME): [rr.LineStrips2D.from_fields(colors=faded), trails[_trail(TRUTH_NAME)]],
            _point(TRUTH_NAME): [rr.Points2D.from_fields(colors=faded)],
            _trail(name): [trails[_trail(name)]],
        }
        return rrb.Spatial2DView(
            name=shown.world_title,
            origin=_PLANE_PATH,
            contents=[_FRAME, _trail(TRUTH_NAME), _point(TRUTH_NAME), *shown_paths],
            background=list(GROUND),
            overrides=overrides,  # type: ignore[arg-type]
        )

    @property
    def _off_words(self) -> str:
        return "off the sensor's" if self.scene.of_estimate else "off"

    def _past(self, slots: int) -> rrb.VisibleTimeRanges:
        # A piece of a trail is recorded at its end, so the oldest piece shown begins a frame earlier.
        reach = max(slots, 4 * stride(self.scene))
        times = times_of(self.scene)
        ends = times.after_cursor(-reach), times.after_cursor(0)
        return rrb.VisibleTimeRanges([rrb.VisibleTimeRange(times.line, start=ends[0], end=ends[1])])

    def styles(self) -> dict[str, rr.AsComponents]:
        """Each estimate in its receiver's colour; the truth white, on top of the others."""
        styles = _point_styles(TRUTH_NAME, TRUTH, radius=3.5, order=40.0)
        styles[_HEADING] = rr.LineStrips2D.from_fields(colors=[TRUTH], radii=rr.Radius.ui_points(2.0), draw_order=41.0)
        styles[_SCALE] = rr.LineStrips2D.from_fields(colors=[LABEL], radii=rr.Radius.ui_points(1.0), show_labels=True)
        styles[_ATTACKS] = rr.Points2D.from_fields(radii=rr.Radius.ui_points(4.5), draw_order=39.0)
        words = rr.Points2D.from_fields(colors=[LABEL], radii=rr.Radius.ui_points(0.0), show_labels=True)
        styles[_ATTACKED] = words
        for i, shown in enumerate(self.scene.receivers):
            bright = self.scene.colours[shown.name]
            styles[_cut(shown.name)] = words
            styles |= _point_styles(shown.name, bright, radius=5.0, order=30.0 - i)
            styles[_off(shown.name)] = words
            if i > 0:
                styles[_arrow(shown.name)] = rr.LineStrips2D.from_fields(
                    colors=[bright], radii=rr.Radius.ui_points(1.5)
                )
                styles[_away(shown.name)] = words
        # Invisible: the view fits its range to it.
        styles[_FRAME] = rr.LineStrips2D.from_fields(colors=[GROUND], radii=rr.Radius.ui_points(0.1))
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Points, trails, ellipses, and the frame around them."""
        k, at = slots.numbers, frames(self.scene, slots.first, slots.count)
        positions = {TRUTH_NAME: on_plane(slots.x)}
        positions |= {name: on_plane(peer.x_hat) for name, peer in slots.peers.items()}
        headings = self._moves.directions(positions[TRUTH_NAME], at)
        pieces = {name: self._trails[name].pieces(points, at) for name, points in positions.items()}
        followed = np.stack([positions[TRUTH_NAME], positions[self.scene.receivers[0].name]])
        boxes = self._frame.boxes(followed.min(axis=0), followed.max(axis=0), at)
        marks = self._marks.marks(positions[TRUTH_NAME], self._attacks.acts(slots), at)
        if not len(at):
            return
        yield from self._attacked(slots, at, boxes, marks)
        border = _BORDER * (boxes[:, 2] - boxes[:, 0])
        low, high = boxes[:, 0] + border, boxes[:, 2] - border
        truth = positions[TRUTH_NAME][at]
        labels: list[Points] = []
        yield Column(_FRAME, k[at], rr.LineStrips2D.columns(strips=line_strips(boxes)))
        size = boxes[:, 2] - boxes[:, 0]
        arrows_of_truth = line_strips(heading_strips(truth, headings, size))
        yield Column(_HEADING, k[at], rr.LineStrips2D.columns(strips=arrows_of_truth))
        bars, lengths = scale_bars(boxes[:, 0], boxes[:, 2])
        texts = [self._distance.text(length) for length in lengths.tolist()]
        yield Column(_SCALE, k[at], rr.LineStrips2D.columns(strips=line_strips(bars), labels=texts))
        places: dict[str, Points] = {}
        for name, points in positions.items():
            trail = within(pieces[name], low, high, truth)
            yield Column(_trail(name), k[at], rr.LineStrips2D.columns(strips=line_strips(trail)))
            places[name] = side_by_side(truth, points[at], [*places.values()], low, high)
            yield Column(_point(name), k[at], rr.Points2D.columns(positions=places[name]))
        for i, shown in enumerate(self.scene.receivers):
            peer = slots.peers[shown.name]
            seen = inside(positions[shown.name][at], low, high)
            outlines = np.repeat(truth[:, None], _CORNERS + 1, axis=1)
            drawn = ellipses(peer.x_hat[at[seen]], peer.P[at[seen]])
            outlines[seen] = np.clip(drawn, low[seen, None], high[seen, None])
            yield Column(_ellipse(shown.name), k[at], rr.LineStrips2D.columns(strips=line_strips(outlines)))
            distances = self._distance.of(slots.x[at], peer.x_hat[at])
            offs = [f"{self._distance.text(distance)} {self._off_words}" for distance in distances.tolist()]
            below = rr.Points2D.columns(positions=labels_below(places[shown.name], low, high), labels=offs)
            yield Column(_off(shown.name), k[at], below)
            if i > 0:
                looked_at = truth, positions[shown.name][at], low, high
                yield from self._far(shown.name, k[at], looked_at, places[shown.name], distances, labels)

    def _attacked(
        self, slots: SceneSlots, at: NDArray[np.intp], boxes: Points, marks: list[list[tuple[Points, Colour]]]
    ) -> Iterator[Column]:
        """The words at the upper border about attacks, marks where the truth was during them, and which links are cut."""
        k, places = slots.numbers[at], title_places(boxes)
        if lane_count(self.scene):
            yield _labels(_ATTACKED, k, places, self._attacks.texts(slots, at))
        if self.scene.acknowledgements is not None:
            points = [point for some in marks for point, _ in some]
            colours = [colour for some in marks for _, colour in some]
            columns = rr.Points2D.columns(positions=np.array(points).reshape(-1, 2), colors=colours)
            yield Column(_ATTACKS, k, columns.partition([len(some) for some in marks]))
        for shown in self.scene.receivers:
            if any(span.receiver == shown.name for span in self.scene.spans):
                cut = cut_off(self.scene, shown.name, k).tolist()
                yield _labels(_cut(shown.name), k, places, ["cut off" if now else "" for now in cut])

    def _far(
        self,
        name: str,
        k: NDArray[np.int64],
        seen: tuple[Points, Points, Points, Points],
        tips: Points,
        distances: Floats,
        labels: list[Points],
    ) -> Iterator[Column]:
        """Arrows with distances where an estimate is outside the frame.

        seen: truth, estimates, lows and highs; tips: of the arrows; labels: those of other receivers, as in `apart`, to which
        its own are added.
        """
        truth, points, low, high = seen
        far = ~inside(points, low, high)
        drawn = arrows(truth[far], points[far], tips[far], low[far], high[far])
        texts = [f"{name}: {self._distance.text(distance)}" for distance in distances[far].tolist()]
        lengths = far.astype(np.int64)
        yield Column(_arrow(name), k, rr.LineStrips2D.columns(strips=line_strips(drawn)).partition(lengths))
        centres = np.full((len(k), 2), np.nan, np.float32)
        centres[far] = labels_of(truth[far], drawn[:, 1], low[far], high[far])
        centres = apart(centres, labels, low, high)
        labels.append(centres)
        columns = rr.Points2D.columns(positions=centres[far], labels=texts)
        yield Column(_away(name), k, columns.partition(lengths))


def _labels(path: str, k: NDArray[np.int64], places: Points, texts: list[str]) -> Column:
    """Labels at places, (f, 2), in slots k, (f,); none where a text is empty."""
    shown = np.array([bool(text) for text in texts])
    columns = rr.Points2D.columns(positions=places[shown], labels=[text for text in texts if text])
    return Column(path, k, columns.partition(shown.astype(np.int64)))


def _point_styles(name: str, bright: Colour, *, radius: float, order: float) -> dict[str, rr.AsComponents]:
    pixels = rr.Radius.ui_points
    return {
        _trail(name): rr.LineStrips2D.from_fields(colors=[dim(bright)], radii=pixels(0.9), draw_order=order - 20.0),
        _ellipse(name): rr.LineStrips2D.from_fields(colors=[bright], radii=pixels(0.9), draw_order=order - 10.0),
        _point(name): rr.Points2D.from_fields(colors=[bright], radii=pixels(radius), draw_order=order),
    }


def _part(name: str, part: str) -> str:
    """The path of something that belongs to the truth or to a receiver."""
    return f"{_PLANE_PATH}/{name}/{part}"


_trail, _ellipse, _point, _arrow, _away, _cut, _off = (
    partial(_part, part=part) for part in ("trail", "cov", "at", "arrow", "away", "cut", "off")
)

Points = NDArray[np.float32]

_FRAMES_PER_SECOND = 30.0
_MOST_FRAMES = 2_000
_MOST_FRAMES_IN_REAL_TIME = 30_000  # five a second for more than an hour
_LARGEST = 1e30  # Rerun's points are float32
_FRAMED_SLOTS = 130  # the length of the path of the truth
_SIGMAS = 2.0
_CORNERS = 40
_BORDER = 0.04  # of the frame's sides, where a dot would be cut
_EDGE = 0.1  # of a frame's sides: the room between the arrows' tips and its border
_LABEL = 0.18  # the same for the labels: half the width of one
_LINE = 0.11  # of a frame's height: what a label needs
_VEHICLE = 0.09  # length of the vehicle, compared with the longer side
_SCALE_BAR = 0.25  # of a frame's width: the longest scale
_HEADLINE = 0.04  # of a frame's height, from its upper border: where words about the whole frame are
_BESIDE = 0.06  # from one tip to the next, compared with the longer side
_MOST_BESIDE = 8  # tips that stand side by side
_ARROW = 0.08  # length of an arrow, compared with the longer side
_FRAME_ROOM = 0.3  # around what the frame follows, compared with its longer side


def stride(scene: Scene) -> int:
    """Slots from one frame to the next."""
    most = _MOST_FRAMES_IN_REAL_TIME if scene.pace > 0 else _MOST_FRAMES
    smooth = math.ceil(1.0 / (_FRAMES_PER_SECOND * scene.pace) - 1e-9) if scene.pace > 0 else 1
    return max(1, smooth, math.ceil(scene.slots / most))


def frames(scene: Scene, first: int, count: int) -> NDArray[np.intp]:
    """The slots among `count` from `first` on that are frames, as offsets; the run's last slot always is."""
    every = stride(scene)
    offsets = np.arange(-first % every, count, every)
    if first + count == scene.slots and (first + count - 1) % every:
        offsets = np.append(offsets, count - 1)
    return offsets


def on_plane(states: Floats) -> Points:
    """The first two states, (c, 2), of states (c, n); Rerun's y axis points down, so the second is negated."""
    return _shown(np.stack([states[:, 0], -states[:, 1]], axis=1))


def ellipses(centres: Floats, P: Floats) -> Points:
    """2σ ellipses of P (c, n, n) around states (c, n) as closed lines, (c, 41, 2).

    A circle mapped by the Cholesky factor, written out so that a covariance of 0 gives a point and not an error.
    """
    angle = np.linspace(0.0, 2.0 * math.pi, _CORNERS + 1)
    with np.errstate(all="ignore"):
        spread = np.sqrt(np.maximum(P[:, 0, 0], 0.0))
        lean = np.where(spread > 0.0, P[:, 1, 0] / np.where(spread > 0.0, spread, 1.0), 0.0)
        rest = np.sqrt(np.maximum(P[:, 1, 1] - lean * lean, 0.0))
        x = centres[:, :1] + _SIGMAS * spread[:, None] * np.cos(angle)
        y = centres[:, 1:2] + _SIGMAS * (lean[:, None] * np.cos(angle) + rest[:, None] * np.sin(angle))
    return _shown(np.stack([x, -y], axis=2))


def inside(points: Points, low: Points, high: Points) -> NDArray[np.bool_]:
    """Which points, (f, 2), are in the frames from low to high, (f, 2)."""
    within_bounds: NDArray[np.bool_] = np.all((points >= low) & (points <= high), axis=1)
    return within_bounds


def within(pieces: Points, low: Points, high: Points, otherwise: Points) -> Points:
    """The pieces of a path, (f, p, 2); one that leaves its frame becomes a dot at a point of `otherwise`, (f, 2)."""
    # Both coordinates by themselves: numpy is slow along an axis of two.
    (left, top), (right, bottom) = low.T[..., None], high.T[..., None]
    x, y = pieces[..., 0], pieces[..., 1]
    stays = np.all((x >= left) & (x <= right) & (y >= top) & (y <= bottom), axis=1, keepdims=True)
    kept: Points = np.where(stays[..., None], pieces, otherwise[:, None])
    return kept


def borders(truth: Points, points: Points, low: Points, high: Points) -> Points:
    """The points, (f, 2); one outside its frame is moved along its line to the truth, to a border inside the frame's."""
    edge = _EDGE * (high - low).astype(np.float64)
    towards = points.astype(np.float64) - truth
    with np.errstate(all="ignore"):
        room = np.where(towards > 0.0, high - edge - truth, low + edge - truth) / towards
    fraction = np.nan_to_num(np.where(towards == 0.0, np.inf, room), nan=0.0).min(axis=1, initial=1.0).clip(0.0, 1.0)
    moved = truth + fraction[:, None] * towards
    return _shown(np.where(inside(points, low, high)[:, None], points, moved))


def side_by_side(truth: Points, points: Points, others: Sequence[Points], low: Points, high: Points) -> Points:
    """Where points, (f, 2), are drawn: as by `borders`; those outside the frame are beside the `others`, not on them."""
    placed, size = borders(truth, points, low, high).astype(np.float64), (high - low).astype(np.float64)
    far, towards = ~inside(points, low, high), placed - truth
    across = np.stack([-towards[:, 1], towards[:, 0]], axis=1)
    step = _BESIDE * size.max(axis=1, initial=0.0) / np.maximum(np.hypot(towards[:, 0], towards[:, 1]), 1e-300)
    for _ in others[:_MOST_BESIDE]:
        covered = far & np.any(np.all(np.abs(placed - np.stack(others)) < 0.9 * _BESIDE * size, axis=2), axis=0)
        if not covered.any():
            break
        placed += np.where(covered[:, None], step[:, None] * across, 0.0)
    return _shown(np.clip(placed, low, high))


def arrows(truth: Points, points: Points, ends: Points, low: Points, high: Points) -> Points:
    """Arrows, (f, 5, 2), with their tips at `ends`, towards points outside: a shaft, and both sides of its head."""
    tips = ends.astype(np.float64)
    towards = points.astype(np.float64) - truth
    direction = towards / np.maximum(np.hypot(towards[:, 0], towards[:, 1]), 1e-300)[:, None]
    length = _ARROW * (high - low).astype(np.float64).max(axis=1, keepdims=True, initial=0.0)
    return _shown(arrow_lines(tips - length * direction, tips, direction, 0.4 * length))


def heading_strips(truth: Points, headings: Points, size: Points) -> Points:
    """Arrows at the truth, (f, 2), in its directions, (f, 2), as lines, (f, 5, 2); size: of the frames."""
    length = _VEHICLE * size.max(axis=1, keepdims=True)
    tips = truth + 0.6 * length * headings
    return _shown(arrow_lines(truth - 0.4 * length * headings, tips, headings, 0.5 * length, 0.7))


def arrow_lines(
    tails: NDArray[Any], tips: NDArray[Any], along: NDArray[Any], head: NDArray[Any], spread: float = 0.6
) -> NDArray[Any]:
    """Arrows, (f, 5, 2): a shaft and both sides of its head; along: their directions, (f, 2); head: its length, (f, 1)."""
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    sides = [tips - head * (along + sign * spread * across) for sign in (1.0, -1.0)]
    return np.stack([tails, tips, sides[0], tips, sides[1]], axis=1)


def scale_bars(low: Points, high: Points) -> tuple[Points, Floats]:
    """A bar in the lower left corner of each frame, (f, 2, 2), and its length, (f,): 1, 2 or 5 times a power of ten."""
    width = np.maximum((high - low)[:, 0].astype(np.float64), 1e-30)
    decade = 10.0 ** np.floor(np.log10(_SCALE_BAR * width))
    lengths = decade * np.select([_SCALE_BAR * width >= 5 * decade, _SCALE_BAR * width >= 2 * decade], [5.0, 2.0], 1.0)
    left = np.stack([low[:, 0] + 0.06 * width, high[:, 1] - 0.06 * (high - low)[:, 1]], axis=1)
    right = left + np.stack([lengths, np.zeros_like(lengths)], axis=1)
    return _shown(np.stack([left, right], axis=1)), lengths


def title_places(boxes: Points) -> Points:
    """Where words are drawn at the upper border of frames, (f, 2)."""
    low, high = boxes[:, 0], boxes[:, 2]
    return _shown(np.stack([(low + high)[:, 0] / 2, low[:, 1] + _HEADLINE * (high - low)[:, 1]], axis=1))


def labels_below(points: Points, low: Points, high: Points) -> Points:
    """Where the labels of points, (f, 2), are drawn: below them, or above them near the lower border."""
    size = high - low
    line = np.where(points[:, 1] > high[:, 1] - 2 * _LINE * size[:, 1], -_LINE, 0.5 * _LINE) * size[:, 1]
    moved = points + np.stack([np.zeros_like(line), line], axis=1)
    return _shown(np.clip(moved, low + size * [_LABEL, 0.0], high - size * [_LABEL, 0.5 * _LABEL]))


def labels_of(truth: Points, tips: Points, low: Points, high: Points) -> Points:
    """Where the labels of arrows with these tips, (f, 2), are drawn: away from the truth, with room for their letters."""
    size = high - low
    rising = np.where(tips[:, 1] <= truth[:, 1], -_LABEL, 0.0)[:, None] * size * [0.0, 1.0]
    return _shown(np.clip(tips + rising, low + size * [_LABEL, 0.0], high - size * [_LABEL, 0.5 * _LABEL]))


def apart(centres: Points, others: Sequence[Points], low: Points, high: Points) -> Points:
    """The centres of labels, (f, 2), moved towards the middle of their frames by lines until none covers one of `others`.

    NaN where there is no label.
    """
    placed, size = centres.astype(np.float64), (high - low).astype(np.float64)
    line = np.where(placed[:, 1] > (low + high)[:, 1] / 2, -_LINE, _LINE) * size[:, 1]
    for _ in range(2 * len(others)):  # each of them covers two lines at most
        distances = [np.abs(placed - other) for other in others]
        covered = np.any([np.all(gap < size * [2 * _LABEL, 0.99 * _LINE], axis=1) for gap in distances], axis=0)
        if not covered.any():
            break
        placed[:, 1] += np.where(covered, line, 0.0)
    return placed.astype(np.float32)


def _shown(values: NDArray[Any]) -> Points:
    points: Points = np.fmax(np.fmin(values, _LARGEST), -_LARGEST).astype(np.float32)  # NaN becomes the largest
    return points


@final
@dataclass
class Frame:
    """The part of the plane to show: a box around recent points, with some room.

    Its sides lie on a grid that is coarse compared with its size, so that the view does not jitter.
    """

    _lows: Points = field(default_factory=lambda: np.empty((0, 2), np.float32))
    _highs: Points = field(default_factory=lambda: np.empty((0, 2), np.float32))

    def boxes(self, lows: Points, highs: Points, offsets: NDArray[np.intp]) -> Points:
        """Closed boxes (len(offsets), 5, 2) at these offsets of the next slots, which reach from lows to highs (c, 2)."""
        before = len(self._lows)
        self._lows = np.concatenate([self._lows, lows])
        self._highs = np.concatenate([self._highs, highs])
        ends = offsets + before + 1
        recent = np.stack([np.maximum(ends - _FRAMED_SLOTS, 0), ends], axis=1).ravel()
        low, high = (
            least.reduceat(np.pad(bounds, ((0, 1), (0, 0))), recent, axis=0)[::2].astype(np.float64)
            for least, bounds in ((np.minimum, self._lows), (np.maximum, self._highs))
        )
        self._lows, self._highs = self._lows[-_FRAMED_SLOTS:], self._highs[-_FRAMED_SLOTS:]
        room = _FRAME_ROOM * (high - low).max(axis=1, keepdims=True, initial=0.0)
        low, high = low - room, high + room
        step = np.exp2(np.floor(np.log2(np.maximum(high - low, 1e-30).max(axis=1, keepdims=True, initial=1e-30)))) / 8
        low, high = (np.floor(low / step) - 0.5) * step, (np.ceil(high / step) + 0.5) * step
        corners = [(low, low), (high, low), (high, high), (low, high), (low, low)]
        return _shown(np.stack([np.stack([x[:, 0], y[:, 1]], axis=1) for x, y in corners], axis=1))


@final
@dataclass
class TruthDirection:
    """The direction in which the truth moved over the last slots."""

    _recent: Points = field(default_factory=lambda: np.empty((0, 2), np.float32))
    _last: Points = field(default_factory=lambda: np.array([1.0, 0.0], np.float32))

    def directions(self, positions: Points, offsets: NDArray[np.intp]) -> Points:
        """Unit vectors (len(offsets), 2) at these offsets of the next positions (c, 2); where nothing moved, the last one."""
        before = len(self._recent)
        path = np.concatenate([self._recent, positions]).astype(np.float64)
        ends = offsets + before
        moved = path[ends] - path[np.maximum(ends - _HEADED_SLOTS, 0)]
        lengths = np.hypot(moved[:, 0], moved[:, 1])
        known = np.flatnonzero((lengths > 0.0) & (lengths < _LARGEST))
        turns = np.concatenate([self._last[None], (moved[known] / lengths[known, None]).astype(np.float32)])
        directions = turns[np.searchsorted(known, np.arange(len(offsets)), side="right")]
        self._last = turns[-1]
        self._recent = path[-_HEADED_SLOTS:].astype(np.float32)
        return directions


_HEADED_SLOTS = 8


@final
@dataclass
class AttackMarks:
    """Where the truth was when an attacker acted, for the frame that follows."""

    _waiting: list[tuple[Points, Colour]] = field(default_factory=list)

    def marks(
        self, truth: Points, acts: Sequence[tuple[Colour, Flags]], offsets: NDArray[np.intp]
    ) -> list[list[tuple[Points, Colour]]]:
        """The places, (2,), and colours of the acts since the frame before, for each frame at offsets of the next slots.

        truth: (c, 2); acts: the colour of each kind, and in which slots it was, (c,).
        """
        acted = sorted((int(at), colour) for colour, flags in acts for at in np.flatnonzero(flags))
        frames_of = np.searchsorted(offsets, [at for at, _ in acted])
        marks: list[list[tuple[Points, Colour]]] = [[] for _ in range(len(offsets) + 1)]
        marks[0] = self._waiting
        for frame, (at, colour) in zip(frames_of.tolist(), acted, strict=True):
            marks[frame] = [*marks[frame], (truth[at], colour)]
        *marks, self._waiting = marks
        return marks


@final
@dataclass
class Trail:
    """The path of one point, cut at the frames into pieces of equal length, so that they fit into one array.

    Piece i leads from the previous frame to frame i, through every slot between.
    """

    every: int
    """Slots from one frame to the next, as by `stride`."""
    _since: Points | None = None

    def pieces(self, positions: Points, offsets: NDArray[np.intp]) -> Points:
        """Pieces (len(offsets), every + 1, 2) that end at these offsets of the next positions (c, 2)."""
        since = positions[:1] if self._since is None else self._since
        path = np.concatenate([since, positions])
        ends = offsets + len(since)
        # A piece that would begin before the run, or before the frame ahead of a shortened last one, repeats its start.
        starts = np.concatenate([[len(since) - 1 if self._since is None else 0], ends[:-1]]) if len(ends) else ends
        index = np.maximum(ends[:, None] - np.arange(self.every, -1, -1), starts[:, None])
        pieces: Points = path[np.minimum(index, len(path) - 1)]
        keep_from = int(ends[-1]) if len(ends) else 0
        self._since = path[keep_from:]
        return pieces


_MAP_PATH = "map"
_FLATTEST = 0.35  # height of the map section shown, compared with its width
_MAP_ROOM = 0.75  # from the middle to each side, so that labels fit


@final
class GroundMap(ViewPanel):
    """Where sender and receivers are, and how far apart, drawn at the view's frames."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only with a link whose losses depend on distance; not for a closed loop, whose view is full."""
        return bool(scene.ways) and not scene.moving

    def views(self) -> Iterator[PlacedView]:
        """One view, on the right."""
        corners = np.concatenate([self._corners(way) for ways in self.scene.ways.values() for way in ways])
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle, size = (low + high) / 2, np.maximum(high - low, _FLATTEST * (high - low).max() + 1.0)
        x, y = ((float(m - _MAP_ROOM * s), float(m + _MAP_ROOM * s)) for m, s in zip(middle, size, strict=True))
        bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
        view = rrb.Spatial2DView(name="Map", origin=_MAP_PATH, background=list(GROUND), visual_bounds=bounds)
        yield PlacedView(view, "right", 0.6)

    def styles(self) -> dict[str, rr.AsComponents]:
        """The ways of the whole run as lines; receivers in their colours, senders white."""
        styles: dict[str, rr.AsComponents] = {}
        size = rr.Radius.ui_points
        for shown in self.scene.receivers:
            if shown.name in self.scene.ways:
                bright = self.scene.colours[shown.name]
                ways = [self._corners(way) for way in self.scene.ways[shown.name]]
                lines = rr.LineStrips2D(ways, colors=[dim(TRUTH), dim(bright)], radii=size(1.0))
                styles[f"{_MAP_PATH}/{shown.name}/ways"] = lines
                styles[f"{_MAP_PATH}/{shown.name}/link"] = rr.LineStrips2D.from_fields(colors=[bright], radii=size(0.7))
                styles[f"{_MAP_PATH}/{shown.name}/at"] = rr.Points2D.from_fields(
                    colors=[TRUTH, bright], radii=size(5.0)
                )
                styles[f"{_MAP_PATH}/{shown.name}/words"] = rr.Points2D.from_fields(
                    colors=[LABEL], radii=size(0.0), show_labels=True
                )
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Both ends of each link, and their distance in metres."""
        at = frames(self.scene, slots.first, slots.count)
        if not len(at):
            return
        k = slots.numbers[at]
        for name, ways in self.scene.ways.items():
            ends = np.stack([_on_map(way, k.astype(np.float64)) for way in ways], axis=1)
            distances = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
            labels = [text for distance in distances.tolist() for text in ("sensor", f"{name}: {distance:,.0f} m away")]
            yield Column(f"{_MAP_PATH}/{name}/link", k, rr.LineStrips2D.columns(strips=line_strips(ends)))
            both = ends.reshape(-1, 2)
            points, words = rr.Points2D.columns(positions=both), rr.Points2D.columns(positions=both, labels=labels)
            yield Column(f"{_MAP_PATH}/{name}/at", k, points.partition([2] * len(k)))
            yield Column(f"{_MAP_PATH}/{name}/words", k, words.partition([2] * len(k)))

    def _corners(self, way: Way) -> NDArray[np.float32]:
        """The places of a run at which a way may change its direction, its first and its last one, (corners, 2)."""
        last = self.scene.slots - 1
        return _on_map(way, np.array(sorted({0, last, *(slot for slot in way.slots if slot < last)}), np.float64))


def _on_map(way: Way, slots: NDArray[np.float64]) -> NDArray[np.float32]:
    """Positions in slots, (c, 2); Rerun's y axis points down."""
    x, y = way.at(slots)
    return np.stack([x, -y], axis=1).astype(np.float32)
