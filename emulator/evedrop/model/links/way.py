"""The position of a sender or receiver in every slot: fixed, or on straight lines between waypoints."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, final

import numpy as np

from evedrop.model.checks import as_toml, is_number
from evedrop.model.process import Floats

FARTHEST = 1e9
"""The largest coordinate, in metres."""
_MOST_WAYPOINTS = 10_000
_EXPECTED = "expected a position [x, y] in metres, or waypoints [[slot, x, y], …]"


@final
class Way:
    """Positions by slot.

    given: [x, y], or [[slot, x, y], …] with increasing slots. Before the first waypoint and after the last one it stands there;
    between two waypoints it moves straight and evenly.
    """

    def __init__(self, given: list[Any]) -> None:
        rows = given if isinstance(given[0], list) else [[0, *given]]
        self._slots, self._x, self._y = np.array(rows, np.float64).T
        self.slots = [int(row[0]) for row in rows]
        """The slots of the waypoints."""

    def at(self, slots: Floats) -> tuple[Floats, Floats]:
        """Its position, x and y in metres, each (slots,), with the same bits on every machine."""
        last = len(self._slots) - 1
        leg = np.searchsorted(self._slots, slots, side="right") - 1
        here, there = np.clip(leg, 0, last), np.clip(leg + 1, 0, last)
        span = self._slots[there] - self._slots[here]
        part = np.where(span > 0.0, (slots - self._slots[here]) / np.where(span > 0.0, span, 1.0), 0.0)
        x, y = (axis[here] + (axis[there] - axis[here]) * part for axis in (self._x, self._y))
        return x, y


def way_mistakes(given: Any) -> list[str]:
    """Mistakes in a position or in waypoints."""
    if not isinstance(given, list) or not given:
        return [f"is {as_toml(given)}; {_EXPECTED}"]
    if not isinstance(given[0], list):
        right = len(given) == 2 and all(is_number(value, -FARTHEST, FARTHEST) for value in given)
        return [] if right else [f"is {as_toml(given)}; {_EXPECTED}"]
    if len(given) > _MOST_WAYPOINTS:
        return [f"has {len(given)} waypoints; expected at most {_MOST_WAYPOINTS}"]
    mistakes = [
        f"waypoint {i} is {as_toml(row)}; expected [slot, x, y], a whole number from 0 on and a position in metres"
        for i, row in enumerate(given)
        if not _is_waypoint(row)
    ]
    if not mistakes:
        mistakes = [
            f"waypoint {i} is of slot {after[0]}, not after slot {before[0]}; expected slots that increase"
            for i, (before, after) in enumerate(pairwise(given), 1)
            if after[0] <= before[0]
        ]
    return mistakes


def _is_waypoint(row: Any) -> bool:
    return (
        isinstance(row, list)
        and len(row) == 3
        and type(row[0]) is int
        and 0 <= row[0] <= 10**9
        and all(is_number(value, -FARTHEST, FARTHEST) for value in row[1:])
    )
