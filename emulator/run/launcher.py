"""The launcher: writes the briefs, starts every process, watches them, and ends them all whatever happens.

It imports neither zenoh nor rerun, and it alone decides how the run ended. Children have sessions of their own, so a
Ctrl-C reaches the launcher only; each holds the other end of a pipe, so none outlives even a killed launcher.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from emulator.brief import Brief
from emulator.errors import EvedropError, Interrupted, RunError, UsageError
from emulator.network.access import OBSERVER
from emulator.run.briefs import Observation, briefs_of
from emulator.run.results import new_folder
from emulator.scenario import Scenario

if TYPE_CHECKING:
    from emulator.run.viewer import Viewer

News = Mapping[str, Any]
_GRACE_SECONDS = 3.0  # for the observer to write what there is, and for the others to leave
_LOG_LINES = 12


@dataclass(frozen=True)
class Ended:
    """How a run ended: its exit status, and the viewer if one is still open."""

    status: int
    viewer: Viewer | None


def free_port() -> int:
    """A free TCP port on loopback, below those that the system hands out for outgoing connections."""
    for _ in range(200):
        port = 10_000 + secrets.randbelow(22_000)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise UsageError("no free port between 10000 and 32000 on loopback; end some programs, or give --listen")


def check_endpoint(endpoint: str) -> None:
    """Raise UsageError unless the endpoint tcp/HOST:PORT can be listened on, on loopback."""
    address = endpoint.removeprefix("tcp/")
    host, _, port = address.rpartition(":")
    if not endpoint.startswith("tcp/") or not port.isdigit() or host not in {"127.0.0.1", "localhost", "[::1]"}:
        raise UsageError(f"--listen {endpoint} is no loopback endpoint; give one such as tcp/127.0.0.1:17460")
    family = socket.AF_INET6 if host == "[::1]" else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host.strip("[]"), int(port)))
        except OSError as error:
            raise UsageError(
                f"--listen {endpoint}: {error.strerror}; leave it out, and a free port is found"
            ) from error


def launch(scenario: Scenario, folder: Path, view: str, listen: str | None, tell: Callable[[News], None]) -> Ended:
    """Run a scenario live into a results folder; `tell` gets the observer's news as they come.

    Raises UsageError before anything is started, RunError when the run failed, Interrupted on Ctrl-C or SIGTERM; in the
    last two cases what was measured is in the folder and no process is left.
    """
    if listen is not None:
        check_endpoint(listen)
    endpoint = listen or f"tcp/127.0.0.1:{free_port()}"
    new_folder(folder)
    viewer = _viewer(view, folder / "logs")
    try:
        if viewer is not None and viewer.address is not None:
            tell({"event": "view", "address": viewer.address})
        observation = Observation(folder, view != "off", viewer.url if viewer is not None else None)
        briefs = briefs_of(scenario, endpoint, observation)
        with tempfile.TemporaryDirectory(prefix="evedrop-") as private, _Children(folder / "logs") as children:
            for brief in briefs.values():
                children.start(brief, brief.write(Path(private)))
            status = _supervise(children, tell)
    except BaseException:
        if viewer is not None:
            viewer.stop()
        raise
    return Ended(status, viewer)


def _viewer(view: str, logs: Path) -> Viewer | None:
    if view == "off":
        return None
    from emulator.run.viewer import Viewer, choose  # noqa: PLC0415 - a run without view needs none of it

    return Viewer.start(choose(view), logs)


def _supervise(children: _Children, tell: Callable[[News], None]) -> int:
    """Follow the run to its end; the exit status that the observer gives it."""
    ending: News | None = None
    with _signals() as stop:
        while ending is None:
            if stop.is_set():
                children.terminate(OBSERVER)
                children.drain(tell)
                raise Interrupted("interrupted; what was measured is in the results folder")
            news = children.news(0.1)
            if isinstance(news, Exit):
                if news.process != OBSERVER:
                    children.terminate(OBSERVER, _GRACE_SECONDS / 2)
                ending = children.drain(tell)
                if ending is None or news.process == OBSERVER or not _ended_well(ending):
                    raise RunError(children.story(news, ending))
            elif news is not None:
                tell(news)
                ending = news if news["event"] == "ended" else None
        if not _ended_well(ending):
            raise _error_of(ending, children)
    children.wait_all()
    return int(ending["status"])


def _ended_well(ending: News) -> bool:
    return ending["status"] in {0, 1}


def _error_of(ending: News, children: _Children) -> EvedropError:
    if ending["status"] == Interrupted.exit_status:
        return Interrupted("interrupted; what was measured is in the results folder")
    return RunError(children.story(children.first_failure(), ending))


@contextlib.contextmanager
def _signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, while the block runs; outside the main thread signals stay as they are."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass(frozen=True)
class Exit:
    """A child ended."""

    process: str
    status: int


class _Children:
    """The processes of a run. Final; on leaving the block all are gone."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._news: SimpleQueue[News | Exit] = SimpleQueue()
        self._exits: list[Exit] = []

    def __enter__(self) -> _Children:
        return self

    def __exit__(self, *_: object) -> None:
        for name in self._processes:
            self.terminate(name, 0.0)
        deadline = time.monotonic() + _GRACE_SECONDS
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()

    def start(self, brief: Brief, path: Path) -> None:
        """Start the process of a brief. Its output goes to its log, an observer's news to us."""
        conducts = brief.role == "observer"
        with (self._logs / f"{brief.process}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "emulator", brief.role, str(path)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if conducts else log,
                stderr=log,
                start_new_session=True,
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
            )
        self._processes[brief.process] = process
        threading.Thread(target=self._follow, args=(brief.process, process), daemon=True).start()

    def _follow(self, name: str, process: subprocess.Popen[bytes]) -> None:
        if process.stdout is not None:
            with process.stdout as lines:
                for line in lines:
                    with contextlib.suppress(ValueError):
                        self._news.put(json.loads(line))
        self._news.put(Exit(name, process.wait()))

    def news(self, seconds: float) -> News | Exit | None:
        """The next news, or None if there are none for so long. A child that left as it should is no news."""
        try:
            news = self._news.get(timeout=seconds)
        except Empty:
            return None
        if isinstance(news, Exit):
            self._exits.append(news)
        return news

    def drain(self, tell: Callable[[News], None]) -> News | None:
        """Wait a little for the observer to end; its last news if it came to it."""
        deadline = time.monotonic() + _GRACE_SECONDS
        ending: News | None = None
        while time.monotonic() < deadline:
            news = self.news(0.05)
            if isinstance(news, Exit):
                if news.process == OBSERVER:
                    break
            elif news is not None:
                tell(news)
                ending = news if news["event"] == "ended" else ending
        return ending

    def terminate(self, name: str, after: float = 0.0) -> None:
        """Ask a child to end, unless it ends by itself within so many seconds."""
        process = self._processes[name]
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(after)
        if process.poll() is None:
            process.terminate()

    def wait_all(self) -> None:
        """Let everybody leave in peace, within the grace."""
        deadline = time.monotonic() + _GRACE_SECONDS
        for process in self._processes.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - time.monotonic()))

    def first_failure(self) -> Exit | None:
        """The child whose failure came first, as far as exit statuses tell; never the observer if another failed."""
        for name, process in self._processes.items():
            status = process.poll()
            if status not in {None, 0} and name != OBSERVER:
                return Exit(name, int(status or 0))
        return None

    def story(self, first: Exit | None, ending: News | None) -> str:
        """What happened: the process that failed, and the last lines of its log."""
        failed = self.first_failure() or first
        why = ending["how"] if ending is not None and ending["status"] not in {0, 1} else None
        if failed is None:
            return f"the run failed: {why}"
        how = f"was ended by signal {-failed.status}" if failed.status < 0 else f"ended with status {failed.status}"
        path = self._logs / f"{failed.process}.log"
        lines = path.read_text(errors="replace").splitlines()[-_LOG_LINES:]
        log = "\n".join(f"    {line}" for line in lines) or "    (it wrote nothing)"
        reason = f" ({why})" if why else ""
        return f"{failed.process} {how}{reason}; the last lines of logs/{path.name}:\n{log}"
