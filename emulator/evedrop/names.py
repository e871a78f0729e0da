"""Names of the processes of a run, and of the actions on them."""

from __future__ import annotations

from enum import StrEnum

SENSOR = "sensor"
LEGITIMATE = "legitimate"
ROUTER = "router"
RECORDER = "recorder"
OPERATOR = "operator"
CONTROLLER = "controller"
ACKNOWLEDGEMENTS = "acknowledgements"
"""Not a process: the name of the link of acknowledgements, whose random stream is `link/acknowledgements`."""
RELAY = "relay"
RESERVED = (SENSOR, LEGITIMATE, ROUTER, RELAY, RECORDER, OPERATOR, CONTROLLER, ACKNOWLEDGEMENTS)


class ProcessAction(StrEnum):
    """What the launcher does to a receiver's process."""

    END = "end"
    """SIGKILL."""
    START = "start"
    """Start it again."""
    STOP = "stop"
    """SIGSTOP."""
    CONTINUE = "continue"
    """SIGCONT."""

    @property
    def connected(self) -> bool | None:
        """Whether the process is on the network afterwards; None if it may lose its connection or keep it."""
        # A process that was stopped for long loses its connection, and must have it back.
        return {ProcessAction.END: False, ProcessAction.STOP: None}.get(self, True)


KERNELS_VARIABLE = "EVEDROP_KERNELS"
"""The environment variable that selects the kernels: see `evedrop.model.kernels.choice`."""
