"""The command as it is, which also writes what its progress line shows: run as a script, or imported by a fork server.

The environment variable EVEDROP_TEST_NEWS names the file for the events, if it is set, and EVEDROP_TEST_LARGEST_FILE limits the
size of the command's files in bytes (0: no limit). A fork finds the modules of its own PYTHONPATH, as a new interpreter would.
"""

from __future__ import annotations

from evedrop.system.signals import heed_signals

if __name__ == "__main__":
    heed_signals()

import importlib
import os
import resource
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from evedrop import __main__ as command
from evedrop.cli.console import ProgressLine
from evedrop.fork_server import serve
from evedrop.scenario.progress_events import Held
from evedrop.system import fork_channels

if TYPE_CHECKING:
    from evedrop.scenario.progress_events import ProgressEvent

show = ProgressLine.on_event


def on_event(self: ProgressLine, event: ProgressEvent) -> None:
    """In the place of `ProgressLine.on_event`."""
    if (path := os.environ.get("EVEDROP_TEST_NEWS")) is not None:
        with open(path, "a") as file:
            done = event.before if isinstance(event, Held) else getattr(event, "done", 0)
            file.write(f"{done} {event.__struct_config__.tag}\n")
    show(self, event)


class Forked:
    """A process that was forked from this one."""

    def __init__(self, pid: int) -> None:
        self._pid = pid

    def kill(self) -> None:
        """End it."""
        os.kill(self._pid, 9)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end: it has been killed."""
        del timeout
        return os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])


def forked_servers(channels: Sequence[socket.socket], modules: Sequence[Sequence[str]]) -> Forked:
    """In the place of `start_servers`, in a command that has made all imports and has no other thread yet."""
    del modules
    pid = os.fork()
    if pid == 0:
        _become_servers(channels)
    return Forked(pid)


def _become_servers(channels: Sequence[socket.socket]) -> NoReturn:
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    theirs = [channel.dup() for channel in channels]
    before = 3
    for channel in sorted(theirs, key=socket.socket.fileno):
        os.closerange(before, channel.fileno())
        before = channel.fileno() + 1
    os.closerange(before, os.sysconf("SC_OPEN_MAX"))
    serve(theirs[0], (), [(channel, ()) for channel in theirs[1:]])


def limited_program() -> NoReturn:
    """`program`, whose files are no larger than the environment says."""
    largest = int(os.environ.get("EVEDROP_TEST_LARGEST_FILE", "0"))
    if largest:
        sys.dont_write_bytecode = True  # before 3.12.8, Python would leave half a .pyc for the next process
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
    program()


def program_with_path() -> NoReturn:
    """In the place of `program`, in a fork: with the modules of PYTHONPATH, and a `sitecustomize` among them.

    Debian and Ubuntu ship a `sitecustomize` that this process has imported long ago; the one in PYTHONPATH comes before it.
    """
    folders = [
        folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder and folder not in sys.path
    ]
    if folders:
        sys.path[:0] = folders
        importlib.invalidate_caches()
        sys.modules.pop("sitecustomize", None)
        with suppress(ModuleNotFoundError):
            importlib.import_module("sitecustomize")
    limited_program()


ProgressLine.on_event = on_event  # type: ignore[method-assign]
program = command.program

if __name__ == "__main__":
    limited_program()
else:
    fork_channels.start_servers = forked_servers
    command.program = program_with_path
