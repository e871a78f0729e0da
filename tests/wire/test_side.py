"""The sides of a wire: where they listen, whom they let in, and what joins them outside the wire."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from evedrop.errors import UsageError
from evedrop.live.network.certificates import Authority
from evedrop.system.lacks import lack_of
from evedrop.system.ports import free_port
from evedrop.wire.plan import Side
from evedrop.wire.records import WireFate
from evedrop.wire.side import PROBES, SideSession, side_config
from evedrop.wire.tables import TlsTable
from tests.conftest import wait_until
from tests.wire.test_publications import reader, ready
from tests.wire.wire_at_work import ANYWHERE, at_work, both_ways, link, plan_of, program


def a_router(**config: Any) -> zenoh.Session:
    """A router outside the wire."""
    quiet = {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps({"mode": "router", "scouting": quiet, **config})))


@pytest.mark.parametrize("protocol", ["tcp", "ws"])
def test_the_endpoint_has_the_real_port(protocol: str) -> None:
    """A program can connect there. And a fixed port is told as it is."""
    port = free_port()
    with (
        SideSession(Side("a", (f"{protocol}/127.0.0.1:0",)), 100) as side,
        SideSession(Side("b", (f"tcp/127.0.0.1:{port}",)), 100) as other,
    ):
        assert side.endpoints[0].startswith(f"{protocol}/127.0.0.1:")
        with program(side.endpoints) as session:
            assert [str(router) for router in session.info.routers_zid()] == [side.zid]
        assert not side.endpoints[0].endswith(":0")
        assert other.endpoints == (f"tcp/127.0.0.1:{port}",)


def test_a_side_that_zenoh_does_not_close_in_time_ends_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when a program no longer reads and keeps its connection; the journal and the summary must still be written."""

    def times_out() -> None:
        raise zenoh.ZError("close operation timed out!")

    side = SideSession(Side("a", (ANYWHERE,)), 100)
    with side.session, monkeypatch.context() as patched:
        patched.setattr(side, "session", SimpleNamespace(close=times_out))
        with side:
            pass


@pytest.mark.parametrize("name", ["to base", "from robot", "from base", "queries"])
def test_a_wire_that_lacks_threads_says_so(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And not that a thread cannot be joined: the first error is the one that `lack_of` knows."""
    start = threading.Thread.start

    def fails(thread: threading.Thread) -> None:
        if thread.name == name:
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", fails)
    with pytest.raises(RuntimeError) as raised:
        at_work(both_ways(), tmp_path).__enter__()
    assert lack_of(raised.value) is not None


def test_a_message_twice_as_large_as_the_largest_is_still_heard() -> None:
    """So it has a fate, `too_large`: Zenoh discards only what is larger still, and more than 1 GiB."""
    for largest, limit in ((2**30, 2**31), (1000, 2**30)):
        assert side_config(Side("a"), largest, None)["transport"]["link"]["rx"]["max_message_size"] == limit


def test_a_port_that_is_taken_is_reported(tmp_path: Path) -> None:
    """With the name of the side and the remedy, and nothing stays open."""
    with SideSession(Side("first", (ANYWHERE,)), 100) as first:
        plan = plan_of(link("a", "b"), sides={"b": Side("b", first.endpoints)})
        with pytest.raises(
            UsageError, match=r"side b cannot listen at tcp/127\.0\.0\.1:\d+ .*; end the program"
        ) as refused:
            at_work(plan, tmp_path).__enter__()
        assert ".rs:" not in str(refused.value)  # no lines of Zenoh's source
        with SideSession(Side("later", (ANYWHERE,)), 100):
            pass


def test_a_side_that_cannot_connect_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """After some seconds."""
    monkeypatch.setattr("evedrop.wire.side._CONNECT_SECONDS", 0.2)
    nobody = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(UsageError, match="side a cannot connect to tcp"):
        SideSession(Side("a", (), (nobody,)), 100)


def test_a_side_may_attach_to_a_router_that_is_there(tmp_path: Path) -> None:
    """Programs of that router are at the side."""
    port = free_port()
    with a_router(listen={"endpoints": [f"tcp/127.0.0.1:{port}"]}):
        plan = plan_of(
            link("robot", "base"),
            link("base", "robot"),
            sides={"robot": Side("robot", (), (f"tcp/127.0.0.1:{port}",))},
        )
        with at_work(plan, tmp_path) as wire, program([f"tcp/127.0.0.1:{port}"]) as robot, wire.program("base") as base:
            ready(wire, robot, base)
            ready(wire, base, robot)


def test_a_router_that_joins_two_sides_is_reported_and_nothing_goes_round(tmp_path: Path) -> None:
    """Until it is gone: then messages cross again. Lossless ones would go round as well."""
    plan = both_ways(lossless=("stop",))
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        ready(wire, robot, base)
        endpoints = [wire.relay.endpoints[name][0] for name in ("robot", "base")]
        with a_router(connect={"endpoints": endpoints}, listen={"endpoints": []}):
            wait_until(
                lambda: any("outside the wire, through the router " in line for line in wire.told), "it is reported"
            )
            wait_until(lambda: robot.put("x", b"") or WireFate.LOOPED in wire.fates(), "messages do not go round")
            robot.put("stop", b"")
            wait_until(lambda: len(wire.rows_of("stop")), "the wire hears a lossless one")
            assert set(wire.rows_of("stop")["fate"]) == {WireFate.LOOPED}
            (bypass,) = [
                event.line for event in wire.journal.history.events if event.bypass
            ]  # programs speak past the wire
            assert "outside the wire, through the router " in bypass
        wait_until(lambda: any("no longer pass between the sides" in line for line in wire.told), "its end is reported")
        got = reader(base, "y")
        wait_until(lambda: robot.put("y", b"") or got, "messages cross again")


def test_a_program_at_two_sides_is_reported(tmp_path: Path) -> None:
    """By its Zenoh id; messages cross nevertheless."""
    with at_work(both_ways(), tmp_path) as wire:
        endpoints = [wire.relay.endpoints[name][0] for name in ("robot", "base")]
        with program(endpoints, mode="peer") as both, wire.program("robot") as robot, wire.program("base") as base:
            zid = str(both.zid())
            wait_until(lambda: any(zid in line and "robot and base" in line for line in wire.told), "it is reported")
            ready(wire, robot, base)


def test_only_users_with_their_password_may_connect(tmp_path: Path) -> None:
    """Their messages cross."""
    sides = {"robot": Side("robot", (ANYWHERE,), users={"ann": "secret"})}
    with at_work(plan_of(link("robot", "base"), sides=sides), tmp_path) as wire, wire.program("base") as base:
        with pytest.raises(zenoh.ZError):
            wire.program("robot", connect={"endpoints": list(wire.relay.endpoints["robot"]), "timeout_ms": 0})
        login = {"auth": {"usrpwd": {"user": "ann", "password": "secret"}}}
        with wire.program("robot", transport=login) as ann:
            ready(wire, ann, base)


def test_programs_may_use_only_the_keys_of_their_side(tmp_path: Path) -> None:
    """In both directions; tokens and queryables too."""
    sides = {"robot": Side("robot", (ANYWHERE,), keys=("ready", "robot/**"))}
    plan = plan_of(link("robot", "base"), link("base", "robot"), sides=sides)
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        ready(wire, robot, base)
        ready(wire, base, robot)
        here, there, everything = reader(robot, "robot/down"), reader(base, "**"), reader(robot, "secret/**")
        token = robot.liveliness().declare_token("robot/alive")
        wait_until(lambda: [reply for reply in base.liveliness().get("robot/*") if reply.ok], "its token crosses")
        for n in range(3):
            robot.put("secret/up", str(n))
            base.put("secret/down", str(n))
            robot.put("robot/up", str(n))
            base.put("robot/down", str(n))
        wait_until(lambda: sum(str(sample.key_expr) == "robot/up" for sample in there) == 3, "what is allowed crosses")
        wait_until(lambda: sum(str(sample.key_expr) == "robot/down" for sample in here) == 3, "in both directions")
        assert "secret/up" not in {str(sample.key_expr) for sample in there}
        assert "secret/down" not in {str(sample.key_expr) for sample in everything}
        del token


@pytest.mark.parametrize(("connect", "granted"), [((), False), (("tcp/127.0.0.1:7447",), True)])
def test_programs_may_not_use_the_probes_of_the_wire(connect: tuple[str, ...], granted: bool) -> None:
    """At a side with keys; only a side that connects to a router must let them pass."""
    side = Side("robot", (ANYWHERE,), connect, keys=("robot/**",))
    (rule,) = side_config(side, 1000, None)["access_control"]["rules"]
    assert (PROBES in rule["key_exprs"]) == granted


def test_a_side_with_tls_wants_certificates_of_its_authority(tmp_path: Path) -> None:
    """A program without one is refused; with one, its messages cross."""
    certificates = Authority("wire")

    def files_of(name: str) -> tuple[str, str, str]:
        """Paths of the certificate, the key and the authority's certificate of a process."""
        identity = certificates.identity(name, ["127.0.0.1"])
        paths = []
        for part in ("certificate", "key", "authority"):
            path = tmp_path / f"{name}-{part}.pem"
            path.write_text(getattr(identity, part), encoding="utf-8")
            paths.append(str(path))
        return paths[0], paths[1], paths[2]

    files = files_of("side")
    tls = TlsTable(certificate=files[0], key=files[1], authority=files[2])
    sides = {"robot": Side("robot", ("tls/127.0.0.1:0",), tls=tls)}
    with at_work(plan_of(link("robot", "base"), sides=sides), tmp_path / "out") as wire, wire.program("base") as base:
        endpoint = {"endpoints": list(wire.relay.endpoints["robot"]), "timeout_ms": 0}
        certificate, key, authority = files_of("robot")
        transport = {"root_ca_certificate": authority}
        with pytest.raises(zenoh.ZError):
            wire.program("robot", connect=endpoint, transport={"link": {"tls": transport}})
        own = {**transport, "enable_mtls": True, "connect_certificate": certificate, "connect_private_key": key}
        with wire.program("robot", transport={"link": {"tls": own}}) as robot:
            ready(wire, robot, base)
