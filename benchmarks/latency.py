"""What our router adds to the one-way latency of Zenoh, at a thousand slots a second.

    python benchmarks/latency.py [--quick]

Our router is the real program, started from the briefs of `evedrop brief`. The sensor and the receivers are small processes that
follow docs/protocol.md and look only at the clock (zenoh_peers.py); the same processes measure Zenoh alone. Both take turns.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import raw
import zenoh
from table import Row, judged, run_alone
from zenoh_peers import Load, Peer, Present, Times, carry, envelope, session_of

from evedrop.names import LEGITIMATE, RECORDER, ROUTER, SENSOR
from evedrop.system.ports import free_port

RATE = 1000.0
_NOT_RECEIVERS = (ROUTER, SENSOR, RECORDER)
_APPEAR_SECONDS = 30.0
_LEAVE_SECONDS = 20.0


def routed(slots: int) -> Times:
    """The times of all packets of the scenario `eavesdroppers`, through our router."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with tempfile.TemporaryDirectory() as folder:
        program = [sys.executable, "-m", "evedrop"]
        options = [
            "--slots",
            str(slots),
            "--pace",
            str(1.0 / RATE),
            "--listen",
            endpoint,
            "--out",
            folder,
            "--wait",
            "30",
        ]
        subprocess.run([*program, "brief", "eavesdroppers", *options], check=True, stdout=subprocess.DEVNULL)
        briefs = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in Path(folder).glob("*.json")}
        router = subprocess.Popen([*program, ROUTER, f"{folder}/{ROUTER}.json"])
        try:
            return _through(router, endpoint, briefs, Load(slots, raw.BYTES_PER_TRIAL, RATE))
        finally:
            if router.poll() is None:
                router.kill()
            router.wait()


def _through(router: subprocess.Popen[bytes], endpoint: str, briefs: dict[str, Any], load: Load) -> Times:
    """Take the recorder's place: wait for all, read the journal, and end the router."""
    recorder = briefs[RECORDER]
    prefix = f"evedrop/{recorder['run']}"
    receivers = [name for name in briefs if name not in _NOT_RECEIVERS]
    assert LEGITIMATE in receivers, sorted(briefs)

    def peer(name: str, key: str) -> Peer:
        return Peer(f"{prefix}/{key}", f"{prefix}/alive/{name}", briefs[name]["user"], briefs[name]["password"])

    with _connected(router, endpoint, recorder) as session:
        journal = session.declare_subscriber(f"{prefix}/journal", lambda _: None)
        Present(session, [f"{prefix}/alive/{ROUTER}"]).wait([router])
        times = carry(
            session, endpoint, peer(SENSOR, "uplink"), [peer(name, f"downlink/{name}") for name in receivers], load
        )
        control = f"{prefix}/control/{ROUTER}"
        session.put(control, envelope(control, {"do": "end"}))
        router.wait(_LEAVE_SECONDS)
        journal.undeclare()
    return times


def _connected(router: subprocess.Popen[bytes], endpoint: str, brief: dict[str, Any]) -> zenoh.Session:
    """A session of the recorder's, when the router listens."""
    deadline = time.monotonic() + _APPEAR_SECONDS
    while True:
        try:
            return session_of("client", endpoint, brief["user"], brief["password"])
        except zenoh.ZError:
            if router.poll() is not None or time.monotonic() > deadline:
                raise
            time.sleep(0.02)


def rows(quick: bool) -> Iterator[Row]:
    """The latency that our router adds."""
    slots = 300 if quick else 5_000
    pairs = []
    for _ in range(1 if quick else 5):
        ours = routed(slots)
        pairs.append((ours, raw.carried(Load(slots, raw.BYTES_PER_TRIAL, RATE), len(ours.received))))

    def median(fraction: float) -> tuple[float, float]:
        added = statistics.median(ours.delay(fraction) - bare.delay(fraction) for ours, bare in pairs)
        return added, statistics.median(bare.delay(fraction) for _, bare in pairs)

    (middle, bare), (tail, bare_tail) = median(0.5), median(0.99)
    yield Row(
        "latency that the router adds at 1 kHz, 4 receivers",
        f"median {middle:,.0f} µs, 99 % {tail:,.0f} µs",
        f"raw Zenoh: median {bare:,.0f} µs, 99 % {bare_tail:,.0f} µs",
        "median below 80 µs, 99 % below 400 µs",
        "median below 50 µs",
        judged(middle < 80 and tail < 400, middle < 50),
    )


if __name__ == "__main__":
    run_alone(rows)
