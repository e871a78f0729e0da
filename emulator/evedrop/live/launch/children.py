"""The launcher's child processes: starts, watches and ends them, and finds the cause of a failure."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty
from typing import final

from evedrop.errors import RunError
from evedrop.live.launch.starter import (
    CONNECTION_LOST,
    FORK_SERVER_LOST,
    GRACE_SECONDS,
    StartedProcess,
    Starter,
    end_all,
    start_process,
)
from evedrop.live.protocol.brief import AnyBrief, RoutingPart, with_files_in
from evedrop.live.protocol.last_word import Cause, LastWord, last_word_file, read_last_word
from evedrop.live.protocol.launcher_events import (
    Alive,
    ProcessRequest,
    RouterListens,
    SaveStarted,
    SlotsDone,
    read_event,
)
from evedrop.names import RECORDER, RELAY, ROUTER, SENSOR, ProcessAction
from evedrop.results.folder import HeldFolder
from evedrop.scenario.progress_events import OnEvent, ProgressEvent, RunEnded
from evedrop.system.environment import SINGLE_THREADED, check_zenoh_runtime, lock_step_environment, own_environment
from evedrop.system.processes import wait_for
from evedrop.system.signals import INTERRUPTED
from evedrop.system.threads import Queue
from evedrop.system.waiting import wait_until
from evedrop.system.world import world

ROUTER_RESTARTS = 3  # how often routers that were ended by a signal are restarted in a run
SILENCE_SECONDS = 30.0  # after which the launcher gives up on a silent recorder, which sends a heartbeat every second
_BEGIN_SECONDS = 30.0  # for a living recorder to begin to write its results
_FINISH_SECONDS = 600.0  # for it to write them: 10⁶ slots take some seconds
_GONE_SECONDS = 5.0  # for a process that has left the network to end, and to say why in its log
_LOG_LINES = 12
_NO_MEMORY = "memory allocation of"  # Zenoh and Rerun end the process when they get no memory
_HUBS = frozenset({ROUTER, RELAY, RECORDER})
_FRAME = re.compile(r"stack backtrace:$|\s+\d+: |\s+at \S+:\d+")
"""A line of a stack that Zenoh shows when it panics; the line before them says why."""
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_ZENOH_CLOSES = "Received Data for unknown expr_id"


@dataclass(frozen=True)
class ProcessExit:
    """The end of a child process."""

    process: str
    status: int

    @property
    def manner(self) -> str:
        """How it ended, as the end of a sentence that begins with the process's name."""
        if self.status < 0:
            return f"was ended by signal {-self.status}"
        if self.status == INTERRUPTED:
            return "was interrupted by a signal"
        if self.status == CONNECTION_LOST:
            return "was lost with its host"
        if self.status == FORK_SERVER_LOST:
            return "was lost with its fork server"
        return f"ended with status {self.status}" if self.status else "left before the run ended"


@final
class Children:
    """The processes of a run; all are ended on leaving the block."""

    def __init__(
        self, folder: HeldFolder, private: Path, lock_step: bool = False, starter: Starter = start_process
    ) -> None:
        """folder: of the results; private: of the briefs; lock_step: whether processes wait for each other every few slots."""
        self._folder, self._starter = folder, starter
        self._lock_step = lock_step
        self._private = private
        self._processes: dict[str, StartedProcess] = {}
        self._events: Queue[ProgressEvent | ProcessExit] = world().queue()
        self.silent_seconds = 0.0
        """How many seconds the recorder has been silent for."""
        self.over = False
        """Whether the run is over, and all processes have been told to leave."""
        self._finishing = False
        self._requests = deque[ProcessRequest]()
        """The recorder's requests that have not been carried out."""
        self._listening = set[str]()
        """The routers that have said that they listen."""
        self._restarts = 0
        self._briefs: dict[str, AnyBrief] = {}
        self._killed: set[int] = set()
        """Ids of processes whose end is not a failure: those killed by the scenario."""

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        end_all(self._processes.values())

    def start(self, brief: AnyBrief, again: bool = False) -> None:
        """Start the process of a brief, or restart it (`again`).

        Its output goes to its log, the events of a recorder or a router to the launcher. Raises
        RunError if the system cannot start it, and UsageError if it could not open a session with this environment.
        """
        check_zenoh_runtime()
        self._briefs[brief.process] = brief
        self._listening.discard(brief.process)
        brief = with_files_in(brief, self._private)
        environment = {
            **(lock_step_environment(brief.role) if self._lock_step else {}),
            **own_environment(),
            **SINGLE_THREADED,
        }
        if isinstance(brief.part, RoutingPart):
            environment["TMPDIR"] = str(self._private)  # their password files are removed with the briefs
        try:
            world().disk.remove(last_word_file(self._private, brief.process), missing_ok=True)  # of an earlier start
            path = brief.write(self._private)
            log_file = self._folder.now / "logs" / f"{brief.process}.log"
            with world().disk.writer(log_file, "ab" if again else "wb") as log:
                process = self._starter(brief.role, path, log, environment)
        except OSError as error:
            why = error.strerror or str(error)
            raise RunError(f"{brief.process} cannot be started ({why}); free system resources and run again") from error
        before = self._processes.get(brief.process)
        if before is not None and before.stdin is not None:
            before.stdin.close()
        self._processes[brief.process] = process
        self._killed.discard(process.pid)  # of one that ended long ago, if the system gives its id again
        try:
            world().thread(self._follow, brief.process, process, name=f"follows {brief.process}").start()
        except RuntimeError:  # no thread can be started: nobody will read what the process tells
            if process.stdout is not None:
                process.stdout.close()
            raise

    def _follow(self, name: str, process: StartedProcess) -> None:
        if process.stdout is not None:
            with process.stdout as lines:
                for line in lines:
                    try:
                        event = read_event(line)
                        if name != RECORDER and event != RouterListens(name):
                            raise ValueError("only the recorder sends such events")
                        if isinstance(event, ProcessRequest) and event.process not in self._processes:
                            raise ValueError(f"there is no process {event.process:.40}")
                        self._events.put(event)
                    except ValueError as error:
                        self._refuse(name, error)
        status = process.wait()  # without a limit: nobody waits for this thread
        if process.pid not in self._killed:
            self._events.put(ProcessExit(name, status))

    def _refuse(self, name: str, error: ValueError) -> None:
        """Write into a process's log that the launcher cannot read its events."""
        with (
            contextlib.suppress(OSError),
            world().disk.text_writer(self._folder.now / "logs" / f"{name}.log", "ab") as log,
        ):
            log.write(f"evedrop: the launcher refused a malformed event: {error}\n")

    def listens(self, router: str) -> bool:
        """Whether a router or relay has said that it listens; true for one that cannot say so, or is not there."""
        process = self._processes.get(router)
        return process is None or process.stdout is None or router in self._listening

    def restart_router(self, ended: ProcessExit) -> bool:
        """Restart a router or relay if a signal ended it, a few times per run; returns whether it was restarted."""
        signalled = ended.status < 0 or ended.status == INTERRUPTED
        if ended.process not in {ROUTER, RELAY} or not signalled or self._restarts == ROUTER_RESTARTS:
            return False
        self._restarts += 1
        self.start(self._briefs[ended.process], again=True)
        return True

    def act(self, request: ProcessRequest) -> None:
        """Carry out the recorder's request on a process, and confirm it as soon as it is carried out.

        Raises RunError if a process cannot be restarted.
        """
        name, process = request.process, self._processes[request.process]
        if request.do == ProcessAction.END:
            self._killed.add(process.pid)
            process.kill()
            world().thread(self._confirm_end, process, request, name="confirms an end").start()
            return
        if request.do == ProcessAction.START:
            self.start(replace(self._briefs[name], first=request.first), again=True)
        else:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGSTOP if request.do == ProcessAction.STOP else signal.SIGCONT)
        self._confirm(request)

    def _confirm_end(self, process: StartedProcess, request: ProcessRequest) -> None:
        """Confirm that a process has ended, whenever its fork server or its host says so."""
        process.wait()  # without a limit: nobody waits for this thread
        if process.stdin is not None:
            process.stdin.close()
        self._confirm(request)

    def _confirm(self, request: ProcessRequest) -> None:
        recorder = self._processes[RECORDER].stdin
        if recorder is not None:
            with contextlib.suppress(OSError, ValueError):  # it has ended, or the run has
                recorder.write(b"%d\n" % request.number)
                recorder.flush()

    def next_event(self, seconds: float) -> ProgressEvent | ProcessExit | None:
        """The next event or exit that concerns the caller, or None; waits for `seconds` at most.

        A process that is to be started again waits, as the others did, until its router listens.
        """
        try:
            event = self._events.get(timeout=seconds)
        except Empty:
            self.silent_seconds += seconds
            return None
        if isinstance(event, ProcessExit):
            return event
        self.silent_seconds = 0.0
        match event:
            case RouterListens(process):
                self._listening.add(process)
                self._carry_out()
            case ProcessRequest():
                self._requests.append(event)
                self._carry_out()
            case SlotsDone():
                self.over = True
            case SaveStarted():
                self._finishing = True
        return None if isinstance(event, Alive | RouterListens | ProcessRequest | SlotsDone | SaveStarted) else event

    def _carry_out(self) -> None:
        """Carry out the recorder's requests that can be, in order."""
        while self._requests and (
            self._requests[0].do != ProcessAction.START or all(self.listens(name) for name in (ROUTER, RELAY))
        ):
            self.act(self._requests.popleft())

    def conclude(self, on_event: OnEvent, patience: float = 0.0) -> RunEnded | None:
        """End the recorder, at once or after `patience` seconds; returns its `RunEnded`, or None if it sent none.

        Once it has begun to write the results, it may take `_FINISH_SECONDS`, as long as it sends heartbeats.
        """
        recorder = self._processes[RECORDER]
        with contextlib.suppress(subprocess.TimeoutExpired):
            recorder.wait(patience)
        if recorder.poll() is None:
            recorder.terminate()
        begun = world().monotonic()
        ending: RunEnded | None = None
        while self.silent_seconds < SILENCE_SECONDS and (
            world().monotonic() - begun < (_FINISH_SECONDS if self._finishing else _BEGIN_SECONDS)
        ):
            event = self.next_event(0.05)
            if isinstance(event, ProcessExit):
                if event.process == RECORDER:
                    break
            elif event is not None:
                on_event(event)
                ending = event if isinstance(event, RunEnded) else ending
        return ending

    def wait_all(self) -> None:
        """Wait for all processes to leave by themselves, for `GRACE_SECONDS` at most."""
        wait_for(self._processes.values(), GRACE_SECONDS)

    def failure_report(self, first: ProcessExit | None, ending: RunEnded | None) -> str:
        """The failure in words: the process at fault, and the last lines of its log and of the log that accuses it.

        first: the first process that ended too early, if any; ending: the end as the recorder reported it, if it did.
        """
        if orphans := [name for name, process in self._processes.items() if process.poll() == FORK_SERVER_LOST]:
            theirs = ", ".join(orphans)
            return f"the fork server of {theirs} ended or stopped responding (killed, suspended or out of memory); run again"
        suspects, accused = ([], []) if ending is None else (list(ending.suspects), list(ending.accused))
        why = ending.how if ending is not None and ending.status not in {0, 1, INTERRUPTED} else ""
        first, suspects = self._at_fault(first, suspects)
        missed = first is not None and self._missed_recorder(first.process)
        if missed and RELAY in self._processes and suspects == [ROUTER]:
            first = None  # the recorder is there, and misses the router: their link is cut
        elif missed:
            return "\n".join(
                [f"{RECORDER}: {why}" if why else f"{RECORDER} did not appear", *self._log_lines(RECORDER)]
            )
        if not accused and (first is None or (first.process == RECORDER and first.status > 0)):
            first, suspects = self._at_fault(self._first_failure(suspects) or first, suspects)
        broken_by = None if ending is None else ending.broken_by
        if accused and why:
            named, head = [name for name in accused if name in self._processes], why
        elif first is not None:
            named, head = [first.process], f"{first.process} {first.manner}{self._lack(first)}"
            word = self._last_word(first.process)
            broken_by = None
            if word is not None and first.status == CONNECTION_LOST:
                head = f"{first.process} was lost: {word.sentence}"
            elif word is not None and word.cause is Cause.NO_CONNECTION:
                head = f"{head}: {word.sentence}"
            elif word is not None and word.cause is Cause.BROKEN_PROTOCOL:
                broken_by, why = next(iter(word.blamed), None), word.sentence
        elif suspects:
            named, head = suspects, f"{', '.join(suspects)} stopped responding: hung, suspended or cut off"
        else:
            named, head = [], f"the run failed: {why}"
        if broken_by in self._processes and (broken_by not in named or accused):
            named = list(dict.fromkeys([broken_by, *named]))
            head = f"{broken_by} broke the protocol: {why}"
        return "\n".join([head, *(line for name in named for line in self._log_lines(name))])

    def _first_failure(self, suspects: list[str]) -> ProcessExit | None:
        """A child that failed or left too early, other than the recorder. Waits a moment for missing processes to end."""
        deadline = world().monotonic() + (_GONE_SECONDS if suspects else 0.0)
        while True:
            ended = {
                name: process.poll()
                for name, process in self._processes.items()
                if name != RECORDER and process.pid not in self._killed
            }
            for name, status in ended.items():
                for_others = self._missed_recorder(name) or (
                    {ROUTER, RELAY} & set(suspects) and self._lost_router(name)
                )
                if status and not for_others:
                    return ProcessExit(name, status)
            if suspects and all(ended.get(name) == 0 for name in suspects):
                return ProcessExit(suspects[0], 0)
            if world().monotonic() > deadline:
                return None
            world().sleep(0.01)

    def _missed_recorder(self, name: str) -> bool:
        """Whether a process ended because the recorder did not appear."""
        word = self._last_word(name)
        return word is not None and word.cause is Cause.MISSING_PROCESSES and RECORDER in word.blamed

    def _lost_router(self, name: str) -> bool:
        """Whether a process ended because it could no longer reach its router."""
        word = self._last_word(name)
        return word is not None and word.cause is Cause.NO_CONNECTION

    def _at_fault(self, first: ProcessExit | None, suspects: list[str]) -> tuple[ProcessExit | None, list[str]]:
        """The router in place of a process that only gave up on it first."""
        lost = None if first is None else self._lost_by_all(first.process, suspects)
        return (first, suspects) if lost is None else (None, [lost])

    def _lost_by_all(self, name: str, suspects: list[str]) -> str | None:
        """The router that a process gave up on, if the recorder or all its other users miss it, too; otherwise None."""
        if not self._lost_router(name):
            return None
        if missed := next((process for process in (RELAY, ROUTER) if process in suspects), None):
            return missed
        place = self._briefs[name].router
        hub = RELAY if RELAY in self._processes and name != SENSOR else ROUTER
        others = [process for process, brief in self._briefs.items() if brief.router == place and process not in _HUBS]
        if len(others) < 2 or suspects:
            return None
        lost = wait_until(lambda: all(self._lost_router(process) for process in others), _GONE_SECONDS, 0.05)
        return hub if lost else None

    def _lack(self, ended: ProcessExit) -> str:
        """What the log of a process says that the machine lacked, as the end of a sentence; empty if nothing."""
        aborted = ended.status == -signal.SIGABRT and any(_NO_MEMORY in line for line in self._log(ended.process))
        return ", not enough memory" if aborted else ""

    def _last_word(self, name: str) -> LastWord | None:
        """Why a process ended, if it said so."""
        return read_last_word(last_word_file(self._private, name))

    def _log(self, name: str) -> list[str]:
        """The lines of a log, without Zenoh's lines about messages that arrive while its session closes."""
        try:
            text = _COLOUR.sub("", (self._folder.now / "logs" / f"{name}.log").read_text("utf-8", "replace"))
        except OSError as error:
            return [f"(cannot be read: {error.strerror})"]
        return [line for line in text.splitlines() if _ZENOH_CLOSES not in line]

    def _log_lines(self, name: str) -> list[str]:
        log = [line for line in self._log(name) if not _FRAME.match(line)]
        lines = log[-_LOG_LINES:] or ["(it wrote nothing)"]
        return [f"the last lines of logs/{name}.log:", *(f"    {line}" for line in lines)]
