"""A link: the way from the router to one receiver, from random numbers and a timeline to the fate of every packet.

Its account has the outcomes of its packets, slot by slot, and the distributions of its losses and delays.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import (
    LAST_SLOT,
    expect_slots,
    is_probability,
    number_mistakes,
    probability_mistakes,
    whole_number_mistakes,
)
from evedrop.model.delays import DELAY_MODELS, DelayModel, delay_of
from evedrop.model.kernels.current import kernels
from evedrop.model.links import LOSS_MODELS, loss_of, single_specs
from evedrop.model.links.loss_model import REASONS, Fate, LossModel
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags
from evedrop.model.slot.records import LinkSlots
from evedrop.model.streams import MOST_SLOTS, Batch, BlockReader, StreamReader

NEVER = LAST_SLOT
"""A slot that no run reaches."""


class Fates(NamedTuple):
    """The fates of the packets of c slots."""

    codes: Codes
    """`Fate`, (c, R)."""
    delays: NDArray[np.uint32] | None = None
    """How many slots after its own each packet arrives, (c, R); None: all arrive in their own."""
    again: Flags | None = None
    """Whether a second copy arrives with it, (c, R); None: there are no copies."""
    rests: Floats | None = None
    """The remaining fraction of a slot in the delay of the first trial's packets, (c,); None where there are no delays."""

    @property
    def in_time(self) -> Flags:
        """γ: delivered in its own slot, (c, R)."""
        delivered: Flags = self.codes == int(Fate.DELIVERED)
        return delivered if self.delays is None else delivered & (self.delays == 0)

    def copied(self) -> Fates:
        """A copy with arrays of its own, so that packets may be silenced in it."""
        return self._replace(codes=self.codes.copy(), again=None if self.again is None else self.again.copy())

    def silence(self, row: int, sent: Flags) -> None:
        """Mark the packets of one slot that are not sent (R,) as unsent, in place."""
        self.codes[row][~sent] = Fate.UNSENT
        if self.again is not None:
            self.again[row] &= sent

    def part(self, slots: slice = slice(None), trials: slice = slice(None)) -> Fates:
        """The fates of some of the slots and some of the trials."""
        return Fates(
            self.codes[slots, trials],
            None if self.delays is None else self.delays[slots, trials],
            None if self.again is None else self.again[slots, trials],
            None if self.rests is None else self.rests[slots],
        )


class ReceiverOutage(NamedTuple):
    """Slots start ≤ k < stop in which a receiver is away."""

    start: int
    stop: int
    reason: Fate
    keeps_state: bool = True
    """Whether it continues from its last belief; otherwise from the prior of the slot in which it went away."""


_READ_AT_ONCE = 65_536  # slots


def _expect_delays(delays: Any, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless these are delays: cast to whole slots, NaN and negative numbers would be very late packets."""
    if not isinstance(delays, np.ndarray) or delays.dtype != np.float64 or delays.shape != shape:
        found = f"{delays.dtype} of shape {delays.shape}" if isinstance(delays, np.ndarray) else type(delays).__name__
        raise ValueError(f"delays() gave {found}; expected an array of float64, shape {shape}: slots, R trials")
    if not (delays >= 0.0).all():
        wrong = delays[~(delays >= 0.0)].flat[0]
        raise ValueError(f"delays() gave {wrong}; expected slots, 0 or more")


_SETTINGS = frozenset({"loss", "delay", "reorder", "duplicate", "corrupt", "rate", "queue"})
MOST_RATE = 1e6
"""The highest rate of a link, in packets a slot."""
MOST_QUEUED = 1_000_000
"""The longest queue of a link, in packets."""
_LONGEST = float(np.iinfo(np.uint32).max)
"""The longest delay, in slots, with the queue's; longer delays are cut to it: no run has that many slots."""


@dataclass(frozen=True)
class Change:
    """From slot `at` on, a link has other settings, or it is cut or healed."""

    at: int
    settings: Mapping[str, Any] | None = None
    """As in `LinkSchedule.settings`; None keeps them."""
    cut: bool | None = None
    """None keeps the state."""


@dataclass(frozen=True)
class LinkSchedule:
    """Everything that is known of a link in advance: its settings at slot 0, and their changes."""

    settings: Mapping[str, Any]
    """`loss`: {"model": …}; and, where they differ from the default, `delay`: {"model": …}, `reorder`, `duplicate`, `corrupt`:
    probabilities, `rate` in packets a slot with `queue` in packets."""
    window: int = 0
    """Slots by which a packet may be late for its receiver."""
    changes: tuple[Change, ...] = ()
    outages: tuple[ReceiverOutage, ...] = ()
    correlation: tuple[str, float] | None = None
    """The receiver whose losses these are tied to, and how strongly."""

    def expect_possible(self) -> None:
        """Raise ValueError unless window, changes and outages are within a run's slots, and all settings are right.

        Settings that lack a name, or have one that is not registered, raise KeyError.
        """
        outages = (slot for outage in self.outages for slot in (outage.start, outage.stop))
        expect_slots(self.window, *(change.at for change in self.changes), *outages)
        if self.window > MOST_SLOTS:
            raise ValueError(f"its window is above {MOST_SLOTS} slots")
        if self.correlation is not None and not is_probability(self.correlation[1]):
            raise ValueError(f"its correlation is {self.correlation[1]:g}, expected a number from 0 to 1")
        for settings in (self.settings, *(change.settings for change in self.changes if change.settings is not None)):
            _expect_settings(settings)


def _expect_settings(settings: Mapping[str, Any]) -> None:
    """Raise ValueError or KeyError for a mistake in the settings of a link."""
    if unknown := sorted(settings.keys() - _SETTINGS):
        raise ValueError(f"a link has no setting {unknown[0]:.40}")
    if not isinstance(settings.get("loss"), Mapping):
        raise ValueError("its settings have no loss")
    if not (specs := single_specs(settings["loss"])):
        raise ValueError("its loss pools no links")
    for spec in specs:
        _expect_right(LOSS_MODELS[spec["model"]], spec)
    mistakes = [
        *probability_mistakes(settings, "reorder", "duplicate", "corrupt"),
        *number_mistakes(settings, "rate", 0.0, MOST_RATE),
        *whole_number_mistakes(settings, "queue", 0, MOST_QUEUED),
    ]
    for entry, problem in mistakes:
        raise ValueError(f"{entry} {problem}")
    if settings.get("rate") and "queue" not in settings:
        raise ValueError("it has a rate, and no queue")
    if (delay := settings.get("delay")) is not None:
        _expect_right(DELAY_MODELS[delay["model"]], delay)


def _expect_right(kind: type[LossModel | DelayModel], spec: Mapping[str, Any]) -> None:
    """Raise ValueError for a mistake in the parameters of a model, which must be all that it has."""
    given = {name: value for name, value in spec.items() if name != "model"}
    for entry, problem in kind.mistakes(given):
        raise ValueError(f"{entry} {problem}")
    kind(**given)


def streams_of(receiver: str, schedule: LinkSchedule) -> tuple[str, ...]:
    """The random streams of a receiver's link: losses, delays, all other faults, and correlation."""
    names = (f"link/{receiver}", f"delay/{receiver}", f"fate/{receiver}")
    return names if schedule.correlation is None else (*names, f"mix/{receiver}", f"link/{schedule.correlation[0]}")


@final
@dataclass
class _State:
    """The memory of a link between slots: it is copied so that slots can be decided again."""

    settings: Mapping[str, Any]
    loss: LossModel
    cut: bool = False
    free: float = 0.0
    """When the queue will have sent all its packets, in slots."""

    def copied(self) -> _State:
        """A copy that may change; a loss model never changes its memory in place."""
        return _State(self.settings, copy.copy(self.loss), self.cut, self.free)


@final
@dataclass
class Link:
    """One receiver's link. Slots must be read in order, any number at a time.

    keys: the keys of `streams_of`; reader: what reads their numbers, from a key, the batch and the numbers of a trial.
    """

    schedule: LinkSchedule
    receiver: str
    keys: Mapping[str, bytes]
    batch: Batch
    reader: Callable[[bytes, Batch, int], StreamReader] = BlockReader
    _state: _State = field(init=False)
    _before: tuple[_State, range] | None = field(init=False, default=None)
    _changes: list[Change] = field(init=False)
    _readers: dict[tuple[str, int], StreamReader] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._state = _State(self.schedule.settings, loss_of(self.schedule.settings["loss"]))
        self._changes = sorted(self.schedule.changes, key=lambda change: change.at)

    def like(self, keys: Mapping[str, bytes]) -> Link:
        """The same link with other keys, which is quicker than to make it. This link must not have begun."""
        link = Link.__new__(Link)
        vars(link).update(vars(self), keys=keys, _state=self._state.copied(), _readers={})
        return link

    def planned(self, slots: range) -> Fates:
        """The fates of the next slots, which may still be amended."""
        self._before = (self._state.copied(), slots)
        return self.fates(slots)

    def amended(self, at: int, changes: Iterable[Change]) -> Fates:
        """The fates of the last planned slots from `at` on, decided again; the changes replace all later changes."""
        if self._before is None or at not in self._before[1]:
            raise ValueError(f"slot {at} is not among those last planned")
        self._state, slots = self._before
        if at > slots.start:
            self.fates(range(slots.start, at))
        earlier = [change for change in self._changes if slots.start <= change.at < at]  # the state has those before
        self._changes = sorted([*earlier, *changes], key=lambda change: change.at)
        return self.planned(range(at, slots.stop))

    def fates(self, slots: range) -> Fates:
        """The fates of the packets of the next slots in every trial."""
        if not self._changes:
            return self._unchanged(slots)
        parts = [self._unchanged(some) for some in self._stretches(slots)]
        return parts[0] if len(parts) == 1 else _joined(parts)

    def skip(self, stop: int) -> None:
        """Go on with slot `stop`, as if all earlier ones had been read: few are, unless later losses depend on them."""
        for some in self._stretches(range(stop)):
            if self._state.loss.memoryless and not self._state.settings.get("rate"):
                continue
            for start in range(0, len(some), _READ_AT_ONCE):
                self._unchanged(some[start : start + _READ_AT_ONCE])

    def _stretches(self, slots: range) -> Iterator[range]:
        """Consecutive slots in stretches of constant settings; the changes at the beginning of each are applied before it."""
        marks = sorted({change.at for change in self._changes if slots.start < change.at < slots.stop})
        for start, stop in pairwise([slots.start, *marks, slots.stop]):
            self._apply([change for change in self._changes if change.at == start])
            yield range(start, stop)

    def _apply(self, changes: Iterable[Change]) -> None:
        """Apply the changes of one slot, in order. A loss model that they leave as it was keeps its memory."""
        before = self._state.settings["loss"]
        for change in changes:
            if change.settings is not None:
                self._state.settings = change.settings
            if change.cut is not None:
                self._state.cut = change.cut
        if self._state.settings["loss"] != before:
            self._state.loss = loss_of(self._state.settings["loss"])

    def _unchanged(self, slots: range) -> Fates:
        """The fates of slots during which the settings stay the same."""
        settings, shape = self._state.settings, (len(slots), self.batch.trials)
        codes = self._state.loss.fates(slots.start, self._loss_uniforms(slots))
        befalls = settings.get("reorder") or settings.get("duplicate") or settings.get("corrupt")
        chances = self._reader("fate", 3).uniforms(slots) if befalls else None
        if chances is not None and settings.get("corrupt"):
            codes = np.where((codes == 0) & (chances[:, 0] < settings["corrupt"]), np.uint8(Fate.CORRUPTED), codes)
        delays = self._delays(slots, chances)
        if settings.get("rate"):
            waits, full = self._queue(slots)
            codes = np.where(full[:, None], np.uint8(Fate.OVERFLOW), codes)
            delays = waits[:, None] + (np.zeros(shape) if delays is None else delays)
        if delays is not None:
            delays = np.minimum(delays, _LONGEST)
        if self._state.cut:
            codes = np.where(codes == int(Fate.OVERFLOW), codes, np.uint8(Fate.CUT))
        whole = None if delays is None else delays.astype(np.uint32)
        codes = self._received(slots, codes, whole)
        again = None
        if chances is not None and settings.get("duplicate"):
            again = (codes == int(Fate.DELIVERED)) & (chances[:, 2] < settings["duplicate"])
        rests = None if delays is None or whole is None else delays[:, 0] - whole[:, 0]
        return Fates(codes, whole, again, rests)

    def _delays(self, slots: range, chances: Floats | None) -> Floats | None:
        """The delays in slots, (c, R), without the queue's; None if there are none."""
        settings = self._state.settings
        if settings.get("delay") is None:
            return None
        model = delay_of(settings["delay"])
        reader = self._reader("delay", 1)
        numbers = (reader.normals(slots) if model.normal else reader.uniforms(slots))[:, 0]
        delays = model.delays(slots.start, numbers)
        if DELAY_MODELS.foreign(settings["delay"]["model"]):
            _expect_delays(delays, numbers.shape)
        if chances is not None and settings.get("reorder"):
            delays = np.where(chances[:, 1] < settings["reorder"], 0.0, delays)
        return delays

    def _queue(self, slots: range) -> tuple[Floats, Flags]:
        """The time that each slot's packet waits in the queue, in slots, (c,), and whether the queue is full."""
        rate, places = float(self._state.settings["rate"]), int(self._state.settings["queue"])
        waits, full = np.zeros(len(slots)), np.zeros(len(slots), np.bool_)
        for row, k in enumerate(slots):
            wait = max(0.0, self._state.free - k)
            full[row] = wait * rate > places
            waits[row] = 0.0 if full[row] else wait
            if not full[row]:
                self._state.free = max(self._state.free, float(k)) + 1.0 / rate
        return waits, full

    def _received(self, slots: range, codes: Codes, delays: NDArray[np.uint32] | None) -> Codes:
        """The fates after checking whether the receiver can accept the packets that the network delivers."""
        if delays is None and not self.schedule.outages:
            return codes
        arrives: NDArray[np.int64] = np.arange(slots.start, slots.stop)[:, None]
        sent = arrives
        if delays is not None:
            arrives = sent + delays
            codes = np.where((codes == 0) & (delays > self.schedule.window), np.uint8(Fate.LATE), codes)
        for outage in self.schedule.outages:
            if delays is not None or (outage.start < slots.stop and slots.start < outage.stop):
                away = (codes == 0) & (sent < outage.stop) & (arrives >= outage.start)
                codes = np.where(away, np.uint8(outage.reason), codes)
        if delays is not None:
            codes = np.where((codes == 0) & (arrives >= self.batch.slots), np.uint8(Fate.UNDERWAY), codes)
        return codes

    def _loss_uniforms(self, slots: range) -> Floats:
        """Uniform numbers of this link's own stream, or in some slots of the stream to which its losses are tied."""
        width = self._state.loss.uniforms_per_slot
        own = self._reader("link", width).uniforms(slots)
        if self.schedule.correlation is None:
            return own
        other, strength = self.schedule.correlation
        mixed = self._reader("mix", 1).uniforms(slots)
        theirs = self._reader_of(f"link/{other}", width).uniforms(slots)
        return np.where(mixed < strength, theirs, own)

    def _reader(self, stream: str, width: int) -> StreamReader:
        return self._reader_of(f"{stream}/{self.receiver}", width)

    def _reader_of(self, name: str, width: int) -> StreamReader:
        reader = self._readers.get((name, width))
        if reader is None:
            reader = self._readers[name, width] = self.reader(self.keys[name], self.batch, width)
        return reader


def _joined(parts: list[Fates]) -> Fates:
    """Fates of consecutive slots as one."""
    shapes = [part.codes.shape for part in parts]

    def column(name: str, dtype: Any, axes: int = 2) -> Any:
        values = [getattr(part, name) for part in parts]
        if all(value is None for value in values):
            return None
        blank = [np.zeros(shape[:axes], dtype) for shape in shapes]
        return np.concatenate([value if value is not None else zero for value, zero in zip(values, blank, strict=True)])

    codes = np.concatenate([part.codes for part in parts])
    return Fates(codes, column("delays", np.uint32), column("again", np.bool_), column("rests", np.float64, 1))


def link_of(loss: Mapping[str, Any], key: bytes, batch: Batch) -> Link:
    """A link that only loses packets: by a loss model, `{"model": …}`, and the key of its losses."""
    return Link(LinkSchedule({"loss": loss}), "it", {"link/it": key}, batch)


_LET_THROUGH = (Fate.DELIVERED, Fate.LATE, Fate.DOWN, Fate.PAUSED, Fate.UNDERWAY)
COUNTED_BURSTS = 64
"""Bursts of at least this many packets are counted together."""


@dataclass(frozen=True)
class Account:
    """The outcomes of the packets of some slots on one link."""

    slots: LinkSlots
    bursts: NDArray[np.uint32]
    """Runs of packets lost to the loss model that ended in these slots, by length: 1, 2, … and 64 or more. A slot without a
    packet ends a run."""
    delays: NDArray[np.uint32]
    """Packets of these slots that the link let through, by their delay in slots: 0, 1, …, the window, and more.

    With those that their receiver missed and those that the run's end cut off, which would be the slow ones more often."""


@final
class Accountant:
    """Keeps the account of one link; slots must be added in order."""

    def __init__(self, window: int, trials: int) -> None:
        self._window = window
        self._trials = trials
        self._due: dict[int, NDArray[np.uint16]] = {}
        self._run = np.zeros(trials, np.int64)  # how many of its last packets each trial has lost

    def account(self, slots: range, fates: Fates) -> Account:
        """The account of the next slots."""
        counts = kernels.count_codes(fates.codes, len(Fate))
        lost = counts[:, 1 : 1 + len(REASONS)].copy()
        return Account(
            LinkSlots(slots.start, fates.in_time, lost, counts[:, Fate.UNSENT].copy(), self._late(slots, fates)),
            kernels.count_bursts(fates.codes, Fate.LOST, self._run, COUNTED_BURSTS),
            self._delays(fates, counts),
        )

    def _late(self, slots: range, fates: Fates) -> NDArray[np.uint16] | None:
        if not self._window:
            return None
        counts = np.zeros((len(slots), self._trials), np.uint16)
        for k in [k for k in self._due if k < slots.stop]:
            counts[k - slots.start] += self._due.pop(k)
        if fates.delays is not None:
            waits = np.where(fates.codes == int(Fate.DELIVERED), fates.delays, 0)
            for row, trial in zip(*np.nonzero(waits), strict=True):
                k = slots.start + int(row) + int(waits[row, trial])
                if k < slots.stop:
                    counts[k - slots.start, trial] += 1
                else:
                    self._due.setdefault(k, np.zeros(self._trials, np.uint16))[trial] += 1
        return counts

    def _delays(self, fates: Fates, counts: NDArray[np.uint32]) -> NDArray[np.uint32]:
        bins = self._window + 2
        if fates.delays is None:
            delays = np.zeros(bins, np.uint32)
            delays[0] = counts[:, _LET_THROUGH].sum()
            return delays
        through = np.isin(fates.codes, _LET_THROUGH)
        return np.bincount(np.minimum(fates.delays[through], bins - 1), minlength=bins).astype(np.uint32)


_AHEAD = 128  # slots drawn at once


def deliveries(link: Link, slots: int) -> Iterator[Flags]:
    """γ_k (R,) of slots 0 … slots−1, one after the other."""
    for start in range(0, slots, _AHEAD):
        yield from link.fates(range(start, min(start + _AHEAD, slots))).in_time
