"""Starts processes of a run on this host for a launcher on another one, which gives orders on standard input.

It knows only the briefs of the processes that it starts. They are in a folder that only this user can read, until the
processes have read them. When standard input closes, however that happens, it ends all processes and removes the folder.

Source: docs/hosts.md, how it works.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

from evedrop.environment import own_environment
from evedrop.errors import UsageError
from evedrop.live.launch.host_messages import line_of, message_in, own_version
from evedrop.live.launch.preloading import preloaded_without_observer
from evedrop.live.launch.private_folder import private_folder
from evedrop.live.launch.starter import StartedProcess, Starter, end_all
from evedrop.signals import held_back, raise_on_signals

_LAST_LINES_SECONDS = 1.0  # for the last lines of a process that has ended, whose own children may hold its log open


def serve_launcher() -> None:
    """Carry out the launcher's orders until it closes standard input."""
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("`evedrop host` is started by `evedrop run SCENARIO --hosts FILE`, over ssh; use that command")
    os.umask(0o077)
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # so that nothing else can write between the messages
    with raise_on_signals(), private_folder() as private, preloaded_without_observer() as start:
        host, silence = HostProcesses(private, start, answers.write), _Silence()
        try:
            host.answer({"evedrop": own_version()})
            for line in sys.stdin.buffer:
                order = message_in(line)
                silence.heard(order.get("silence"))
                host.obey(order)
        finally:
            host.end()


@final
class _Silence:
    """Ends this program when the launcher has been silent for long: its host may be gone, and the connection seem open."""

    def __init__(self) -> None:
        self._timer: threading.Timer | None = None
        self._seconds = 0.0

    def heard(self, seconds: float | None) -> None:
        """Note that an order came; seconds: how long the launcher may be silent from now on, if the order says so."""
        self._seconds = self._seconds if seconds is None else float(seconds)
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
        self._processes: dict[int, StartedProcess] = {}

    def answer(self, message: Mapping[str, Any]) -> None:
        """Send a message to the launcher; harmless if it is gone."""
        with self._sending, contextlib.suppress(OSError):
            left = memoryview(line_of(message))
            while left:
                left = left[self._send(left) :]

    def obey(self, order: Mapping[str, Any]) -> None:
        """Start a process, or send a signal to one. Raises KeyError, TypeError or ValueError if the order is malformed."""
        if "start" in order:
            self._begin(order["start"], order["role"], order["brief"], order["environment"])
        elif "signal" in order and (process := self._processes.get(order["signal"])) is not None:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(order["number"])

    def end(self) -> None:
        """End all processes."""
        end_all(self._processes.values())

    def _begin(self, number: int, role: str, brief: dict[str, Any], added: Mapping[str, str]) -> None:
        process = brief["process"]
        if Path(process).name != process:
            raise ValueError(f"{process} is not the name of a process")
        if brief["part"].get("state_file") is not None:
            brief["part"]["state_file"] = str((self._private / f"{process}.state").absolute())
        environment = {**own_environment(), **added}
        if "TMPDIR" in added:
            environment["TMPDIR"] = str(self._private)
        read, write = os.pipe()
        try:
            with os.fdopen(write, "wb") as log:
                path = self._private / f"{process}.json"
                with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
                    json.dump(brief, file)
                with held_back():
                    self._processes[number] = self._start(role, path, log, environment)
        except OSError as error:
            os.close(read)
            self.answer({"log": number, "text": f"evedrop: {process} cannot be started ({error})\n"})
            self.answer({"ended": number, "status": 1})
            return
        threading.Thread(target=self._follow, args=(number, read), daemon=True).start()

    def _follow(self, number: int, log: int) -> None:
        """Send what a process writes to its log, and how it ended."""
        reader = threading.Thread(target=self._read, args=(number, log), daemon=True)
        reader.start()
        process = self._processes[number]
        status = process.wait()
        if process.stdin is not None:
            process.stdin.close()
        reader.join(_LAST_LINES_SECONDS)
        self.answer({"ended": number, "status": status})

    def _read(self, number: int, log: int) -> None:
        with os.fdopen(log, "rb", buffering=0) as lines:
            while text := lines.read(65536):
                self.answer({"log": number, "text": text.decode("utf-8", "replace")})
