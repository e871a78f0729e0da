"""A fork server: a bare process from which the processes of a run are forked, so that modules are imported only once.

It knows no scenario, no seed and no brief. For each process the launcher (`evedrop.live.launch.starter`) sends the words
of its command, its environment, folder, umask and standard files; a fork then runs that command as a new interpreter would.
The launcher gets each process's id and, when it ends, its status. This process ends when the launcher does. A server for
roles that need further modules is a fork of this one that has imported those, too.
"""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from setproctitle import setproctitle

from evedrop.system.lacks import refuse_scipy_without_room
from evedrop.system.parents import continue_when_parent_dies
from evedrop.system.signals import SIGNALS, heed_signals

_MOST_BYTES = 1 << 17
_FILES = 3
Server = tuple[socket.socket, Sequence[str]]
"""The channel of a server, and what it imports in addition to those before it."""


def serve(channel: socket.socket, modules: Sequence[str], further: Sequence[Server] = ()) -> NoReturn:
    """Start processes as the launcher asks, and report their ends, until the launcher closes the channel.

    further: servers that import these modules and more.
    """
    continue_when_parent_dies()  # the parent of a further server is the one before it, which ends with the launcher
    for name in modules:
        with suppress(Exception):  # the process that needs it will say why it cannot be imported
            import_module(name)
    successor = os.fork() if further else None
    if successor == 0:
        channel.close()
        serve(*further[0], further[1:])
    for other, _ in further:
        other.close()
    gc.collect()
    gc.freeze()  # so that a fork's collections do not copy all pages
    ended, woken = os.pipe()
    os.set_blocking(woken, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(woken, warn_on_full_buffer=False)
    try:
        while True:
            # Without a limit: the launcher's end closes the channel, and a suspended server is then continued.
            ready, _, _ = select.select([channel.fileno(), ended], [], [])
            if ended in ready:
                os.read(ended, 512)
                _report_ends(channel, successor)
            if channel.fileno() in ready:
                request, files, _, _ = socket.recv_fds(channel, _MOST_BYTES, _FILES)
                if not request:
                    os._exit(0)
                _start(channel, request, files, (ended, woken))
    except OSError:  # the launcher is gone
        os._exit(0)


def _report_ends(channel: socket.socket, successor: int | None) -> None:
    with suppress(ChildProcessError):
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            if pid == successor:
                continue
            channel.send(json.dumps({"pid": pid, "status": os.waitstatus_to_exitcode(status)}).encode())


def _start(channel: socket.socket, request: bytes, files: list[int], own: tuple[int, int]) -> None:
    # A fork forgets the signals that reach it before it runs; blocked ones wait until its handlers are installed.
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        pid = os.fork()
    except OSError as error:
        channel.send(json.dumps({"error": error.errno}).encode())
    else:
        if pid == 0:
            channel.close()
            _become(request, files, own)
        handle = os.pidfd_open(pid)
        socket.send_fds(channel, [json.dumps({"pid": pid}).encode()], [handle])
        os.close(handle)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    for file in files:
        os.close(file)


def _become(request: bytes, files: list[int], own: tuple[int, int]) -> NoReturn:
    """Run a command in this fork, as a new interpreter would."""
    status = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        for number, file in enumerate(files):
            os.dup2(file, number)
        for file in (*files, *own):
            os.close(file)
        message = json.loads(request)
        if message["folder"] is not None:
            os.chdir(message["folder"])
        os.umask(message["umask"])
        sys.argv[1:] = message["words"]
        # Before the environment changes, next to which the system keeps the command line.
        setproctitle(" ".join([sys.executable, "-P", "-m", "evedrop", *message["words"]]))
        os.environ.clear()
        os.environ.update(message["environment"])
        from evedrop.__main__ import program  # noqa: PLC0415 - not needed by the process that forks

        program()
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 1
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        os._exit(status)


if __name__ == "__main__":
    heed_signals()
    refuse_scipy_without_room()
    first, *others = [(socket.socket(fileno=int(one[0])), one[1:]) for one in json.loads(sys.argv[1])]
    serve(*first, others)
