"""Messages that a link loses, and MCAP recordings of them, written with the mcap library as recorders write them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.writer import CompressionType, Writer

from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Fate
from evedrop.scenario.recordings.link_recording import Outcomes

BURSTS = {"model": "gilbert-elliott", "p": 0.05, "r": 0.3}
SECOND = 10**9
BEGAN = 1_700_000_000 * SECOND


@dataclass
class Recorded:
    """The messages of a publisher, as a recorder heard them: number, time of sending and of recording in seconds."""

    topic: str
    messages: Sequence[tuple[int, float, float]]
    metadata: Mapping[str, str] = field(default_factory=dict)
    own_times: bool = True
    """False: the recorder writes its own time as the time of publication, as rosbag2 did before Jazzy."""


def write(path: Path, recorded: Iterable[Recorded], compression: CompressionType = CompressionType.ZSTD) -> Path:
    """A recording of several publishers, each on a channel of its own, in the order of recording."""
    with path.open("wb") as file:
        _write(file, list(recorded), compression)
    return path


def _write(file: BinaryIO, recorded: Sequence[Recorded], compression: CompressionType) -> None:
    writer = Writer(
        file, chunk_size=4096, compression=compression, use_chunking=compression is not CompressionType.NONE
    )
    writer.start("ros2", "libmcap")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
    rows = []
    for topic_ in recorded:
        channel = writer.register_channel(topic_.topic, "cdr", schema, dict(topic_.metadata))
        for number, sent, heard in topic_.messages:
            logged = BEGAN + round(heard * SECOND)
            rows.append((logged, channel, number, BEGAN + round(sent * SECOND) if topic_.own_times else logged))
    for logged, channel, number, published in sorted(rows, key=lambda row: row[0]):
        writer.add_message(channel, logged, b"\x00\x01\x00\x00", published, number % 2**32)
    writer.finish()


def lossy(spec: Mapping[str, Any], count: int, seed: int = 1) -> Outcomes:
    """What a link does to messages, (count,)."""
    loss = loss_of(dict(spec))
    uniforms = np.random.default_rng(seed).random((count, loss.uniforms_per_slot, 1))
    delivered: Outcomes = (loss.fates(0, uniforms)[:, 0] == Fate.DELIVERED).astype(np.uint8)
    return delivered


def heard(
    outcomes: Outcomes, period: float = 0.1, first: int = 1, delay: float = 0.005
) -> list[tuple[int, float, float]]:
    """The messages that arrived of those that were sent regularly, from the number `first` on."""
    return [(first + i, i * period, i * period + delay) for i in np.flatnonzero(outcomes).tolist()]


def trimmed(outcomes: Outcomes) -> list[int]:
    """From the first to the last delivered message: losses before and after cannot be seen."""
    places = np.flatnonzero(outcomes)
    trimmed_: list[int] = outcomes[places[0] : places[-1] + 1].tolist()
    return trimmed_
