"""The keys of a run: the reader of each, the only process that may write it, and how large a message on it may be.

A router drops larger messages, and no process accepts them.

Source: docs/protocol.md, keys and limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

from evedrop.model.digest import BLOCK_SLOTS, DIGEST_BYTES
from evedrop.model.links.loss_model import REASONS
from evedrop.model.record import largest_bytes
from evedrop.model.slot.link import COUNTED_BURSTS
from evedrop.model.slot.records import LinkSlots, PacketSlots, ReceiverSlots, SensorSlots
from evedrop.names import CONTROLLER, LEGITIMATE, OPERATOR, RECORDER, ROUTER, SENSOR

KINDS = ("uplink", "downlink", "ack", "estimate", "state", "input", "telemetry", "journal", "progress", "control")
"""The kinds of a run's keys, as they follow the run's name."""
MOST_PARTS = 20_480
"""How many lists and maps a message of more than 64 KiB may have; enough for all packets of the longest window, each twice."""


@final
class RunKeys:
    """The keys of one run."""

    def __init__(self, run: str) -> None:
        self.run = run
        self._under = f"evedrop/{run}"
        self.uplink = f"{self._under}/uplink"
        """Packets, sensor to router."""
        self.journal = f"{self._under}/journal"
        """Fates, router to recorder."""
        self.acknowledged = f"{self._under}/ack/sent"
        """Acknowledgements, legitimate estimator to router."""
        self.acknowledgements = f"{self._under}/ack/delivered"
        """Acknowledgements that were neither lost nor blocked, and forged ones: router to sensor."""
        self.estimate = f"{self._under}/estimate"
        """Estimates, legitimate estimator to controller."""
        self.state = f"{self._under}/state"
        """The true state, sensor to controller, if the controller acts on the truth."""
        self.input = f"{self._under}/input"
        """Inputs, controller to sensor, and to a legitimate estimator that knows the inputs."""

    def downlink(self, receiver: str) -> str:
        """Deliveries, router to one receiver."""
        return f"{self._under}/downlink/{receiver}"

    def telemetry(self, process: str) -> str:
        """Reports, one process to recorder."""
        return f"{self._under}/telemetry/{process}"

    def progress(self, process: str) -> str:
        """Progress, a receiver or the recorder to the sensor."""
        return f"{self._under}/progress/{process}"

    def control(self, process: str) -> str:
        """Commands to one process."""
        return f"{self._under}/control/{process}"

    def alive(self, process: str) -> str:
        """Liveliness token of a process."""
        return f"{self._under}/alive/{process}"


_ENDS: Mapping[str, tuple[str | None, str | None]] = {
    "uplink": (SENSOR, ROUTER),
    "downlink": (ROUTER, None),
    "ack": (ROUTER, SENSOR),
    "ack/sent": (LEGITIMATE, ROUTER),
    "estimate": (LEGITIMATE, CONTROLLER),
    "state": (SENSOR, CONTROLLER),
    "input": (CONTROLLER, SENSOR),
    "telemetry": (None, RECORDER),
    "journal": (ROUTER, RECORDER),
    "progress": (None, SENSOR),
    "control": (RECORDER, None),
    "control/recorder": (OPERATOR, RECORDER),
}
"""A key after the run's name, or its kind → its writer and its reader; None: the process that the key names."""


def _ends(key: str) -> tuple[str, str]:
    """The writer and the reader of a key; empty if it is not a key of a run."""
    path = "/".join(key.split("/")[2:])
    kind, _, name = path.partition("/")
    writer, reader = _ENDS.get(path) or _ENDS.get(kind, (None, None))
    return writer or name, reader or name


def reader_of(key: str) -> str:
    """The process that reads a key; the sensor for inputs, which the legitimate estimator may read, too."""
    return _ends(key)[1]


def reads(process: str, key: str) -> bool:
    """Whether a process may read a key."""
    return process == reader_of(key) or (process == LEGITIMATE and key.split("/")[2:] == ["input"])


def writer_of(key: str) -> str:
    """The only process that may write a key; empty if it is not a key of a run."""
    return _ends(key)[0]


ZenohConfig = dict[str, Any]
"""A JSON object whose entries Zenoh defines."""


_FRAME_BYTES = 4096
"""Room for the other parts of a message: its key, field names, and additions of later versions."""
COMMAND_BYTES = 32 * 2**20
"""The largest command: changes of links contain their settings, such as recorded losses; and the largest answer."""
QUESTION_BYTES = 2**20
"""The largest request of the operator."""
_NAME_BYTES = 128  # of a key in a list
_LATE_BYTES = 32  # of the slots of a late packet, besides its columns


@dataclass(frozen=True)
class Sizes:
    """The dimensions that determine the sizes of a run's messages."""

    n: int
    trials: int
    recorded: int
    batch: int
    """The largest number of slots in a report."""
    window: int
    """The longest window of the receivers, in slots."""
    receivers: int
    header: int = 0
    inputs: int = 0
    period: int = 1
    """Slots between decisions."""
    message: int = 1
    """The most slots whose packets a message carries."""

    @property
    def of_kinds(self) -> dict[str, int]:
        """Kind of key, the part after the run's name → bytes of its largest message."""
        n, R, c = self.n, self.trials, self.batch
        mask, state = (R + 7) // 8, 8 * n * R
        axes = {"n": n, "R": R, "S": self.recorded, "m": self.inputs, "h": self.header, "F": len(REASONS)}
        packet = largest_bytes(PacketSlots, 1, axes) + _LATE_BYTES
        # Blocks of the digest that end in a report: one may have begun before it, and the last may be short.
        blocks = c // BLOCK_SLOTS + 2
        digests, sums = blocks * DIGEST_BYTES * R, blocks * 8 * R
        report = largest_bytes(ReceiverSlots, c, axes) + digests + sums
        truth = largest_bytes(SensorSlots, c, axes)
        leaving = state + 8 * n * n * R
        decisions = 8 * (c + self.period) + digests + self.period // BLOCK_SLOTS * DIGEST_BYTES * R
        waits = _NAME_BYTES * (self.receivers + 1)
        link = largest_bytes(LinkSlots, c, axes) + 4 * (COUNTED_BURSTS + self.window + 2) + _FRAME_BYTES
        kinds = {
            "uplink": self.message * packet,
            "downlink": self.message * packet * (1 + 2 * (self.window + 1)),
            "ack": mask,
            "estimate": state,
            "state": state,
            "input": 8 * self.inputs * R + mask,
            "telemetry": max(report, truth, leaving, decisions, waits),
            "journal": max(self.receivers * link, waits),
            "progress": 0,
            "control": COMMAND_BYTES,
        }
        return {kind: kinds[kind] + _FRAME_BYTES for kind in KINDS}


def low_pass(run: str, kinds: Mapping[str, int]) -> list[ZenohConfig]:
    """The `low_pass_filter` section of a router's Zenoh configuration, which drops larger messages; kinds: `Sizes.of_kinds`."""

    def rule(name: str, keys: list[str], size: int, messages: list[str]) -> ZenohConfig:
        return {"id": name, "flows": ["ingress"], "messages": messages, "key_exprs": keys, "size_limit": size}

    under = {kind: [f"evedrop/{run}/{kind}", f"evedrop/{run}/{kind}/**"] for kind in kinds}
    asked = [f"evedrop/{run}/control/recorder"]
    return [
        *(rule(kind, under[kind], size, ["put", "delete"]) for kind, size in kinds.items()),
        rule("question", asked, QUESTION_BYTES + _FRAME_BYTES, ["query"]),
        rule("answer", asked, COMMAND_BYTES + _FRAME_BYTES, ["reply"]),
    ]
