"""Commands in processes of their own that need not import anything: forked from a server of the test session."""

from __future__ import annotations

import atexit
import os
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import IO, Any, Protocol
from unittest.mock import patch

from evedrop.live.launch.starter import OF_OTHERS, OF_RECORDERS, OF_SUMMARIES, ForkServer, fork_servers

_MODULES = (
    *OF_OTHERS,
    *OF_RECORDERS,
    *OF_SUMMARIES,
    "evedrop.cli.commands.run",
    "evedrop.live.launch.launcher",
    "evedrop.live.launch.shards",
    "evedrop.live.launch.gathering",
    "evedrop.results.folder",
    "evedrop.show.report.writing",
    "evedrop.show.view.shown_figure",
    "matplotlib.backends.backend_svg",
    "tests.telling",
)
_ROOT = Path(__file__).parents[1]
_UNTIL_THE_END = ExitStack()
atexit.register(_UNTIL_THE_END.close)
NEWS = "EVEDROP_TEST_NEWS"
"""The environment variable that names the file for a command's events."""
LARGEST_FILE = "EVEDROP_TEST_LARGEST_FILE"
"""The environment variable that limits the size of the files of a command that writes its events, in bytes; 0: no limit."""
TELLING = Path(__file__).with_name("telling.py")
"""Runs a command that writes its events."""


class CommandProcess(Protocol):
    """The part of `subprocess.Popen[str]` that tests use."""

    pid: int

    @property
    def returncode(self) -> int | None:
        """Its exit status; None while it runs."""

    def poll(self) -> int | None:
        """Its exit status; None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""

    def communicate(self, *, timeout: float | None = None) -> tuple[str, str]:
        """Wait for its end; returns its output and errors. Raises subprocess.TimeoutExpired."""

    def send_signal(self, sig: int) -> None:
        """Send it a signal."""

    def terminate(self) -> None:
        """Ask it to end."""

    def kill(self) -> None:
        """End it."""


class ForkedCommand:
    """A command that was forked, and what it writes."""

    def __init__(
        self,
        words: Sequence[str],
        environment: Mapping[str, str],
        folder: Path,
        stdout: IO[Any] | None = None,
        umask: int | None = None,
    ) -> None:
        """stdout: where its output goes, if it is not to be kept; umask: by default that of this process."""
        if umask is None:
            umask = os.umask(0)
            os.umask(umask)
        with ExitStack() as stack:
            nothing = stack.enter_context(open(os.devnull))
            pipes = [os.pipe() for _ in range(2)]
            for _, end in pipes:
                stack.callback(os.close, end)
            files = (nothing.fileno(), pipes[0][1] if stdout is None else stdout.fileno(), pipes[1][1])
            self._fork = _server().fork(words, files, environment, str(folder), umask)
        self.pid = self._fork.pid
        self._said = ["", ""]
        self._readers = [
            threading.Thread(target=self._read, args=(i, end), daemon=True) for i, (end, _) in enumerate(pipes)
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, number: int, end: int) -> None:
        with open(end, encoding="utf-8", errors="replace") as file:
            self._said[number] = file.read()

    @property
    def returncode(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._fork.poll()

    def communicate(self, *, timeout: float | None = None) -> tuple[str, str]:
        """Wait for its end; returns its output and errors. Raises subprocess.TimeoutExpired."""
        self.wait(timeout)
        for reader in self._readers:
            reader.join()
        return self._said[0], self._said[1]

    def poll(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._fork.poll()

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        return self._fork.wait(timeout)

    def send_signal(self, sig: int) -> None:
        """Send it a signal."""
        self._fork.send_signal(sig)

    def terminate(self) -> None:
        """Ask it to end."""
        self._fork.terminate()

    def kill(self) -> None:
        """End it."""
        self._fork.kill()


@cache
def _server() -> ForkServer:
    """The server of this test process, which ends with it."""
    with patch.dict(os.environ, {"PYTHONPATH": str(_ROOT)}):
        (server,) = _UNTIL_THE_END.enter_context(fork_servers(_MODULES))
    return server
