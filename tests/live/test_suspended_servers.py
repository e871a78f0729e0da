"""Fork servers that are suspended for good, or killed: the run still ends, at any request or by itself, and leaves nothing."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest

from evedrop.errors import Interrupted
from evedrop.live.launch.starter import FORK_SERVER_LOST, ForkServer, PreloadedStarter, fork_servers
from evedrop.system.environment import own_environment
from tests.conftest import LIMIT, Evedrop, Live, cause_of, wait_until
from tests.examples import mostly_long
from tests.processes import parent_of

ENDLESS = ("--slots", "1000000")
WHICH = {"that of recorders": ["recorder"], "that of others": ["sensor"], "both": ["recorder", "sensor"]}
"""Fork servers → a process of each."""


def suspend(live: Live, which: str) -> list[int]:
    """Suspend fork servers of a run; returns them."""
    servers = [parent_of(live.child(name)) for name in WHICH[which]]
    for server in servers:
        os.kill(server, signal.SIGSTOP)
    return servers


@pytest.mark.long
@pytest.mark.parametrize(("which", "number"), [*((name, signal.SIGINT) for name in WHICH), ("both", signal.SIGTERM)])
def test_a_signal_ends_a_run_whose_fork_servers_are_suspended(
    evedrop: Evedrop, which: str, number: signal.Signals
) -> None:
    """They report no end, so the launcher asks the system, and gives them up."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    suspend(live, which)
    live.process.send_signal(number)
    done = live.end()
    assert done.status == 130, done.err
    assert done.err.splitlines() == ["evedrop: interrupted; the results so far are in run"]
    live.nothing_left()
    assert live.results.slots.num_rows > 0


@pytest.mark.long
def test_a_run_whose_fork_servers_are_suspended_completes(evedrop: Evedrop) -> None:
    """Nobody asks for its end: all its processes end by themselves, and it is complete."""
    live = evedrop.live("eavesdroppers", "--slots", "200", "--paused")
    live.held()
    suspend(live, "both")
    assert evedrop("resume", "run").status == 0
    done = live.end()
    assert (done.status, done.err) == (0, "")
    live.nothing_left()
    assert live.results.summary["ended"] == "complete"


def lives(pid: int) -> bool:
    """Whether a process runs or is suspended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in {"Z", "X"}
    except OSError:
        return False


@pytest.mark.long
@pytest.mark.parametrize("which", WHICH)
def test_a_suspended_fork_server_does_not_outlive_a_killed_launcher(evedrop: Evedrop, which: str) -> None:
    """The system continues it when its parent dies; it then finds its channel closed."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    servers = suspend(live, which)
    live.process.kill()
    live.process.wait(LIMIT)
    wait_until(lambda: not any(lives(server) for server in servers), "no fork server left")
    wait_until(lambda: not live.left(), "no process left of the run")
    assert list(live.temporary.iterdir()) == []


@pytest.mark.thorough
@pytest.mark.parametrize("which", mostly_long(["that of recorders", "that of others"], ["that of others"]))
def test_a_killed_fork_server_is_named_and_no_victim(evedrop: Evedrop, which: str) -> None:
    """Its processes are ended by the launcher: none of them is at fault."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    for server in suspend(live, which):
        os.kill(server, signal.SIGKILL)
    done = live.end()
    assert done.status == 3
    assert done.err.startswith("evedrop: the fork server of "), done.err
    assert ("recorder" in done.err.splitlines()[0]) == (which == "that of recorders")
    assert "was ended by signal" not in done.err
    live.nothing_left()
    assert cause_of(live.results.summary["ended"]) in done.err


def suspended(server: ForkServer, folder: Path) -> int:
    """Suspend a fork server; returns its process id."""
    with (folder / "log").open("wb") as log:
        process = server.start("sensor", folder / "no.json", log, own_environment())
    pid = parent_of(process.pid)
    assert process.wait(LIMIT) == 2
    assert process.stdin is not None
    process.stdin.close()
    os.kill(pid, signal.SIGSTOP)
    return pid


def cleaners(live: Live) -> dict[int, Path]:
    """The shells that remove the private folders of a run → their folders. There are two where a path is long."""
    commands = {pid: command.split() for pid, command in live.left().items() if "while read -r _" in command}
    assert commands
    return {pid: Path(words[-1]) for pid, words in commands.items()}


@pytest.mark.parametrize("how", mostly_long([signal.SIGINT, signal.SIGTERM, signal.SIGKILL], [signal.SIGKILL]))
def test_a_suspended_cleaner_keeps_nothing_from_ending_and_leaves_no_folder(
    evedrop: Evedrop, how: signal.Signals
) -> None:
    """Also if everything but the launcher is suspended, and the launcher killed: the system continues who has to end."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    folders = cleaners(live)
    assert all(folder.is_dir() for folder in folders.values())
    for pid in folders:
        os.kill(pid, signal.SIGSTOP)
    if how == signal.SIGKILL:
        suspend(live, "both")
    live.process.send_signal(how)
    status = live.end().status
    assert status == (-signal.SIGKILL if how == signal.SIGKILL else 130)
    wait_until(lambda: not live.left(), "no process left of the run")
    assert not any(folder.exists() for folder in folders.values())
    assert list(live.temporary.iterdir()) == []


@pytest.mark.long
def test_a_run_that_is_to_end_waits_for_no_fork_server(tmp_path: Path) -> None:
    """A suspended one starts nothing, and ends with the block."""
    stop = threading.Event()
    with fork_servers(["evedrop.cli.main"]) as servers:
        pid = suspended(servers[0], tmp_path)
        threading.Timer(0.1, stop.set).start()
        with (tmp_path / "log").open("wb") as log, pytest.raises(Interrupted):
            PreloadedStarter(servers).until(stop)("sensor", tmp_path / "no.json", log, own_environment())
        wait_until(lambda: not servers[0].alive, "a server that is given up")
    wait_until(lambda: not Path(f"/proc/{pid}").exists(), "no server left")


def test_a_fork_server_that_starts_nothing_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a time in which the slowest machine makes all imports."""
    with fork_servers(["evedrop.cli.main"]) as servers:
        suspended(servers[0], tmp_path)
        monkeypatch.setattr("evedrop.live.launch.starter._START_SECONDS", 0.5)
        with (tmp_path / "log").open("wb") as log, pytest.raises(OSError, match="did not respond"):
            servers[0].start("sensor", tmp_path / "no.json", log, own_environment())


@pytest.mark.long
def test_an_end_that_no_fork_server_reports_is_seen(tmp_path: Path) -> None:
    """The system says that the process has ended; how, only its parent could say."""
    with fork_servers(["evedrop.cli.main"]) as (server,):
        with (tmp_path / "log").open("wb") as log:
            process = server.start("sensor", tmp_path / "no.json", log, own_environment())
        os.kill(parent_of(process.pid), signal.SIGSTOP)
        process.kill()
        assert process.wait(LIMIT) in {FORK_SERVER_LOST, 2}  # 2: it had ended before
        assert process.stdin is not None
        process.stdin.close()


@pytest.mark.thorough
def test_ctrl_z_says_that_the_run_goes_on(evedrop: Evedrop) -> None:
    """Only the launcher stops, and the message names the command that pauses the run."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    live.process.send_signal(signal.SIGTSTP)
    stat = Path(f"/proc/{live.process.pid}/stat")
    wait_until(lambda: stat.read_text().rpartition(")")[2].split()[0] == "T", "a launcher that is suspended")
    live.process.send_signal(signal.SIGCONT)
    live.process.send_signal(signal.SIGINT)
    done = live.end()
    assert done.status == 130
    assert "the processes of the run go on" in done.err.splitlines()[0]
    assert "evedrop pause run" in done.err.splitlines()[0]
    live.nothing_left()
