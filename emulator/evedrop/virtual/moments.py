"""The moments at which a fault may strike: after so many events of any kind, or of those at which most can go wrong.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.names import RECORDER
from evedrop.virtual import notes

EVENTS = "events"
BARRIERS = "barriers"
COMMANDS = "commands to it"
LOSSES = "lost connections"
OF_KEYS: Mapping[str, str] = {
    "messages of the sensor": "uplink",
    "messages of progress": f"progress/{RECORDER}",
    "acknowledgements": "ack/sent",
    "inputs": "input",
}
"""Moment → the key of the messages that it counts."""


def is_counted(moment: str, target: str, commanded: bool, what: str, words: tuple[object, ...]) -> bool:
    """Whether a note counts for a moment; target: of the fault; commanded: whether that is a process which gets commands.

    If it is not, every command counts.
    """
    if moment == LOSSES:
        return what == notes.DISCONNECTS
    if what != notes.PUT:
        return False
    key, _, said = map(str, words)
    if moment in OF_KEYS:
        return key == OF_KEYS[moment]
    if moment == BARRIERS:
        return key == "uplink" and said.startswith("hold")
    return key == f"control/{target}" if commanded and target != RECORDER else key.startswith("control/")
