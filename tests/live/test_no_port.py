"""A run on one machine needs no port: its router listens at a socket in a folder that no other user can enter."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO

import pytest

from evedrop.errors import Interrupted, RunError
from evedrop.live.launch.ports import RouterEndpoints, endpoints_at
from evedrop.live.launch.private_folder import private_folder, socket_folder
from evedrop.live.launch.process_set import Launch, launch_one
from evedrop.live.launch.starter import StartedProcess, Starter, process_starter
from evedrop.live.network.endpoint import Endpoint, SocketEndpoint, endpoint_in
from evedrop.live.protocol.launcher_events import RouterListens
from evedrop.scenario.progress_events import silent
from evedrop.scenario.tables import Scenario
from evedrop.system.ports import free_port
from tests.conftest import LIMIT, Evedrop, Live, with_mark
from tests.examples import mostly_long
from tests.live.launch.test_children import Ended
from tests.live.network.bench import small_network
from tests.privileged import CannotRun, skip

NOBODY = 65_534
ATTACK = f"""
import os, socket, sys
path = sys.argv[1]
os.setgroups([])
os.setgid({NOBODY})
os.setuid({NOBODY})
assert os.access("/tmp", os.X_OK)
for attempt in (
    lambda: socket.socket(socket.AF_UNIX).connect(path),
    lambda: socket.socket(socket.AF_UNIX).bind(path + "2"),
    lambda: os.listdir(os.path.dirname(path)),
    lambda: os.unlink(path),
    lambda: os.rename(os.path.dirname(path), os.path.dirname(path) + "2"),
):
    try:
        attempt()
    except PermissionError:
        print("refused")
    else:
        print("LET IN")
"""


def listening_ports(pids: Iterator[int] | list[int]) -> list[str]:
    """The local addresses of the TCP sockets of these processes that listen, as the system writes them."""
    inodes = set()
    for pid in pids:
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):  # closed meanwhile
                inodes.add(os.readlink(descriptor))
    listening_ports = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in inodes:
                listening_ports.append(words[1])
    return listening_ports


def router_of(live: Live, where: str = "control.json") -> str:
    """The endpoint of a run in progress."""
    endpoint: str = json.loads((live.folder / where).read_text())["router"]
    return endpoint


@pytest.mark.thorough
@pytest.mark.parametrize("shards", mostly_long([1, 2], [1]))
def test_a_run_opens_no_port(shards: int, evedrop: Evedrop) -> None:
    """No process of it, launcher and fork servers included, has a TCP socket that listens, from the first slot to the last."""
    changes = ("--slots", "100000", "--trials", "4", "--set", f"shards={shards}", "--set", "pace=0.002")
    live = evedrop.live("eavesdroppers", *changes)
    live.running()
    pids = list(with_mark(str(live.temporary)))
    assert len(pids) > 5 * shards
    assert listening_ports(pids) == []
    with socket.create_server(("127.0.0.1", 0)) as server:  # the test's own: else the table shows nothing
        port = server.getsockname()[1]
        assert listening_ports([os.getpid()]).count(f"0100007F:{port:04X}") == 1
    controls = ["control.json"] if shards == 1 else [f"shards/{number}/control.json" for number in (1, 2)]
    folders = []
    for control in controls:
        endpoint = endpoint_in(router_of(live, control))
        assert isinstance(endpoint, SocketEndpoint)
        folders.append(endpoint.path.parent)
        assert stat.S_IMODE(folders[-1].stat().st_mode) == 0o700
    if shards == 1:
        assert evedrop("status", "run").status == 0
        assert evedrop("pause", "run").out.startswith("held before slot")
        assert evedrop("resume", "run").status == 0
    live.process.terminate()
    assert live.end().status == 130
    live.nothing_left()
    assert not any(folder.exists() for folder in folders)


@pytest.mark.thorough
def test_another_user_cannot_reach_the_router(evedrop: Evedrop) -> None:
    """As an unprivileged user in a folder that all can enter: no connection, no socket in its place, no list, no removal."""
    if os.getuid() != 0:
        skip(CannotRun("a second user is needed, which only root can become"))
    environment = {**evedrop.environment, "TMPDIR": "/tmp"}  # noqa: S108 - a folder that every user can enter
    options = ("--slots", "100000", "--set", "pace=0.002")
    live = evedrop.live("eavesdroppers", *options, env=environment)
    try:
        live.running()
        endpoint = endpoint_in(router_of(live))
        assert isinstance(endpoint, SocketEndpoint)
        endpoint.dial(5.0).close()  # we can
        attack = [sys.executable, "-I", "-S", "-c", ATTACK, str(endpoint.path)]
        done = subprocess.run(attack, capture_output=True, text=True, check=False, timeout=LIMIT, cwd="/")
        assert done.stdout.split() == ["refused"] * 5, done.stderr
    finally:
        live.process.terminate()
        assert live.end().status == 130
    assert not endpoint.path.parent.exists()


@dataclass
class Squatted:
    """Takes the router's port before the router is started, as another user would who won the race."""

    start: Starter
    port: int
    started: list[str] = field(default_factory=list)
    server: socket.socket | None = None

    def __call__(self, role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        """Start a process; the first is the router."""
        if self.server is None:
            self.server = socket.create_server(("127.0.0.1", self.port))
            self.server.setblocking(False)
        self.started.append(brief.stem)
        return self.start(role, brief, log, environment)


def test_who_takes_the_port_first_meets_no_process(tmp_path: Path) -> None:
    """The router cannot listen, says so, and the run ends: no process has been started that could have connected."""
    port = free_port()
    with process_starter() as start:
        squatted = Squatted(start, port)
        with pytest.raises(RunError, match="Address already in use"):
            launch(tmp_path, squatted, endpoints_at(f"tcp/127.0.0.1:{port}"))
    assert squatted.started == ["router"]
    assert squatted.server is not None
    with squatted.server, pytest.raises(BlockingIOError):
        squatted.server.accept()


def launch(
    folder: Path,
    starter: Starter,
    endpoints: RouterEndpoints | None = None,
    stop: threading.Event | None = None,
    scenario: Scenario | None = None,
    patience: int = 30,
) -> None:
    """Run the small scenario with this starter."""
    with contextlib.chdir(folder):
        launch_one(
            Launch(
                scenario or small_network(),
                folder / "run",
                "off",
                silent,
                stop or threading.Event(),
                starter,
                patience=patience,
                endpoints=endpoints,
            )
        )


@dataclass
class Silent:
    """A process that lives until it is told to end, and has written these lines."""

    pid: int
    stdout: IO[bytes] | None
    stdin: IO[bytes] | None = None
    over: threading.Event = field(default_factory=threading.Event)

    def poll(self) -> int | None:
        """Its status."""
        return 0 if self.over.is_set() else None

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end."""
        if not self.over.wait(timeout):
            raise subprocess.TimeoutExpired("silent", timeout or 0.0)
        return 0

    def send_signal(self, sig: int) -> None:
        """Only the end is obeyed."""

    def terminate(self) -> None:
        """End."""
        self.over.set()

    kill = terminate


@dataclass
class Routers:
    """Starts routers that write these lines and live, and other processes that end at once."""

    lines: Mapping[str, bytes]
    started: list[str] = field(default_factory=list)
    stop: threading.Event | None = None

    def __call__(self, role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:  # noqa: ARG002 - nothing is run
        """Start one."""
        self.started.append(brief.stem)
        number = len(self.started)
        if role in ("router", "relay"):
            if self.stop is not None:
                self.stop.set()
            return Silent(number, BytesIO(self.lines.get(role, b"")))
        return Ended(number, BytesIO() if role == "recorder" else None, None, 2)


TWO = "tls/127.0.0.1:1", None, "tls/127.0.0.1:2"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("lines", "started"),
    mostly_long(
        [
            ({}, ["router"]),
            ({"router": b"noise\n"}, ["router"]),
            ({"router": RouterListens("relay").line}, ["router"]),
            ({"router": b'{"event": "over"}\n'}, ["router"]),
            ({"router": RouterListens("router").line}, ["router", "relay"]),
        ],
        [
            ({"router": RouterListens("relay").line}, ["router"]),
            ({"router": RouterListens("router").line}, ["router", "relay"]),
        ],
    ),
)
def test_no_process_starts_before_the_routers_say_that_they_listen(
    lines: Mapping[str, bytes], started: list[str], tmp_path: Path
) -> None:
    """In a run with two, the relay after the router, and all others after the relay; nothing else counts as their word."""
    routers = Routers(lines)
    with pytest.raises(RunError, match=f"{started[-1]} did not listen within"):
        launch(tmp_path, routers, endpoints_at(*TWO), scenario=small_network(network={"routers": 2}), patience=1)
    assert routers.started == started


def test_the_processes_start_once_the_routers_listen(tmp_path: Path) -> None:
    """All of them, the recorder last."""
    routers = Routers({name: RouterListens(name).line for name in ("router", "relay")})
    with pytest.raises(RunError):
        launch(tmp_path, routers, endpoints_at(*TWO), scenario=small_network(network={"routers": 2}))
    assert routers.started[:2] == ["router", "relay"]
    assert routers.started[-1] == "recorder"
    assert len(routers.started) > 4


def test_a_signal_ends_the_wait_for_a_router(tmp_path: Path) -> None:
    """At once, although the router says nothing."""
    stop = threading.Event()
    routers = Routers({}, stop=stop)
    with pytest.raises(Interrupted):
        launch(tmp_path, routers, stop=stop)
    assert routers.started == ["router"]


def test_a_socket_is_refused_in_a_folder_that_others_can_enter(tmp_path: Path) -> None:
    """A router that found its folder opened would listen where others can take its place."""
    tmp_path.chmod(0o700)
    SocketEndpoint(tmp_path / "router").try_to_listen()
    for mode in (0o710, 0o701, 0o755):
        tmp_path.chmod(mode)
        with pytest.raises(PermissionError, match="other users can enter"):
            SocketEndpoint(tmp_path / "router").try_to_listen()


@pytest.mark.parametrize("length", [60, 140])
def test_a_long_or_odd_temporary_folder_has_its_sockets_elsewhere(
    length: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The briefs stay where the user wants temporary files; the socket is in a private folder of its own, and goes with it."""
    with private_folder(tmp_path) as private, socket_folder(private) as near:
        pass
    del near
    folder = tmp_path / ("x" * (length - 1) if length > 100 else "a#b")
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    with private_folder() as private, socket_folder(private) as sockets:
        assert private.parent == folder
        assert sockets.parent == Path("/tmp")  # noqa: S108 - what is tested
        assert stat.S_IMODE(sockets.stat().st_mode) == 0o700
        assert isinstance(endpoint_in(f"unixsock-stream/{sockets}/router"), SocketEndpoint)
    assert not sockets.exists()


@pytest.mark.long
def test_a_run_with_a_long_temporary_folder(evedrop: Evedrop) -> None:
    """It runs, and leaves nothing in either folder."""
    folder = evedrop.folder / ("x" * 120)
    folder.mkdir()
    environment = {**evedrop.environment, "TMPDIR": str(folder)}
    done = evedrop.process("run", "eavesdroppers", "--slots", "50", "--view", "off", "--out", "run", env=environment)
    assert done.status == 0, done.err
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("text", ["unixsock-stream/router", "unixsock-stream//a?b", f"unixsock-stream//{'x' * 103}"])
def test_malformed_sockets_are_refused(text: str) -> None:
    """A relative path, a character that Zenoh takes for the end of the path, a path that no socket can have."""
    with pytest.raises(ValueError, match="names no socket"):
        endpoint_in(text)
    assert isinstance(endpoint_in("unixsock-stream//" + "x" * 102), SocketEndpoint)
    assert isinstance(endpoint_in("tcp/127.0.0.1:7447"), Endpoint)


@pytest.mark.thorough
def test_a_port_without_certificates_is_said_to_be_exposed(evedrop: Evedrop) -> None:
    """`brief` and `run` say who can do what, and what to give instead; with certificates they say nothing."""
    port = free_port()
    message = (
        f"evedrop: warning: tcp/127.0.0.1:{port} is not encrypted, and a user of this machine who listens there before"
    )
    for words in (("brief",), ("run", "--slots", "50", "--view", "off")):
        name, *rest = words
        done = evedrop(name, "eavesdroppers", *rest, "--out", name, "--listen", f"tcp/127.0.0.1:{port}")
        assert message in done.err
        assert f"give tls/127.0.0.1:{port}" in done.err
    assert evedrop("brief", "eavesdroppers", "--out", "safe").err == ""
    assert json.loads((evedrop.folder / "safe" / "sensor.json").read_text())["router"].startswith("tls/127.0.0.1:")
