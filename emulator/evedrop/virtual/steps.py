"""The steps of a simulated run, as they are shown: each of one note, or of a message that is sent and all its arrivals.

Source: docs/maintainers/simulated-world.md, a failing seed.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import final

from evedrop.live.protocol.keys import reader_of, writer_of
from evedrop.virtual import notes
from evedrop.virtual.processes import FORK_SERVERS, LAUNCHER
from evedrop.virtual.scheduler import Occurrence

_LATE = 0.05
"""Virtual seconds after which a message that arrives is a step of its own."""
_MESSAGES = {
    "uplink": "slot",
    "downlink": "delivery",
    "telemetry": "report",
    "journal": "fates",
    "control": "command",
}
"""Kind of key → what its messages are, where the kind does not say so."""
_LIVES = (notes.STARTS, notes.ENDS, notes.SIGNAL)
_BETWEEN = {notes.CONNECTS: ("to",), notes.DISCONNECTS: ("from",)}
"""Word of a note → what stands before its second word when it is read."""


class Mark(Enum):
    """What becomes of a message on its way to a process."""

    ARRIVES = auto()
    LOST = auto()
    LEAVES = auto()
    """It arrives, or is lost, in a later step."""
    UNKNOWN = auto()
    """It neither arrives nor is lost before the end."""


class Life(Enum):
    """What changes in the life of a process."""

    BEGINS = notes.STARTS
    ENDS = notes.ENDS
    STOPS = notes.SUSPENDED
    GOES_ON = notes.GOES_ON


@final
@dataclass
class Step:
    """Something that happens to a process, between processes, or to the run."""

    at: float
    """Virtual seconds."""
    text: str
    process: str | None
    """Where it happens, or who sends; None for a fault."""
    kind: str
    """What it is, without numbers: steps of one kind are alike."""
    to: dict[str, Mark] = field(default_factory=dict)
    """Receiver → whether it arrives there."""
    steady: bool = False
    """Whether there are so many of the kind that a few of them show all."""
    late: bool = False
    """Whether it arrives long after it was sent, which was a step before."""
    life: Life | None = None
    about: str | None = None
    """Whose life changes."""

    @property
    def others(self) -> Mapping[str, Mark]:
        """The receivers but for the sender itself."""
        return {name: mark for name, mark in self.to.items() if name != self.process}

    @property
    def lost(self) -> bool:
        """Whether it never arrives at one of them."""
        return Mark.LOST in self.to.values()


def steps_of(happened: Sequence[Occurrence]) -> list[Step]:
    """The steps of everything that happened."""
    reader = _NoteReader()
    for number, note in enumerate(happened, 1):
        reader.read(number, note)
    return reader.steps


@final
class _NoteReader:
    """Makes steps of notes."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self._sent: dict[object, tuple[Step, int]] = {}
        """Number of a message → its step, and how many notable steps, which are no messages, there were before."""
        self._notable = 0

    def read(self, number: int, note: Occurrence) -> None:
        """Add the step of a note, or complete that of an earlier one."""
        if note.what == notes.PUT:
            self._put(number, note)
        elif note.what in (notes.GETS, notes.LOST):
            self._ends(note)
        elif note.what != notes.WRITES and not (note.what in _LIVES and str(note.words[0]).startswith(FORK_SERVERS)):
            self._add(_other(note))

    def _add(self, step: Step) -> None:
        self._notable += not step.steady
        self.steps.append(step)

    def _put(self, number: int, note: Occurrence) -> None:
        key, _, content = map(str, note.words)
        kind = key.partition("/")[0]
        name = _MESSAGES.get(kind, kind)
        step = Step(note.at, f"{name} {content}".strip(), note.process, f"{name} {key}", steady=kind != "control")
        step.to[reader_of(f"//{key}")] = Mark.UNKNOWN
        self.steps.append(step)
        self._sent[number] = step, self._notable

    def _ends(self, note: Occurrence) -> None:
        """A message ends its way to a process: in the step in which it was sent, unless much happened since then."""
        receiver, key, number, why = (*note.words, "", "", "")[:4]
        lost = note.what == notes.LOST
        mark, ending = (Mark.LOST, f" lost {why}".rstrip()) if lost else (Mark.ARRIVES, "")
        sent, notable = self._sent.get(number, (None, 0))
        if sent is None:
            text, sender = str(key), writer_of(f"//{key}") or str(receiver)
        else:
            if note.at - sent.at <= _LATE and notable == self._notable:
                sent.to[str(receiver)] = mark
                sent.text, sent.steady = sent.text + ending, sent.steady and not lost
                return
            sent.to[str(receiver)] = Mark.LEAVES
            text, sender = sent.text, sent.process or str(receiver)
        kind = f"{'lost' if lost else 'late'} {key}"
        self._add(Step(note.at, text + ending, sender, kind, {str(receiver): mark}, steady=not lost, late=True))


def _other(note: Occurrence) -> Step:
    words = [str(word) for word in note.words]
    if note.what == notes.FAULT:
        return Step(note.at, " ".join(words), None, notes.FAULT)
    about = words[0] if words else note.process
    text = " ".join([note.what, *_BETWEEN.get(note.what, ()), *words[1:]])
    if note.what == notes.SIGNAL and isinstance(note.words[1], int):
        text = signal.Signals(note.words[1]).name
    life = Life(note.what) if note.what in {life.value for life in Life} else None
    step = Step(note.at, text, about, f"{note.what} {about}", life=life, about=about)
    if note.what in (notes.SIGNAL, notes.STARTS) and note.process not in ("world", about):
        step.process, step.to = LAUNCHER if note.process in FORK_SERVERS else note.process, {about: Mark.ARRIVES}
    return step
