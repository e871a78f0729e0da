"""The launcher's view of its children: their briefs, the recorder's events, and how a run ended; no process is started."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO

import pytest

from evedrop.errors import Interrupted, MalformedMessage, MissingProcesses
from evedrop.live.launch import process_set
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.children import Children, ProcessExit
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.launch.process_set import follow_to_end
from evedrop.live.launch.starter import FORK_SERVER_LOST
from evedrop.live.protocol.brief import read_brief
from evedrop.live.protocol.last_word import Cause, LastWord, last_word_file, protocol_breaker, read_last_word
from evedrop.live.protocol.launcher_events import ProcessRequest, RouterListens, read_event
from evedrop.names import ProcessAction
from evedrop.results.folder import HeldFolder, new_folder
from evedrop.scenario.progress_events import ConnectionOutage, ProgressEvent, RunEnded, RunProgress, Started, silent
from evedrop.system.signals import INTERRUPTED
from tests.conftest import wait_until
from tests.live.network.bench import small_network


@dataclass
class Ended:
    """A process that has written its output and ended."""

    pid: int
    stdout: IO[bytes] | None
    stdin: IO[bytes] | None = None
    status: int = 0

    def poll(self) -> int:
        """It has ended."""
        return self.status

    def wait(self, timeout: float | None = None) -> int:
        """It has ended."""
        del timeout
        return self.status

    def send_signal(self, sig: int) -> None:
        """Nobody is there to take it."""

    def terminate(self) -> None:
        """It has ended."""

    kill = terminate


@dataclass
class FakeStarter:
    """Starts processes that end at once; a recorder writes these lines first."""

    lines: bytes = b""
    status: int = 0
    pipes: dict[str, IO[bytes]] = field(default_factory=dict)
    """Other processes that write something → what."""
    begun: list[str] = field(default_factory=list)
    pids: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def __call__(self, role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> Ended:  # noqa: ARG002 - nothing is run
        """Start one."""
        self.begun.append(brief.stem)
        stdout = BytesIO(self.lines) if role == "recorder" else self.pipes.get(brief.stem)
        return Ended(next(self.pids), stdout, None, self.status)


class Bench:
    """Children in a test's hands."""

    def __init__(self, folder: Path) -> None:
        self.private, self.results = folder / "private", new_folder(folder / "run")
        self.private.mkdir()
        (self.results / "logs").mkdir(exist_ok=True)
        self.briefs = briefs_of(small_network(), endpoints_at("tcp/127.0.0.1:1"), RecorderTask(self.results, False))
        self.starter = FakeStarter()
        self.held = HeldFolder(self.results)
        self.children = Children(self.held, self.private, starter=self.starter)

    def leaves(self, name: str, word: LastWord) -> None:
        """A process leaves its last word."""
        word.leave(last_word_file(self.private, name))

    def tells(self, *lines: bytes) -> list[ProgressEvent]:
        """The recorder writes these lines and ends: what the launcher shows of them."""
        self.starter.lines = b"".join(lines)
        self.children.start(self.briefs["recorder"])
        events: list[ProgressEvent] = []

        def ended() -> bool:
            match self.children.next_event(0.1):
                case ProcessExit("recorder"):
                    return True
                case ProgressEvent() as event:
                    events.append(event)
            return False

        wait_until(ended, "the recorder's end")
        return events


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Children of a run that is not there."""
    bench = Bench(tmp_path)
    with closing(bench.held), bench.children:
        yield bench


def test_a_signal_that_comes_when_the_run_is_complete_changes_nothing(bench: Bench) -> None:
    """The recorder, told to end, says that it was complete: so its summary does, and the exit status follows."""
    stop = threading.Event()
    stop.set()
    bench.starter.lines = RunEnded(1, "complete").line
    bench.children.start(bench.briefs["recorder"])
    assert follow_to_end(bench.children, stop, silent) == 1
    bench.starter.lines = RunEnded(130, "interrupted").line
    bench.children.start(bench.briefs["recorder"])
    with pytest.raises(Interrupted):
        follow_to_end(bench.children, stop, silent)


class LateStop(threading.Event):
    """A signal to the launcher that comes just after the one to a child."""

    def wait(self, timeout: float | None = None) -> bool:
        """It comes now."""
        del timeout
        self.set()
        return True


def test_nobody_waits_for_a_recorder_that_the_same_signal_has_ended(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was still starting, and says nothing any more."""
    monkeypatch.setattr(bench.children, "conclude", lambda *_: pytest.fail("it waits for the recorder's end"))
    bench.starter.status = INTERRUPTED
    bench.children.start(bench.briefs["recorder"])
    with pytest.raises(Interrupted):
        follow_to_end(bench.children, LateStop(), silent)


@pytest.mark.parametrize("status", [0, 3])
def test_a_run_that_is_complete_has_lost_nobody(status: int, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """If a process leaves, and the launcher does not hear for a second that the run is over."""
    monkeypatch.setattr(process_set, "_EARLY_SECONDS", -1.0)
    monkeypatch.setattr(bench.children, "conclude", lambda _: RunEnded(0, "complete"))
    monkeypatch.setattr(bench.children, "wait_all", lambda: None)
    bench.starter.status = status
    bench.children.start(bench.briefs["eve"])
    assert follow_to_end(bench.children, threading.Event(), silent) == 0


MISSED = LastWord.about(MissingProcesses("eve", ("legitimate", "recorder"), "within 30 s; start them"))
CUT_OFF = LastWord(Cause.NO_CONNECTION, "it has had no connection with the router for 30 s")


PANIC = """
thread '<unnamed>' (18226) panicked at tokio-1.53.2/src/runtime/scheduler/multi_thread/worker.rs:514:13:
OS can't spawn worker thread: Resource temporarily unavailable (os error 11)
stack backtrace:
   0: __rustc::rust_begin_unwind
  75:     0x7f3e7ac4524a - __libc_start_call_main
                               at ./csu/../sysdeps/nptl/libc_start_call_main.h:58:16
""".lstrip()


def test_why_zenoh_panicked_is_shown_without_its_stack(bench: Bench) -> None:
    """The stack has dozens of lines, and the reason is before them."""
    bench.starter.status = -6
    bench.children.start(bench.briefs["eve"])
    (bench.results / "logs" / "eve.log").write_text(PANIC)
    report = bench.children.failure_report(ProcessExit("eve", -6), None)
    assert report.splitlines()[-1] == "    OS can't spawn worker thread: Resource temporarily unavailable (os error 11)"


@pytest.mark.parametrize(("log", "end"), [("memory allocation of 32 bytes failed\n", ", not enough memory"), ("", "")])
def test_a_process_that_gets_no_memory_is_named_as_such(bench: Bench, log: str, end: str) -> None:
    """Zenoh and Rerun then abort, and only their last line says why."""
    bench.starter.status = -6
    bench.children.start(bench.briefs["eve"])
    (bench.results / "logs" / "eve.log").write_text(log)
    report = bench.children.failure_report(ProcessExit("eve", -6), None)
    assert report.splitlines()[0] == f"eve was ended by signal 6{end}"


def test_a_fork_server_that_ends_meanwhile_is_named() -> None:
    """Its processes count as lost a moment after the first of them has ended."""
    assert ProcessExit("eve", FORK_SERVER_LOST).manner == "was lost with its fork server"


@pytest.mark.parametrize("first", [ProcessExit("eve", 3), ProcessExit("recorder", 3)])
def test_who_ends_for_lack_of_a_recorder_is_not_at_fault(bench: Bench, first: ProcessExit) -> None:
    """Cut off from the router, the recorder and all others give up after the same time; it is named, and why."""
    for name in ("eve", "recorder"):
        bench.starter.status = 3
        bench.children.start(bench.briefs[name])
    bench.leaves("eve", MISSED)
    report = bench.children.failure_report(first, RunEnded(3, "no router answered at tcp/127.0.0.1:1 within 30 s"))
    assert report.startswith("recorder"), report
    assert "logs/recorder.log" in report
    assert "logs/eve.log" not in report


def test_who_ends_for_lack_of_another_process_is_named(bench: Bench) -> None:
    """The recorder was there."""
    bench.starter.status = 3
    for name in ("eve", "recorder"):
        bench.children.start(bench.briefs[name])
    bench.leaves("eve", LastWord.about(MissingProcesses("eve", ("legitimate",), "within 30 s; start them")))
    assert bench.children.failure_report(ProcessExit("eve", 3), None).startswith("eve")


@pytest.mark.parametrize(
    ("key", "sender"),
    [
        ("ack/sent", "legitimate"),
        ("ack/delivered", "router"),
        ("uplink", "sensor"),
        ("telemetry/eve", "eve"),
        ("control/eve", "recorder"),
    ],
)
def test_the_sender_of_a_malformed_message_is_named(bench: Bench, key: str, sender: str) -> None:
    """By the key that the message was put on, no matter which process complains."""
    for name in ("legitimate", "router", "sensor", "eve", "recorder"):
        bench.children.start(bench.briefs[name])
    error = MalformedMessage(f"evedrop/r1/{key}", "3", "4", b"")
    bench.leaves("naive", LastWord.about(error))
    message = f"{sender} broke the protocol: malformed message on evedrop/r1/{key}"
    assert bench.children.failure_report(ProcessExit("naive", 3), RunEnded(3, "naive left")).startswith(message)
    ending = RunEnded(3, str(error), broken_by=protocol_breaker(error))
    assert bench.children.failure_report(None, ending).startswith(message)


def test_a_router_that_all_have_lost_is_at_fault(bench: Bench) -> None:
    """Not the process that gave up first; it is, if the others still have their connections."""
    bench.starter.status = 3
    for name in bench.briefs:
        bench.children.start(bench.briefs[name])
    bench.leaves("eve", CUT_OFF)
    report = bench.children.failure_report(ProcessExit("eve", 3), RunEnded(3, "", suspects=["eve"]))
    assert report.startswith(f"eve ended with status 3: {CUT_OFF.sentence}\n")
    for name in bench.briefs.keys() - {"router", "recorder"}:
        bench.leaves(name, CUT_OFF)
    assert bench.children.failure_report(ProcessExit("eve", 3), None).startswith("router ended with")


def test_a_process_that_is_started_again_has_not_said_why_it_ends(bench: Bench) -> None:
    """What its predecessor said is gone, and its brief says where it may."""
    bench.leaves("eve", CUT_OFF)
    bench.children.start(bench.briefs["eve"])
    assert read_last_word(last_word_file(bench.private, "eve")) is None
    assert read_brief(bench.private / "eve.json").last_word == str(last_word_file(bench.private, "eve"))


def test_the_end_of_a_process_is_noticed_that_has_the_id_of_a_killed_one(bench: Bench) -> None:
    """In a long run with many kills, the system gives ids again."""
    bench.starter.pids = itertools.repeat(1)
    for name in ("recorder", "eve"):
        bench.children.start(bench.briefs[name])
    bench.children.act(ProcessRequest(ProcessAction.END, "eve", 3, 1))
    bench.starter.status = 3
    bench.children.act(ProcessRequest(ProcessAction.START, "eve", 9, 2))
    wait_until(lambda: bench.children.next_event(0.01) == ProcessExit("eve", 3), "the end of the process")
    assert bench.children.failure_report(None, None).startswith("eve ended with status 3")


def test_a_process_starts_again_only_when_its_router_listens(bench: Bench) -> None:
    """A router that has just been restarted has not said so: the request waits, and is carried out later."""
    bench.starter.pipes = {"router": BytesIO()}
    bench.children.start(bench.briefs["router"])
    bench.children.start(bench.briefs["eve"])
    bench.starter.lines = ProcessRequest(ProcessAction.START, "eve", 3, 1).line
    bench.children.start(bench.briefs["recorder"])
    begun = len(bench.starter.begun)
    for _ in range(10):
        bench.children.next_event(0.01)
    assert bench.starter.begun[begun:] == []
    bench.starter.pipes = {"router": BytesIO(RouterListens("router").line)}
    bench.children.start(bench.briefs["router"], again=True)

    def started_again() -> bool:
        bench.children.next_event(0.01)
        return "eve" in bench.starter.begun[begun:]

    wait_until(started_again, "the process to start again")
    assert bench.starter.begun[begun:] == ["router", "eve"]


def test_an_act_is_confirmed_to_nobody_after_the_run(bench: Bench) -> None:
    """A process's end may be reported only when the recorder's pipe is closed."""
    bench.children.start(bench.briefs["eve"])
    bench.tells()
    pipe = BytesIO()
    bench.children._processes["recorder"] = Ended(7, None, pipe)
    request = ProcessRequest(do=ProcessAction.STOP, process="eve", first=0, number=1)
    bench.children.act(request)
    assert pipe.getvalue() == b"1\n"
    pipe.close()
    bench.children.act(request)


def test_a_request_that_waits_does_not_speak_for_its_recorder(bench: Bench) -> None:
    """A recorder that falls silent is noticed, also while a process waits to be started again."""
    bench.starter.pipes = {"router": BytesIO()}
    bench.children.start(bench.briefs["router"])
    bench.children.start(bench.briefs["eve"])
    bench.tells(ProcessRequest(ProcessAction.START, "eve", 3, 1).line)
    for _ in range(20):
        bench.children.next_event(0.01)
    assert bench.children.silent_seconds > 0.1


PROGRESS = RunProgress(3, 2.5, "slots/s", {"eve": float("inf")})
OUTAGE = ConnectionOutage("router", 3, 5, 0.5)


def test_no_news_deletes_the_brief_of_a_process_that_may_not_have_read_it(bench: Bench) -> None:
    """Events of another process, or of an earlier start of this one, say nothing about who is starting just now."""
    router = bench.private / "router.json"
    bench.children.start(bench.briefs["router"])
    bench.tells(Started().line)
    bench.children.start(bench.briefs["router"], again=True)
    bench.tells(OUTAGE.line, OUTAGE.line)
    assert router.exists()


@pytest.mark.parametrize(
    "event", [PROGRESS, OUTAGE, RunEnded(3, "é", ["eve"], ["eve"], "why", "eve"), RunEnded(0, "complete")]
)
def test_news_are_read_as_they_were_written(event: ProgressEvent) -> None:
    """Whatever their entries."""
    result = read_event(event.line)
    assert (type(result), result.line) == (type(event), event.line)


MALFORMED = {
    b"{": "Expecting",
    b"[1]": "Expected `object`, got `array`",
    b'{"event": 3}': "Expected `str`, got `int` - at `$.event`",
    b'{"event": "dance"}': "Invalid value 'dance' - at `$.event`",
    b"[" * 100_000: "nested too deeply",
    b'{"event": "ended", "status": 0}': "missing required field `how`",
    b'{"event": "ended", "status": "0", "how": ""}': "Expected `int`, got `str` - at `$.status`",
    b'{"event": "started", "k": 1}': "unknown field `k`",
    b'{"event": "act", "do": "dance", "process": "eve", "first": 0, "number": 1}': "Invalid enum value 'dance'",
    b'{"event": "act", "do": "end", "process": "nobody", "first": 0, "number": 1}': "there is no process nobody",
    b'{"event": "progress", "done": 1, "rate": true, "rate_unit": "", "squared_errors": {}}': "got `bool` - at `$.rate`",
    b'{"event": "progress", "done": -1, "rate": 1, "rate_unit": "", "squared_errors": {}}': "Expected `int` >= 0 - at `$.done`",
}
"""A line → what is wrong with it."""


@pytest.mark.parametrize("line", MALFORMED)
def test_malformed_news_are_refused(line: bytes, bench: Bench) -> None:
    """The launcher goes on with the next line, and the recorder's log says what was wrong."""
    assert bench.tells(line + b"\n", PROGRESS.line) == [PROGRESS]
    log = (bench.results / "logs" / "recorder.log").read_text()
    assert log.startswith("evedrop: the launcher refused a malformed event: ")
    assert MALFORMED[line] in log
