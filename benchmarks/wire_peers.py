"""A sender and a receiver in processes of their own, in plain zenoh-python, for `wire.py`.

    python benchmarks/wire_peers.py send|receive

Each reads its task, a line of JSON, and writes a line of JSON with what it found. The receiver is ready when it has declared its
subscriber; the sender begins when the first of its trial messages has come through, which it learns from a line on its input.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass
from typing import Any

import zenoh

_LATENCY_BYTES = 8
TRIAL = b"trial"
END = b"end"


@dataclass(frozen=True)
class Traffic:
    """What is sent: how many messages of each key, of how many bytes, and how many messages a second (0: as fast as it goes)."""

    count: int
    size: int
    rate: float = 0.0
    keys: tuple[str, ...] = ("robot/scan",)
    block: bool = True
    """Whether Zenoh waits for readers that are slow; otherwise it drops messages."""


@dataclass(frozen=True)
class Carried:
    """What came of it."""

    received: int
    seconds: float
    """From the first message to the last one, at the receiver."""
    median: float
    """One-way latency, microseconds."""


def session_to(endpoint: str) -> zenoh.Session:
    """A client's session."""
    quiet = {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}}
    wait = {"block": {"wait_before_close": 60_000_000}}
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint]},
        "scouting": quiet,
        "transport": {"link": {"tx": {"queue": {"congestion_control": wait}}}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def carry(sender_at: str, receiver_at: str, traffic: Traffic, patience: float = 120.0) -> Carried:
    """Send messages from one endpoint to another; the end of the traffic is a message on a key of its own, `end`."""
    receiver = _started("receive", receiver_at, traffic)
    sender = _started("send", sender_at, traffic)
    try:
        assert receiver.stdout is not None
        assert sender.stdin is not None
        assert receiver.stdout.readline() == "heard\n", "no trial message arrived"
        sender.stdin.write("go\n")
        sender.stdin.flush()
        out, _ = receiver.communicate(timeout=patience)
        results: dict[str, Any] = json.loads(out)
        return Carried(**results)
    finally:
        for process in (sender, receiver):
            if process.poll() is None:
                process.kill()
            process.wait()


def _started(role: str, endpoint: str, traffic: Traffic) -> subprocess.Popen[str]:
    task = json.dumps({"endpoint": endpoint, "traffic": asdict(traffic)})
    return subprocess.Popen(
        [sys.executable, __file__, role, task], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def _await_line(going: threading.Event) -> None:
    if sys.stdin.readline():
        going.set()


def _send(session: zenoh.Session, traffic: Traffic) -> None:
    control = zenoh.CongestionControl.BLOCK if traffic.block else zenoh.CongestionControl.DROP
    publishers = [session.declare_publisher(key, congestion_control=control) for key in traffic.keys]
    going = threading.Event()
    threading.Thread(target=_await_line, args=(going,), daemon=True).start()
    while not going.wait(0.02):
        session.put("trial", TRIAL)
    rest = b"\0" * (traffic.size - _LATENCY_BYTES)
    clock = time.time_ns
    begun = time.perf_counter()
    large = (
        zenoh.ZBytes(b"\0" * traffic.size) if traffic.size > 1 << 16 else None
    )  # sent as it is, without a copy in Python
    for n in range(traffic.count):
        if traffic.rate:
            time.sleep(max(0.0, begun + n / traffic.rate - time.perf_counter()))
        message: Any = clock().to_bytes(_LATENCY_BYTES, "little") + rest if large is None else large
        for publisher in publishers:
            publisher.put(message)
    session.put("end", END, congestion_control=zenoh.CongestionControl.BLOCK)
    sys.stdin.readline()
    time.sleep(60)


def _receive(session: zenoh.Session, traffic: Traffic) -> None:
    ended, heard = threading.Event(), threading.Event()
    channel: Any = zenoh.handlers.FifoChannel(1 << 16 if traffic.size < 1 << 16 else 16)
    messages = session.declare_subscriber("robot/**", channel)
    session.declare_subscriber("trial", lambda _: heard.set())
    session.declare_subscriber("end", lambda _: ended.set())
    heard.wait(30.0)
    print("heard" if heard.is_set() else "silence", flush=True)
    first = last = 0
    delays: list[int] = []
    received = 0
    clock = time.time_ns
    while True:
        message = messages.try_recv()
        if message is None:
            if ended.is_set() and clock() - last > 500_000_000:
                break
            time.sleep(0.00005 if traffic.rate else 0.0005)
            continue
        last = clock()
        first = first or last
        received += 1
        if traffic.rate:
            delays.append(last - int.from_bytes(message.payload.to_bytes()[:_LATENCY_BYTES], "little"))
    delays.sort()
    median = delays[len(delays) // 2] / 1e3 if delays else 0.0
    print(json.dumps(asdict(Carried(received, (last - first) / 1e9, median))), flush=True)


if __name__ == "__main__":
    role_, told = sys.argv[1], json.loads(sys.argv[2])
    fields = told["traffic"]
    with session_to(told["endpoint"]) as session_:
        (_send if role_ == "send" else _receive)(session_, Traffic(**{**fields, "keys": tuple(fields["keys"])}))
