"""The moments at which a fault may strike: after so many events of any kind, or of those at which most can go wrong.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from evedrop.names import CONTROLLER, RECORDER
from evedrop.virtual import notes

EVENTS = "events"
BARRIERS = "barriers"
COMMANDS = "commands to it"
LOSSES = "lost connections"
CHANGES = "changes of the results"
FINAL_BELIEFS = "final beliefs"
OF_SENSOR = "messages of the sensor"
PROGRESS = "messages of progress"
PROGRESS_OF_RECEIVERS = "messages of progress of receivers"
ACKNOWLEDGED = "acknowledgements"
INPUTS = "inputs"
DECISIONS = "reports of the controller"
_OF_MESSAGES: Mapping[str, Callable[[str, str], bool]] = {
    BARRIERS: lambda key, said: key == "uplink" and said.startswith("hold"),
    FINAL_BELIEFS: lambda _, said: said.startswith("leaves"),
    OF_SENSOR: lambda key, _: key == "uplink",
    PROGRESS: lambda key, _: key == f"progress/{RECORDER}",
    PROGRESS_OF_RECEIVERS: lambda key, _: key.startswith("progress/") and key != f"progress/{RECORDER}",
    ACKNOWLEDGED: lambda key, _: key == "ack/sent",
    INPUTS: lambda key, _: key == "input",
    DECISIONS: lambda key, _: key == f"telemetry/{CONTROLLER}",
}
"""Moment → whether it counts a message, by its key and what it says."""


def is_counted(moment: str, target: str, commanded: bool, what: str, words: tuple[object, ...]) -> bool:
    """Whether a note counts for a moment; target: of the fault; commanded: whether that is a process which gets commands.

    If it is not, every command counts.
    """
    if what == notes.DISCONNECTS:
        return moment == LOSSES
    if what == notes.WRITES:
        return moment == CHANGES and str(words[2]).startswith("results/")
    if what != notes.PUT:
        return False
    key, _, said = map(str, words)
    if moment == COMMANDS:
        return key == f"control/{target}" if commanded and target != RECORDER else key.startswith("control/")
    return moment in _OF_MESSAGES and _OF_MESSAGES[moment](key, said)
