"""The keys of a run: the reader of each, and the only process that may write it.

Source: docs/protocol.md, keys.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from evedrop.names import CONTROLLER, LEGITIMATE, OPERATOR, RECORDER, ROUTER, SENSOR

KINDS = ("uplink", "downlink", "ack", "estimate", "state", "input", "telemetry", "journal", "progress", "control")
"""The kinds of a run's keys, as they follow the run's name."""


@dataclass(frozen=True)
class RunKeys:
    """The keys of one run."""

    run: str

    def _under(self, path: str) -> str:
        return f"evedrop/{self.run}/{path}"

    @property
    def uplink(self) -> str:
        """Packets, sensor to router."""
        return self._under("uplink")

    @property
    def journal(self) -> str:
        """Fates, router to recorder."""
        return self._under("journal")

    @property
    def acknowledged(self) -> str:
        """Acknowledgements, legitimate estimator to router."""
        return self._under("ack/sent")

    @property
    def acknowledgements(self) -> str:
        """Acknowledgements that were neither lost nor blocked, and forged ones: router to sensor."""
        return self._under("ack/delivered")

    @property
    def estimate(self) -> str:
        """Estimates, legitimate estimator to controller."""
        return self._under("estimate")

    @property
    def state(self) -> str:
        """The true state, sensor to controller, if the controller acts on the truth."""
        return self._under("state")

    @property
    def input(self) -> str:
        """Inputs, controller to sensor, and to a legitimate estimator that knows the inputs."""
        return self._under("input")

    def downlink(self, receiver: str) -> str:
        """Deliveries, router to one receiver."""
        return self._under(f"downlink/{receiver}")

    def telemetry(self, process: str) -> str:
        """Reports, one process to recorder."""
        return self._under(f"telemetry/{process}")

    def progress(self, process: str) -> str:
        """Progress, a receiver or the recorder to the sensor."""
        return self._under(f"progress/{process}")

    def control(self, process: str) -> str:
        """Commands to one process."""
        return self._under(f"control/{process}")

    def alive(self, process: str) -> str:
        """Liveliness token of a process."""
        return self._under(f"alive/{process}")


def reader_of(key: str) -> str:
    """The process that reads a key; the sensor for inputs, which the legitimate estimator may read, too."""
    kind, _, name = "/".join(key.split("/")[2:]).partition("/")
    if kind == "ack":
        return ROUTER if name == "sent" else SENSOR
    readers = {
        "uplink": ROUTER,
        "journal": RECORDER,
        "telemetry": RECORDER,
        "progress": SENSOR,
        "estimate": CONTROLLER,
        "state": CONTROLLER,
        "input": SENSOR,
    }
    return readers.get(kind, name)


def writer_of(key: str) -> str:
    """The only process that may write a key; empty if it is not a key of a run."""
    kind, _, name = "/".join(key.split("/")[2:]).partition("/")
    if kind == "ack":
        return LEGITIMATE if name == "sent" else ROUTER
    writers = {
        "uplink": SENSOR,
        "downlink": ROUTER,
        "journal": ROUTER,
        "control": OPERATOR if name == RECORDER else RECORDER,
        "estimate": LEGITIMATE,
        "state": SENSOR,
        "input": CONTROLLER,
    }
    return writers.get(kind, name)


ZenohConfig = dict[str, Any]
"""A JSON object whose entries Zenoh defines."""
