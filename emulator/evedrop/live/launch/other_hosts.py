"""Processes of a run on other hosts, over ssh: the launcher's side, the program that starts them there, and their messages.

There is one connection for each host, with the system's `ssh`. Each host gets the briefs of its own processes and no others,
over the connection. Each message is one JSON object on a line: the entries of its class, and its kind. The program on the host
gets its orders on standard input. It knows only the briefs of the processes that it starts; they are in a folder that only this
user can read, until the processes have read them. When the connection closes, however that happens, it ends all processes and
removes the folder.

Source: docs/hosts.md, how it works.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.metadata
import itertools
import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Annotated, Any, final

from msgspec import Meta, Struct, to_builtins

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.live.launch.hosts_file import HostsPlan, HostTable
from evedrop.live.launch.private_folder import private_folder
from evedrop.live.launch.starter import (
    CONNECTION_LOST,
    FORK_SERVER_LOST,
    ReportedProcess,
    StartedProcess,
    Starter,
    end_all,
    preloaded_without_recorder,
)
from evedrop.live.network.launcher_pipe import input_lines
from evedrop.live.protocol.brief import ImportingPart, brief_from, read_brief, with_files_in
from evedrop.live.protocol.last_word import Cause, LastWord, last_word_file, read_last_word
from evedrop.system.environment import own_environment
from evedrop.system.fields import NotNegative, Slot
from evedrop.system.lacks import lack_of
from evedrop.system.processes import kill, wait_for
from evedrop.system.structs import converted
from evedrop.system.threads import ThreadEvent
from evedrop.system.waiting import Alarm
from evedrop.system.world import world

MOST_NOISE = 200
"""The most lines that the login shell of a host may print before the program begins."""


class HostMessage(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """The base class of all messages but the first."""


class StartProcess(HostMessage, frozen=True, tag="start"):
    """To the host: start a process."""

    number: Slot
    """Distinguishes it from all other processes of the run."""
    brief: Mapping[str, Any]
    """The entries of its brief."""
    environment: Mapping[str, str]
    """Variables in addition to those of the host."""

    def __repr__(self) -> str:
        return f"StartProcess({self.number})"  # without keys and passwords


class SendSignal(HostMessage, frozen=True, tag="signal"):
    """To the host: send a signal to a process."""

    number: Slot
    signal: Annotated[int, Meta(ge=1, le=64)]


class LauncherHeartbeat(HostMessage, frozen=True, tag="heartbeat"):
    """To the host: the launcher is still there."""

    silence: NotNegative
    """Seconds after which the host may consider a silent launcher gone."""


class Greeting(Struct, frozen=True):
    """To the launcher, before all else: the program runs. That of another version may have other fields, too."""

    evedrop: str
    """Its version."""


class LogText(HostMessage, frozen=True, tag="log"):
    """To the launcher: what a process has written to its log."""

    number: Slot
    written: str


class ProcessEnded(HostMessage, frozen=True, tag="ended"):
    """To the launcher: a process has ended."""

    number: Slot
    status: Annotated[int, Meta(ge=-64, le=FORK_SERVER_LOST)]
    """Negative: the signal that ended it. `FORK_SERVER_LOST`: it ended with its fork server."""
    last_word: LastWord | None = None
    """Why it ended, if it could tell."""


Order = StartProcess | SendSignal | LauncherHeartbeat
"""What a launcher sends."""
Answer = LogText | ProcessEnded
"""What a host sends after its greeting."""


def line_of(message: HostMessage | Greeting) -> bytes:
    """A message as a line."""
    return json.dumps(to_builtins(message)).encode() + b"\n"


def order_in(line: bytes) -> Order:
    """The order of a line. Raises ValueError if it is not one."""
    order: Order = _message_in(line, Order)
    return order


def answer_in(line: bytes) -> Answer:
    """The answer of a line. Raises ValueError if it is not one."""
    answer: Answer = _message_in(line, Answer)
    return answer


def greeting_in(line: bytes) -> Greeting:
    """The greeting of a line, of any version of the program. Raises ValueError if it is not one."""
    greeting: Greeting = _message_in(line, Greeting)
    return greeting


def _message_in(line: bytes, kind: Any) -> Any:
    try:
        return converted(json.loads(line), kind)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{line[:80]!r} is not a message ({error})") from error


def own_version() -> str:
    """The version of Evedrop, which must be the same on all hosts."""
    return importlib.metadata.version("evedrop")


ANSWER_SECONDS = 60.0
"""How long a host may take to connect and to start Python."""
_END_SECONDS = 8.0  # for a host to end its processes; they take three at most
_SEND_SECONDS = 10.0  # for ssh to take some bytes; a suspended one takes none
_POLL_SECONDS = 0.05
_MOST_BYTES = 2**16
_ALIVE_SECONDS = 1
_BEAT_SECONDS = 30.0
SILENCE_SECONDS = 600.0
"""After which a host considers a silent launcher gone; a user may suspend it for a while."""
TOLERATED = 0.8
"""The fraction of the longest outage for which a host may be cut off: a run goes on."""
_OPTIONS = (
    "-T",
    *("-o", "BatchMode=yes"),  # never ask for a password or a key
    *("-o", "ControlMaster=no"),  # a shared connection would outlive the run
    *("-o", "ControlPath=none"),  # one that exists already asks a silent host as its own options say
    *("-o", "ClearAllForwardings=yes"),
    *("-o", "ForwardAgent=no"),
    *("-o", "ForwardX11=no"),
    *("-o", "LogLevel=ERROR"),
    *("-o", "ConnectTimeout=20"),
    *("-o", f"ServerAliveInterval={_ALIVE_SECONDS}"),
)


@final
class HostedProcess(ReportedProcess):
    """A process on another host."""

    def __init__(self, number: int, host: SshHost, log: IO[bytes], last_word: str | None) -> None:
        """number: distinguishes it from all other processes of the run.

        log: its log, which it closes; last_word: the launcher's file for its last word.
        """
        super().__init__(number)
        self._host, self._log, self._last_word = host, log, last_word

    def write(self, text: str) -> None:
        """Write to its log."""
        with contextlib.suppress(OSError):  # the disk is full
            self._log.write(text.encode(errors="backslashreplace"))

    def lose(self, why: str) -> None:
        """Note that it was lost with its host, and write why into its log."""
        self.write(f"evedrop: {why}\n")
        self.end(CONNECTION_LOST, LastWord(Cause.FAILURE, why))

    def end(self, status: int, last_word: LastWord | None) -> None:
        """Note that it ended with this status and this last word."""
        if last_word is not None:
            with contextlib.suppress(MemoryError):  # who waits for it must hear of its end
                last_word.leave(self._last_word)
        self.ended(status)

    def _close(self) -> None:
        self._log.close()

    def send_signal(self, sig: int) -> None:
        """Send a signal to it, if it still runs."""
        if self._status is None:
            self._host.send(SendSignal(self.pid, sig))


@final
class SshHost:
    """A host, and the connection with it."""

    def __init__(self, name: str, table: HostTable, config: Path | None, longest_outage: float) -> None:
        """Begin to connect; longest_outage: seconds for which a process of the run may be cut off.

        Raises UsageError if there is no ssh.
        """
        self.name, self._table = name, table
        self._trial = shlex.join(trial_command(table, config))
        self._sending, self._guard = world().lock(), world().lock()
        self._processes: dict[int, HostedProcess] = {}
        self._version = ""
        self._said_before = 0
        """How much ssh and the login shell had written before the program began."""
        self._noisy = False
        """Whether anything came before the program began."""
        self._lack: str | None = None
        self._answered, self._lost = world().event(), world().event()
        try:
            self._ssh = world().ssh(ssh_command(table, config, longest_outage))
        except OSError as error:
            raise UsageError(f"ssh cannot be started ({error.strerror}); install OpenSSH's client") from error
        self._reader = world().thread(self._follow, name=f"host {name}")
        self._reader.start()
        world().thread(self._beat, name=f"heartbeat of {name}").start()

    def _beat(self) -> None:
        """Tell the host from time to time that this launcher is still there."""
        while not self._lost.wait(_BEAT_SECONDS if self._answered.is_set() else _POLL_SECONDS):
            if self._answered.is_set():
                self.send(LauncherHeartbeat(SILENCE_SECONDS))

    def wait_until_ready(self, deadline: float, stop: ThreadEvent) -> None:
        """Wait until Evedrop answers there. Raises UsageError if it does not, or has another version; Interrupted if stopped."""
        while not self._answered.wait(_POLL_SECONDS):
            if stop.is_set():
                raise Interrupted("interrupted before the run began; nothing was started")
            if self._lost.is_set():
                raise UsageError(f"host {self.name}: {self._reason()}; {self._remedy()}")
            if world().monotonic() > deadline:
                raise UsageError(
                    f"host {self.name}: evedrop did not answer there within {ANSWER_SECONDS:.0f} s ({self._reason()}); "
                    f"{self._remedy()}"
                )
        if self._version != own_version():
            raise UsageError(
                f"host {self.name}: evedrop {self._version} is installed there, and {own_version()} here; install the same "
                "version, since their messages and digests may differ"
            )

    def start(self, number: int, path: Path, log: IO[bytes], environment: Mapping[str, str]) -> HostedProcess:
        """Start the process of the brief at a path there. Raises RunError if the connection is lost."""
        brief = read_brief(path)
        world().disk.remove(path)  # its keys should not stay on disk
        if self._table.modules is not None and isinstance(brief.part, ImportingPart) and brief.part.modules is not None:
            brief = replace(brief, part=replace(brief.part, modules=self._table.modules))
        process = HostedProcess(number, self, world().disk.again(log), brief.last_word)
        with self._guard:
            if self._lost.is_set():
                process.ended(CONNECTION_LOST)
                raise RunError(f"{brief.process} cannot be started: {self._ending()}; run again")
            self._processes[number] = process
        own = own_environment()
        added = {name: value for name, value in environment.items() if own.get(name) != value}
        self.send(StartProcess(number, brief.entries, added))
        return process

    def send(self, order: Order) -> None:
        """Send an order; harmless if the connection is lost, which ends all processes there. Ends an ssh that takes nothing."""
        with self._sending, contextlib.suppress(OSError, ValueError):
            if not self._ssh.send(line_of(order), _SEND_SECONDS):
                self._ssh.kill()

    def hang_up(self) -> None:
        """Close the connection: the processes there end. Does not wait."""
        with self._sending, contextlib.suppress(OSError):
            self._ssh.hang_up()

    def close(self, deadline: float) -> None:
        """Wait until ssh has ended, and end it at the deadline."""
        self.hang_up()
        kill(*wait_for([self._ssh], deadline - world().monotonic()))
        self._reader.join(_END_SECONDS)  # it reads the end of the connection at once, and may then wait for ssh as long
        self._ssh.close()

    def _follow(self) -> None:
        """Read the host's messages until the connection ends; all processes there have ended then."""
        try:
            self._read()
        except MemoryError as error:
            self._lack = lack_of(error)
        self._lose()

    def _read(self) -> None:
        with self._ssh.answers as answers, contextlib.suppress(ValueError, OSError):
            for line in itertools.islice(answers, MOST_NOISE):  # of the login shell
                with contextlib.suppress(ValueError):
                    self._version = greeting_in(line).evedrop
                    self._said_before = len(self._ssh.said)
                    break
                self._noisy = True
            else:
                raise ValueError
            self._answered.set()
            for line in answers:
                self._take(answer_in(line))

    def _take(self, answer: Answer) -> None:
        with self._guard:
            process = self._processes.get(answer.number)
            if process is None:
                return
            if not isinstance(answer, LogText):
                del self._processes[process.pid]
        if isinstance(answer, LogText):
            process.write(answer.written)
        elif answer.status == FORK_SERVER_LOST:
            process.lose(
                f"the fork server on host {self.name} ended or stopped responding (killed, suspended or out of memory)"
            )
        else:
            process.end(answer.status, answer.last_word)

    def _lose(self) -> None:
        self.hang_up()
        wait_for([self._ssh], _END_SECONDS)
        with self._guard:
            self._lost.set()
            left, self._processes = list(self._processes.values()), {}
        for process in left:
            process.lose(self._ending())

    def _ending(self) -> str:
        """Why the host can be used no more."""
        return f"the connection with host {self.name} ended: {self._reason()}"

    def _reason(self) -> str:
        """What this machine lacks, or the last line that ssh printed, or its exit status."""
        if self._lack is not None:
            return self._lack
        lines = [line.strip() for line in self._ssh.said[self._said_before :].splitlines() if line.strip()]
        status = self._ssh.poll()
        if lines:
            return lines[-1]
        if status is not None:
            return f"ssh ended with status {status}"
        if self._answered.is_set():
            return "ssh has not ended"
        return "only its login shell has printed" if self._noisy else "ssh is still connecting"

    def _remedy(self) -> str:
        """A command that the user can try."""
        return f"try `{self._trial}`"


def ssh_words(table: HostTable) -> list[str]:
    """The words after `ssh` that name the user, the port and the host."""
    user = [] if table.user is None else ["-l", table.user]
    port = [] if table.port is None else ["-p", str(table.port)]
    return [*user, *port, "--", table.address]


def ssh_command(table: HostTable, config: Path | None, longest_outage: float) -> list[str]:
    """The command that starts Evedrop's program on a host; nothing in it is secret.

    longest_outage: as for `SshHost`. ssh asks a silent host every second. It gives up when the next question is due after too
    many without an answer: soon after what is tolerated, and before the processes there count as lost, so that it is named.
    """
    alive = ["-o", f"ServerAliveCountMax={max(1, math.ceil(TOLERATED * longest_outage / _ALIVE_SECONDS))}"]
    return ["ssh", *_given(config), *_OPTIONS, *alive, *ssh_words(table), _on_host(table, "host")]


def trial_command(table: HostTable, config: Path | None) -> list[str]:
    """The command that the user can try: it asks in the same way for the version of Evedrop there."""
    words = [word for word in ssh_words(table) if word != "--"]
    there = _on_host(table, "--version").removeprefix("exec ")
    apart = there.split()
    # ssh joins the words, so they need quotes only if one has any.
    return ["ssh", *_given(config), *words, *(apart if shlex.join(apart) == there else [there])]


def _given(config: Path | None) -> list[str]:
    return [] if config is None else ["-F", str(config)]


def _on_host(table: HostTable, word: str) -> str:
    """What the shell of a host is given: it calls Evedrop with a word."""
    folder = "" if table.folder is None else f"cd {shlex.quote(table.folder)} && "
    return f"{folder}exec {shlex.join([*table.command, word])}"


@contextmanager
def ssh_starter(
    plan: HostsPlan,
    here: Starter,
    stop: ThreadEvent,
    longest_outage: float,
) -> Iterator[Starter]:
    """A starter that is connected to all of these hosts; ends all processes on them at the end of the block.

    longest_outage: as for `SshHost`. Raises UsageError if a host cannot be used, Interrupted if stopped meanwhile.
    """
    with ExitStack() as stack:
        hosts: dict[str, SshHost] = {}

        def close() -> None:
            deadline = world().monotonic() + _END_SECONDS
            for host in hosts.values():
                host.hang_up()
            for host in hosts.values():
                host.close(deadline)

        stack.callback(close)
        for name, table in plan.hosts.items():
            hosts[name] = SshHost(name, table, plan.ssh_config, longest_outage)
        deadline = world().monotonic() + ANSWER_SECONDS
        for host in hosts.values():
            host.wait_until_ready(deadline, stop)
        numbers = itertools.count(2**32)  # a process here has a process id, which is smaller

        def start(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
            host = plan.host_of(brief.stem)
            if host is None:
                return here(role, brief, log, environment)
            return hosts[host].start(next(numbers), brief, log, environment)

        yield start


_LAST_LINES_SECONDS = 1.0  # for the last lines of a process that has ended, whose own children may hold its log open


def serve_launcher() -> None:
    """Carry out the launcher's orders until it closes standard input.

    Raises RunError for an order that is malformed; all processes are then ended.
    """
    this = world().process
    this.continue_when_parent_dies()  # if suspended, once the connection, whose process on this host is the parent, is closed
    this.keep_files_private()
    this.keep_events_apart(launched=True)
    with this.raise_on_signals(), private_folder() as private, preloaded_without_recorder() as start:
        host = HostProcesses(private, start, this.send_event)
        # The launcher's host may be gone, and the connection seem open, perhaps before anything came.
        silence, silent_seconds = Alarm(this.interrupt), SILENCE_SECONDS
        silence.set(silent_seconds)
        try:
            host.greet()
            for line in input_lines():
                try:
                    order = order_in(line)
                    if isinstance(order, LauncherHeartbeat):
                        silent_seconds = order.silence
                    silence.set(silent_seconds or None)
                    host.obey(order)
                except ValueError as error:
                    raise RunError(
                        f"the launcher gave an order that cannot be carried out ({error}); use the same version of Evedrop "
                        "on all hosts"
                    ) from error
        finally:
            host.end()


@final
class HostProcesses:
    """The processes of a launcher on this host.

    private: the folder for their files; send: sends a line to the launcher.
    """

    def __init__(self, private: Path, start: Starter, send: Callable[[bytes], object]) -> None:
        self._private, self._start, self._send = private, start, send
        self._sending = world().lock()
        self._ending = False
        self._processes: dict[int, StartedProcess] = {}

    def greet(self) -> None:
        """Say that the program runs, on a line of its own: the login shell may have printed one without its end."""
        self.answer(Greeting(own_version()), b"\n")

    def answer(self, message: Greeting | Answer, before: bytes = b"") -> None:
        """Send a message to the launcher, with what must come before it; harmless if it is gone."""
        with self._sending, contextlib.suppress(OSError):
            self._send(before + line_of(message))

    def obey(self, order: Order) -> None:
        """Start a process, or send a signal to one. Raises ValueError for an unusable brief, and a name that no file can have."""
        if isinstance(order, StartProcess):
            self._begin(order)
        elif isinstance(order, SendSignal) and (process := self._processes.get(order.number)) is not None:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(order.signal)

    def end(self) -> None:
        """End all processes. The launcher learns of it by the end of the connection: no process there failed by itself."""
        self._ending = True
        end_all(self._processes.values())

    def _begin(self, order: StartProcess) -> None:
        number, brief = order.number, with_files_in(brief_from(order.brief), self._private)
        environment = {**own_environment(), **order.environment}
        if "TMPDIR" in order.environment:
            environment["TMPDIR"] = str(self._private)
        lines, log = world().pipe()
        try:
            with log:
                path = brief.write(self._private)
                world().disk.remove(last_word_file(self._private, brief.process), missing_ok=True)
                self._processes[number] = self._start(brief.role, path, log, environment)
        except OSError as error:
            lines.close()
            self.answer(LogText(number, f"evedrop: {brief.process} cannot be started ({error})\n"))
            gone = error.errno in (errno.ESRCH, errno.ETIMEDOUT)  # its fork server, whose host is to blame
            self.answer(ProcessEnded(number, FORK_SERVER_LOST if gone else 1))
            return
        events = self._processes[number].stdout
        if events is not None:
            events.close()  # the launcher waits for no router on another host
        world().thread(self._follow, number, brief.process, lines, name=f"log of {brief.process}").start()

    def _follow(self, number: int, name: str, log: IO[bytes]) -> None:
        """Send what a process writes to its log, and how it ended."""
        reader = world().thread(self._read, number, log, name="log")
        reader.start()
        process = self._processes[number]
        status = process.wait()  # without a limit: nobody waits for this thread
        if process.stdin is not None:
            process.stdin.close()
        reader.join(_LAST_LINES_SECONDS)
        if not self._ending:
            self.answer(ProcessEnded(number, status, read_last_word(last_word_file(self._private, name))))

    def _read(self, number: int, log: IO[bytes]) -> None:
        with log as lines:
            while text := lines.read(_MOST_BYTES):
                self.answer(LogText(number, text.decode("utf-8", "replace")))
