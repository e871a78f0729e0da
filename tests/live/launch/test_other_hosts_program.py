"""The program that starts processes on a host for a launcher on another one."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import pytest

from evedrop.live.launch.other_hosts import HostProcesses, LogText, ProcessEnded, SendSignal, StartProcess, answer_in
from evedrop.live.launch.starter import FORK_SERVER_LOST, StartedProcess
from evedrop.live.protocol.brief import brief_from
from evedrop.live.protocol.last_word import Cause, LastWord
from tests.conftest import LIMIT, Evedrop, wait_until
from tests.examples import mostly_long
from tests.live.network.bench import brief_of_eve

ORDER = StartProcess(7, brief_of_eve().entries, {})


def unable(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
    """A starter on a system that has no process to spare."""
    raise OSError(11, "Resource temporarily unavailable")


class Process:
    """A process that runs until it is told to end."""

    pid, stdin, stdout = 1, None, None

    def __init__(self) -> None:
        self.over = threading.Event()

    def poll(self) -> int | None:
        """Its status."""
        return -signal.SIGTERM if self.over.is_set() else None

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end."""
        assert self.over.wait(LIMIT if timeout is None else timeout)
        return -signal.SIGTERM

    def send_signal(self, sig: int) -> None:
        """Only the signal that ends it has an effect."""
        if sig == signal.SIGTERM:
            self.over.set()

    def terminate(self) -> None:
        """End it."""
        self.send_signal(signal.SIGTERM)

    kill = terminate


def test_a_process_has_its_files_in_the_private_folder(tmp_path: Path) -> None:
    """Its brief, its state, its last word and its temporary files; its log and its end are sent."""
    started: list[tuple[dict[str, Any], Mapping[str, str], int]] = []
    sent: list[bytes] = []

    def start(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        assert (role, brief) == ("eavesdropper", tmp_path / "eve.json")
        started.append((json.loads(brief.read_text()), environment, brief.stat().st_mode & 0o777))
        log.write(b"a line\n")
        return Process()

    host = HostProcesses(tmp_path, start, sent.append)
    eve = brief_of_eve(state_file="/launcher/eve.state", outages=[(3, 5, True)])
    given = replace(eve, last_word="/launcher/eve.last-word")
    word = LastWord(Cause.NO_CONNECTION, "why")
    word.leave(tmp_path / "eve.last-word")  # of an earlier start
    host.obey(StartProcess(7, given.entries, {"TMPDIR": "/launcher", "A": "1"}))
    ((brief, environment, mode),) = started
    assert brief["part"]["state_file"] == str(tmp_path / "eve.state")
    assert brief["last_word"] == str(tmp_path / "eve.last-word")
    assert not Path(brief["last_word"]).exists()
    word.leave(brief["last_word"])
    assert brief_from(brief).keys == given.keys
    assert (environment["TMPDIR"], environment["A"], mode) == (str(tmp_path), "1", 0o600)
    wait_until(lambda: b"".join(sent).endswith(b"\n"), "the log")
    host.obey(SendSignal(7, signal.SIGTERM))
    wait_until(lambda: b"".join(sent).count(b"\n") == 2, "the end")
    assert [answer_in(line) for line in b"".join(sent).splitlines()] == [
        LogText(7, "a line\n"),
        ProcessEnded(7, -15, word),
    ]


def test_what_the_program_itself_ends_is_not_reported(tmp_path: Path) -> None:
    """The launcher would take it for the failure of a process; it learns of it by the end of the connection."""
    sent: list[bytes] = []
    process = Process()

    host = HostProcesses(tmp_path, lambda *_: process, sent.append)
    before = threading.active_count()
    host.obey(ORDER)
    host.end()
    assert process.over.is_set()
    wait_until(lambda: threading.active_count() == before, "the thread that follows the process has ended")
    assert sent == []


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="reads /proc")
@pytest.mark.parametrize(("folder", "why"), [("", "Resource temporarily unavailable"), ("gone", "No such file")])
def test_a_process_that_cannot_be_started_is_reported(folder: str, why: str, tmp_path: Path) -> None:
    """The launcher gets the reason for the log, and an end; the host goes on, and no file stays open."""
    sent: list[bytes] = []

    host = HostProcesses(tmp_path / folder, unable, sent.append)
    before = os.listdir("/proc/self/fd")
    host.obey(ORDER)
    assert os.listdir("/proc/self/fd") == before
    log, end = (answer_in(line) for line in sent)
    assert isinstance(log, LogText)
    assert log.number == 7
    assert log.written.startswith("evedrop: eve cannot be started (")
    assert why in log.written
    assert end == ProcessEnded(7, 1)
    host.end()


@pytest.mark.parametrize("number", [errno.ESRCH, errno.ETIMEDOUT])
def test_a_process_whose_fork_server_is_gone_is_reported_as_lost_with_it(number: int, tmp_path: Path) -> None:
    """The launcher then names the host, and not the process alone."""
    sent: list[bytes] = []

    def start(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        raise OSError(number, "its fork server is gone")

    HostProcesses(tmp_path, start, sent.append).obey(ORDER)
    assert answer_in(sent[-1]) == ProcessEnded(7, FORK_SERVER_LOST)


MALFORMED = (b"no order", b'{"kind": "start"}', b"[" * 100_000, b'{"kind": "signal", "number": -1, "signal": 9}')


@pytest.mark.parametrize("order", mostly_long(MALFORMED, MALFORMED[-1:]))
def test_a_malformed_order_ends_the_program_with_a_sentence(evedrop: Evedrop, order: bytes) -> None:
    """With the status of a run that failed, and without a traceback; nothing is left."""
    words = [sys.executable, "-m", "evedrop", "host"]
    done = subprocess.run(
        words, input=order + b"\n", capture_output=True, env=evedrop.environment, timeout=LIMIT, check=False
    )
    assert done.returncode == 3
    (line,) = done.stderr.decode().splitlines()
    assert line.startswith("evedrop: the launcher gave an order that cannot be carried out (")
    assert [*evedrop.temporary.iterdir()] == []


def test_a_malformed_brief_names_the_entry(tmp_path: Path) -> None:
    """And nothing is started."""
    with pytest.raises(ValueError, match="role is None, expected one of router, relay"):
        HostProcesses(tmp_path, unable, len).obey(StartProcess(7, {}, {}))
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("name", ["../eve", "/etc/eve"])
def test_a_brief_is_written_only_into_the_folder_of_the_run(name: str, tmp_path: Path) -> None:
    """The launcher's name of a process is not a path."""
    order = StartProcess(7, {**ORDER.brief, "process": name}, {})
    (tmp_path / "private").mkdir()
    with pytest.raises(ValueError, match=r"matching regex .* at `\$\.process`"):
        HostProcesses(tmp_path / "private", unable, len).obey(order)
    assert [path.name for path in tmp_path.rglob("*")] == ["private"]
