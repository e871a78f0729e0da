"""A publisher and a subscriber on two sides of a wire, in one process: what is sent and what arrives is written down at once.

    python -m tests.faults.programs ROBOT BASE FIRST FOLDER

The length of a message's payload is its number: the journal of a wire has it as `size`.
"""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path

import zenoh

from tests.wire.wire_at_work import program

KEYS = ("scan", "slow")
_EVERY_SECONDS = 0.005


def main(robot: str, base: str, first: str, folder: str) -> None:
    """Publish until SIGTERM, or until the wire is gone."""
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    with (
        (Path(folder) / "sent").open("a", buffering=1) as sent,
        (Path(folder) / "received").open("a", buffering=1) as received,
        program([robot]) as at_robot,
        program([base]) as at_base,
    ):
        ready = threading.Event()
        at_base.declare_subscriber("ready", lambda _: ready.set())
        for key in KEYS:

            def take(sample: zenoh.Sample, key: str = key) -> None:
                received.write(f"{key} {len(sample.payload)}\n")

            at_base.declare_subscriber(key, take)
        while not ready.wait(0.05) and not ended.is_set():
            at_robot.put("ready", b"")
        publishers = [at_robot.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK) for key in KEYS]
        number = int(first)
        while not ended.wait(_EVERY_SECONDS):
            for key, publisher in zip(KEYS, publishers, strict=True):
                sent.write(f"{key} {number}\n")
                publisher.put(bytes(number))
            number += 1


if __name__ == "__main__":
    main(*sys.argv[1:])
