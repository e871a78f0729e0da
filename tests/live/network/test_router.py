"""The router process: what becomes of every packet on every link, and what it refuses."""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable

import msgpack
import numpy as np
import pytest
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes

from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import packets, telemetry
from evedrop.live.protocol.commands import End
from tests.live.network.bench import LIMIT_SECONDS, Bench


def uniforms_of(key: bytes, slots: int, trials: range) -> np.ndarray:
    """The link's uniforms (slots, R), word by word from docs/protocol.md: one word of each block of two is used."""
    encryptor = Cipher(algorithms.AES(key), modes.ECB()).encryptor()  # noqa: S305 - the protocol's counter mode
    drawn = [
        [struct.unpack("<Q", encryptor.update(((k << 64) + r).to_bytes(16, "big"))[:8])[0] for r in trials]
        for k in range(slots)
    ]
    return np.array([[(word >> 11) / 2**53 for word in row] for row in drawn])


def run_through(bench: Bench) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Send every slot; what each receiver got of it, (slots, R), and how many were lost by the journal, (slots,)."""
    scenario, keys = bench.scenario, bench.keys
    shape = (2, scenario.trials)
    gammas = {name: np.zeros((scenario.slots, scenario.trials), bool) for name in scenario.receivers}
    for k in range(scenario.slots):
        bench.put("sensor", keys.uplink, packets.uplink(k, bench.packet(k)))
    for name in scenario.receivers:
        for k in range(scenario.slots):
            (gamma, z, *_), late = packets.read_delivery(wire.Reader(*bench.downlinks[name].hear()), k, shape)
            assert np.array_equal(z, np.where(gamma, bench.packet(k), 0.0))
            assert late == ()
            gammas[name][k] = gamma
    lost = {name: np.zeros(scenario.slots, int) for name in scenario.receivers}
    k = 0
    while k < scenario.slots:
        windows, extent = dict.fromkeys(scenario.receivers, 0), telemetry.Extent(scenario.slots, 8, *shape)
        journal = telemetry.read_journal(wire.Reader(*bench.journal.hear()), k, windows, extent)
        rows = slice(k, k + journal.count)
        for name in scenario.receivers:
            assert np.array_equal(journal.links[name].delivered, gammas[name][rows])
            lost[name][rows] = sum(journal.links[name].lost.values())
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
    stage.put("observer", stage.keys.control("router"), End().pack())
    assert stage.router.wait(LIMIT_SECONDS) == 0
    assert stage.log.read_text() == ""


def test_perfect_and_dead_links(bench: Callable[..., Bench]) -> None:
    """A link of quality 1 delivers everything, one of quality 0 nothing, and both have a delivery in every slot."""
    eavesdroppers = {"eve": {"strategy": "naive", "link": {"quality": 0.0}}}
    stage = bench(slots=20, trials=9, legitimate={"link": {"quality": 1.0}}, eavesdroppers=eavesdroppers)
    gammas, lost = run_through(stage)
    assert gammas["legitimate"].all()
    assert not gammas["eve"].any()
    assert lost["eve"].tolist() == [9] * 20


def test_passwords_do_not_outlast_the_opening(bench: Callable[..., Bench]) -> None:
    """While the router runs, its file of users and passwords is already gone: a killed router leaves none behind."""
    assert list(bench().private.iterdir()) == []


GOOD = packets.uplink(0, np.zeros((2, 5)))
BAD = {
    "gap": (
        [packets.uplink(k, np.zeros((2, 5))) for k in (1, 2)],
        "gap on .*/uplink: slot 2 arrived where slot 0 was due",
    ),
    "not msgpack": ([b"\xc1"], "malformed message on .*/uplink: not msgpack .*c1"),
    "too short": ([GOOD[:-1]], "malformed message on .*/uplink"),
    "other shape": ([packets.uplink(0, np.zeros((2, 4)))], "malformed .*z of 64 bytes; expected 80 bytes"),
    "not finite": ([packets.uplink(0, np.full((2, 5), np.nan))], "malformed .*z with a NaN or infinity"),
    "not a map": ([msgpack.packb([0])], "malformed .*a list; expected a msgpack map"),
    "slot below 0": ([msgpack.packb({"k": -1, "z": bytes(80)})], "malformed .*k = -1"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_packet_ends_the_router(name: str, bench: Callable[..., Bench]) -> None:
    """A gap that is not closed, or a malformed packet, ends the router with status 3 and a line that says which."""
    messages, line = BAD[name]
    stage = bench(longest_outage=0.0)
    for message in messages:
        stage.put("sensor", stage.keys.uplink, message)
    assert stage.router.wait(LIMIT_SECONDS) == 3
    text = stage.log.read_text()
    assert re.search(line, text), text
    assert "Traceback" not in text
    assert stage.tokens.hear() == (f"deleted {stage.keys.alive('router')}", b"")


def test_a_doubled_packet_is_delivered_once(bench: Callable[..., Bench]) -> None:
    """A slot that comes twice, and one that comes too early, are ignored."""
    stage = bench()
    for k in (0, 0, 2, 1):
        stage.put("sensor", stage.keys.uplink, packets.uplink(k, np.zeros((2, 5))))
    for ear in stage.downlinks.values():
        assert [wire.Reader(*ear.hear()).integer("k") for _ in range(2)] == [0, 1]
    stage.put("sensor", stage.keys.uplink, packets.uplink(2, np.zeros((2, 5))))
    for ear in stage.downlinks.values():
        assert wire.Reader(*ear.hear()).integer("k") == 2


def test_a_part_of_a_slot_is_waited_for_in_real_time(bench: Callable[..., Bench]) -> None:
    """With half a slot of delay and a tenth of a second a slot, a delivery is 50 ms later than that of a link without."""
    delayed = {"quality": 1.0, "delay": {"model": "constant", "value": 0.5}}
    eve = {"strategy": "naive", "link": {"quality": 1.0}}
    stage = bench(slots=3, pace=0.1, legitimate={"link": delayed}, eavesdroppers={"eve": eve})
    for k in range(3):
        began = time.monotonic()
        stage.put("sensor", stage.keys.uplink, packets.uplink(k, stage.packet(k)))
        stage.downlinks["eve"].hear()
        stage.downlinks["legitimate"].hear()
        assert time.monotonic() - began >= 0.05
