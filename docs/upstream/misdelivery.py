"""Zenoh delivers one key's messages to another key's subscriber after connections flap. Needs nothing but eclipse-zenoh.

    python misdelivery.py                       # 5 clients, 30 s of cuts
    python misdelivery.py --seconds 60 --seed 3
    python misdelivery.py --reopen              # clients that open a new session after each loss
    RUST_LOG=error python misdelivery.py        # with what the router logs

Linux; no root. A router, and clients in processes of their own on this machine. All connections are reset in bursts of 3 to
20, and Zenoh connects the clients again at once. Router and clients put messages on declared publishers all the time; each
payload is the key that it is put on. A subscriber counts the samples whose payload is another key. There should be none.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress

import zenoh

DOWN, UP = ("downlink", "control"), ("progress", "telemetry")
GAPS = (0.0, 0.01, 0.03, 0.1)
LIBC = ctypes.CDLL(None)


def opened(mode: str, **endpoints: str) -> zenoh.Session:
    """A session that listens or connects at one endpoint, and looks for nobody else."""
    config = {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "listen": {"endpoints": []},
        "connect": {"endpoints": [], "retry": {"period_init_ms": 20, "period_max_ms": 200}},
    }
    for kind, endpoint in endpoints.items():
        config[kind]["endpoints"] = [endpoint]  # type: ignore[index]
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


class Count:
    """Samples, and those whose payload is another key than their subscriber's."""

    def __init__(self) -> None:
        self.got = self.wrong = 0

    def of(self, key: str) -> Callable[[zenoh.Sample], None]:
        """The callback of the subscriber of a key."""

        def take(sample: zenoh.Sample) -> None:
            self.got += 1
            self.wrong += sample.payload.to_bytes() != key.encode()

        return take


def reset(port: int) -> None:
    """Reset every TCP connection that this process, the router, has at that port; both ends are told at once."""
    for number in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            if not os.readlink(f"/proc/self/fd/{number}").startswith("socket:"):
                continue
        with suppress(OSError), closing(socket.socket(fileno=os.dup(int(number)))) as connection:
            if connection.family == socket.AF_INET and connection.getsockname()[1] == port:
                connection.getpeername()  # that which listens has no peer, and stays
                LIBC.connect(
                    connection.fileno(), bytes(16), 16
                )  # to an address of family AF_UNSPEC: resets the connection


def client(name: str, port: int, seconds: float, reopen: bool) -> None:
    """Puts and counts for some seconds; on one session that Zenoh connects again, or on a new one after each loss."""
    count, openings, end = Count(), 0, time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            session = opened("client", connect=f"tcp/127.0.0.1:{port}")
        except zenoh.ZError:
            time.sleep(0.02)
            continue
        openings += 1
        lost = threading.Event()
        if reopen:
            session.info.declare_transport_events_listener(
                lambda event, lost=lost: lost.set() if event.kind == zenoh.SampleKind.DELETE else None  # type: ignore[misc]
            )
        for kind in DOWN:
            session.declare_subscriber(f"run/{kind}/{name}", count.of(f"run/{kind}/{name}"))
        keys = [f"run/{kind}/{name}" for kind in UP]
        publishers = [session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK) for key in keys]
        while time.monotonic() < end and not lost.is_set():
            for key, publisher in zip(keys, publishers, strict=True):
                publisher.put(key)
            time.sleep(0.001)
        if reopen:
            session.close()  # type: ignore[no-untyped-call]
    print(json.dumps({"got": count.got, "wrong": count.wrong, "openings": openings}), flush=True)
    os._exit(0)


def main() -> None:
    """Run the router, the proxy and the clients, and print what was counted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--clients", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--reopen", action="store_true")
    parser.add_argument("--client", nargs=2, metavar=("NAME", "PORT"))
    options = parser.parse_args()
    zenoh.init_log_from_env_or("off")
    if options.client:
        client(options.client[0], int(options.client[1]), options.seconds, options.reopen)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    router, count = opened("router", listen=f"tcp/127.0.0.1:{port}"), Count()
    names = [str(number) for number in range(options.clients)]
    for key in (f"run/{kind}/{name}" for kind in UP for name in names):
        router.declare_subscriber(key, count.of(key))
    keys = [f"run/{kind}/{name}" for kind in DOWN for name in names]
    publishers = [router.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK) for key in keys]
    command = [sys.executable, __file__, "--seconds", str(options.seconds), *["--reopen"] * options.reopen]
    clients = [subprocess.Popen([*command, "--client", name, str(port)], stdout=subprocess.PIPE) for name in names]
    cuts, end = 0, time.monotonic() + options.seconds - 2.0

    def put() -> None:
        while time.monotonic() < end:
            for key, publisher in zip(keys, publishers, strict=True):
                publisher.put(key)
            time.sleep(0.001)

    threading.Thread(target=put, daemon=True).start()
    rng = random.Random(options.seed)
    while not count.got and time.monotonic() < end:
        time.sleep(0.1)
    while time.monotonic() < end:
        time.sleep(rng.uniform(0.3, 1.0))
        for _ in range(rng.choice((3, 6, 12, 20))):
            reset(port)
            cuts += 1
            time.sleep(rng.choice(GAPS))
    counts = [json.loads(client.communicate()[0].splitlines()[-1]) for client in clients]
    print(
        f"{cuts} cuts, seed {options.seed}, clients that {'open a new session' if options.reopen else 'Zenoh reconnects'}"
    )
    print(
        f"from router to clients: {sum(count_['wrong'] for count_ in counts)} of {sum(count_['got'] for count_ in counts)} wrong"
    )
    print(
        f"from clients to router: {count.wrong} of {count.got} wrong; sessions: {sum(count_['openings'] for count_ in counts)}"
    )
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
