"""A run whose processes are started over ssh, on loopback: the same digests, no secret on a wrong host, and nothing left behind.

A folder for temporary files stands for each host: every process there has it in its environment.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import ScenarioError, UsageError
from evedrop.live.launch.hosts_file import load_hosts
from evedrop.live.launch.launcher import launch
from evedrop.live.launch.other_hosts import (
    LauncherHeartbeat,
    StartProcess,
    greeting_in,
    line_of,
    order_in,
    ssh_command,
    trial_command,
)
from evedrop.scenario.loading import load
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import NetworkTable
from evedrop.system.ports import free_port
from tests.builders import digests_of, places_of
from tests.conftest import LIMIT, Evedrop, Live, wait_until, with_mark
from tests.examples import mostly_long
from tests.golden.pages import Golden
from tests.privileged import CannotRun, skip
from tests.processes import parent_of
from tests.sshd import Sshd, sshd

ENDLESS = ("--slots", "1000000", "--pace", "0.002")
OURS = shlex.join([sys.executable, "-m", "evedrop"])
PLACES = {"alpha": ("router", "sensor", "legitimate", "smart"), "beta": ("naive",)}
"""Host → its processes. The scenario gives the schedule to the receiver `smart`, and not to `naive`."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sshd]:
    """An sshd for all tests of this module."""
    try:
        with sshd(tmp_path_factory.mktemp("sshd")) as server:
            yield server
    except CannotRun as error:
        skip(error)


def temporary(evedrop: Evedrop, host: str) -> Path:
    """The folder for temporary files of a host."""
    folder = evedrop.temporary / host
    folder.mkdir(exist_ok=True)
    return folder


def hosts(evedrop: Evedrop, server: Sshd, command: str = OURS, port: int | None = None, direct: bool = False) -> Path:
    """A file of two hosts, both of which are this one; all that each receives is kept in its folder, unless `direct`."""
    text = [f'ssh_config = "{server.config}"', "[router]", f'listen = "tls/127.0.0.1:{free_port()}"']
    for host, processes in PLACES.items():
        script = evedrop.folder / f"{host}.sh"
        received = shlex.quote(str(evedrop.folder / f"{host}.received"))
        runs = f"exec {command}" if direct else f"tee {received} | {command}"
        script.write_text(f'export TMPDIR={shlex.quote(str(temporary(evedrop, host)))}\n{runs} "$@"\n')
        text += [f"[hosts.{host}]", 'address = "127.0.0.1"', f"processes = {json.dumps(processes)}"]
        text += [f'command = ["sh", {json.dumps(str(script))}]', f"port = {port or server.port}"]
    path = evedrop.folder / "hosts.toml"
    path.write_text("\n".join(text))
    return path


def nothing_left(evedrop: Evedrop) -> None:
    """No process and no file of a process is left on any host."""
    wait_until(lambda: not with_mark(str(evedrop.temporary)), "no process left on any host")
    assert sorted(path.name for path in evedrop.temporary.rglob("*")) == sorted(PLACES)


@pytest.mark.thorough
def test_over_ssh_it_is_the_same_run(evedrop: Evedrop, server: Sshd) -> None:
    """Receivers are killed, started again and paused; each host gets what its own processes may know, and not the schedule."""
    changes = ("--trials", "3", "--set", "event.1.state=last", "--set", "expect=[]")
    path = hosts(evedrop, server)
    done = evedrop("run", "restart", *changes, "--hosts", str(path), "--view", "off", "--out", "run")
    assert done.status == 0, done.err
    nothing_left(evedrop)
    assert evedrop("montecarlo", "restart", *changes, "--out", "memory").status == 0
    assert digests_of(evedrop.folder / "run") == digests_of(evedrop.folder / "memory")
    logs = {log.stem for log in (evedrop.folder / "run" / "logs").iterdir()}
    assert logs == {"router", "sensor", "legitimate", "smart", "naive", "recorder"}
    secret = [key.hex() for key in StreamKeys.from_scenario(load("restart")).secret(("schedule", "noise")).values()]
    received = {host: (evedrop.folder / f"{host}.received").read_text() for host in PLACES}
    assert all(key in received["alpha"] and key not in received["beta"] for key in secret)
    assert "schedule" in received["alpha"]
    assert "schedule" not in received["beta"]
    for host, text in received.items():
        orders = [order_in(line.encode()) for line in text.splitlines()]
        assert {order.brief["process"] for order in orders if isinstance(order, StartProcess)} == set(PLACES[host])


def running(evedrop: Evedrop, server: Sshd, direct: bool = False) -> Live:
    """A run in progress that does not end by itself; direct: as for `hosts`."""
    words = ("--set", "event=[]", "--set", "expect=[]", "--hosts", str(hosts(evedrop, server, direct=direct)))
    live = evedrop.live("restart", *ENDLESS, *words)
    live.running()
    return live


@pytest.mark.thorough
def test_ctrl_c_ends_everything_on_all_hosts(evedrop: Evedrop, server: Sshd) -> None:
    """The results so far are here."""
    live = running(evedrop, server)
    live.process.send_signal(signal.SIGINT)
    assert live.end().status == 130
    nothing_left(evedrop)
    assert live.results.slots.num_rows > 0


def struck(evedrop: Evedrop, case: str, number: signal.Signals) -> None:
    """Send a signal to the program on the host beta, its fork server, or the ssh that is connected with it."""
    mark = evedrop.folder / "beta.sh" if case == "ssh" else temporary(evedrop, "beta")
    word = "evedrop.fork_server" if case == "fork server" else "host"
    (pid,) = (pid for pid, command in with_mark(str(mark)).items() if word in command.split())
    os.kill(pid, number)


@pytest.mark.long
@pytest.mark.parametrize("case", ["evedrop host", "ssh"])
def test_ctrl_c_ends_a_run_whose_connection_hangs(case: str, evedrop: Evedrop, server: Sshd) -> None:
    """The host reports no end; once the connection is closed, the system continues it, and it ends its processes."""
    live = running(evedrop, server, direct=True)
    struck(evedrop, case, signal.SIGSTOP)
    live.process.send_signal(signal.SIGINT)
    done = live.end()
    assert done.status == 130, done.err
    nothing_left(evedrop)
    assert live.results.slots.num_rows > 0


@pytest.mark.long
@pytest.mark.parametrize("case", ["evedrop host", "ssh"])
def test_a_killed_launcher_leaves_nothing_where_a_connection_hangs(case: str, evedrop: Evedrop, server: Sshd) -> None:
    """The system ends ssh with the launcher; it would wait for a suspended host, or is suspended itself."""
    live = running(evedrop, server, direct=True)
    struck(evedrop, case, signal.SIGSTOP)
    live.process.kill()
    live.process.wait()
    nothing_left(evedrop)


@pytest.mark.long
def test_a_killed_launcher_leaves_nothing_on_any_host(evedrop: Evedrop, server: Sshd) -> None:
    """Its connections close, and the hosts end their processes; even one that is paused."""
    live = running(evedrop, server)
    paused = live.child("smart")
    os.kill(paused, signal.SIGSTOP)
    live.process.kill()
    live.process.wait()
    nothing_left(evedrop)


@pytest.mark.long
def test_a_host_that_dies_in_the_middle_is_named(evedrop: Evedrop, server: Sshd) -> None:
    """After kill -9 of its connection's server, the run ends, the message names process and host, and the results are kept."""
    live = running(evedrop, server)
    ours = [pid for pid, command in with_mark(str(temporary(evedrop, "beta"))).items() if command.split()[-1] == "host"]
    above = [ours[0]]
    while above[-1] != server.process.pid:
        above.append(parent_of(above[-1]))
    # Where sshd gives up its rights there are two for each connection, and either of them would keep it open.
    serving = [pid for pid in above[:-1] if Path(f"/proc/{pid}/comm").read_text().startswith("sshd")]
    assert serving
    for pid in serving:
        with suppress(ProcessLookupError):  # the second may end with the first
            os.kill(pid, signal.SIGKILL)
    done = live.end()
    assert done.status == 3
    assert "the connection with host beta ended" in done.err
    assert done.err.startswith("evedrop: naive was lost"), done.err
    nothing_left(evedrop)
    assert live.results.slots.num_rows > 0
    assert "host beta" in live.results.summary["ended"]


ENDS = {
    "evedrop host": (signal.SIGTERM, "the connection with host beta ended: "),
    "fork server": (signal.SIGKILL, "the fork server on host beta ended or stopped responding"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", mostly_long(ENDS, ["evedrop host"]))
def test_a_host_whose_program_ends_is_named(case: str, evedrop: Evedrop, server: Sshd) -> None:
    """And no process there is said to have been ended by a signal."""
    live = running(evedrop, server, direct=True)
    struck(evedrop, case, ENDS[case][0])
    done = live.end()
    assert done.status == 3
    assert done.err.startswith(f"evedrop: naive was lost: {ENDS[case][1]}"), done.err
    nothing_left(evedrop)


def nobody_listens(evedrop: Evedrop, server: Sshd) -> Path:
    """Hosts at a port where no sshd listens."""
    return hosts(evedrop, server, port=free_port())


def no_such_key(evedrop: Evedrop, server: Sshd) -> Path:
    """Hosts whose sshd does not know the key."""
    path = hosts(evedrop, server)
    config = evedrop.folder / "client"
    config.write_text(server.config.read_text().replace(f"{server.folder}/user", str(evedrop.folder / "none")))
    path.write_text(path.read_text().replace(str(server.config), str(config)))
    return path


def no_program(evedrop: Evedrop, server: Sshd) -> Path:
    """Hosts without Evedrop."""
    path = hosts(evedrop, server)
    path.write_text(re.sub(r"(?m)^command = .*$", 'command = ["/nowhere/evedrop"]', path.read_text()))
    return path


def other_version(evedrop: Evedrop, server: Sshd) -> Path:
    """Hosts with another version of Evedrop."""
    return hosts(evedrop, server, """(echo Welcome; echo '{"evedrop": "0.0.9"}'; exec cat >/dev/null) #""")


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (nobody_listens, "Connection refused"),
        (no_such_key, "Permission denied"),
        pytest.param(no_program, "/nowhere/evedrop", marks=pytest.mark.long),
        (other_version, "evedrop 0.0.9 is installed there"),
    ],
)
def test_a_host_that_cannot_be_used_is_named(
    made: Callable[[Evedrop, Sshd], Path], message: str, evedrop: Evedrop, server: Sshd
) -> None:
    """One line with its name and the reason, exit status 2; nothing is started, and there are no results."""
    done = evedrop("run", "restart", "--hosts", str(made(evedrop, server)), "--view", "off", "--out", "run")
    assert done.status == 2
    assert done.err.startswith("evedrop: host alpha: ")
    assert message in done.err
    assert done.err.count("\n") == 1
    nothing_left(evedrop)
    assert not (evedrop.folder / "run").exists()


WRONG = """
[router]
listen = "tcp/0.0.0.0:7447"
[hosts.alpha]
address = "-oProxyCommand=x"
port = 0
processes = ["router"]
speed = 3
command = "evedrop"
"""
UNFIT = """
[router]
listen = "tcp/0.0.0.0:7447"
connect = "tcp/alpha.lan:7447"
[relay]
listen = "tls/beta.lan:7447"
[hosts.alpha]
address = "alpha.lan"
processes = ["router", "smrt", "recorder"]
[hosts.beta]
address = "beta.lan"
processes = ["router"]
"""


@pytest.mark.parametrize(
    ("text", "places"),
    [
        (WRONG, ["hosts.alpha.address", "hosts.alpha.port", "hosts.alpha.command", "hosts.alpha.speed"]),
        (UNFIT, ["hosts.alpha.processes", "hosts.alpha.processes", "hosts.beta.processes", "router.listen", "relay"]),
    ],
    ids=["wrong", "unfit"],
)
def test_mistakes_in_the_file_are_all_listed(text: str, places: list[str], tmp_path: Path, golden: Golden) -> None:
    """Each with its line."""
    (tmp_path / "hosts.toml").write_text(text)
    with pytest.raises(ScenarioError) as error:
        load_hosts(tmp_path / "hosts.toml", load("restart"))
    assert places_of(error.value.mistakes) == places
    golden("run", error.value.mistakes)


NO_CLASSES = """
[router]
listen = "tls/alpha.lan:7447"
[hosts.alpha]
address = "alpha.lan"
processes = ["router"]
[hosts.beta]
address = "beta.lan"
processes = ["smart"]
modules = "/srv/classes"
"""


@pytest.mark.parametrize(
    ("changes", "place"),
    [({"network": NetworkTable(routers=2)}, "relay"), ({"modules": "/srv/here"}, "hosts.alpha.modules")],
    ids=["relay", "modules"],
)
def test_what_the_scenario_needs_is_missed(changes: dict[str, Any], place: str, tmp_path: Path, golden: Golden) -> None:
    """A second router, and a folder of classes on every host."""
    (tmp_path / "hosts.toml").write_text(NO_CLASSES)
    with pytest.raises(ScenarioError) as error:
        load_hosts(tmp_path / "hosts.toml", load("restart").model_copy(update=changes))
    assert places_of(error.value.mistakes) == [place]
    golden("run", error.value.mistakes)


def test_a_configuration_of_ssh_is_beside_the_file(tmp_path: Path) -> None:
    """Wherever the command is called."""
    (tmp_path / "hosts.toml").write_text(f'ssh_config = "ssh/config"\n{NO_CLASSES}')
    assert load_hosts(tmp_path / "hosts.toml", load("restart")).ssh_config == tmp_path / "ssh" / "config"
    (tmp_path / "hosts.toml").write_text(NO_CLASSES)
    assert load_hosts(tmp_path / "hosts.toml", load("restart")).ssh_config is None


def test_a_host_has_a_plain_name(tmp_path: Path) -> None:
    """It is part of sentences and of paths in mistakes."""
    (tmp_path / "hosts.toml").write_text(NO_CLASSES.replace("hosts.beta", 'hosts."Beta 1"'))
    with pytest.raises(ScenarioError) as error:
        load_hosts(tmp_path / "hosts.toml", load("restart"))
    (mistake,) = error.value.mistakes
    assert "expected a name of a lower-case letter" in mistake


def test_what_ssh_is_given_never_asks_and_has_no_secret(tmp_path: Path) -> None:
    """A host's table determines every word of the command line."""
    (tmp_path / "hosts.toml").write_text(
        '[router]\nlisten = "tls/alpha.lan:7447"\n[hosts.beta]\naddress = "beta.lan"\nuser = "lab"\nport = 2222\n'
        'processes = ["smart"]\nfolder = "/a b"\ncommand = ["/opt/my env/evedrop"]\n'
    )
    plan = load_hosts(tmp_path / "hosts.toml", load("restart"))
    words = ssh_command(plan.hosts["beta"], plan.ssh_config, 30.0)
    assert words[0] == "ssh"
    for option in ("BatchMode=yes", "ControlPath=none"):
        assert words[words.index(option) - 1] == "-o"
    assert words[-7:] == ["-l", "lab", "-p", "2222", "--", "beta.lan", "cd '/a b' && exec '/opt/my env/evedrop' host"]
    trial = trial_command(plan.hosts["beta"], tmp_path / "config")
    there = "cd '/a b' && exec '/opt/my env/evedrop' --version"
    assert trial == ["ssh", "-F", str(tmp_path / "config"), "-l", "lab", "-p", "2222", "beta.lan", there]


@pytest.mark.parametrize("longest_outage", [1.0, 3.0, 5.0, 7.5, 11.0, 30.0, 100.0])
def test_ssh_gives_up_soon_after_what_is_tolerated(longest_outage: float, tmp_path: Path) -> None:
    """Four fifths of the longest outage, as docs/hosts.md says, and at most two questions more; if it is long, before its end."""
    (tmp_path / "hosts.toml").write_text(NO_CLASSES)
    table = next(iter(load_hosts(tmp_path / "hosts.toml", load("restart")).hosts.values()))
    words = ssh_command(table, None, longest_outage)
    options = dict(word.split("=") for word in words if word.startswith("ServerAlive"))
    interval, most = int(options["ServerAliveInterval"]), int(options["ServerAliveCountMax"])
    assert 0.8 * longest_outage <= most * interval
    assert (most + 1) * interval <= 0.8 * longest_outage + 2.0


@pytest.mark.thorough
def test_ssh_waits_until_the_next_question_is_due(server: Sshd) -> None:
    """It does not give up as soon as its last question is without an answer: simulated hosts rely on it."""
    most = 2
    options = ("ServerAliveInterval=1", f"ServerAliveCountMax={most}")
    ssh = subprocess.Popen(
        ["ssh", "-F", server.config, *(word for option in options for word in ("-o", option)), "-p", str(server.port),
         server.address, "echo there; exec sleep 600"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert ssh.stdout is not None
    assert ssh.stdout.readline() == b"there\n"
    begun, sessions = time.monotonic(), server.sessions()
    for session in sessions:
        os.kill(session, signal.SIGSTOP)
    try:
        errors = ssh.communicate(timeout=LIMIT)[1]
    finally:
        for session in reversed(sessions):
            os.kill(session, signal.SIGKILL)
    assert b"not responding" in errors
    assert time.monotonic() - begun > most


@pytest.mark.long
def test_ctrl_c_while_a_host_does_not_answer_ends_at_once(evedrop: Evedrop, server: Sshd) -> None:
    """A host that accepts the connection and says nothing: status 130, and no ssh is left."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        path = hosts(evedrop, server, port=silent.getsockname()[1])
        live = evedrop.live("restart", "--hosts", str(path))
        connection, _ = silent.accept()
        live.process.send_signal(signal.SIGINT)
        done = live.end()
        connection.close()
    assert done.status == 130
    assert "nothing was started" in done.err
    nothing_left(evedrop)
    assert not (evedrop.folder / "run").exists()


def test_a_host_ends_when_its_launcher_is_silent(evedrop: Evedrop) -> None:
    """It ends although its standard input is still open."""
    host = evedrop.start(["-m", "evedrop"], ("host",), {"stdin": subprocess.PIPE})
    assert host.stdin is not None
    assert host.stdout is not None
    assert host.stdout.readline() == "\n", "a login shell may have printed a line without its end"
    assert greeting_in(host.stdout.readline().encode()).evedrop == version("evedrop")
    host.stdin.write(line_of(LauncherHeartbeat(0.2)).decode())
    host.stdin.flush()
    assert host.wait(LIMIT) == 130
    for stream in (host.stdin, host.stdout, host.stderr):
        assert stream is not None
        stream.close()
    assert list(evedrop.temporary.iterdir()) == []


def test_a_router_without_certificates_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On hosts as on one machine; here nothing is started, for there is no ssh."""
    (tmp_path / "hosts.toml").write_text(
        '[router]\nlisten = "tcp/127.0.0.1:7447"\n[hosts.beta]\naddress = "beta.lan"\nprocesses = ["smart"]\n'
    )
    scenario = load("restart")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match="ssh cannot be started"):
        launch(
            scenario,
            tmp_path / "run",
            "off",
            None,
            lambda _: None,
            hosts=load_hosts(tmp_path / "hosts.toml", scenario),
        )
    assert "tcp/127.0.0.1:7447 is not encrypted" in capsys.readouterr().err
