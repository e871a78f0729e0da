"""Fork servers: each process of a run is a fork that has nothing of the launcher or of another process."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import mkdtemp

import pytest

from evedrop import preloaded
from evedrop.live.launch import starter
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import loopback_endpoints
from evedrop.live.launch.starter import (
    FORK_SERVER_LOST,
    StartedProcess,
    Starter,
    fork_servers,
    process_starter,
    start_process,
)
from evedrop.names import KERNELS_VARIABLE
from evedrop.system.environment import own_environment
from tests.conftest import LIMIT, wait_until
from tests.live.network.bench import small_network
from tests.processes import parent_of, words_of

OTHER_KERNELS = "" if os.environ.get(KERNELS_VARIABLE) == "numpy" else "numpy"


class Bench:
    """A router that runs, or a process whose brief is missing."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self.log = folder / "log"

    def start(self, role: str = "router", brief: Path | None = None, **environment: str) -> StartedProcess:
        """Start a process; brief: None for that of a router with a port of its own."""
        if brief is None:
            briefs = briefs_of(
                small_network(), loopback_endpoints(None, None, False), RecorderTask(self._folder, False)
            )
            brief = briefs["router"].write(Path(mkdtemp(dir=self._folder)))  # which it removes
        with process_starter() as starter, self.log.open("wb") as log:
            process = starter(role, brief, log, {**own_environment(), **environment})
        if process.stdin is not None:
            self._stack.enter_context(closing(process.stdin))
        if process.stdout is not None:
            self._stack.enter_context(closing(process.stdout))
        return process

    def missing(self, role: str, **environment: str) -> StartedProcess:
        """A process that ends because there is no such brief."""
        return self.start(role, self._folder / f"no {role}.json", **environment)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Processes of a test; those that it leaves end with their standard input."""
    with process_starter(), ExitStack() as stack:
        yield Bench(tmp_path, stack)


@pytest.fixture
def own_bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """The same with fork servers that no other test uses: their interpreters have another environment."""
    monkeypatch.setenv("PYTHONWARNINGS", "ignore")
    with preloaded(), ExitStack() as stack:
        yield Bench(tmp_path, stack)


def test_a_process_has_a_folder_a_session_and_a_name_of_its_own(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if an interpreter had been started for it, here and now."""
    monkeypatch.chdir(tmp_path)
    router = bench.start()
    wait_until(lambda: words_of(router.pid)[-4:-1] == ["-m", "evedrop", "router"], "the fork's command line")
    assert os.getsid(router.pid) == router.pid
    assert Path(f"/proc/{router.pid}/cwd").resolve() == tmp_path.resolve()


@pytest.mark.thorough
@pytest.mark.parametrize("role", ["recorder", "sensor"])
def test_its_status_and_its_complaint_are_its_own(bench: Bench, role: str) -> None:
    """Of two processes that run at the same time, one ends: its status, its log."""
    router = bench.start()
    missing = bench.missing(role)
    assert missing.wait(LIMIT) == missing.poll() == 2
    assert f"no {role}.json" in bench.log.read_text()
    assert router.poll() is None
    missing.kill()  # its id may be another process's by now
    router.terminate()
    assert router.wait(LIMIT) == 130


def test_a_killed_process_has_a_status_too(bench: Bench) -> None:
    """As of a process that an interpreter was started for."""
    router = bench.start()
    router.kill()
    assert router.wait(LIMIT) == -signal.SIGKILL


@pytest.mark.thorough
def test_a_signal_that_reaches_a_fork_before_it_runs_is_not_lost(bench: Bench) -> None:
    """Sent as soon as its id is known."""
    for _ in range(20):
        router = bench.start()
        router.terminate()
        assert router.wait(LIMIT) == 130


def test_a_process_ends_with_its_standard_input(bench: Bench) -> None:
    """The launcher's end of the pipe is in no other fork."""
    first, second = bench.start(), bench.start()
    assert first.stdin is not None
    first.stdin.close()
    first.wait(LIMIT)
    assert second.poll() is None


@pytest.mark.parametrize(("variable", "value"), [("PYTHONWARNINGS", "ignore"), (KERNELS_VARIABLE, OTHER_KERNELS)])
def test_in_a_block_all_runs_have_the_same_servers(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    """Unless an interpreter would start differently now."""
    first, second = bench.start(), bench.start()
    assert parent_of(first.pid) == parent_of(second.pid) != os.getpid()
    with process_starter() as before:
        pass
    monkeypatch.setenv(variable, value)
    with process_starter() as other:
        assert other is not before
    monkeypatch.undo()
    with process_starter() as after:
        assert after is before


def test_a_run_in_another_thread_has_servers_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a run end with it; in a block, all threads have the same."""
    monkeypatch.setattr(starter, "_preloaded", [])

    def in_a_thread() -> Starter:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(starter_of_a_run).result(LIMIT)

    def starter_of_a_run() -> Starter:
        with process_starter() as found:
            return found

    with process_starter() as own:
        assert starter_of_a_run() is own
        assert in_a_thread() is not own
    with preloaded() as shared:
        assert in_a_thread() is starter_of_a_run() is shared


@pytest.mark.thorough
def test_without_its_server_a_process_is_ended(own_bench: Bench, tmp_path: Path) -> None:
    """Nobody could say any more how it ended. Its run cannot start another process; the next run has other servers."""
    with process_starter() as starter:
        router = own_bench.start()
        os.kill(parent_of(router.pid), signal.SIGKILL)
        assert router.wait(LIMIT) == FORK_SERVER_LOST
        with own_bench.log.open("wb") as log, pytest.raises(OSError, match="fork server"):
            starter("router", tmp_path / "no.json", log, {})
    wait_until(lambda: not is_kept(starter), "other servers")
    with process_starter() as other, own_bench.log.open("wb") as log:
        process = other("sensor", tmp_path / "no.json", log, own_environment())
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(LIMIT) == 2


def is_kept(starter: Starter) -> bool:
    """Whether a run that begins now has this starter."""
    with process_starter() as kept:
        return kept is starter


def test_where_nothing_can_be_forked_interpreters_are_started(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """On another system than Linux."""
    monkeypatch.setenv("PYTHONWARNINGS", "ignore")
    monkeypatch.delattr(os, "pidfd_open")
    with process_starter() as starter:
        assert starter is start_process
    router = bench.start()
    assert parent_of(router.pid) == os.getpid()
    router.kill()
    assert router.wait(LIMIT) == -signal.SIGKILL


SPY = """
import json, os, sys

def opened(event, values):
    if event == "open" and str(values[0]).endswith("/no.json"):
        os.write(2, json.dumps(dict(os.environ)).encode() + b"\\n")

sys.addaudithook(opened)
"""
"""A module that writes the environment of a process that opens its brief."""


def test_a_process_has_the_environment_it_was_given_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing that only its server had."""
    (tmp_path / "spy.py").write_text(SPY)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    given = {"PATH": os.environ["PATH"], "TMPDIR": str(tmp_path)}
    with fork_servers(["spy"]) as (server,), (tmp_path / "log").open("wb") as log:
        process = server.start("sensor", tmp_path / "no.json", log, given)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(LIMIT) == 2
    assert json.loads((tmp_path / "log").read_text().splitlines()[0]) == given


@pytest.mark.long
def test_a_further_server_has_modules_that_the_first_has_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a recorder have no place in other processes; both end with the block."""
    (tmp_path / "spy.py").write_text(SPY)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    given = {"PATH": os.environ["PATH"], "TMPDIR": str(tmp_path)}
    parents = []
    with fork_servers(["evedrop.cli.main"], ["spy"]) as servers:
        for number, server in enumerate(servers):
            with (tmp_path / str(number)).open("wb") as log:
                process = server.start("sensor", tmp_path / "no.json", log, given)
            parents.append(parent_of(process.pid))
            assert process.stdin is not None
            process.stdin.close()
            assert process.wait(LIMIT) == 2
    first, second = ((tmp_path / name).read_text() for name in "01")
    assert "TMPDIR" not in first
    assert json.loads(second.splitlines()[0]) == given
    assert len({*parents, os.getpid()}) == 3
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in parents), "no server left")


def test_a_machine_without_threads_leaves_no_socket_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a fork server that nobody could follow."""
    made, pair = list[socket.socket](), socket.socketpair

    def recorded(family: int, kind: int) -> tuple[socket.socket, socket.socket]:
        ends = pair(family, kind)
        made.extend(ends)
        return ends

    def fails(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(socket, "socketpair", recorded)
    monkeypatch.setattr(threading.Thread, "start", fails)
    with pytest.raises(RuntimeError, match="can't start new thread"), fork_servers(["json"]):
        pytest.fail("it began")
    assert [end.fileno() for end in made] == [-1, -1]
