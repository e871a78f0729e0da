"""The router process: what becomes of every packet on every link, and what it refuses."""

from __future__ import annotations

import re
import struct
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, cast

import msgpack
import numpy as np
import pytest
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes

from evedrop.errors import RunError
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.network.router import RouterLoop
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import packets, telemetry
from evedrop.live.protocol.brief import Brief, Flow, RouterPart
from evedrop.live.protocol.commands import EndRun, Go, LinkChange
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.packets import read_delivery
from evedrop.model.process import Floats
from evedrop.model.slot.link import Change
from tests.conftest import LIMIT
from tests.live.in_memory import Stage
from tests.live.network.bench import Bench, small_network
from tests.messages import packet


def uniforms_of(key: bytes, slots: int, trials: range) -> np.ndarray:
    """The link's uniforms (slots, R), word by word from docs/random-streams.md: one word of each block of two is used."""
    encryptor = Cipher(algorithms.AES(key), modes.ECB()).encryptor()  # noqa: S305 - the protocol's counter mode
    drawn = [
        [struct.unpack("<Q", encryptor.update(((k << 64) + r).to_bytes(16, "big"))[:8])[0] for r in trials]
        for k in range(slots)
    ]
    return np.array([[(word >> 11) / 2**53 for word in row] for row in drawn])


@dataclass
class Ear:
    """What a router puts on one key, in order."""

    bench: MemoryBench
    key: str

    def hear(self) -> tuple[str, bytes]:
        """The next message."""
        kept = self.bench.heard[self.key]
        while not kept:
            key, payload = self.bench.stage.put.get(timeout=LIMIT)
            self.bench.heard[key].append(payload)
        return self.key, kept.popleft()


class MemoryBench:
    """The work of a router in a thread of its own, on a session in memory, with everybody else played by the test."""

    def __init__(self, **changes: Any) -> None:
        self.scenario = small_network(**changes)
        self.briefs = briefs_of(self.scenario, endpoints_at("tcp/127.0.0.1:1"), RecorderTask(Path("nowhere"), False))
        brief = self.briefs["router"]
        assert isinstance(brief.part, RouterPart)
        self.brief = cast(Brief[RouterPart], replace(brief, flow=Flow(32, 8, self.scenario.longest_outage)))
        self.keys, self.stage = RunKeys(brief.run), Stage()
        self.heard: defaultdict[str, deque[bytes]] = defaultdict(deque)
        self.downlinks = {name: Ear(self, self.keys.downlink(name)) for name in self.scenario.receivers}
        self.journal = Ear(self, self.keys.journal)

    def __enter__(self) -> Self:
        self._loop = RouterLoop(self.brief, self.stage.session(self.brief))
        self._thread = threading.Thread(target=self._loop.carry_on, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def put(self, process: str, key: str, payload: bytes) -> None:
        """The sensor sends a packet."""
        assert (process, key) == ("sensor", self.keys.uplink)
        self.stage.fill(key, [payload])

    def end(self) -> None:
        """The run is over: the router returns."""
        self.stage.commands.put(EndRun().pack())
        self._thread.join(LIMIT)
        assert not self._thread.is_alive()

    def packet(self, k: int) -> Floats:
        """The payloads of slot k: any numbers that tell slots, states and trials apart."""
        n, trials = 2, self.scenario.trials
        return np.arange(n * trials, dtype=float).reshape(n, trials) + 100.0 * (k + 1)


def run_through(bench: Bench | MemoryBench) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Send every slot; what each receiver got of it, (slots, R), and how many were lost by the journal, (slots,)."""
    scenario, keys = bench.scenario, bench.keys
    shape = (2, scenario.trials)
    gammas = {name: np.zeros((scenario.slots, scenario.trials), bool) for name in scenario.receivers}
    for k in range(scenario.slots):
        bench.put("sensor", keys.uplink, packet(k, bench.packet(k)))
    for name in scenario.receivers:
        for k in range(scenario.slots):
            arrivals = read_delivery(wire.Reader(*bench.downlinks[name].hear()), k, shape)
            assert np.array_equal(arrivals.z[0], np.where(arrivals.gamma[0], bench.packet(k), 0.0))
            assert not arrivals.late
            gammas[name][k] = arrivals.gamma[0]
    lost = {name: np.zeros(scenario.slots, int) for name in scenario.receivers}
    k = 0
    while k < scenario.slots:
        windows, extent = dict.fromkeys(scenario.receivers, 0), telemetry.Extent(scenario.slots, 8, *shape)
        journal = telemetry.read_journal(wire.Reader(*bench.journal.hear()), k, windows, extent)
        rows = slice(k, k + journal.count)
        for name in scenario.receivers:
            assert np.array_equal(journal.links[name].slots.delivered, gammas[name][rows])
            lost[name][rows] = journal.links[name].slots.lost.sum(axis=1)
        k += journal.count
    return gammas, lost


def test_every_packet_is_accounted_for(bench: Callable[..., Bench]) -> None:
    """Offered is delivered plus lost, slot by slot on every link; fates are those of the link's own stream; exit 0."""
    stage = bench(slots=61, first_trial=1000)
    gammas, lost = run_through(stage)
    for name, gamma in gammas.items():
        assert np.array_equal(gamma.sum(axis=1) + lost[name], np.full(61, 5))
        key = stage.briefs["router"].stream_keys[f"link/{name}"]
        quality = stage.scenario.quality[name]
        assert np.array_equal(gamma, uniforms_of(key, 61, range(1000, 1005)) < quality)
    stage.put("recorder", stage.keys.control("router"), EndRun().pack())
    assert stage.router.wait(LIMIT) == 0
    assert stage.log.read_text() == ""


def test_perfect_and_dead_links() -> None:
    """A link of quality 1 delivers everything, one of quality 0 nothing, and both have a delivery in every slot."""
    eavesdroppers = {"eve": {"strategy": "naive", "link": {"quality": 0.0}}}
    with MemoryBench(slots=20, trials=9, legitimate={"link": {"quality": 1.0}}, eavesdroppers=eavesdroppers) as bench:
        gammas, lost = run_through(bench)
    assert gammas["legitimate"].all()
    assert not gammas["eve"].any()
    assert lost["eve"].tolist() == [9] * 20


def test_passwords_do_not_outlast_the_opening(bench: Callable[..., Bench]) -> None:
    """While the router runs, its file of users and passwords is already gone: a killed router leaves none behind."""
    assert list(bench().private.iterdir()) == []


GOOD = packet(0, np.zeros((2, 5)))
BAD = {
    "gap": (
        [packet(k, np.zeros((2, 5))) for k in (1, 2)],
        "gap on .*/uplink: slot 2 arrived where slot 0 was due",
    ),
    "not msgpack": ([b"\xc1"], "malformed message on .*/uplink: not msgpack .*c1"),
    "too short": ([GOOD[:-1]], "malformed message on .*/uplink"),
    "other shape": ([packet(0, np.zeros((2, 4)))], "malformed .*z of 64 bytes; expected 80 bytes"),
    "not finite": ([packet(0, np.full((2, 5), np.nan))], "malformed .*z with a NaN or infinity"),
    "not a map": ([msgpack.packb([0])], "malformed .*a list; expected a msgpack map"),
    "slot below 0": ([msgpack.packb({"k": -1, "z": bytes(80)})], "malformed .*k = -1"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_packet_is_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gap that is not closed, or a malformed packet, ends the router's work with an error that says which."""
    monkeypatch.setattr("evedrop.live.network.process_session._LEAST_GAP", 0.0)
    messages, line = BAD[name]
    bench = MemoryBench(longest_outage=0.0)
    loop = RouterLoop(bench.brief, bench.stage.session(bench.brief))
    bench.stage.fill(bench.keys.uplink, messages)
    with pytest.raises(RunError, match=line) as raised:
        loop.carry_on()
    bench.stage.commands.put(EndRun().pack())  # ends the thread that reads commands
    assert raised.value.exit_status == 3


@pytest.mark.long
def test_bad_packet_ends_the_router(bench: Callable[..., Bench]) -> None:
    """A malformed packet ends the process with status 3, a line that says which, and no traceback."""
    messages, line = BAD["too short"]
    stage = bench(longest_outage=0.0)
    for message in messages:
        stage.put("sensor", stage.keys.uplink, message)
    assert stage.router.wait(LIMIT) == 3
    text = stage.log.read_text()
    assert re.search(line, text), text
    assert "Traceback" not in text
    assert stage.tokens.hear() == (f"deleted {stage.keys.alive('router')}", b"")


def test_a_doubled_packet_is_delivered_once() -> None:
    """A slot that comes twice, and one that comes too early, are ignored."""
    with MemoryBench() as bench:
        for k in (0, 0, 2, 1):
            bench.put("sensor", bench.keys.uplink, packet(k, np.zeros((2, 5))))
        for ear in bench.downlinks.values():
            assert [wire.Reader(*ear.hear()).integer("k") for _ in range(2)] == [0, 1]
        bench.put("sensor", bench.keys.uplink, packet(2, np.zeros((2, 5))))
        for ear in bench.downlinks.values():
            assert wire.Reader(*ear.hear()).integer("k") == 2


def test_a_part_of_a_slot_is_waited_for_in_real_time(bench: Callable[..., Bench]) -> None:
    """With half a slot of delay and a tenth of a second a slot, a delivery is 50 ms later than that of a link without."""
    delayed = {"quality": 1.0, "delay": {"model": "constant", "value": 0.5}}
    eve = {"strategy": "naive", "link": {"quality": 1.0}}
    stage = bench(slots=6, pace=0.1, legitimate={"link": delayed}, eavesdroppers={"eve": eve})
    for k in range(3):
        began = time.monotonic()
        stage.put("sensor", stage.keys.uplink, packet(k, stage.packet(k)))
        stage.downlinks["eve"].hear()
        stage.downlinks["legitimate"].hear()
        assert time.monotonic() - began >= 0.05
    stage.put("sensor", stage.keys.uplink, packets.barrier(3))
    for name in ("eve", "legitimate"):
        assert packets.is_barrier(wire.Reader(*stage.downlinks[name].hear()))
    lossless = {"model": "bernoulli", "quality": 1.0}
    change = LinkChange("eve", (Change(3, {"loss": lossless, "delay": delayed["delay"]}),))
    for command in (change, Go(3)):
        stage.put("recorder", stage.keys.control("router"), command.pack())
    for k in range(3, 6):
        began = time.monotonic()
        stage.put("sensor", stage.keys.uplink, packet(k, stage.packet(k)))
        stage.downlinks["eve"].hear()
        assert time.monotonic() - began >= 0.05, "a link that an operator gives a delay"
