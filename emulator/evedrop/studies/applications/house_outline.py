"""The lines of a house in a drawing: x to the right, from 0 to `WIDTH`, and y downwards, from 0 to `HEIGHT`."""

from __future__ import annotations

import math

from evedrop.scenario.application import Spot

Lines = tuple[tuple[Spot, ...], ...]

WIDTH, HEIGHT = 12.0, 8.0
_LEFT, _RIGHT, _FLOOR, _EAVES = 2.6, 9.4, 7.2, 3.0
OUTLINE: Lines = (
    ((_LEFT - 0.6, _EAVES + 0.25), (6.0, 1.0), (_RIGHT + 0.6, _EAVES + 0.25)),
    ((_LEFT, _EAVES), (_LEFT, _FLOOR), (_RIGHT, _FLOOR), (_RIGHT, _EAVES)),
    ((0.3, _FLOOR), (_LEFT, _FLOOR)),
    ((_RIGHT, _FLOOR), (WIDTH - 0.3, _FLOOR)),
)
"""Roof, walls and floor, and the ground on both sides."""
SUN: Lines = (
    tuple((1.1 + 0.35 * math.cos(math.tau * i / 24), 0.6 + 0.35 * math.sin(math.tau * i / 24)) for i in range(25)),
    ((3.1, 2.4), (5.0, 1.3), (5.1, 1.47), (3.2, 2.57), (3.1, 2.4)),
)
"""The sun, and solar panels on the left side of the roof."""
GRID: Lines = (
    ((11.5, _FLOOR), (11.5, 4.0)),
    ((11.1, 4.2), (11.9, 4.2)),
    ((11.2, 4.6), (11.8, 4.6)),
)
"""A pole of the grid."""
RADIATOR: Lines = (
    *(((3.0 + 0.3 * i, 4.2), (3.0 + 0.3 * i, 5.6)) for i in range(4)),
    ((2.9, 4.2), (4.0, 4.2)),
    ((2.9, 5.6), (4.0, 5.6)),
)
"""A radiator at the left wall."""
