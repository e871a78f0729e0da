"""The keys of a run: the reader of each, the only process that may write it, and how large a message on it may be.

A router drops larger messages, and no process accepts them.

Source: docs/protocol.md, keys and limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evedrop.model.digest import BLOCK_SLOTS, DIGEST_BYTES
from evedrop.model.links.loss_model import REASONS
from evedrop.model.record import largest_bytes
from evedrop.model.slot.link import COUNTED_BURSTS
from evedrop.model.slot.records import LinkSlots, PacketSlots, ReceiverSlots, SensorSlots
from evedrop.names import CONTROLLER, LEGITIMATE, OPERATOR, RECORDER, ROUTER, SENSOR

KINDS = ("uplink", "downlink", "ack", "estimate", "state", "input", "telemetry", "journal", "progress", "control")
"""The kinds of a run's keys, as they follow the run's name."""
MOST_PARTS = 4096
"""How many lists and maps a message of more than 64 KiB may have; enough for many processes."""


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


def reads(process: str, key: str) -> bool:
    """Whether a process may read a key."""
    return process == reader_of(key) or (process == LEGITIMATE and key.split("/")[2:] == ["input"])


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


_FRAME_BYTES = 4096
"""Room for the other parts of a message: its key, field names, and additions of later versions."""
_COMMAND_BYTES = 32 * 2**20  # changes of links contain their settings, such as recorded losses
_QUESTION_BYTES = 2**20
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
            "control": _COMMAND_BYTES,
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
        rule("question", asked, _QUESTION_BYTES, ["query"]),
        rule("answer", asked, _COMMAND_BYTES, ["reply"]),
    ]
