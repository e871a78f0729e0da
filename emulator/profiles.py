"""Powers over time, from a CSV file whose header has units: what a day of a house is given as.

    time [s], P_solar [kW], P_load [kW]
    0, 0.0, 0.235
    1, 0.0, 0.235

Lines are slots: the first column is the time, which starts at 0 and advances by what a slot lasts. W and kW are understood.
The file may be compressed (`.csv.gz`), and may be longer than the run.
Source: docs/microgrid.md, a day of your own.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.errors import ProfileError

Floats = NDArray[np.float64]

KILOWATTS = {"kW": 1.0, "W": 1e-3}
_HEADER = re.compile(r"^(?P<name>[^\[\]]*?)\s*\[(?P<unit>[^\[\]]*)\]$")
_EXAMPLE = "time [s], P_solar [kW], P_load [kW]"
_MOST_SAID = 5


def read_profile(path: Path, names: Sequence[str], slots: int, slot_seconds: float = 1.0) -> Floats:
    """The columns `names` of a file, in kW, for slots of `slot_seconds` seconds: (len(names), slots).

    Raises ProfileError with every mistake: no file, wrong or missing columns and units, what is no finite number, times that
    do not advance by a slot, too few lines.
    """
    rows = _rows(path)
    if not rows:
        raise ProfileError(str(path), [f"is empty; expected a line of names such as {_EXAMPLE}, and a line per slot"])
    line, header = rows[0]
    places, factors, mistakes = _columns(line, header, names)
    if mistakes:
        raise ProfileError(str(path), mistakes)
    numbers, mistakes = _numbers(rows[1:], len(header), ["time", *names], places)
    if not mistakes:
        mistakes = _time_mistakes([line for line, _ in rows[1:]], numbers[0], slot_seconds)
    if not mistakes and numbers.shape[1] < slots:
        mistakes = [
            f"has {numbers.shape[1]} slots, up to line {rows[-1][0]}, but the run has {slots}; expected as many or more: "
            f"a longer file, or --slots {numbers.shape[1]}"
        ]
    if mistakes:
        raise ProfileError(str(path), mistakes)
    return np.ascontiguousarray(numbers[1:, :slots] * np.array(factors)[:, None])


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and cells of every line that is not blank. Raises ProfileError."""
    try:
        raw = path.read_bytes()
        text = (gzip.decompress(raw) if path.suffix == ".gz" else raw).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text), skipinitialspace=True)
        return [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(map(str.strip, row))]
    except (OSError, EOFError, ValueError, csv.Error) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error).splitlines()[0]
        what = f"cannot be read ({why}); expected a CSV file whose first line is such as {_EXAMPLE}"
        raise ProfileError(str(path), [what]) from error


def _columns(line: int, header: list[str], names: Sequence[str]) -> tuple[list[int], list[float], list[str]]:
    """Where time and the named columns stand, what makes their values kW, and what is wrong."""
    found: dict[str, tuple[int, str]] = {}
    mistakes = []
    for i, cell in enumerate(header):
        match = _HEADER.match(cell)
        name, unit = (match["name"], match["unit"].strip()) if match else (cell, "")
        if name in found:
            mistakes.append(f'line {line} names "{name}" twice; expected each column once')
        found[name] = (i, unit)
    places, factors = [], []
    for name in ("time", *names):
        units = {"s": 1.0} if name == "time" else KILOWATTS
        known = " or ".join(f"{name} [{unit}]" for unit in units)
        if name not in found:
            there = ", ".join(f'"{cell}"' for cell in header[:8])
            mistakes.append(f'line {line} has no column "{name}", only {there}; expected {known}')
            continue
        place, unit = found[name]
        if unit not in units:
            given = f"is in [{unit}]" if unit else "has no unit"
            mistakes.append(f'line {line}: the column "{name}" {given}; expected {known}')
            continue
        places.append(place)
        if name != "time":
            factors.append(units[unit])
    return places, factors, mistakes


def _numbers(
    rows: list[tuple[int, list[str]]], width: int, names: Sequence[str], places: Sequence[int]
) -> tuple[Floats, list[str]]:
    """The values, (columns, lines), and what is wrong with lines."""
    values: list[list[float]] = []
    mistakes: list[str] = []
    wrong = 0
    for line, row in rows:
        if len(row) != width:
            wrong += 1
            mistakes.append(f"line {line} has {len(row)} columns; expected {width}, as the first line has")
            continue
        try:
            value = [float(row[place]) for place in places]
            good = all(map(math.isfinite, value))
        except ValueError:
            good = False
        if good:
            values.append(value)
            continue
        wrong += 1
        for name, place in zip(names, places, strict=True):
            if not _is_finite(row[place]):
                shown = f'"{row[place][:40]}"' if row[place] else "empty"
                mistakes.append(f"line {line}: {name} is {shown}; expected a finite number")
    if len(mistakes) > _MOST_SAID:
        mistakes = [*mistakes[:_MOST_SAID], f"and more of the kind: {wrong} of {len(rows)} lines have mistakes"]
    return np.array(values).reshape(-1, len(places)).T, mistakes


def _time_mistakes(lines: list[int], times: Floats, slot_seconds: float) -> list[str]:
    """Where the time does not start at 0 or does not advance by a slot."""
    if not len(times):
        return ["has no line after its first; expected one for every slot"]
    mistakes = []
    if times[0] != 0.0:
        mistakes.append(f"line {lines[0]}: the time starts at {times[0]:g} s; expected 0, and every time less that")
    steps = np.diff(times)
    wrong = np.flatnonzero(~np.isclose(steps, slot_seconds, rtol=1e-6, atol=1e-9 * abs(times).max()))
    for i in wrong[:_MOST_SAID]:
        missing = round(steps[i] / slot_seconds) - 1
        what = (
            f"a gap of {missing} slot{'' if missing == 1 else 's'}: fill it, such as with the line before"
            if missing > 0
            else "times must grow by a slot from line to line"
        )
        mistakes.append(
            f"line {lines[i + 1]}: the time is {times[i + 1]:g} s after {times[i]:g} s; expected "
            f"{times[i] + slot_seconds:g} s, for slots of {slot_seconds:g} s: {what}"
        )
    if len(wrong) > _MOST_SAID:
        mistakes.append(f"and more of the kind: {len(wrong)} lines are not a slot after the one before")
    return mistakes


def _is_finite(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False
