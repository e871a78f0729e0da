"""The launcher's side of a connection with a host; a script stands for ssh."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import RunError, UsageError
from evedrop.live.launch import other_hosts
from evedrop.live.launch.hosts_file import HostTable
from evedrop.live.launch.other_hosts import (
    MOST_NOISE,
    Greeting,
    HostedProcess,
    LauncherHeartbeat,
    LogText,
    Order,
    ProcessEnded,
    SshHost,
    StartProcess,
    answer_in,
    line_of,
    order_in,
    own_version,
)
from evedrop.live.launch.starter import CONNECTION_LOST, FORK_SERVER_LOST
from evedrop.live.protocol.brief import brief_from
from evedrop.live.protocol.last_word import Cause, LastWord, last_word_file, read_last_word
from evedrop.system.environment import own_environment
from evedrop.system.ssh_client import SystemSsh
from tests.conftest import LIMIT, wait_until
from tests.live.network.bench import brief_of_eve

GREETING = line_of(Greeting(own_version())).decode().strip()
Connect = Callable[..., SshHost]


@pytest.fixture
def connect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Connect:
    """Begin a connection; the script says these lines, keeps all that it is told, and ends with its standard input."""
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=":")

    def begin(*lines: str, warning: str = "", **table: Any) -> SshHost:
        (tmp_path / "bin").mkdir()
        (tmp_path / "told").touch()
        (tmp_path / "said").write_text("".join(f"{line}\n" for line in lines))
        script = tmp_path / "bin" / "ssh"
        script.write_text(
            f"#!/bin/sh\nprintf '{warning}' >&2\ncat '{tmp_path}/said'\nexec cat 3>&1 >'{tmp_path}/told'\n"
        )
        script.chmod(0o700)
        return SshHost("beta", HostTable(address="beta.lan", processes=("smart",), **table), None, 30.0)

    return begin


def ready(host: SshHost) -> None:
    """Wait until the host has answered."""
    host.wait_until_ready(time.monotonic() + LIMIT, threading.Event())


def told(folder: Path) -> list[Order]:
    """What the host has been told."""
    return [order_in(line) for line in (folder / "told").read_bytes().splitlines()]


def test_a_host_gets_the_brief_and_what_differs_from_its_own_environment(connect: Connect, tmp_path: Path) -> None:
    """No brief stays on disk here, and classes are in the folder there; with the connection its processes are lost."""
    host = connect(GREETING, modules="/srv/classes")
    ready(host)
    brief = brief_of_eve(modules="/srv/here")
    path, log = brief.write(tmp_path), tmp_path / "eve.log"
    with log.open("wb") as file:
        process = host.start(7, path, file, {**own_environment(), "OMP_NUM_THREADS": "one"})
    assert not path.exists()
    assert process.poll() is None
    host.close(time.monotonic() + LIMIT)
    (order,) = (order for order in told(tmp_path) if isinstance(order, StartProcess))
    assert brief_from(order.brief).text == brief.text.replace("/srv/here", "/srv/classes")
    assert (order.number, order.environment) == (7, {"OMP_NUM_THREADS": "one"})
    assert process.wait(LIMIT) == CONNECTION_LOST
    assert log.read_text() == "evedrop: the connection with host beta ended: ssh ended with status 0\n"


def test_a_brief_without_classes_gets_no_folder_of_classes(connect: Connect, tmp_path: Path) -> None:
    """It has no use for it."""
    host = connect(GREETING, modules="/srv/classes")
    ready(host)
    path = brief_of_eve().write(tmp_path)
    with (tmp_path / "eve.log").open("wb") as file:
        host.start(7, path, file, {})
    host.close(time.monotonic() + LIMIT)
    (order,) = (order for order in told(tmp_path) if isinstance(order, StartProcess))
    assert brief_from(order.brief).part == brief_of_eve().part


def test_a_process_whose_fork_server_is_gone_is_lost_with_its_host(connect: Connect, tmp_path: Path) -> None:
    """Its log names the host. A process that is to be started on a host that is gone names it, too, as a failure of the run."""
    host = connect(GREETING)
    ready(host)
    word = last_word_file(tmp_path, "eve")
    path, log = replace(brief_of_eve(), last_word=str(word)).write(tmp_path), tmp_path / "eve.log"
    with log.open("wb") as file:
        process = host.start(7, path, file, {})
        host._take(answer_in(line_of(ProcessEnded(7, FORK_SERVER_LOST))))
        assert process.poll() == CONNECTION_LOST
        assert log.read_text().startswith("evedrop: the fork server on host beta ended or stopped responding")
        left = read_last_word(word)
        assert left is not None
        assert log.read_text() == f"evedrop: {left.sentence}\n"
        host.hang_up()
        wait_until(host._lost.is_set, "the end of the connection")
        with pytest.raises(RunError, match=r"^eve cannot be started: the connection with host beta ended: ssh ended"):
            host.start(8, brief_of_eve().write(tmp_path), file, {})
        host.close(time.monotonic() + LIMIT)


def test_the_last_word_of_a_process_there_is_read_here(connect: Connect, tmp_path: Path) -> None:
    """From the file in which a process of this machine would have left it."""
    host = connect(GREETING)
    ready(host)
    file, word = last_word_file(tmp_path, "eve"), LastWord(Cause.NO_CONNECTION, "no router", ("router",))
    with (tmp_path / "eve.log").open("wb") as log:
        process = host.start(7, replace(brief_of_eve(), last_word=str(file)).write(tmp_path), log, {})
    host._take(answer_in(line_of(ProcessEnded(7, 3, word))))
    assert process.poll() == 3
    assert read_last_word(file) == word
    host.close(time.monotonic() + LIMIT)


def test_half_a_character_is_written_as_its_number(connect: Connect, tmp_path: Path) -> None:
    """Rather than that it ends the connection; a last word with one is none."""
    host = connect(GREETING)
    ready(host)
    file, word = last_word_file(tmp_path, "eve"), LastWord(Cause.FAILURE, "why \ud800")
    with (tmp_path / "eve.log").open("wb") as log:
        process = host.start(7, replace(brief_of_eve(), last_word=str(file)).write(tmp_path), log, {})
    host._take(LogText(7, "half \ud800"))
    host._take(ProcessEnded(7, 3, word))
    assert process.poll() == 3
    assert (tmp_path / "eve.log").read_text() == "half \\ud800"
    assert read_last_word(file) is None
    host.close(time.monotonic() + LIMIT)


def test_what_a_login_shell_prints_is_passed_over(connect: Connect) -> None:
    """Up to a number of lines, even if they are JSON."""
    host = connect("Welcome", "7", "[1]", "{}", *["more"] * (MOST_NOISE - 5), GREETING)
    ready(host)
    host.close(time.monotonic() + LIMIT)


def test_a_host_that_only_talks_is_given_up(connect: Connect) -> None:
    """After that many lines."""
    host = connect(*["more"] * MOST_NOISE, GREETING)
    with pytest.raises(UsageError, match=r"^host beta: "):
        ready(host)
    host.close(time.monotonic() + LIMIT)


def test_a_warning_at_the_beginning_is_not_why_a_connection_ended(connect: Connect, tmp_path: Path) -> None:
    """What ssh says once the program runs is; before that, a warning may be."""
    host = connect(GREETING, warning="cannot change locale")
    ready(host)
    assert isinstance(host._ssh, SystemSsh)
    host._ssh.kill()
    wait_until(host._lost.is_set, "the end of the connection")
    assert host._ending() == "the connection with host beta ended: ssh ended with status -9"
    host.close(time.monotonic() + LIMIT)


def test_a_host_whose_program_does_not_begin_is_not_still_connecting(connect: Connect) -> None:
    """Its login shell may wait for something."""
    host = connect("Your password will expire.")
    wait_until(lambda: host._noisy, "the words of the login shell")
    with pytest.raises(UsageError, match=r"only its login shell has printed.*; try `ssh beta.lan evedrop --version`"):
        host.wait_until_ready(time.monotonic(), threading.Event())
    host.close(time.monotonic() + LIMIT)


def test_a_host_is_told_that_the_launcher_lives(
    connect: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From time to time; the order says how long it may wait for the next."""
    monkeypatch.setattr(other_hosts, "_BEAT_SECONDS", 0.01)
    host = connect(GREETING)
    ready(host)
    wait_until(lambda: len((tmp_path / "told").read_bytes().splitlines()) > 2, "three heartbeats")
    host.close(time.monotonic() + LIMIT)
    assert told(tmp_path)[:3] == [LauncherHeartbeat(600.0)] * 3


def test_an_ssh_that_takes_nothing_is_ended(connect: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A suspended one would keep the launcher waiting for room in the pipe, deaf to Ctrl-C."""
    monkeypatch.setattr("evedrop.live.launch.other_hosts._SEND_SECONDS", 0.2)
    host = connect(GREETING)
    ready(host)
    assert isinstance(host._ssh, SystemSsh)
    os.kill(host._ssh.process.pid, signal.SIGSTOP)
    path = brief_of_eve(modules="/srv/" + "x" * 1_000_000).write(tmp_path)
    with (tmp_path / "eve.log").open("wb") as file:
        process = host.start(7, path, file, {})
    assert process.wait(LIMIT) == CONNECTION_LOST
    host.close(time.monotonic() + LIMIT)


def test_a_launcher_without_memory_for_what_a_host_says_loses_its_processes(
    connect: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, also if there is none for a process's last word: it would wait for ever for a host that nobody listens to."""

    def refuse(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(other_hosts, "answer_in", refuse)
    monkeypatch.setattr(LastWord, "leave", refuse)
    host = connect(GREETING, GREETING)
    wait_until(host._lost.is_set, "the loss of the host")
    assert "there is not enough memory" in host._ending()
    with (tmp_path / "eve.log").open("wb") as log:
        process = HostedProcess(7, host, log, str(tmp_path / "last word"))
        process.lose(host._ending())
    assert process.poll() == CONNECTION_LOST
    host.close(time.monotonic() + LIMIT)
