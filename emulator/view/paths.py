"""The place of each entity in the recording. The panels show entity names, so these are short."""

from __future__ import annotations

from evedrop.view.scene import Scene

TIMELINE = "slot_number"
"""Rerun makes the events' first column as wide as this name, and "slot" is too narrow for a number."""
ERROR = "error"
TRACE = "trace"
THEORY = "theory"
PACKETS = "packets"
PLANE = "plane"
EVENTS = "events"
FRAME = f"{PLANE}/frame"
TRUTH = "truth"
NOTES = "run"
MOVING = "moving"
LEVELS = "levels"


def lane(scene: Scene, i: int) -> str:
    """Lane of the i-th receiver, or of the sensor for i = −1. Lanes are sorted by path, hence the number."""
    digits = len(str(len(scene.receivers)))
    name = "sent" if i < 0 else scene.receivers[i].name
    return f"{PACKETS}/{i + 1:0{digits}d}_{name}"


def curve(kind: str, name: str) -> str:
    """A receiver's curve of one kind: ERROR, TRACE or THEORY."""
    return f"{kind}/{name}"


def trail(name: str) -> str:
    """The path of a receiver's past estimates."""
    return f"{PLANE}/{name}/trail"


def ellipse(name: str) -> str:
    """The path of the ellipse of a receiver's belief."""
    return f"{PLANE}/{name}/cov"


def point(name: str) -> str:
    """The path of a receiver's current estimate."""
    return f"{PLANE}/{name}/at"


def events(name: str) -> str:
    """Lines about one receiver, or `NOTES` about the run."""
    return f"{EVENTS}/{name}"
