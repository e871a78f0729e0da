"""What became of the messages of a wire's links over time, from the rows of its journal: for lanes and charts.

Time is divided into equal steps. A link needs a few hundred numbers for each, however many messages it took.

Source: docs/wire/results.md, the journal.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from evedrop.errors import UsageError
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes
from evedrop.results.wire_summary import WireSummary
from evedrop.show.view.lanes import Lane

_JOURNAL = "journal"
_MOST_STEPS, _SHORTEST_STEP = 300, 0.1  # seconds
_STEPS_OF_A_POINT = 5
_LEAST_DELAY, _PER_DECADE, _BUCKETS = 1e-5, 40, 322  # seconds; quantiles are right within 3 %

LANE = Lane(
    ("no messages", "all delivered", "some lost", "most lost", "all lost", "cut"),
    ((244, 245, 247), (190, 214, 236), (120, 166, 208), (60, 100, 150), (24, 44, 84), (0, 0, 0)),
)
"""The lane of a link: the darker, the more was lost."""


@final
@dataclass
class LinkOverTime:
    """A link in c steps of time."""

    steps: int
    heard: Floats = field(init=False)
    """Messages, (c,)."""
    lost: Floats = field(init=False)
    """Those that were not delivered, for whatever reason, (c,)."""
    cut: Floats = field(init=False)
    """Those that came while the link was cut, (c,)."""

    def __post_init__(self) -> None:
        """Begin with no message."""
        self.heard, self.lost, self.cut = np.zeros((3, self.steps))
        self._delays = np.zeros((self.steps, _BUCKETS), np.int64)
        self._least, self._most = np.full((2, _BUCKETS), [[np.inf], [-np.inf]])

    def add(self, step: np.ndarray[tuple[int], np.dtype[np.int64]], reasons: pa.ChunkedArray, delays: Floats) -> None:
        """Count messages by the step in which they came; reasons: why they were not delivered, null if they were."""
        lost = reasons.is_valid().to_numpy(zero_copy_only=False)
        cut = pc.fill_null(pc.equal(reasons, "cut"), False).to_numpy(zero_copy_only=False)
        self.heard += np.bincount(step, minlength=self.steps)
        self.lost += np.bincount(step[lost], minlength=self.steps)
        self.cut += np.bincount(step[cut], minlength=self.steps)
        with np.errstate(all="ignore"):
            places = np.nan_to_num(1 + _PER_DECADE * np.log10(delays[~lost] / _LEAST_DELAY), nan=0.0, neginf=0.0)
        buckets = np.clip(places, 0, _BUCKETS - 1).astype(np.int64)
        np.minimum.at(self._least, buckets, delays[~lost])
        np.maximum.at(self._most, buckets, delays[~lost])
        cells = step[~lost] * _BUCKETS + buckets
        self._delays += np.bincount(cells, minlength=self._delays.size).reshape(self._delays.shape)

    def coarser(self, factor: int) -> LinkOverTime:
        """The same in longer steps, each of so many of these; their number must be a multiple of it."""
        link = LinkOverTime(self.steps // factor)
        for name in ("heard", "lost", "cut", "_delays"):
            counts = getattr(self, name)
            setattr(link, name, counts.reshape(link.steps, factor, *counts.shape[1:]).sum(1))
        link._least, link._most = self._least, self._most
        return link

    @property
    def loss(self) -> Floats:
        """The fraction of the messages that were not delivered, (c,); NaN in a step without messages."""
        with np.errstate(invalid="ignore"):
            return self.lost / self.heard

    @property
    def codes(self) -> Codes:
        """The codes of `LANE`, (c,)."""
        loss = np.nan_to_num(self.loss)
        degrees = np.select([loss == 0.0, loss <= 0.5, loss < 1.0], [1, 2, 3], 4)
        shown = np.where(2 * self.cut > self.heard, 5, degrees)
        return np.where(self.heard == 0.0, 0, shown).astype(np.uint8)

    @property
    def delayed(self) -> bool:
        """Whether a delivered message was held back."""
        return bool(self._delays[:, 1:].any())

    def delay(self, fraction: float) -> Floats:
        """The delay in seconds that this fraction of the delivered messages of a step does not exceed, (c,); NaN without any."""
        counts = np.cumsum(self._delays, axis=1)
        total = counts[:, -1]
        bucket = (counts < fraction * total[:, None]).sum(1)
        there, delays = (total > 0) & (bucket > 0), np.where(total > 0, 0.0, np.nan)
        of_bucket = bucket[there]  # stands for the delays that are in it, so that a constant delay is shown as it is
        delays[there] = (self._least[of_bucket] + self._most[of_bucket]) / 2.0
        return delays


@dataclass(frozen=True)
class WireOverTime:
    """The links of a wire over the time since its start."""

    step: float
    """Seconds."""
    links: Mapping[str, LinkOverTime]

    @property
    def coarser(self) -> WireOverTime:
        """The same in longer steps, for curves."""
        links = {name: link.coarser(_STEPS_OF_A_POINT) for name, link in self.links.items()}
        return WireOverTime(self.step * _STEPS_OF_A_POINT, links)

    @property
    def seconds(self) -> Floats:
        """The middle of each step, (c,)."""
        count = next((link.steps for link in self.links.values()), 0)
        return np.asarray((np.arange(count) + 0.5) * self.step, np.float64)

    @classmethod
    def read(cls, folder: Path, summary: WireSummary, journal: Iterable[pa.Table]) -> WireOverTime:
        """Count the rows of the start that a summary is about; journal: these. Raises UsageError if they cannot be read."""
        most = min(_MOST_STEPS, math.ceil(summary.seconds / _SHORTEST_STEP))
        steps = max(1, math.ceil(most / _STEPS_OF_A_POINT)) * _STEPS_OF_A_POINT
        step = max(summary.seconds, _SHORTEST_STEP) / steps
        links = {name: LinkOverTime(steps) for name in summary.links}
        try:
            began = _began(folder / _JOURNAL / "history.jsonl", summary.start)
            for table in journal:
                places = np.clip((table["time"].to_numpy() - began) / step, 0, steps - 1).astype(np.int64)
                of_link = table["link"].cast(pa.string())
                for name, link in links.items():
                    mine = pc.fill_null(pc.equal(of_link, name), False)
                    rows = table.filter(mine)
                    if rows.num_rows:
                        which = mine.to_numpy(zero_copy_only=False)
                        link.add(places[which], rows["reason"].cast(pa.string()), rows["delay"].to_numpy())
        except (OSError, pa.ArrowException, KeyError, ValueError, TypeError, AttributeError) as error:
            raise UsageError(f"the journal in {folder} cannot be read ({error})") from error
        return cls(step, links)


def _began(history: Path, start: int) -> float:
    """When a start of the wire began, in seconds since 1970."""
    with history.open(encoding="utf-8") as lines:
        entries = (json.loads(line) for line in lines if line.startswith('{"start"'))
        return float(next(entry["time"] for entry in entries if entry["start"] == start))
