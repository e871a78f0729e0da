"""The probabilities of a link: how likely each slot's packet has arrived some slots later, segment by segment.

Source: docs/mathematics/links.md, late packets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evedrop.model.delays import delay_of
from evedrop.model.links import loss_of
from evedrop.model.links.chain import Chain
from evedrop.model.process import Floats
from evedrop.model.slot.link import LinkSchedule

_FAR = 10**8  # a slot in which all movement has ended


@dataclass(frozen=True)
class Segment:
    """Slots from `start` on, until the next segment, with constant link settings."""

    start: int
    chain: Chain
    """The chain of the losses; a single state for losses without a memory that differ from slot to slot."""
    passes: float
    """Probability that a packet that is not lost gets through: 1 − corrupt, and 0 while the link is cut."""
    arrived: Floats
    """Probability that a packet that gets through has arrived 0, 1, … slots later, (window + 1,)."""
    quality_at: Callable[[range], Floats] | None = None
    """For losses that differ from slot to slot: probability that a packet is not lost, (c,)."""
    continues: bool = False
    """Whether the chain goes on from the segment before; otherwise it starts in its stationary distribution."""

    def quality(self, slots: range) -> Floats:
        """Probability that a packet gets through in each slot and state, (c, states)."""
        if self.quality_at is not None:
            return self.passes * self.quality_at(slots)[:, None]
        return np.repeat(self.passes * self.chain.quality[None], len(slots), axis=0)


@dataclass(frozen=True)
class LinkDistribution:
    """A link's segments, and the outages of its receiver."""

    segments: tuple[Segment, ...]
    outages: tuple[tuple[int, int, bool], ...] = ()
    """First slot, first slot after the outage, and whether the receiver keeps its state."""

    @classmethod
    def steady(cls, chain: Chain) -> LinkDistribution:
        """The distribution of a link that only loses packets, by a chain."""
        return cls((Segment(0, chain, 1.0, np.ones(1)),))

    @property
    def window(self) -> int:
        """Slots by which a packet may be late."""
        return len(self.segments[0].arrived) - 1

    def rates(self, slots: range) -> Floats:
        """Probability that the packet of each slot arrives in that slot, (c,)."""
        rates = np.zeros(len(slots))
        starts = [segment.start for segment in self.segments]
        for segment, stop in zip(self.segments, [*starts[1:], slots.stop], strict=True):
            some = range(max(segment.start, slots.start), min(stop, slots.stop))
            if some:
                rate = np.zeros(len(some))
                # State by state, so that the bits do not depend on how many slots are asked for at a time.
                for quality, odds in zip(segment.quality(some).T, segment.chain.stationary.tolist(), strict=True):
                    rate += quality * odds
                rates[some.start - slots.start : some.stop - slots.start] = segment.arrived[0] * rate
        for start, stop, _ in self.outages:
            rates[max(start - slots.start, 0) : max(stop - slots.start, 0)] = 0.0
        return rates

    @property
    def last(self) -> Chain:
        """The link in its last state: the last segment's chain, counting every packet that eventually arrives."""
        segment = self.segments[-1]
        gone = any(stop > _FAR for _, stop, _ in self.outages)
        quality = segment.quality(range(_FAR, _FAR + 1))[0] * (0.0 if gone else segment.arrived[-1])
        return Chain(segment.chain.transitions, segment.chain.stationary, quality)

    @property
    def alike(self) -> Chain | None:
        """A single state, if all fates are independent and identically distributed and no packet is late, as in the paper."""
        first = self.segments[0]
        unchanging = len(self.segments) == 1 and first.quality_at is None and not self.outages and self.window == 0
        return self.last if unchanging and first.chain.independent else None


def distribution_of(schedule: LinkSchedule) -> LinkDistribution | None:
    """The distribution of a link, from everything that is known of it in advance; None if theory does not cover it.

    It does not cover losses with a memory that is not a chain, losses that never settle, queues, delays that are not
    independent draws, and receivers that are away while packets are under way.
    """
    segments, loss = [], None
    for start, settings, cut in stretches(schedule):
        segment = _segment(start, settings, cut, schedule.window)
        if segment is None:
            return None
        segments.append(replace(segment, continues=settings["loss"] == loss))
        loss = settings["loss"]
    late = any(segment.arrived[0] < segment.arrived[-1] for segment in segments)
    if late and schedule.outages:
        return None
    if not late:
        segments = [replace(segment, arrived=segment.arrived[-1:]) for segment in segments]
    outages = tuple((outage.start, outage.stop, outage.keeps_state) for outage in schedule.outages)
    return LinkDistribution(tuple(segments), outages)


def stretches(schedule: LinkSchedule) -> list[tuple[int, Mapping[str, Any], bool]]:
    """The first slots of stretches with constant link settings, with the settings and whether the link is cut."""
    settings, cut = schedule.settings, False
    marks = [(0, settings, False)]
    for change in sorted(schedule.changes, key=lambda later: later.at):
        settings = settings if change.settings is None else change.settings
        cut = cut if change.cut is None else change.cut
        if marks[-1][0] == change.at:
            marks.pop()
        marks.append((change.at, settings, cut))
    return marks


def _segment(start: int, settings: Mapping[str, Any], cut: bool, window: int) -> Segment | None:
    loss = loss_of(settings["loss"])
    if settings.get("rate", 1.0) < 1.0 or not (loss.chain is not None or (loss.memoryless and loss.settles)):
        return None
    arrived = np.ones(window + 1)
    if settings.get("delay") is not None:
        model, reorder = delay_of(settings["delay"]), settings.get("reorder", 0.0)
        there = [model.arrived(lag) for lag in range(window + 1)]
        if any(probability is None for probability in there):
            return None
        arrived = reorder + (1.0 - reorder) * np.array(there, np.float64)
    passes = 0.0 if cut else 1.0 - settings.get("corrupt", 0.0)
    if loss.chain is not None:
        return Segment(start, loss.chain, passes, arrived)
    return Segment(start, Chain(np.ones((1, 1)), np.ones(1), np.ones(1)), passes, arrived, loss.quality_at)
