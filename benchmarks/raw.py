"""Raw Zenoh carrying the messages of a run, without anything of ours: the yardstick of benchmarks/live.py.

    python benchmarks/raw.py throughput SLOTS TRIALS RECEIVERS     slots/s, a line of JSON
    python benchmarks/raw.py latency SLOTS RATE RECEIVERS          one-way latencies in microseconds, a line of JSON

A publisher process, a session in router mode in this process, receivers as processes: the router routes one key to all.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time

import msgpack
import zenoh
from zenoh.handlers import FifoChannel

from evedrop.ports import free_port

_KEY = "raw/uplink"


def _config(mode: str, endpoint: str) -> zenoh.Config:
    where = "listen" if mode == "router" else "connect"
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0}
    wait = {"link": {"tx": {"queue": {"congestion_control": {"block": {"wait_before_close": 60_000_000}}}}}}
    config = {"mode": mode, where: {"endpoints": [endpoint]}, "scouting": quiet, "transport": wait}
    return zenoh.Config.from_json5(json.dumps(config))


def send(endpoint: str, slots: int, trials: int, rate: float, receivers: int) -> None:
    """Publish one message a slot, as fast as it goes or at a rate, once all receivers are there."""
    payload = bytes(16 * trials)
    with zenoh.open(_config("client", endpoint)) as session:
        publisher = session.declare_publisher(_KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        ready = session.declare_subscriber("raw/ready", FifoChannel(64))
        for _ in range(receivers):
            ready.recv()
        start = time.monotonic()
        for k in range(slots):
            if rate:
                time.sleep(max(0.0, start + k / rate - time.monotonic()))
            publisher.put(msgpack.packb({"k": k, "t": time.monotonic(), "z": payload}))
        done = session.declare_subscriber("raw/done", FifoChannel(64))
        for _ in range(receivers):
            done.recv()
        print(json.dumps({"slots_per_second": slots / (time.monotonic() - start)}), flush=True)


def receive(endpoint: str, slots: int) -> None:
    """Receive all messages; print the median and the 99th percentile of the one-way latency."""
    delays = []
    with zenoh.open(_config("client", endpoint)) as session:
        messages = session.declare_subscriber(_KEY, FifoChannel(65_536))
        ready = session.declare_publisher("raw/ready")
        while not ready.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool
            time.sleep(0.005)
        ready.put(b"")
        for k in range(slots):
            message = msgpack.unpackb(messages.recv().payload.to_bytes())
            delays.append(time.monotonic() - message["t"])
            assert message["k"] == k
        done = session.declare_publisher("raw/done")
        while not done.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool
            time.sleep(0.005)
        done.put(b"")
    delays.sort()
    print(json.dumps([delays[len(delays) // 2] * 1e6, delays[len(delays) * 99 // 100] * 1e6]), flush=True)


def throughput(slots: int, trials: int, receivers: int) -> float:
    """Slots a second from one publisher through the router to all receivers."""
    rate, _ = _carry(slots, trials, 0.0, receivers)
    return rate


def latency(slots: int, rate: float, receivers: int) -> tuple[float, float]:
    """Median and 99th percentile, over receivers the largest, of the one-way latency in microseconds."""
    _, delays = _carry(slots, 1, rate, receivers)
    return max(delay[0] for delay in delays), max(delay[1] for delay in delays)


def _carry(slots: int, trials: int, rate: float, receivers: int) -> tuple[float, list[list[float]]]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with zenoh.open(_config("router", endpoint)):
        command = [sys.executable, __file__]
        sender = _started([*command, "send", endpoint, str(slots), str(trials), str(rate), str(receivers)])
        others = [_started([*command, "receive", endpoint, str(slots)]) for _ in range(receivers)]
        found = json.loads(sender.communicate()[0])["slots_per_second"]
        return found, [json.loads(other.communicate()[0]) for other in others]


def _started(command: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command, stdout=subprocess.PIPE)


if __name__ == "__main__":
    role, *rest = sys.argv[1:]
    if role == "send":
        send(rest[0], int(rest[1]), int(rest[2]), float(rest[3]), int(rest[4]))
    elif role == "receive":
        receive(rest[0], int(rest[1]))
    elif role == "throughput":
        print(json.dumps(throughput(*(int(number) for number in rest))))
    else:
        print(json.dumps(latency(int(rest[0]), float(rest[1]), int(rest[2]))))
