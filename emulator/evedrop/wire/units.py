"""Lengths of time, sizes and rates of wire files: numbers in seconds, bytes and bytes per second, or texts with a unit.

Source: docs/wire.md, units.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from evedrop.scenario.table import expected

_TIMES = {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
_SIZES = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_BITS = {"bit/s": 1 / 8, "kbit/s": 1e3 / 8, "Mbit/s": 1e6 / 8, "Gbit/s": 1e9 / 8}
_RATES = {**{f"{unit}/s": float(size) for unit, size in _SIZES.items()}, **_BITS}
_WITH_UNIT = re.compile(r"(\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)\s*(\S+)")
LONGEST_SECONDS = 1e6
LARGEST_BYTES = 2**40


def in_unit(text: str, units: Mapping[str, float]) -> float | None:
    """The number in a text such as "20 ms", in the base unit; None if it is not a number with one of the units."""
    found = _WITH_UNIT.fullmatch(text.strip())
    if found is None or found[2] not in units:
        return None
    number = float(found[1]) * units[found[2]]
    return round(number, 12)  # 20 ms are the number that 0.02 is


def in_seconds(text: str) -> float | None:
    """The seconds in a text such as "20 ms"; None if it is not a length of time."""
    return in_unit(text, _TIMES)


def seconds_of(text: str) -> float | None:
    """The seconds in a text such as "20 ms" or "0.02", up to `LONGEST_SECONDS`; None if it is neither."""
    found = in_seconds(text if text.strip()[-1:].isalpha() else f"{text} s")
    return found if found is not None and found <= LONGEST_SECONDS else None


def _seconds(value: Any) -> Any:
    return _read(value, _TIMES, 'seconds, or a text such as "20 ms"')


def _rate(value: Any) -> Any:
    return _read(value, _RATES, 'bytes per second, or a text such as "2 MB/s"')


def _size(value: Any) -> Any:
    number = _read(value, _SIZES, 'bytes, or a text such as "256 kB"')
    return int(number) if isinstance(number, float) and number.is_integer() else number


def _read(value: Any, units: Mapping[str, float], what: str) -> Any:
    if not isinstance(value, str):
        return value
    number = in_unit(value, units)
    if number is None:
        raise expected(f"{what}; the units are {', '.join(units)}")
    return number


Seconds = Annotated[float, Field(strict=True, ge=0.0, le=LONGEST_SECONDS), BeforeValidator(_seconds)]
Rate = Annotated[float, Field(strict=True, ge=1.0, le=float(LARGEST_BYTES)), BeforeValidator(_rate)]
"""Bytes per second."""
Size = Annotated[int, Field(strict=True, ge=0, le=LARGEST_BYTES), BeforeValidator(_size)]
"""Bytes."""
