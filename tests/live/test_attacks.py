"""Processes that break in, lie or say nothing: each attack against a real run, which ends with the attacker's name.

A rogue is a real process of the run, with its own brief and credentials, in which one thing is done otherwise.
"""

from __future__ import annotations

import re
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.notices import RefusalNotice
from evedrop.scenario.loading import load
from evedrop.system.ports import free_port
from tests.by_hand import by_hand
from tests.conftest import Evedrop, Live
from tests.rogue import with_rogue

SMALL = ("--slots", "600", "--trials", "3")


def refused(live: Live, name: str) -> str:
    """Check that a run failed because of a process, and that what it left can be read; what was said of it."""
    done = live.end()
    assert done.status == 3, done.err
    live.nothing_left()
    summary = live.results.summary
    assert name in done.err.splitlines()[0]
    assert f"logs/{name}.log" in done.err
    assert summary["ended"] in done.err
    assert summary["peers"]["smart"]["digest"] is None
    return done.err


DENIES = """
import numpy as np
def one(self):
    action = self.slots.action.copy()
    if self.slots.first <= {slot} < self.slots.first + len(action):
        action[{slot} - self.slots.first, 2] = 0 if action[{slot} - self.slots.first, 2] else 3
    return dict(action=action)
change(one)
"""
LIES = {
    "x_hat = 7, P = 0, no digests": (
        "change(lambda self: dict(x_hat=self.slots.x_hat * 0.0 + 7.0, P=self.slots.P * 0.0, trace=self.slots.trace * 0.0,"
        " digests={block: one * 0 for block, one in self.digests.items()},"
        " trace_sums={block: one * 0 for block, one in self.trace_sums.items()}))",
        r"smart contradicts itself: its digest of slots 0 to 255 of trial 0 is (00){16}, and what it reported of these slots "
        r"gives [0-9a-f]{32}; look at logs/smart.log",
    ),
    "one packet of one unrecorded trial": (
        DENIES.format(slot=77),
        r"smart contradicts router: in slot 77, trial 2, it says that it received (nothing|the packet) [(]action [03][)], but "
        r"the journal says that it was (not )?delivered; look at logs/smart.log and logs/router.log",
    ),
    "the last packet": (
        DENIES.format(slot=599),
        "smart contradicts router: in slot 599, trial 2, it says that it received",
    ),
    "a wrong digest at the end": (
        "change(lambda self: dict(digests={block: one + (block > 256) for block, one in self.digests.items()}))",
        "smart contradicts itself: its digest of slots 512 to 599 of trial 0",
    ),
    "a better covariance than it has": (
        "change(lambda self: dict(P=self.slots.P * 0.5, trace=self.slots.trace * [0.5, 0.25]))",
        "smart contradicts itself: its sum of tr P over slots 0 to 255 of trial 0",
    ),
    "a better covariance than it has, in all sums too": (
        "change(lambda self: dict(P=self.slots.P * 0.5, trace=self.slots.trace * [0.5, 0.25], "
        "trace_sums={k: one * 0.5 for k, one in self.trace_sums.items()}))",
        "smart contradicts itself: its digest of slots 0 to 255 of trial 0",
    ),
    "packets that it denies": (
        "change(lambda self: dict(action=self.slots.action * 0, digests={k: one for k, one in self.digests.items()}))",
        "smart contradicts",
    ),
}
"""What a receiver claims → how it claims that, and the expected message."""
FEW = ("x_hat = 7, P = 0, no digests", "the last packet")


@pytest.mark.parametrize("case", [lie if lie in FEW else pytest.param(lie, marks=pytest.mark.long) for lie in LIES])
def test_a_receiver_that_lies_is_found_out(evedrop: Evedrop, case: str) -> None:
    """Whatever a receiver claims, against its own reports or against the journal, the run ends with its name and both values."""
    does, message = LIES[case]
    live = evedrop.live("eavesdroppers", *SMALL, env=with_rogue(evedrop, "smart", does))
    result = refused(live, "smart")
    assert re.search(message, result), result
    checked = live.results.summary["verification"]
    assert checked["smart"]["verified"] == []
    assert "received_fraction" in checked["naive"]["verified"]


@pytest.mark.parametrize(
    ("does", "message"),
    [
        ("dict(digests={2**63: np.zeros((3, 16), np.uint8)})", "digests of block 9223372036854775808"),
        (
            "dict(P=self.slots.P + np.array([[[[0.0], [0.0]], [[1.0], [0.0]]]]))",
            r"P with \S+ at \[0, 0, 1, 0\] and \S+ at \[0, 1, 0, 0\]",
        ),
        pytest.param("dict(x_hat=self.slots.x_hat[:, :, :2])", "x_hat of", marks=pytest.mark.long),
        pytest.param(
            "dict(x_hat=np.zeros((601, 3, 1)), action=np.zeros((601, 3), np.uint8))",
            "c = 601; expected an integer c from 1 to",
            marks=pytest.mark.long,
        ),
    ],
    ids=["block of no run", "asymmetric covariances", "another shape", "more slots than the run has"],
)
def test_a_report_that_no_run_has_is_refused(evedrop: Evedrop, does: str, message: str) -> None:
    """Blocks, slots and shapes of no run end it as soon as they are read, with key, sender and values; no table is broken."""
    rogue = with_rogue(evedrop, "smart", f"import numpy as np\nchange(lambda self: {does})")
    result = refused(evedrop.live("eavesdroppers", *SMALL, env=rogue), "smart")
    assert result.startswith("evedrop: smart broke the protocol: malformed message on evedrop/"), result
    assert "telemetry/smart: " in result
    assert re.search(message, result), result
    assert "Check that smart speaks docs/protocol.md" in result


@pytest.mark.thorough
def test_what_is_verified_and_what_is_not(evedrop: Evedrop) -> None:
    """The summary says for how many trials digests were recomputed, and which metrics rest on a receiver's own report."""
    done = evedrop(
        "run", "eavesdroppers", "--slots", "40", "--trials", "4", "--record-trials", "3", "--view", "off", "--json"
    )
    some = {
        "recomputed_trials": 3,
        "verified": ["mean_squared_error", "received_fraction"],
        "own_word": ["used_fraction", "mean_trace_covariance", "digest"],
    }
    assert done.summary["verification"] == dict.fromkeys(done.summary["peers"], some)
    done = evedrop("run", "eavesdroppers", "--slots", "40", "--view", "off", "--json")
    assert done.summary["verification"]["smart"]["own_word"] == ["used_fraction"]
    in_memory = evedrop("montecarlo", "eavesdroppers", "--slots", "40", "--trials", "4", "--json")
    assert in_memory.summary["verification"] is None


HANG = """
import threading
def hang(): threading.Event().wait()
"""
RECEIVER = """
from evedrop.live.network.reporting import BeliefReporter
def add_slots(self, made, honest=BeliefReporter.add_slots): hang() if SLOT in made.slots else honest(self, made)
BeliefReporter.add_slots = add_slots
"""
SENSOR = """
import evedrop.peers.sensor as sensor
def sent(packets, honest=sensor.uplink): return hang() if SLOT in packets.slots else honest(packets)
sensor.uplink = sent
"""
ROUTER = """
import evedrop.live.network.router as router
def read(*given, honest=router.read_uplink):
    packets = honest(*given)
    return hang() if SLOT in packets.slots else packets
router.read_uplink = read
"""
CONTROLLER = """
import evedrop.peers.controller as controller
def told(k, u, failed, honest=controller.decided): return hang() if k >= SLOT else honest(k, u, failed)
controller.decided = told
"""
SILENT = {
    "a receiver in the middle": ("eavesdroppers", "smart", RECEIVER.replace("SLOT", "300")),
    "a receiver from the first slot on": ("eavesdroppers", "smart", RECEIVER.replace("SLOT", "0")),
    "the legitimate estimator, whose acknowledgements are waited for": (
        "acknowledged", "legitimate", RECEIVER.replace("SLOT", "20")
    ),
    "the sensor": ("eavesdroppers", "sensor", SENSOR.replace("SLOT", "300")),
    "the router": ("eavesdroppers", "router", ROUTER.replace("SLOT", "300")),
    "the controller": ("microgrid", "controller", CONTROLLER.replace("SLOT", "120")),
}  # fmt: skip
"""The silent process → its scenario, its name, and how it is silent."""


@pytest.mark.thorough
@pytest.mark.parametrize(
    "case",
    [name if name == "a receiver in the middle" else pytest.param(name, marks=pytest.mark.long) for name in SILENT],
)
def test_a_process_that_is_alive_and_silent_is_named(evedrop: Evedrop, case: str) -> None:
    """Its connection and its token stay, and its loop stands still: the run ends, and names the process that all waited for."""
    scenario, name, does = SILENT[case]
    rogue = with_rogue(evedrop, name, HANG + does)
    live = evedrop.live(scenario, "--pace", "0", "--set", "longest_outage=2", env=rogue)
    done = live.end()
    assert done.status == 3, done.err
    assert done.err.startswith(f"evedrop: {name}: alive, and silent for "), done.err
    assert f"logs/{name}.log" in done.err
    live.nothing_left()


@pytest.mark.long
def test_a_process_that_heeds_no_signal_is_killed_and_its_log_says_what_it_did(evedrop: Evedrop) -> None:
    """Native code that holds Python's lock keeps all of Python waiting; the stacks are written all the same.

    It waits for a mutex that it has locked itself, through `PyDLL`, which does not let go of Python's lock.
    """
    scenario, name, does = SILENT["a receiver in the middle"]
    holds = "import ctypes\ndef hang():\n    mutex = ctypes.create_string_buffer(64)\n"
    holds += "    for _ in range(2): ctypes.PyDLL(None).pthread_mutex_lock(mutex)\n"
    live = evedrop.live(
        scenario, "--pace", "0", "--set", "longest_outage=2", env=with_rogue(evedrop, name, holds + does)
    )
    done = live.end()
    assert done.status == 3, done.err
    assert done.err.startswith(f"evedrop: {name}: alive, and silent for "), done.err
    live.nothing_left()
    stacks = (live.folder / "logs" / f"{name}.log").read_text()
    assert " in hang" in stacks, stacks


@pytest.mark.long
def test_an_operator_may_pause_for_longer_than_an_outage(evedrop: Evedrop) -> None:
    """Nobody is silent in a run that is held."""
    live = evedrop.live("eavesdroppers", "--pace", "0.001", "--slots", "1000000", "--set", "longest_outage=2")
    live.running()
    assert evedrop("pause", "run").status == 0
    with pytest.raises(subprocess.TimeoutExpired):
        live.process.wait(12.0)
    assert evedrop("resume", "run").status == 0
    live.process.send_signal(signal.SIGINT)
    assert live.end().status == 130


PROGRESS = {
    "no message": ("b''", "not msgpack"),
    "beyond what was sent": ("pack({'k': 10**9})", r"k = 1000000000; expected an integer k from 0 to \d+"),
}
"""What a receiver says about its progress → how it says that, and the expected message."""


@pytest.mark.thorough
@pytest.mark.parametrize("case", ["beyond what was sent", pytest.param("no message", marks=pytest.mark.long)])
def test_malformed_progress_is_its_senders(evedrop: Evedrop, case: str) -> None:
    """The sensor refuses it, and the run ends with the name of the receiver that sent it, not with the sensor's."""
    does, message = PROGRESS[case]
    rogue = with_rogue(evedrop, "naive", f"reporting.Progress.pack = lambda notice: {does}")
    done = evedrop.live("eavesdroppers", "--slots", "100000", env=rogue).end()
    assert done.status == 3
    first = done.err.splitlines()[0]
    assert re.match(
        rf"evedrop: naive broke the protocol: malformed message on evedrop/\w+/progress/naive: {message}", first
    ), first
    assert "logs/naive.log" in done.err


@pytest.mark.long
def test_the_sender_is_named_where_everybody_is_started_by_hand(
    evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sensor, on another host perhaps, tells the recorder what it refuses before it ends, so the sender is named."""
    rogue = with_rogue(evedrop, "naive", "reporting.Progress.pack = lambda notice: pack({'k': 10**9})")
    monkeypatch.setenv("PYTHONPATH", rogue["PYTHONPATH"])
    scenario = load("eavesdroppers", {"slots": 100_000})
    with by_hand(scenario, evedrop.folder, f"tcp/127.0.0.1:{free_port()}") as run:
        run.write()
        run.start()
        assert run.statuses()["recorder"] == 3
        ended = run.summary["ended"]
    assert re.match(
        r"malformed message on evedrop/\w+/progress/naive: k = 1000000000; .*Check that naive speaks", ended
    ), ended
    assert ended.endswith("(refused by sensor)")


def test_nobody_is_accused_of_keys_that_are_not_its_own() -> None:
    """A refusal must be of a key that the process reads, in its own run; and what it says is shown without control characters."""
    reader = Reader("evedrop/r1/telemetry/naive", RefusalNotice.of("evedrop/r1/uplink", "x").pack())
    with pytest.raises(MalformedMessage, match="a key that naive reads"):
        RefusalNotice.read(reader, "naive")
    reader = Reader("evedrop/r1/telemetry/sensor", RefusalNotice.of("evedrop/r2/progress/naive", "x").pack())
    with pytest.raises(MalformedMessage, match="a key that sensor reads"):
        RefusalNotice.read(reader, "sensor")
    reader = Reader("evedrop/r1/telemetry/sensor", RefusalNotice.of("evedrop/r1/progress/naive", "\x1b[2Jx\n").pack())
    result = RefusalNotice.read(reader, "sensor")
    assert result is not None
    assert result.at_fault == ("naive",)
    assert str(result) == "malformed message on evedrop/r1/progress/naive: ?[2Jx? (refused by sensor)"


BOMB = """
from evedrop.live.network.reporting import BeliefReporter
def add_slots(self, slots, *rest, honest=BeliefReporter.add_slots):
    for k in slots.slots:
        for _ in range(5 if k % 500 == 0 else 0):
            self._put(k, bytes([0xdd, 0, 0x98, 0x96, 0x80]) + bytes([0x90]) * 10**7)
            self._put_progress(k, bytes([0x90]) * 10**7)
    honest(self, slots, *rest)
BeliefReporter.add_slots = add_slots
"""


@pytest.mark.long
def test_messages_of_megabytes_harm_nobody(evedrop: Evedrop) -> None:
    """The router drops messages larger than any of the run; the run goes on to its end, and no process takes more memory."""
    live = evedrop.live("eavesdroppers", "--slots", "1200", "--json", env=with_rogue(evedrop, "naive", BOMB))
    largest = dict.fromkeys(("recorder", "sensor", "router"), 0.0)
    while live.process.poll() is None:
        for name, pid in live.children().items():
            with suppress(OSError, IndexError):
                peak = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
                if name in largest and peak is not None:
                    largest[name] = max(largest[name], int(peak[1]) / 1000)
    done = live.end()
    assert done.status in {0, 1}, done.err
    assert done.summary["slots"] == 1200
    assert 0.0 < largest["recorder"] < 500.0
    assert 0.0 < largest["sensor"] < 200.0
    assert 0.0 < largest["router"] < 250.0
