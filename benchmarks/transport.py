"""What other ways for messages would save: reports straight to the recorder, and Unix sockets in place of TCP.

    python benchmarks/transport.py [--quick]

Processor time of Zenoh alone, for the messages of a run with 1000 trials and two states: a packet of one slot, and a report of
100 slots. Each way is measured in turn, over several rounds, and the medians are printed.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import zenoh
from zenoh.handlers import FifoChannel

from evedrop.system.ports import free_port

KEY = "transport/message"
SIZES = {"packet, 16 KB": (16_500, 20_000), "report of 100 slots, 1.7 MB": (1_700_000, 400)}
"""What → bytes of a message, and how many are sent."""


def session(mode: str, endpoint: str) -> zenoh.Session:
    """A session that listens if it is a router's, and connects otherwise."""
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0}
    where = "listen" if mode == "router" else "connect"
    return zenoh.open(
        zenoh.Config.from_json5(json.dumps({"mode": mode, where: {"endpoints": [endpoint]}, "scouting": quiet}))
    )


def processor_time() -> float:
    """Seconds of the processor that this process has used."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def route(endpoint: str) -> None:
    """Be a router until standard input ends; print the seconds."""
    with session("router", endpoint):
        began = processor_time()
        print("ready", flush=True)
        sys.stdin.read()
        print(processor_time() - began, flush=True)


def receive(endpoint: str, mode: str, count: int) -> None:
    """Receive the messages; print the seconds."""
    with session(mode, endpoint) as opened:
        messages = opened.declare_subscriber(KEY, FifoChannel(1024))
        began = processor_time()
        print("ready", flush=True)
        for _ in range(count):
            messages.recv().payload.to_bytes()
        print(processor_time() - began, flush=True)


def send(endpoint: str, size: int, count: int) -> None:
    """Send the messages once there is a reader; print the seconds."""
    with session("client", endpoint) as opened:
        publisher = opened.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        while not publisher.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool
            time.sleep(0.005)
        payload, began = bytes(size), processor_time()
        for _ in range(count):
            publisher.put(payload)
        sys.stdin.read()  # until all have arrived: Zenoh sends on threads of its own
        print(processor_time() - began, flush=True)


def started(*words: object) -> subprocess.Popen[str]:
    """One of these processes."""
    command = [sys.executable, __file__, *map(str, words)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def seconds(process: subprocess.Popen[str]) -> float:
    """The seconds that a process prints when it ends."""
    return float(process.communicate(timeout=120)[0].split()[-1])


def ready(process: subprocess.Popen[str]) -> subprocess.Popen[str]:
    """The process once it is ready."""
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def microseconds(endpoint: str, routed: bool, size: int, count: int) -> float:
    """The processor time of a message in all processes: sender, receiver, and the router between them if there is one."""
    router = ready(started("route", endpoint)) if routed else None
    receiver = ready(started("receive", endpoint, "client" if routed else "router", count))
    sender = started("send", endpoint, size, count)
    used = seconds(receiver) + seconds(sender) + (0.0 if router is None else seconds(router))
    return used / count * 1e6


def main(quick: bool) -> None:
    """Through a router and straight, by TCP and by a Unix socket."""
    for name, (size, count) in SIZES.items():
        times: dict[str, list[float]] = {}
        for _ in range(1 if quick else 5):
            for way, routed in (("through the router", True), ("straight", False)):
                with tempfile.TemporaryDirectory() as folder:
                    unix = f"unixsock-stream/{Path(folder) / 'socket'}"
                    for protocol, endpoint in (("TCP", f"tcp/127.0.0.1:{free_port()}"), ("a Unix socket", unix)):
                        taken = microseconds(endpoint, routed, size, count // 20 if quick else count)
                        times.setdefault(f"{way}, {protocol}", []).append(taken)
        for way, values in times.items():
            print(f"{name}: {way}: {statistics.median(values):,.0f} µs of the processor a message")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["route", where]:
            route(where)
        case ["receive", where, mode, messages]:
            receive(where, mode, int(messages))
        case ["send", where, length, messages]:
            send(where, int(length), int(messages))
        case options:
            main("--quick" in options)
