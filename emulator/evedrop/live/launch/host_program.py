"""Starts processes of a run on this host for a launcher on another one, which gives orders on standard input.

It knows only the briefs of the processes that it starts. They are in a folder that only this user can read, until the
processes have read them. When standard input closes, however that happens, it ends all processes and removes the folder.

Source: docs/hosts.md, how it works.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any, final

from evedrop.errors import RunError, UsageError
from evedrop.live.launch.host_messages import (
    Answer,
    Greeting,
    LauncherHeartbeat,
    LogText,
    Order,
    ProcessEnded,
    SendSignal,
    StartProcess,
    line_of,
    order_in,
    own_version,
)
from evedrop.live.launch.preloading import preloaded_without_recorder
from evedrop.live.launch.private_folder import private_folder
from evedrop.live.launch.starter import FORK_SERVER_LOST, StartedProcess, Starter, end_all
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.brief_parts import ReceiverPart
from evedrop.live.protocol.last_word import last_word_file, read_last_word
from evedrop.system.environment import own_environment
from evedrop.system.processes import continue_when_parent_dies
from evedrop.system.signals import raise_on_signals

_LAST_LINES_SECONDS = 1.0  # for the last lines of a process that has ended, whose own children may hold its log open


def serve_launcher() -> None:
    """Carry out the launcher's orders until it closes standard input.

    Raises UsageError if no launcher gives orders, RunError for one that is malformed; all processes are then ended.
    """
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("`evedrop host` is started by `evedrop run SCENARIO --hosts FILE`, over ssh; use that command")
    continue_when_parent_dies()  # if suspended, once the connection, whose process on this host is the parent, is closed
    os.umask(0o077)
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # so that nothing else can write between the messages
    with raise_on_signals(), private_folder() as private, preloaded_without_recorder() as start:
        host, silence = HostProcesses(private, start, answers.write), _Silence()
        try:
            host.answer(Greeting(own_version()))
            for line in sys.stdin.buffer:
                try:
                    order = order_in(line)
                    silence.heard(order)
                    host.obey(order)
                except ValueError as error:
                    raise RunError(
                        f"the launcher gave an order that cannot be carried out ({error}); use the same version of Evedrop "
                        "on all hosts"
                    ) from error
        finally:
            host.end()


@final
class _Silence:
    """Ends this program when the launcher has been silent for long: its host may be gone, and the connection seem open."""

    def __init__(self) -> None:
        self._timer: threading.Timer | None = None
        self._seconds = 0.0

    def heard(self, order: Order) -> None:
        """Note that an order came. A heartbeat says how long the launcher may be silent from now on."""
        if isinstance(order, LauncherHeartbeat):
            self._seconds = order.silence
        if self._timer is not None:
            self._timer.cancel()
        if self._seconds:
            self._timer = threading.Timer(self._seconds, os.kill, (os.getpid(), signal.SIGTERM))
            self._timer.daemon = True
            self._timer.start()


@final
class HostProcesses:
    """The processes of a launcher on this host.

    private: the folder for their files; send: writes bytes to the launcher.
    """

    def __init__(self, private: Path, start: Starter, send: Any) -> None:
        self._private, self._start, self._send = private, start, send
        self._sending = threading.Lock()
        self._ending = False
        self._processes: dict[int, StartedProcess] = {}

    def answer(self, message: Greeting | Answer) -> None:
        """Send a message to the launcher; harmless if it is gone."""
        with self._sending, contextlib.suppress(OSError):
            left = memoryview(line_of(message))
            while left:
                left = left[self._send(left) :]

    def obey(self, order: Order) -> None:
        """Start a process, or send a signal to one. Raises ValueError if the name of a process cannot be that of a file."""
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
        number, brief = order.number, self._kept_here(order.brief)
        if Path(brief.process).name != brief.process:
            raise ValueError(f"{brief.process} is not the name of a process")
        environment = {**own_environment(), **order.environment}
        if "TMPDIR" in order.environment:
            environment["TMPDIR"] = str(self._private)
        read, write = os.pipe()
        try:
            with os.fdopen(write, "wb") as log:
                path = brief.write(self._private)
                last_word_file(self._private, brief.process).unlink(missing_ok=True)
                self._processes[number] = self._start(brief.role, path, log, environment)
        except OSError as error:
            os.close(read)
            self.answer(LogText(number, f"evedrop: {brief.process} cannot be started ({error})\n"))
            gone = error.errno in (errno.ESRCH, errno.ETIMEDOUT)  # its fork server, whose host is to blame
            self.answer(ProcessEnded(number, FORK_SERVER_LOST if gone else 1))
            return
        events = self._processes[number].stdout
        if events is not None:
            events.close()  # the launcher waits for no router on another host
        threading.Thread(target=self._follow, args=(number, brief.process, read), daemon=True).start()

    def _kept_here(self, brief: AnyBrief) -> AnyBrief:
        """The same brief with the files of the process in the private folder of this host."""
        if brief.last_word is not None:
            brief = replace(brief, last_word=str(last_word_file(self._private, brief.process)))
        if not isinstance(brief.part, ReceiverPart) or brief.part.state_file is None:
            return brief
        state_file = str((self._private / f"{brief.process}.state").absolute())
        return replace(brief, part=replace(brief.part, state_file=state_file))

    def _follow(self, number: int, name: str, log: int) -> None:
        """Send what a process writes to its log, and how it ended."""
        reader = threading.Thread(target=self._read, args=(number, log), daemon=True)
        reader.start()
        process = self._processes[number]
        status = process.wait()  # without a limit: nobody waits for this thread
        if process.stdin is not None:
            process.stdin.close()
        reader.join(_LAST_LINES_SECONDS)
        if not self._ending:
            self.answer(ProcessEnded(number, status, read_last_word(last_word_file(self._private, name))))

    def _read(self, number: int, log: int) -> None:
        with os.fdopen(log, "rb", buffering=0) as lines:
            while text := lines.read(65536):
                self.answer(LogText(number, text.decode("utf-8", "replace")))
