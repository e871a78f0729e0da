"""What a wire carries: messages a second, the latency it adds, large messages, new keys, and whether it accounts for all.

    python benchmarks/wire.py [--quick]
    python benchmarks/wire.py --full          # also ten million messages: each must be accounted for

Everything runs on this machine: a sender and a receiver in plain zenoh-python (wire_peers.py), and the wire with its journal in
this process, or for new keys in one of its own. The yardstick of the rate is a bare relay: two sessions and a loop that puts
what it hears.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from processes import processes_of
from table import Row, judged, run_alone
from wire_peers import Carried, Traffic, carry, session_to

from evedrop.errors import UsageError
from evedrop.live.network.control_file import read_control
from evedrop.live.network.operator import ask
from evedrop.live.protocol.requests import StatusRequest
from evedrop.wire.deliveries import KeyDeliveries, bounds
from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import Side, WireLink, WirePlan
from evedrop.wire.records import Records, WireFate
from evedrop.wire.relay import WireRelay, open_sides
from evedrop.wire.side import SideSession

_ANYWHERE = ("tcp/127.0.0.1:0",)
PERFECT: Mapping[str, Any] = {"loss": {"model": "bernoulli", "quality": 1.0}}
BURSTS: Mapping[str, Any] = {"loss": {"model": "gilbert-elliott", "p": 0.01, "r": 0.2}}
_TWO_SIDES = """
[side.robot]
[side.base]
[[link]]
from = "robot"
to = "base"
quality = 0.9
"""
_LOSSES = Path(__file__).parents[1] / "tests" / "wire" / "losses.toml"


class MeasuredWire:
    """A wire in this process: where to connect, and the fates of the messages so far."""

    def __init__(self, relay: WireRelay, journal: WireJournal) -> None:
        self.robot, self.base = relay.endpoints["robot"][0], relay.endpoints["base"][0]
        self.fates: dict[tuple[int, int], int] = {}
        self.first, self.last = float("inf"), 0.0
        self._journal = journal
        journal.listeners.append(self._hear)

    def _hear(self, block: Records) -> None:
        block = block[(block["link"] == 0) | (block["size"] > 10)]
        for link in np.unique(block["link"]).tolist():
            fates, counts = np.unique(block["fate"][block["link"] == link], return_counts=True)
            for fate, count in zip(fates.tolist(), counts.tolist(), strict=True):
                self.fates[link, fate] = self.fates.get((link, fate), 0) + count
        if len(block):
            self.first = min(self.first, float(block["time"].min()))
            self.last = max(self.last, float(block["time"].max()))

    def reset(self) -> None:
        """Count from now on."""
        self._journal.flush()
        self.fates, self.first, self.last = {}, float("inf"), 0.0

    def count(self, *fates: WireFate) -> int:
        """How many messages had one of these fates, or any."""
        self._journal.flush()
        return sum(count for (_, fate), count in self.fates.items() if not fates or fate in fates)


@contextmanager
def a_wire(*links: tuple[str, Mapping[str, Any]]) -> Iterator[MeasuredWire]:
    """A wire from robot to base with these links: key expression, settings."""
    made = [WireLink(f"link-{at}", at, "robot", "base", keys, settings) for at, (keys, settings) in enumerate(links)]
    made.append(WireLink("rest", len(made), "robot", "base", "**", PERFECT))
    plan = WirePlan(7, {name: Side(name, _ANYWHERE) for name in ("robot", "base")}, tuple(made))
    with (
        tempfile.TemporaryDirectory() as folder,
        WireJournal(Path(folder), plan) as journal,
        open_sides(plan) as sides,
        WireRelay(plan, journal, sides) as relay,
    ):
        yield MeasuredWire(relay, journal)


@contextmanager
def bare_relay() -> Iterator[tuple[str, str]]:
    """Two router sessions and a loop between them; the endpoints."""
    with SideSession(Side("a", _ANYWHERE), 2**30) as first, SideSession(Side("b", _ANYWHERE), 2**30) as second:
        channel: Any = zenoh.handlers.FifoChannel(8192)
        heard = first.session.declare_subscriber("**", channel, allowed_origin=zenoh.Locality.REMOTE)

        def pass_on() -> None:
            for sample in heard:
                second.session.put(
                    sample.key_expr,
                    sample.payload,
                    encoding=sample.encoding,
                    congestion_control=sample.congestion_control,
                    attachment=sample.attachment,
                )

        thread = threading.Thread(target=pass_on, daemon=True)
        thread.start()
        yield first.endpoints[0], second.endpoints[0]
        heard.undeclare()
        thread.join()


@contextmanager
def a_router() -> Iterator[str]:
    """Zenoh's router alone; its endpoint."""
    with SideSession(Side("a", _ANYWHERE), 2**30) as router:
        yield router.endpoints[0]


def per_second(carried: Carried) -> float:
    """Messages a second."""
    return carried.received / carried.seconds


def rates(rounds: int, count: int) -> Iterator[Row]:
    """Messages a second through a link that loses in bursts, and through a bare relay, in turns."""
    wires, relays = [], []
    for _ in range(rounds):
        with a_wire(("robot/**", BURSTS)) as wire:
            carry(wire.robot, wire.base, Traffic(count, 64))
            heard = wire.count()
            wires.append(heard / (wire.last - wire.first))
        with bare_relay() as (sender_at, receiver_at):
            relays.append(per_second(carry(sender_at, receiver_at, Traffic(count, 64))))
    rate, ratio = statistics.median(wires), statistics.median(w / r for w, r in zip(wires, relays, strict=True))
    yield Row(
        "wire, 64 bytes through a lossy link, journal on",
        f"{rate:,.0f} messages/s, {ratio:.2f} of the bare relay",
        f"{statistics.median(relays):,.0f} messages/s (bare relay)",
        "70,000 messages/s and 0.6 of the bare relay",
        "100,000 messages/s",
        judged(rate >= 70_000 and ratio >= 0.6, rate >= 100_000 and ratio >= 0.6),
    )


def latencies(rounds: int, count: int) -> Iterator[Row]:
    """What a wire adds to the one-way latency of Zenoh's router, at a thousand messages a second."""
    traffic = Traffic(count, 64, rate=1000.0)
    through, raw = [], []
    for _ in range(rounds):
        with a_wire(("robot/**", BURSTS)) as wire:
            through.append(carry(wire.robot, wire.base, traffic).median)
        with a_router() as endpoint:
            raw.append(carry(endpoint, endpoint, traffic).median)
    added = statistics.median(t - r for t, r in zip(through, raw, strict=True))
    yield Row(
        "wire, latency added at 1,000 messages/s, median",
        f"{added:.0f} µs",
        f"{statistics.median(raw):.0f} µs (one router of Zenoh)",
        "below 200 µs",
        "below 100 µs",
        judged(added < 200, added < 100),
    )


def large(rounds: int, count: int, size: int) -> Iterator[Row]:
    """Bytes a second in large messages, compared with Zenoh's router alone."""
    through, raw = [], []
    for _ in range(rounds):
        with a_wire(("robot/**", PERFECT)) as wire:
            through.append(per_second(carry(wire.robot, wire.base, Traffic(count, size))) * size / 1e9)
        with a_router() as endpoint:
            raw.append(per_second(carry(endpoint, endpoint, Traffic(count, size))) * size / 1e9)
    rate, alone = statistics.median(through), statistics.median(raw)
    yield Row(
        f"wire, messages of {size / 2**20:.0f} MB",
        f"{rate:.2f} GB/s",
        f"{alone:.2f} GB/s (one router of Zenoh)",
        "0.5 GB/s",
        "1 GB/s",
        judged(rate >= 0.5, rate >= 1.0),
    )


def accounted(count: int) -> Iterator[Row]:
    """All messages of a sender are in the journal, and those that were delivered arrive."""
    with a_wire(("robot/**", BURSTS)) as wire:
        received = carry(wire.robot, wire.base, Traffic(count, 64), patience=60 + count / 5000).received
        heard, delivered = wire.count(), wire.count(WireFate.DELIVERED)
    missing = abs(count - heard) + abs(delivered - received)
    yield Row(
        f"wire, messages unaccounted for, of {count:,}",
        f"{missing}",
        f"{heard:,} recorded, {delivered:,} delivered, {received:,} arrived",
        "0",
        "0",
        judged(missing == 0, missing == 0),
    )


def losses(count: int) -> Iterator[Row]:
    """The messages that each model lets through, next to its 99 % bounds."""
    models = {
        name: {"model": name, **table} for name, table in tomllib.loads(_LOSSES.read_text(encoding="utf-8")).items()
    }
    links = {f"robot/{name}": {"loss": model} for name, model in models.items()}
    with a_wire(*links.items()) as wire:
        carry(wire.robot, wire.base, Traffic(count, 64, keys=tuple(links)))
        wire.count()
        fates = dict(wire.fates)
    outside, fractions = [], []
    for at, (name, model) in enumerate(models.items()):
        low, high = bounds([KeyDeliveries({"loss": model}, (), [range(count)])], count)
        delivered = fates.get((at, WireFate.DELIVERED), 0)
        fractions.append(f"{name} {delivered / count:.4f}")
        if not low <= delivered <= high:
            outside.append(f"{name} outside {low / count:.4f} to {high / count:.4f}")
    yield Row(
        f"wire, delivered by each model, of {count:,}",
        ", ".join(fractions),
        "99 % bounds",
        "all within",
        "all within",
        "; ".join(outside) or judged(True, True),
    )


def new_keys(count: int) -> Iterator[Row]:
    """The cost of a new key's first message to a wire in its own process, and how long the wire then takes to end."""
    with tempfile.TemporaryDirectory() as folder:
        file, out = Path(folder, "wire.toml"), Path(folder, "out")
        file.write_text(_TWO_SIDES, encoding="utf-8")
        command = [sys.executable, "-P", "-m", "evedrop", "wire", str(file), "--out", str(out)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        try:
            costs = [_looked_at(process, out)]
            with session_to(process.stdout.readline().split()[1]) as sender:
                for keys in (["robot/scan"] * count, [f"robot/{at:032x}" for at in range(count)]):
                    for key in keys:
                        sender.put(key, b"x" * 64, congestion_control=zenoh.CongestionControl.BLOCK)
                    costs.append(_looked_at(process, out, len(costs) * count))
            begun = time.monotonic()
            process.terminate()
            process.stdout.read()
            process.wait()
            ended = time.monotonic() - begun
        finally:
            process.kill()
            process.wait()
    (old, _), (new, kept) = [
        ((after[0] - before[0]) / count * 1e6, (after[1] - before[1]) / count * 1e3)
        for before, after in pairwise(costs)
    ]
    yield Row(
        f"wire, a message on each of {count:,} new keys",
        f"{new:.0f} µs of the processor and {kept:.1f} kB a key; ended in {ended:.1f} s",
        f"{old:.0f} µs a message of one key",
        "100 µs and 2 kB; 5 s",
        "50 µs and 1 kB; 5 s",
        judged(new < 100 and kept < 2 and ended < 5, new < 50 and kept < 1 and ended < 5),
    )


def _looked_at(process: subprocess.Popen[str], out: Path, heard: int = 0) -> tuple[float, float]:
    """Processor seconds and private MB of a wire's process, once it has heard a number of messages."""
    deadline = time.monotonic() + 300.0
    while True:
        time.sleep(0.1)
        with suppress(UsageError, zenoh.ZError):  # it has not begun yet
            answer = ask(read_control(out), StatusRequest(), 60.0)
            status = None if answer is None else answer.wire
            if status is not None and sum(link.heard for link in status.links.values()) >= heard:
                [now] = processes_of(process.pid)
                return now.cpu_seconds, now.private
        if time.monotonic() > deadline or process.poll() is not None:
            raise RuntimeError(f"the wire did not hear {heard} messages")


def rows(quick: bool) -> Iterator[Row]:
    """All metrics."""
    yield from rates(1 if quick else 5, 5_000 if quick else 300_000)
    yield from latencies(1 if quick else 3, 300 if quick else 5_000)
    yield from large(1 if quick else 3, 10 if quick else 400, 2**22)
    yield from accounted(10_000 if quick else 10_000_000 if "--full" in sys.argv else 500_000)
    yield from losses(500 if quick else 20_000)
    yield from new_keys(3_000 if quick else 100_000)


if __name__ == "__main__":
    run_alone(rows)
