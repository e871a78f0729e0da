"""The launcher: writes the briefs, starts every process, watches them, and ends them all whatever happens.

It imports neither zenoh nor rerun, and it alone decides how the run ended. Children have sessions of their own, so a
Ctrl-C reaches the launcher only; each holds the other end of a pipe, so none outlives even a killed launcher.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
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
from emulator.network.access import OBSERVER, ROUTER, SENSOR
from emulator.runs.briefs import Observation, briefs_of
from emulator.runs.results import ResultsWriter, load_results, new_folder, write_summary
from emulator.runs.score import Tally
from emulator.runs.scorekeeper import Ending, summary_of
from emulator.scenario import Scenario

if TYPE_CHECKING:
    from emulator.runs.viewer import Viewer

News = Mapping[str, Any]
_GRACE_SECONDS = 3.0  # for the observer to begin to write what there is, and for the others to leave
_LOOK_SECONDS = 0.1  # how soon a signal is noticed
_FINISH_SECONDS = 60.0  # for the observer to write it, once it has begun
_SILENCE_SECONDS = 30.0  # the observer gives a sign of life every second
_LOG_LINES = 12
_COMPLAINT = "evedrop: "
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_ZENOH_CLOSES = "Received Data for unknown expr_id"
_REFUSED = re.compile(r"(?:malformed message|gap) on evedrop/[^/\s]+/([a-z0-9_/-]+)")


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
    named = port.isdecimal() and 0 < int(port) < 2**16
    if not endpoint.startswith("tcp/") or not named or host not in {"127.0.0.1", "localhost", "[::1]"}:
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
    with _signals() as stop, _private_folder() as private:
        new_folder(folder)
        viewer = None
        try:
            viewer = _viewer(view, folder / "logs")
            if viewer is not None and viewer.address is not None:
                tell({"event": "view", "address": viewer.address})
            observation = Observation(folder, view != "off", viewer.url if viewer is not None else None)
            briefs = briefs_of(scenario, endpoint, observation)
            with _Children(folder / "logs", private) as children:
                for brief in briefs.values():
                    children.start(brief)
                status = _supervise(children, stop, tell)
        except BaseException as error:
            if viewer is not None:
                viewer.stop()
            if isinstance(error, UsageError):
                _forget(folder)
            elif isinstance(error, EvedropError):
                _note(folder, scenario, "interrupted" if isinstance(error, Interrupted) else str(error))
            raise
    return Ended(status, viewer)


@contextlib.contextmanager
def _private_folder() -> Iterator[Path]:
    """For the briefs: nobody else may look into it."""
    try:
        made = tempfile.TemporaryDirectory(prefix="evedrop-", ignore_cleanup_errors=True)
    except OSError as error:
        raise UsageError(f"no temporary folder can be made ({error.strerror}); set TMPDIR to one") from error
    with made as private:
        yield Path(private)


def _forget(folder: Path) -> None:
    """Leave no folder of a run that was not started, so that the next one can have it."""
    with contextlib.suppress(OSError):
        (folder / "logs").rmdir()
        folder.rmdir()


def _note(folder: Path, scenario: Scenario, how: str) -> None:
    """How the run ended, in its summary; an empty one if the observer did not come to it."""
    with contextlib.suppress(OSError):
        try:
            summary = {**load_results(folder).summary, "ended": how}
        except UsageError:
            tallies = {name: Tally(scenario.slots, scenario.trials) for name in scenario.receivers}
            summary = summary_of(scenario, tallies, dict.fromkeys(scenario.receivers), Ending(0.0, how))
            if not any(folder.glob("*.parquet")):
                with ResultsWriter(folder, scenario.receivers, len(scenario.process.A)):
                    pass
        write_summary(folder, summary)


def _viewer(view: str, logs: Path) -> Viewer | None:
    if view == "off":
        return None
    from emulator.runs.viewer import Viewer, choose  # noqa: PLC0415 - a run without view needs none of it

    return Viewer.start(choose(view), logs)


def _supervise(children: _Children, stop: threading.Event, tell: Callable[[News], None]) -> int:
    """Follow the run to its end; the exit status that the observer gives it."""
    while True:
        if stop.is_set():
            children.conclude(tell)
            raise Interrupted("interrupted; what was measured is in the results folder")
        if children.silent_seconds > _SILENCE_SECONDS:
            raise RunError(children.story(None, {"suspects": [OBSERVER]}))
        news = children.news(_LOOK_SECONDS)
        ending: News | None = None
        if isinstance(news, Exit):
            # Who leaves with 0 before the end is missed by the observer, and after the end by nobody.
            if news.process != OBSERVER and news.status == 0:
                continue
            if news.process != OBSERVER:
                ending = children.conclude(tell, _GRACE_SECONDS / 2 if children.started else 0.0)
            if ending is None or not _ended_well(ending):
                raise RunError(children.story(news, ending))
        elif news is not None:
            tell(news)
            ending = news if news["event"] == "ended" else None
        if ending is not None:
            break
    if ending["status"] == Interrupted.exit_status:
        raise Interrupted("interrupted; what was measured is in the results folder")
    if not _ended_well(ending):
        raise RunError(children.story(None, ending))
    children.wait_all()
    return int(ending["status"])


def _ended_well(ending: News) -> bool:
    return ending["status"] in {0, 1}


def _sender(complaint: str) -> str | None:
    """The process that sent what a complaint about a message is about (docs/protocol.md, keys)."""
    found = _REFUSED.search(complaint)
    if found is None:
        return None
    kind, _, name = found[1].partition("/")
    return {"uplink": SENSOR, "journal": ROUTER, "downlink": ROUTER, "control": OBSERVER}.get(kind, name)


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

    @property
    def manner(self) -> str:
        """As a sentence goes on after the process's name."""
        if self.status < 0:
            return f"was ended by signal {-self.status}"
        return f"ended with status {self.status}" if self.status else "left before the run ended"


class _Children:
    """The processes of a run. Final; on leaving the block all are gone."""

    def __init__(self, logs: Path, private: Path) -> None:
        self._logs = logs
        self._private = private
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._news: SimpleQueue[News | Exit] = SimpleQueue()
        self.silent_seconds = 0.0
        """How long the observer has given no sign of life."""
        self.started = False
        """Whether the conductor has started the run."""
        self._finishing = False

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

    def start(self, brief: Brief) -> None:
        """Start the process of a brief. Its output goes to its log, an observer's news to us.

        Raises RunError if the system does not let us.
        """
        conducts = brief.role == "observer"
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
        if brief.role == "router":
            environment["TMPDIR"] = str(self._private)  # its file of passwords goes with the briefs
        try:
            path = brief.write(self._private)
            with (self._logs / f"{brief.process}.log").open("wb") as log:
                process = subprocess.Popen(
                    [sys.executable, "-m", "emulator", brief.role, str(path)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE if conducts else log,
                    stderr=log,
                    start_new_session=True,
                    env=environment,
                )
        except OSError as error:
            raise RunError(
                f"{brief.process} cannot be started ({error}); free what the system lacks and run again"
            ) from error
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
        """The next news, or None if there are none for so long."""
        try:
            news = self._news.get(timeout=seconds)
        except Empty:
            self.silent_seconds += seconds
            return None
        if isinstance(news, Exit):
            return news
        self.silent_seconds = 0.0
        if news["event"] == "started":
            self.started = True
            self._forget_briefs()
        self._finishing = self._finishing or news["event"] == "finishing"
        return None if news["event"] in {"alive", "finishing"} else news

    def _forget_briefs(self) -> None:
        """Everybody has read its own: the keys need not lie on a disk any longer."""
        for path in self._private.glob("*.json"):
            path.unlink(missing_ok=True)

    def conclude(self, tell: Callable[[News], None], patience: float = 0.0) -> News | None:
        """Have the observer end, at once or after so many seconds; its last news if it came to it."""
        self.terminate(OBSERVER, patience)
        begun = time.monotonic()
        ending: News | None = None
        while time.monotonic() - begun < (_FINISH_SECONDS if self._finishing else _GRACE_SECONDS):
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
        process = self._processes.get(name)
        if process is None:
            return
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

    def story(self, first: Exit | None, ending: News | None) -> str:
        """What happened: the process at fault, and the last lines of its log and of who complained."""
        suspects = list(ending.get("suspects", [])) if ending is not None else []
        why = str(ending["how"]) if ending is not None and ending.get("status") not in {None, 0, 1, 130} else ""
        if first is None or (first.process == OBSERVER and first.status > 0):
            first = self._first_failure(suspects) or first
        if first is not None:
            named, head = [first.process], f"{first.process} {first.manner}"
            words = reversed(self._log(first.process))
            why = next((line for line in words if line.startswith(_COMPLAINT)), "")
        elif suspects:
            named, head = suspects, f"{', '.join(suspects)} gave no sign of life any more: hung, stopped or cut off"
        else:
            named, head = [], f"the run failed: {why}"
        at_fault = _sender(why)
        if at_fault is not None and at_fault in self._processes and at_fault not in named:
            named, head = [at_fault, *named], f"{at_fault} broke the protocol: {why.removeprefix(_COMPLAINT)}"
        return "\n".join([head, *(line for name in named for line in self._log_lines(name))])

    def _first_failure(self, suspects: list[str]) -> Exit | None:
        """A child that failed, or left too early; never the observer. Who is missed is given a moment to be gone."""
        deadline = time.monotonic() + (_GRACE_SECONDS / 2 if suspects else 0.0)
        while True:
            ended = {name: process.poll() for name, process in self._processes.items() if name != OBSERVER}
            for name, status in ended.items():
                if status:
                    return Exit(name, status)
            if suspects and all(ended.get(name) == 0 for name in suspects):
                return Exit(suspects[0], 0)
            if time.monotonic() > deadline:
                return None
            time.sleep(0.01)

    def _log(self, name: str) -> list[str]:
        """The lines of a log, without what Zenoh says of every message that arrives while its session closes."""
        try:
            text = _COLOUR.sub("", (self._logs / f"{name}.log").read_text(errors="replace"))
        except OSError as error:
            return [f"(cannot be read: {error.strerror})"]
        return [line for line in text.splitlines() if _ZENOH_CLOSES not in line]

    def _log_lines(self, name: str) -> list[str]:
        lines = self._log(name)[-_LOG_LINES:] or ["(it wrote nothing)"]
        return [f"the last lines of logs/{name}.log:", *(f"    {line}" for line in lines)]
