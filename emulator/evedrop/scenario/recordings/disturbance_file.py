"""The disturbances of a plant, or states, from a CSV file: a line with their names, then a line of numbers for every slot.

    time [s], P_solar [kW], P_load [kW]
    0, 0.0, 0.235
    1, 0.0, 0.235

A name may be followed by its unit. If the scenario states the units, the file must state them too; powers in W and kW are
converted to the scenario's unit. A column `time`, in seconds, shows where slots are missing. The file may be compressed
(`.csv.gz`), may have other columns, and may be longer than the run: rows after the last slot are not read.

Source: docs/scenario.md, process and plant; docs/microgrid.md, a day of your own.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple

from evedrop.counting import counted
from evedrop.errors import DisturbanceError
from evedrop.system.files import Limit, Unreadable, lines_of

_KILOWATTS = {"W": 1e-3, "kW": 1.0}
_HEADER = re.compile(r"^(?P<name>[^\[\]]*?)\s*\[(?P<unit>[^\[\]]*)\]$")
_TIME = "time"
_EXAMPLE = "time [s], P_solar [kW], P_load [kW]"
_TIME_ERROR, _SCATTER = 1e-6, 0.1  # in slots: times may be rounded, and those that were measured scatter
MOST_REPORTED = 5
"""The most lines of one kind of mistake in a message: more would not be read."""
MOST_NUMBERS = 10_000_000
"""The most numbers in a table of disturbances, slots times columns: more than a month of two columns by the second."""
_ROWS_UNASKED = 10_000  # for a scenario without a number of slots, which is reported as a mistake of its own


def found_file(name: str, folder: Path) -> Path:
    """The path of a file that a scenario in this folder names: in the folder, or otherwise among the built-in files."""
    own = folder / name
    shipped = Path(str(resources.files("evedrop.scenarios"))) / name
    try:
        return shipped if not own.exists() and shipped.is_file() else own
    except OSError:  # the name cannot be a file's: opening it reports that
        return own


def read_disturbances(
    path: Path,
    names: Sequence[str],
    units: Sequence[str] | None = None,
    slots: int | None = None,
    slot_seconds: float = 1.0,
    recorded: bool = False,
) -> list[list[float]]:
    """A row for each slot with the numbers of these names, in their order and units.

    recorded: whether times were measured: they may start anywhere, and scatter by a tenth of a slot.

    Raises DisturbanceError with every mistake: no file, missing columns, wrong units, values that are not finite numbers, times
    that do not advance by `slot_seconds`, fewer rows than `slots`.
    """
    most = MOST_NUMBERS // max(1, len(names))
    if slots is not None and slots > most:
        raise DisturbanceError(
            str(path),
            [f"is read for {slots} slots of {len(names)} columns; expected at most {most} slots, or fewer columns"],
        )
    limit = _ROWS_UNASKED if slots is None else max(0, slots)
    head, rows = _begun(path, limit, len(names), _EXAMPLE)
    series = _read_series(path, head, rows, names, units, limit)
    if series.times is not None:
        series.check_times(slot_seconds, recorded)
    count = len(series.numbers)
    if slots is not None and count < slots:
        few = f"has {counted(count, 'row')}; expected slots, which is {slots}, or more"
        raise DisturbanceError(str(path), [f"{few}: a longer file, or slots = {count}" if count else few])
    return series.numbers


@dataclass(frozen=True)
class StateRecording:
    """A recording of states."""

    path: str
    names: Sequence[str]
    units: Sequence[str] | None
    """None unless every column has one."""
    rows: Sequence[Sequence[float]]
    seconds: float | None
    """The time from one state to the next; None without a column of times."""


def recorded_states(path: Path, names: Sequence[str] | None = None) -> StateRecording:
    """All states of a file; names: its columns, by default all but the time.

    Raises DisturbanceError as `read_disturbances` does; times may scatter by a tenth of their mean distance.
    """
    head, rows = _begun(path, MOST_NUMBERS, 1, "x, y")
    if all(_is_finite(cell, 1.0) for cell in head.cells):
        raise DisturbanceError(
            str(path),
            [
                f"line {head.line} has only numbers; expected a line of names first, such as x, y, then a line for each state"
            ],
        )
    there = [match["name"] if (match := _HEADER.match(cell)) else cell for cell in head.cells]
    names = [name for name in there if name != _TIME] if names is None else names
    series, seconds = _read_series(path, head, rows, names, None, None), None
    if (times := series.times) is not None:
        seconds = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.0
        if len(times) > 1 and not 0.0 < seconds < math.inf:
            raise DisturbanceError(str(path), ["has times that do not grow from line to line; expected seconds"])
        series.check_times(seconds, recorded=True)
    given = {match["name"]: match["unit"].strip() for cell in head.cells if (match := _HEADER.match(cell))}
    units = [given[name] for name in names] if all(name in given for name in names) else None
    return StateRecording(str(path), names, units, series.numbers, seconds)


def table_text(names: Sequence[str], units: Sequence[str] | None, rows: Sequence[Sequence[float]]) -> str:
    """The text of a file that is read back to the same bits."""
    return table_head(names, units) + number_lines(rows)


def table_head(names: Sequence[str], units: Sequence[str] | None) -> str:
    """The first line of such a file."""
    head = names if units is None else [f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)]
    return f"{','.join(head)}\n"


def number_lines(rows: Sequence[Sequence[float]]) -> str:
    """Its lines of numbers."""
    return "".join(f"{','.join([repr(value) for value in row])}\n" for row in rows)


class _Row(NamedTuple):
    """A line of the file and its number. A tuple, since a day has 86 400 of them."""

    line: int
    cells: list[str]


@dataclass(frozen=True)
class _Column:
    """A column that is read: its place in the file, and the factor for its values."""

    name: str
    place: int
    factor: float


@dataclass(frozen=True)
class _Series:
    """The contents of the lines after the first: numbers, line number and time of each."""

    path: Path
    numbers: list[list[float]]
    lines: list[int]
    times: list[float] | None
    """None without a column of times."""

    def check_times(self, slot_seconds: float, recorded: bool) -> None:
        """Raise DisturbanceError unless the times advance by one slot; recorded: as in `read_disturbances`."""
        mistakes = list(_few(_time_mistakes(self.lines, self.times or [], slot_seconds, recorded), "times"))
        if mistakes:
            raise DisturbanceError(str(self.path), mistakes)


def _rows(path: Path, slots: int, columns: int) -> Iterator[_Row]:
    """Every line that is neither blank nor a comment, from a file for so many slots and columns. Raises DisturbanceError."""
    try:
        reader = csv.reader(lines_of(path, Limit.of_rows(slots, columns)), skipinitialspace=True)
        for cells in reader:
            stripped = list(map(str.strip, cells))
            if any(stripped) and not stripped[0].startswith("#"):
                yield _Row(reader.line_num, stripped)
    except (Unreadable, csv.Error) as error:
        problem = f"cannot be read ({error}); expected a CSV file whose first line is such as {_EXAMPLE}"
        raise DisturbanceError(str(path), [problem]) from error


def _begun(path: Path, slots: int, columns: int, example: str) -> tuple[_Row, Iterator[_Row]]:
    """The first line and the others, as from `_rows`; example: a first line, for the message."""
    rows = _rows(path, slots, columns)
    head = next(rows, None)
    if head is None:
        empty = f"is empty; expected a line of names such as {example}, then a line for every slot"
        raise DisturbanceError(str(path), [empty])
    return head, rows


def _columns(head: _Row, names: Sequence[str], units: Sequence[str] | None) -> tuple[list[_Column], list[str]]:
    """The column of the time, if there is one, and those of the names; and mistakes in the first line."""
    places: dict[str, tuple[int, str | None]] = {}
    mistakes = []
    for place, cell in enumerate(head.cells):
        match = _HEADER.match(cell)
        name, unit = (match["name"], match["unit"].strip()) if match else (cell, None)
        if name in places and name in (_TIME, *names):
            mistakes.append(f'line {head.line} names "{name}" twice; expected each column once')
        places[name] = (place, unit)
    columns = []
    if _TIME in places and _TIME not in names:
        place, unit = places[_TIME]
        columns.append(_Column(_TIME, place, 1.0))
        if unit not in (None, "s"):
            mistakes.append(f'line {head.line}: the column "{_TIME}" is in [{unit}]; expected {_TIME} [s]')
    for i, name in enumerate(names):
        wanted = None if units is None or i >= len(units) else units[i]
        if name not in places:
            there = ", ".join(f'"{cell}"' for cell in head.cells[:8])
            names_ = name if wanted is None else f"{name} [{wanted}]"
            mistakes.append(f'line {head.line} has no column "{name}", only {there}; expected {names_} among them')
            continue
        place, unit = places[name]
        factor = 1.0 if wanted is None else _factor(unit, wanted)
        if factor is None:
            given = "has no unit" if unit is None else f"is in [{unit}]"
            choice = [wanted, *(name_ for name_ in _KILOWATTS if name_ != wanted)] if wanted in _KILOWATTS else [wanted]
            names_ = " or ".join(f"{name} [{name_}]" for name_ in choice)
            mistakes.append(f'line {head.line}: the column "{name}" {given}; expected {names_}')
        else:
            columns.append(_Column(name, place, factor))
    return columns, mistakes


def _factor(unit: str | None, wanted: str | None) -> float | None:
    """The factor from one unit to the other; None if they cannot be converted."""
    if unit == wanted:
        return 1.0
    if unit in _KILOWATTS and wanted in _KILOWATTS:
        return _KILOWATTS[unit] / _KILOWATTS[wanted]
    return None


def _read_series(
    path: Path, head: _Row, rows: Iterable[_Row], names: Sequence[str], units: Sequence[str] | None, limit: int | None
) -> _Series:
    """The columns' values of every line, up to this limit, or to `MOST_NUMBERS`. Raises DisturbanceError with the mistakes."""
    columns, mistakes = _columns(head, names, units)
    if mistakes:
        raise DisturbanceError(str(path), mistakes)
    width, timed = len(head.cells), columns != [] and columns[0].name == _TIME and _TIME not in names
    places = [(column.place, column.factor) for column in columns]
    numbers: list[list[float]] = []
    lines: list[int] = []
    wrong: list[_Row] = []
    all_lines = all_wrong = 0
    for row in islice(rows, MOST_NUMBERS // max(1, len(columns)) if limit is None else limit):
        line, cells = row
        all_lines += 1
        try:
            values = [float(cells[place]) * factor for place, factor in places]
        except (ValueError, IndexError):
            values = [math.nan]
        if len(cells) == width and all(map(math.isfinite, values)):
            numbers.append(values)
            lines.append(line)
            continue
        all_wrong += 1
        if all_wrong <= MOST_REPORTED + 1:  # more are not reported, and need not be kept
            wrong.append(row)
    if mistakes := list(_few(_cell_mistakes(wrong, width, columns), f"{all_wrong} of {all_lines} lines")):
        raise DisturbanceError(str(path), mistakes)
    if timed:
        return _Series(path, [row[1:] for row in numbers], lines, [row[0] for row in numbers])
    return _Series(path, numbers, lines, None)


def _cell_mistakes(rows: Sequence[_Row], width: int, columns: Sequence[_Column]) -> Iterator[str]:
    for row in rows:
        if len(row.cells) != width:
            yield f"line {row.line} has {counted(len(row.cells), 'column')}; expected {width}, as the first line has"
            continue
        for column in columns:
            cell = row.cells[column.place]
            if not _is_finite(cell, column.factor):
                shown = f'"{cell[:40]}"' if cell else "empty"
                yield f"line {row.line}: {column.name} is {shown}; expected a finite number"


def _time_mistakes(lines: Sequence[int], times: Sequence[float], slot_seconds: float, recorded: bool) -> Iterator[str]:
    """Mistakes where the time does not start at 0 or does not advance by one slot; recorded: as in `read_disturbances`."""
    if times and times[0] != 0.0 and not recorded:
        yield f"line {lines[0]}: the time starts at {times[0]:.10g} s; expected 0, with that subtracted from every time"
    for line, (before, time) in zip(lines[1:], pairwise(times), strict=True):
        if abs(time - before - slot_seconds) <= (_SCATTER if recorded else _TIME_ERROR) * slot_seconds:
            continue
        slots = (time - before) / slot_seconds
        missing = round(slots) - 1 if math.isfinite(slots) else 0
        problem = "times must grow by a slot from line to line"
        if missing > 0:
            problem = (
                f"a gap of {missing:.10g} slot{'' if missing == 1 else 's'}: fill it, such as with the line before"
            )
        yield (
            f"line {line}: the time is {time:.10g} s after {before:.10g} s; expected {before + slot_seconds:.10g} s, "
            f"for slots of {slot_seconds:.10g} s: {problem}"
        )


def _few(mistakes: Iterator[str], where: str) -> Iterator[str]:
    """The first of the mistakes, and a note if there are more."""
    for i, mistake in enumerate(mistakes):
        if i == MOST_REPORTED:
            yield f"and more such mistakes, in {where}"
            return
        yield mistake


def _is_finite(cell: str, factor: float) -> bool:
    """Whether a cell is a number that is finite also in the unit of the plant."""
    try:
        return math.isfinite(float(cell) * factor)
    except ValueError:
        return False
