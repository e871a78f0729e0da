"""Starts the processes of a run: each by an interpreter of its own, or all by fork servers.

A fork server is a bare process that has already imported the modules (`evedrop.fork_server`). `multiprocessing` has one, too,
which was tried: its forks have the environment of the first, the caller's session and standard files, and live on when the
caller is killed; while it is suspended no death is noticed, and when it is killed all its living forks count as ended. Tests
pass a starter that starts none.

Source: docs/architecture.md, why it is built this way.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from queue import Empty
from typing import IO, Protocol, final

from evedrop.errors import Interrupted
from evedrop.names import RECORDER, RELAY, ROUTER
from evedrop.system.environment import own_environment
from evedrop.system.fork_channels import POLL_SECONDS, ForkChannel, ProcessHandle
from evedrop.system.killable import KILLED_SECONDS, KillableProcess
from evedrop.system.processes import kill, wait_for
from evedrop.system.signals import SHOW_STACKS, held_back
from evedrop.system.threads import Queue, ThreadEvent
from evedrop.system.world import world

TELLING = frozenset({RECORDER, ROUTER, RELAY})
"""The roles whose processes send the launcher events on their standard output."""
GRACE_SECONDS = 3.0  # for all processes to leave
CONNECTION_LOST = 1000
"""The status of a process on another host if the connection with the host, or its fork server, ended; no process ends with it."""
FORK_SERVER_LOST = 1001
"""The status of a process whose fork server ended or stopped responding; no process ends with it."""
_STACKS_SECONDS = 0.3  # for a process that does not leave to write the stacks of its threads into its log


class StartedProcess(KillableProcess, Protocol):
    """The part of `subprocess.Popen` that the launcher uses."""

    @property
    def pid(self) -> int:
        """Its process id."""

    @property
    def stdin(self) -> IO[bytes] | None:
        """The launcher's end of the pipe to its standard input."""

    @property
    def stdout(self) -> IO[bytes] | None:
        """The events of a recorder or a router; None for others, and for a process on another host."""

    def poll(self) -> int | None:
        """Its exit status; None while it runs."""

    def send_signal(self, sig: int) -> None:
        """Send a signal to it."""

    def terminate(self) -> None:
        """Ask it to end."""


class ReportedProcess(ABC):
    """A process whose end another process reports; used like a `subprocess.Popen`."""

    stdin: IO[bytes] | None = None
    stdout: IO[bytes] | None = None

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._status: int | None = None
        self._lock, self._over = world().lock(), world().event()

    @abstractmethod
    def _close(self) -> None:
        """Close what refers to the process, which has ended."""

    @abstractmethod
    def send_signal(self, sig: int) -> None:
        """Send a signal to it, if it still runs."""

    def ended(self, status: int) -> None:
        """Note that it ended with this status; only the first report counts."""
        with self._lock:
            if self._status is not None:
                return
            self._close()
            self._status = status
        self._over.set()

    def poll(self) -> int | None:
        """Its status; None while it runs."""
        return self._status

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        if not self._over.wait(timeout) or self._status is None:
            raise subprocess.TimeoutExpired("evedrop", timeout or 0.0)
        return self._status

    def terminate(self) -> None:
        """Ask it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self.send_signal(signal.SIGKILL)


class Starter(Protocol):
    """Starts the process of a role with the file of its brief; the events of `TELLING` roles come on `stdout`."""

    def __call__(self, role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        """Start it. Raises OSError if the system cannot."""


def start_process(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
    """Start `evedrop ROLE BRIEF` in a session of its own."""
    with held_back():
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "evedrop", role, str(brief)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if role in TELLING else log,
            stderr=log,
            start_new_session=True,
            env=environment,
            umask=0o077,
        )


def end_all(processes: Collection[StartedProcess]) -> None:
    """Ask processes to end, and kill those that still run after `GRACE_SECONDS`. Returns within seconds in any case.

    A killed process whose end is never reported (its fork server or its host is suspended) ends with the connection to it.
    """
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGCONT)  # a paused process could not end
        if process.poll() is None:
            process.terminate()
    if hanging := wait_for(processes, GRACE_SECONDS):
        for process in hanging:
            process.send_signal(SHOW_STACKS)
        kill(*wait_for(hanging, _STACKS_SECONDS))
    for process in processes:
        if process.stdin is not None:
            with contextlib.suppress(OSError):  # what could not be written to one that is dead is written again
                process.stdin.close()


_REPORT_SECONDS = 5.0
"""For a fork server to report the end of a process: a suspended one never does. Only the launcher's own time counts."""
_START_SECONDS = 120.0
"""For a fork server to make its imports and start a process."""
_GONE = (errno.ESRCH, "its fork server has ended")
_SILENT = (errno.ETIMEDOUT, f"its fork server did not respond within {_START_SECONDS:.0f} s")
_EVERY_ROLE = (
    "cryptography.hazmat.primitives.ciphers",
    "evedrop.cli.commands.process",
    "evedrop.cli.main",
    "evedrop.live.protocol.brief",
    "evedrop.scenario.plugins",
    "evedrop.system.signals",
)
OF_OTHERS = (*_EVERY_ROLE, "evedrop.peers.eavesdropper", "evedrop.peers.legitimate")
"""What the processes of most roles import; not the modules of sensor and router, which have no place in an eavesdropper."""
OF_RECORDERS = ("evedrop.live.recorder.recorder",)
"""What a recorder imports in addition."""
OF_SUMMARIES = ("scipy.special",)
"""What it imports once it makes a summary, which takes an eighth of a second."""


@final
class Fork(ReportedProcess):
    """A process that a fork server has started, and whose end it reports."""

    def __init__(self, pid: int, handle: ProcessHandle) -> None:
        super().__init__(pid)
        self._handle = handle

    def _close(self) -> None:
        self._handle.close()

    @property
    def over(self) -> bool:
        """Whether it has ended, reported or not: the system says so."""
        with self._lock:
            return self.poll() is not None or self._handle.over

    def send_signal(self, sig: int) -> None:
        """Send a signal to it, if it still runs."""
        with self._lock, suppress(ProcessLookupError):
            if self.poll() is None:
                self._handle.send_signal(sig)


@final
class ForkServer:
    """The launcher's side of a fork server for some roles: starts processes, and learns how they end.

    A server that does not report the end of a process is given up: its processes are killed.

    channel: whose other end the server has.
    """

    def __init__(self, channel: ForkChannel) -> None:
        self._channel = channel
        self._forks: dict[int, Fork] = {}
        self._asking = world().lock()
        self._begun: Queue[Fork | OSError] = world().queue()
        """The process that was asked for, or why it could not be started."""
        self._follower = world().thread(self._follow, name="fork server")
        self._follower.start()

    @property
    def alive(self) -> bool:
        """Whether it can still start processes."""
        return self._follower.is_alive()

    def close(self) -> None:
        """End the fork server, as soon as it has made its imports; its forks have ended before."""
        self._give_up()
        self._follower.join(KILLED_SECONDS)  # it reads the end of the channel at once
        self._channel.close()

    def _give_up(self) -> None:
        """Close the channel: the server ends, if it is not suspended, and `_follow` ends its processes."""
        with suppress(OSError):  # it is closed
            self._channel.shut()

    def start(
        self,
        role: str,
        brief: Path,
        log: IO[bytes],
        environment: Mapping[str, str],
        stop: ThreadEvent | None = None,
    ) -> StartedProcess:
        """Start `evedrop ROLE BRIEF`, whose files only this user may read. Raises OSError, Interrupted once `stop` is set."""
        files = self._channel.files(log, role in TELLING)
        try:
            process = self.fork([role, str(brief)], files.descriptors, environment, _folder(), 0o077, stop)
        except BaseException:
            files.stdin.close()
            if files.stdout is not None:
                files.stdout.close()
            raise
        finally:
            files.close_theirs()
        process.stdin, process.stdout = files.stdin, files.stdout
        return process

    def fork(
        self,
        words: Sequence[str],
        files: tuple[int, int, int],
        environment: Mapping[str, str],
        folder: str | None,
        umask: int,
        stop: ThreadEvent | None = None,
    ) -> Fork:
        """Run `evedrop WORDS` in a fork of the server, with these standard files, in this folder.

        Raises OSError if that is impossible or takes `_START_SECONDS`, Interrupted if `stop` is set before the process runs.
        """
        request = {"words": [*words], "environment": dict(environment), "folder": folder, "umask": umask}
        with self._asking:
            try:
                self._channel.send(json.dumps(request).encode(), files)
                begun = self._answer(stop)
            except (ConnectionError, TimeoutError):
                begun = OSError(*_GONE)
        if isinstance(begun, OSError):
            if stop is not None and stop.is_set():  # another shard has already given up the server
                raise Interrupted
            raise begun
        return begun

    def _answer(self, stop: ThreadEvent | None) -> Fork | OSError:
        """The answer to a request. A server that does not answer in time is given up, for a late answer would confuse."""
        deadline = world().monotonic() + _START_SECONDS
        while world().monotonic() < deadline:
            with suppress(Empty):
                return self._begun.get(timeout=POLL_SECONDS)
            if stop is not None and stop.is_set():
                self._give_up()
                raise Interrupted
        self._give_up()
        return OSError(*_SILENT)

    def _follow(self) -> None:
        """Read the reports of the fork server until it ends or is given up, and end the processes that it leaves behind."""
        try:
            while (report := self._next_report()) is not None:
                self._take(*report)
        finally:
            for fork in self._forks.values():
                fork.kill()
                fork.ended(FORK_SERVER_LOST)
            self._begun.put(OSError(*_GONE))

    def _next_report(self) -> tuple[dict[str, int], list[ProcessHandle]] | None:
        """The server's next report, and the process that came with it; None if it has ended, or hangs."""
        unreported = 0.0
        while unreported < _REPORT_SECONDS:
            try:
                report, handles = self._channel.receive()
            except TimeoutError:
                # Not by the clock: this process may have been suspended, too.
                unreported = unreported + POLL_SECONDS if any(fork.over for fork in self._forks.values()) else 0.0
            except OSError:
                return None
            else:
                return (json.loads(report), handles) if report else None
        return None

    def _take(self, report: dict[str, int], handles: list[ProcessHandle]) -> None:
        if "error" in report:
            self._begun.put(OSError(report["error"], os.strerror(report["error"])))
        elif "status" in report:
            if (ended := self._forks.pop(report["pid"], None)) is not None:
                ended.ended(report["status"])
        elif not handles:  # the system did not pass it on; the process ends when its standard input does
            self._begun.put(OSError(errno.EMFILE, os.strerror(errno.EMFILE)))
        else:
            fork = self._forks[report["pid"]] = Fork(report["pid"], *handles)
            self._begun.put(fork)


@contextmanager
def fork_servers(*modules: Sequence[str]) -> Iterator[tuple[ForkServer, ...]]:
    """Fork servers, each of which imports these modules and those of the servers before it. Raises OSError."""
    with ExitStack() as stack:
        channels = stack.enter_context(world().fork_channels(modules))
        servers = tuple(ForkServer(channel) for channel in channels)
        for server in servers:
            stack.callback(server.close)
        yield servers


@final
class PreloadedStarter:
    """Starts a recorder from the last of some fork servers, and all others, which need fewer modules, from the first.

    stop: once it is set, no fork server is waited for.
    """

    def __init__(self, servers: Sequence[ForkServer], stop: ThreadEvent | None = None) -> None:
        self._servers, self._stop = servers, stop
        self._environment, self._process = _inherited(), world().process

    @property
    def usable(self) -> bool:
        """Whether the servers live, and interpreters that were started now by this process would be no different."""
        same = self._process is world().process and self._environment == _inherited()
        return same and all(server.alive for server in self._servers)

    def until(self, stop: ThreadEvent) -> PreloadedStarter:
        """The same for a run that ends once this is set."""
        return PreloadedStarter(self._servers, stop)

    def __call__(self, role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        """Start `evedrop ROLE BRIEF`. Raises OSError, and Interrupted if it is stopped before."""
        server = self._servers[-1 if role == RECORDER else 0]
        return server.start(role, brief, log, environment, self._stop)


_preloaded: list[PreloadedStarter] = []
"""What is kept for the `preloaded` blocks that this process is in."""
_OF_RUN: ContextVar[PreloadedStarter | None] = ContextVar("of_run", default=None)
"""What is kept for the run that this thread is in: its servers end with it, and no other thread may use them."""


@contextmanager
def process_starter(stop: ThreadEvent | None = None) -> Iterator[Starter]:
    """The fastest way to start processes on this system, until the block ends. Raises OSError.

    stop: once it is set, the starter waits for nothing, and raises Interrupted. Outside a `preloaded` block, a summary's own
    imports are not made in advance, so that one run starts as early as it can.
    """
    with ExitStack() as stack:
        starter: Starter | None = next(filter(_is_usable, (_OF_RUN.get(), *reversed(_preloaded))), None)
        if starter is None:
            starter = stack.enter_context(_waiting_servers(OF_OTHERS, OF_RECORDERS))
            if isinstance(starter, PreloadedStarter):
                stack.callback(_OF_RUN.reset, _OF_RUN.set(starter))
        yield starter.until(stop) if stop is not None and isinstance(starter, PreloadedStarter) else starter


def _is_usable(starter: PreloadedStarter | None) -> bool:
    return starter is not None and starter.usable


@contextmanager
def preloaded() -> Iterator[Starter]:
    """Make the imports of live runs once for all runs in the block, which then start and end faster.

    Two more processes wait meanwhile. Raises OSError if they cannot be started.

    >>> with preloaded():                                                               # doctest: +SKIP
    ...     found = [run("eavesdroppers", slots=1000, seed=seed) for seed in range(10)]
    """
    with _waiting_servers(OF_OTHERS, (*OF_RECORDERS, *OF_SUMMARIES)) as starter:
        if not isinstance(starter, PreloadedStarter):
            yield starter
            return
        _preloaded.append(starter)
        try:
            yield starter
        finally:
            _preloaded.remove(starter)


def preloaded_without_recorder() -> AbstractContextManager[Starter]:
    """The same on a host that carries only other processes of a run: the imports of a recorder are not made. Raises OSError."""
    return _waiting_servers(OF_OTHERS)


@contextmanager
def _waiting_servers(*modules: Sequence[str]) -> Iterator[Starter]:
    """Fork servers that import these modules, where there can be any. Raises OSError."""
    if not world().forks:
        yield start_process
        return
    with fork_servers(*modules) as servers:
        yield PreloadedStarter(servers)


def _inherited() -> dict[str, str]:
    """What a server's interpreter may have read from the environment; where temporary files are, a fork asks for itself."""
    return {name: value for name, value in own_environment().items() if name not in {"TMPDIR", "TEMP", "TMP"}}


def _folder() -> str | None:
    """The current folder; None if it has been removed."""
    with suppress(OSError):
        return os.getcwd()
    return None
