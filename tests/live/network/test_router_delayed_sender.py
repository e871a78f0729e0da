"""Parts of a slot that are sent later, in real time: never too early, in order, and without holding up other messages."""

from __future__ import annotations

import time
from queue import SimpleQueue

from evedrop.live.network.router import DelayedSender


def test_messages_go_out_when_they_are_due_and_in_order() -> None:
    """A message waits its time; one that is due at once goes before it on another round, and after it on its own."""
    sender, out = DelayedSender(), SimpleQueue[tuple[str, bytes, float]]()
    slow = sender.round(lambda payload: out.put(("slow", payload, time.monotonic())))
    quick = sender.round(lambda payload: out.put(("quick", payload, time.monotonic())))
    began = time.monotonic()
    slow(b"1", 0.3)
    slow(b"2", 0.0)
    quick(b"3", 0.0)
    sent = [out.get(timeout=20) for _ in range(3)]
    assert [(name, payload) for name, payload, _ in sent] == [("quick", b"3"), ("slow", b"1"), ("slow", b"2")]
    assert all(at - began >= 0.3 for name, _, at in sent if name == "slow")
