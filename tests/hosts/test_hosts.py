"""A run whose processes are on hosts of their own: the same bits, nothing to be seen, and cables that are pulled."""

from __future__ import annotations

import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from evedrop.live.protocol.brief import read_brief
from evedrop.results.reading import Results
from evedrop.scenario.tables import Scenario
from tests.builders import MARGINAL, listener, scenario_of
from tests.by_hand import ByHand, as_if_undisturbed, by_hand
from tests.conftest import wait_until
from tests.hosts.lan import Lan, lan

PORT = 7447
HOSTS = ("router", "sensor", "legitimate", "eve", "recorder")


def on_hosts(**changes: Any) -> Scenario:
    """Some seconds of a state that is sent as it is, so that a payload can be told."""
    plain = {"encoding": {"scheme": "plain"}, "legitimate": {"link": {"quality": 0.8}}}
    eavesdroppers = {"eve": listener("naive", 0.7)}
    return scenario_of(
        MARGINAL, **{**plain, "eavesdroppers": eavesdroppers, "slots": 500, "seed": 31, "pace": 0.01, **changes}
    )


@contextmanager
def apart(folder: Path, scenario: Scenario, protocol: str = "tls") -> Iterator[tuple[Lan, ByHand]]:
    """A network, and a run whose briefs are written, a host for each process."""
    hosts = (*HOSTS, "relay") if scenario.relayed else HOSTS
    with lan(*hosts) as network:
        entered = {host: network.entering(host) for host in hosts}
        endpoints = {host: f"{protocol}/{address}:{PORT}" for host, address in network.addresses.items()}
        given = {"entered": entered, "insecure": protocol == "tcp", "relay": endpoints.get("relay")}
        with by_hand(scenario, folder, endpoints["router"], **given) as run:
            run.write()
            yield network, run


@contextmanager
def captured(network: Lan, host: str, file: Path) -> Iterator[None]:
    """Everything that crosses a host's cable, into a file."""
    command = [*network.entering(host), "tcpdump", "-i", "eth0", "-s", "0", "-U", "-Z", "root", "-w", str(file)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as tcpdump:
        try:
            assert tcpdump.stderr is not None
            assert "listening on eth0" in tcpdump.stderr.readline()
            yield
        finally:
            tcpdump.terminate()


def readable(file: Path, run: ByHand) -> tuple[int, set[str]]:
    """How many of the run's payloads can be found in a capture, and whose names and passwords."""
    traffic = file.read_bytes()
    rows = Results.read(run.folder / "run").trials.to_pylist()
    payloads = {struct.pack("<2d", *row["x"]) for row in rows if row["peer"] == "legitimate"}
    assert len(payloads) == run.scenario.slots
    words = set()
    for name in HOSTS[1:]:
        brief = read_brief(run.folder / "briefs" / f"{name}.json")
        words |= {word for word in (brief.password, f"alive/{name}") if word.encode() in traffic}
    return sum(payload in traffic for payload in payloads), words


SCAN = """
import errno, selectors, socket, sys
def knocks(host, ports):
    ports, open_, under_way = iter(ports), [], selectors.DefaultSelector()
    while True:
        while len(under_way.get_map()) < 500 and (port := next(ports, None)) is not None:
            one = socket.socket()
            one.setblocking(False)
            failed = one.connect_ex((host, port))
            if failed in (0, errno.EINPROGRESS):
                under_way.register(one, selectors.EVENT_WRITE, port)
            else:
                one.close()
        if not under_way.get_map():
            return open_
        for key, _ in under_way.select(5.0):
            if not key.fileobj.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                open_.append(key.data)
            under_way.unregister(key.fileobj)
            key.fileobj.close()
for host in sys.argv[2:]:
    for port in knocks(host, range(1, int(sys.argv[1]) + 1)):
        print(host, port)
"""
"""Connects to every port up to a number of every host, and says which are open."""


def test_hosts_of_their_own_change_nothing_and_show_nothing(tmp_path: Path) -> None:
    """Digests are those in memory; a scan finds the router's port alone, and a capture neither payload nor password."""
    scenario = on_hosts(slots=1500)  # more seconds than a busy machine needs to start a command
    with apart(tmp_path, scenario) as (network, run), captured(network, "router", tmp_path / "capture"):
        run.start()
        run.running()
        evedrop = (sys.executable, "-m", "evedrop")
        network.run("recorder", *evedrop, "pause", str(run.folder / "run"))  # however long the scan takes
        router = network.addresses["router"]
        output = network.run("eve", sys.executable, "-c", SCAN, "65535", router)
        assert output.split() == [router, str(PORT)]
        others = [network.addresses[host] for host in HOSTS if host != "router"]
        assert network.run("eve", sys.executable, "-c", SCAN, str(PORT), *others) == ""
        for host in HOSTS:  # what listens at all, of any protocol, is what was scanned for
            listening = network.run(host, "ss", "-Hlntu").splitlines()
            assert [line.split()[4] for line in listening] == [f"{router}:{PORT}"] * (host == "router")
        network.run("recorder", *evedrop, "resume", str(run.folder / "run"))
        assert set(run.statuses().values()) == {0}
        as_if_undisturbed(run.summary, scenario, tmp_path / "memory")
        assert run.summary["outages"] == []
        assert readable(tmp_path / "capture", run) == (0, set())


def test_unencrypted_everything_can_be_read(tmp_path: Path) -> None:
    """With --insecure the same capture has the payloads in it: so it would have shown them."""
    scenario = on_hosts(slots=100)
    with apart(tmp_path, scenario, "tcp") as (network, run), captured(network, "router", tmp_path / "capture"):
        run.start()
        assert set(run.statuses().values()) == {0}
        everybody = {f"alive/{name}" for name in HOSTS[1:]}

        def all_of_it() -> bool:
            """Whether what was captured has been written: tcpdump is behind."""
            payloads, words = readable(tmp_path / "capture", run)
            return payloads > 50 and words == everybody

        wait_until(all_of_it, "payloads and names in the capture")


@pytest.mark.parametrize("host", ["eve", "router"])
def test_a_pulled_cable_is_an_outage(host: str, tmp_path: Path) -> None:
    """Unplugged for longer than a connection's lease, and plugged in again: the run reaches the bits of an undisturbed one."""
    scenario = on_hosts()
    with apart(tmp_path, scenario) as (network, run):
        run.start()
        run.running(50)
        network.unplug(host)
        time.sleep(8.0)  # how long it is out is what is tested
        network.plug(host)
        assert set(run.statuses().values()) == {0}
        as_if_undisturbed(run.summary, scenario, tmp_path / "memory")
        outages = run.summary["outages"]
        # If the router's cable is out, the recorder sees that it reaches nobody, and finds the same router again. The router may
        # notice later than the recorder that another process has lost its connection, too: that is an outage of its own.
        assert "router" not in {outage["process"] for outage in outages}
        assert outages[0]["process"] == {"eve": "eve", "router": "recorder"}[host]
        assert len(outages) == 1 or host == "router"
        assert len({outage["slot"] for outage in outages}) == 1
        assert all(outage["seconds"] > 4.0 for outage in outages)


def test_a_killed_router_is_started_again_on_its_host(tmp_path: Path) -> None:
    """The others find it again at its address, under its certificate."""
    scenario = on_hosts()
    with apart(tmp_path, scenario) as (_, run):
        run.start()
        run.running(50)
        run.kill("router")
        run.start("router")
        assert set(run.statuses().values()) == {0}
        as_if_undisturbed(run.summary, scenario, tmp_path / "memory")
        assert [outage["process"] for outage in run.summary["outages"]] == ["router"]


def test_two_routers_lose_each_other(tmp_path: Path) -> None:
    """The router's cable is pulled, and later the router is killed: sensor and relay find it again, and the bits are the same."""
    scenario = on_hosts(network={"routers": 2})
    with apart(tmp_path, scenario) as (network, run):
        run.start()
        run.running(50)
        network.unplug("router")
        time.sleep(6.0)  # how long it is out is what is tested
        network.plug("router")
        run.running(run.done())
        run.kill("router")
        run.start("router")
        assert set(run.statuses().values()) == {0}
        as_if_undisturbed(run.summary, scenario, tmp_path / "memory")
        cut_off = {outage["process"] for outage in run.summary["outages"]}
        # The recorder is behind the relay: with the router's cable it loses sight of the sensor, too.
        assert {"router"} <= cut_off <= {"router", "sensor"}


KNOCK = """
import socket, sys
try:
    socket.create_connection((sys.argv[1], 9), 1.0)
except ConnectionRefusedError:
    print("refused")
except OSError:
    print("not there")
"""
"""Whether a host is there: if it is, it refuses, since nothing listens."""


def test_two_networks_do_not_meet(tmp_path: Path) -> None:
    """Hosts of two networks have the same addresses and do not reach each other; both are gone in the end."""
    with lan("a", "b") as first, lan("a") as other:
        assert first.addresses["a"] == other.addresses["a"]
        assert first.namespace("a") != other.namespace("a")
        assert first.run("a", sys.executable, "-c", KNOCK, first.addresses["b"]) == "refused\n"
        assert other.run("a", sys.executable, "-c", KNOCK, first.addresses["b"]) == "not there\n"
        names = {first.namespace("a"), first.namespace("b"), other.namespace("a")}
        assert names <= {path.name for path in Path("/run/netns").iterdir()}
    assert not names & {path.name for path in Path("/run/netns").iterdir()}
