"""What happened in a simulated run, as a sequence diagram in text: a column for each process, and time from top to bottom.

A line is a step: a message from one process to others, or what happens to a process. Steps that repeat are folded, except around
faults, at the beginning and at the end.

Source: docs/maintainers/simulated-world.md, a failing seed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import final

from evedrop.names import CONTROLLER, LEGITIMATE, RECORDER, RELAY, ROUTER, SENSOR
from evedrop.virtual import notes
from evedrop.virtual.processes import LAUNCHER
from evedrop.virtual.steps import Life, Mark, Step

_MOST_LINES = 120
_WIDTH = 100
_TIME = 10
"""Characters of the time."""
_LEAST_LANE, _MOST_LANE = 11, 15
_NOTABLE, _FIRST = 5, 8
"""Such steps are shown once all steps this near to a fault or to the end are."""
_LONGEST_CYCLE, _LEAST_REPEATS = 10, 4
_FULL = 12
"""The number of steps before and after a fault, and before the end, that are folded only if they repeat."""
_NEAR = 30
"""The most steps before and after a fault that are shown because of it."""
_MOST_COUNTED = 5
_FIRST_LANES, _LAST_LANES = (LAUNCHER, ROUTER, RELAY, SENSOR, LEGITIMATE), (CONTROLLER, RECORDER)


def diagram(steps: Sequence[Step], most: int = _MOST_LINES) -> str:
    """The diagram of steps, in about as many lines as `most`."""
    lanes = _Lanes(columns_of(steps))
    lines = [lanes.header]
    folded: list[Step] = []
    shown = _shown(steps, most - 2)
    for i, step in enumerate(steps):
        if i in shown:
            if folded:
                lines.append(_fold(folded))
                folded = []
            lines.append(lanes.line(step))
        else:
            folded.append(step)
        lanes.live(step)
    if folded:
        lines.append(_fold(folded))
    return "\n".join([*lines, lanes.header])


def columns_of(run: Sequence[Step]) -> list[str]:
    """All processes of a run, in the order of their columns: the launcher, the routers, and at last the recorder."""
    names = dict.fromkeys(name for step in run for name in (step.process, *step.to) if name is not None)
    others = [name for name in names if name not in (*_FIRST_LANES, *_LAST_LANES)]
    return [
        *(name for name in _FIRST_LANES if name in names),
        *others,
        *(name for name in _LAST_LANES if name in names),
    ]


def _shown(steps: Sequence[Step], most: int) -> set[int]:
    """The numbers of the steps that have a line of their own."""
    ranks = _ranks(steps)
    repeated = _repeated(steps)
    order = sorted((i for i in range(len(steps)) if i not in repeated), key=lambda i: (ranks[i], -i))
    for count in range(min(len(order), most), 0, -1):
        shown = set(order[:count])
        gaps = list(_gaps(shown, len(steps)))
        if len(shown) + len(gaps) <= most:
            return shown | {first for first, last in gaps if first == last}
    return set()


def _gaps(shown: set[int], count: int) -> Iterator[tuple[int, int]]:
    """The first and the last number of each stretch that is not shown."""
    first = None
    for i in range(count + 1):
        if i < count and i not in shown:
            first = i if first is None else first
        elif first is not None:
            yield first, i - 1
            first = None


def _ranks(steps: Sequence[Step]) -> list[int]:
    """How little each step matters: 0 for faults and for the last one."""
    count = len(steps)
    ranks = [min(count - 1 - i, 2 * i) for i in range(count)]
    kinds: set[str] = set()
    for i, step in enumerate(steps):
        if step.kind not in kinds:
            kinds.add(step.kind)
            ranks[i] = min(ranks[i], _FIRST)
        if not step.steady:
            ranks[i] = min(ranks[i], _NOTABLE)
        if step.process is None:
            for near in range(max(0, i - _NEAR), min(count, i + _NEAR + 1)):
                ranks[near] = min(ranks[near], abs(near - i))
    return ranks


def _repeated(run: Sequence[Step]) -> set[int]:
    """The numbers of the steps between the first and the last of several cycles that are alike, in any order of their steps."""
    kinds = [step.kind for step in run]
    faults = [i for i, step in enumerate(run) if step.process is None]
    near = {i + by for i in [*faults, len(run)] for by in range(-_FULL, _FULL + 1)}
    repeated: set[int] = set()
    i = 0
    while i < len(run):
        for length in range(1, _LONGEST_CYCLE + 1):
            cycle, end = sorted(kinds[i : i + length]), i + length
            while sorted(kinds[end : end + length]) == cycle:
                end += length
            if end - i >= _LEAST_REPEATS * length and notes.FAULT not in cycle:
                between = set(range(i + length, end - length))
                repeated |= between if length == 1 else between - near
                i = end - length - 1
                break
        i += 1
    return repeated


def _fold(run: Sequence[Step]) -> str:
    counts = Counter(step.kind.partition(" ")[0] for step in run).most_common()
    named = [f"{count} {name}" for name, count in counts[:_MOST_COUNTED]]
    rest = sum(count for _, count in counts[_MOST_COUNTED:])
    text = ", ".join([*named, *([f"{rest} others"] if rest else [])])
    return f"{'⋮':>{_TIME - 1}} {len(run)} more until {run[-1].at:.4f}: {text}"


@final
class _Lanes:
    """The columns of processes, and who lives."""

    def __init__(self, names: Sequence[str]) -> None:
        self._width = max(_LEAST_LANE, min(_MOST_LANE, (_WIDTH - _TIME) // max(1, len(names))))
        self._places = {name: _TIME + i * self._width for i, name in enumerate(names)}
        self._alive: Counter[str] = Counter()
        self._suspended: set[str] = set()
        self.header = " " * _TIME + "".join(f"{name[: self._width - 1]:{self._width}}" for name in names).rstrip()

    def live(self, step: Step) -> None:
        """Note who begins, ends, stops or goes on."""
        if step.life is None or step.about is None:
            return
        if step.life is Life.BEGINS:
            self._alive[step.about] += 1
        elif step.life is Life.ENDS:
            self._alive[step.about] -= 1
        if step.life is Life.STOPS:
            self._suspended.add(step.about)
        else:
            self._suspended.discard(step.about)

    def line(self, step: Step) -> str:
        """The line of a step."""
        line = [" "] * (_TIME + self._width * len(self._places))
        for name, place in self._places.items():
            line[place] = " " if self._alive[name] <= 0 else "┊" if name in self._suspended else "│"
        line[:_TIME] = f"{step.at:9.4f} "
        if step.process is None:
            _write(line, _TIME, f"━━ {step.text} ".ljust(len(line) - _TIME, "━"))
        elif step.others:
            self._arrow(line, step, self._places[step.process])
        else:
            self._at_one(line, step, self._places[step.process])
        if step.life is Life.BEGINS and step.about is not None:
            line[self._places[step.about]] = "●"
        return "".join(line).rstrip()

    @staticmethod
    def _at_one(line: list[str], step: Step, place: int) -> None:
        line[place] = "■" if step.life is Life.ENDS else "●"
        text = f" {step.text} "
        if place + 1 + len(text) > len(line):
            _write(line, max(_TIME, place - len(text)), text[: place - _TIME])
        else:
            _write(line, place + 1, text)

    def _arrow(self, line: list[str], step: Step, start: int) -> None:
        """Lines from the sender, at this place, to its receivers on both sides."""
        others = step.others
        ends = {self._places[name]: mark for name, mark in others.items()}
        dash = "╌" if step.late or all(mark is Mark.LEAVES for mark in ends.values()) else "─"
        sides = [[place for place in ends if place > start], [place for place in ends if place < start]]
        for right, places in zip((True, False), sides, strict=True):
            if places:
                far = max(places) if right else min(places)
                first, last = (start + 1, far) if right else (far + 1, start)
                line[first:last] = dash * (last - first)
        longest = max((abs(place - start), place) for place in ends)[1]
        line[start] = "┼" if all(sides) else "├" if sides[0] else "┤"
        room = abs(longest - start) - 2
        label = step.text if len(step.text) <= room else f"{step.text[: room - 1]}…"
        spare = room - len(label)
        _write(line, min(start, longest) + (1 if longest > start else 2) + min(1, spare), label)
        for place, mark in ends.items():
            line[place - 1 if place > start else place + 1] = _head(mark, place > start, dash)


def _head(mark: Mark, right: bool, dash: str) -> str:
    heads = {Mark.ARRIVES: "▶" if right else "◀", Mark.LOST: "✗", Mark.LEAVES: dash, Mark.UNKNOWN: "?"}
    return heads[mark]


def _write(line: list[str], place: int, text: str) -> None:
    line[place : place + len(text)] = text[: len(line) - place]
