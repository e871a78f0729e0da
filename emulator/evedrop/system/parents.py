"""What the system does to a process when its parent dies."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

_PR_SET_PDEATHSIG = 1
# The setting survives exec. A parent that died before it was made sends no signal any more. Python ignores SIGPIPE, and a program
# that it becomes would, too.
_SIGNALLED = """
import ctypes, os, signal, sys
{first}
number, parent = int(sys.argv[1]), int(sys.argv[2])
ctypes.CDLL(None).prctl(1, number, 0, 0, 0)
if os.getppid() != parent:
    os.kill(os.getpid(), number)
signal.signal(signal.SIGPIPE, signal.SIG_DFL)
os.execv(sys.argv[3], sys.argv[3:])
"""


def continue_when_parent_dies() -> None:
    """Let the system continue this process if it is suspended when its parent dies: it would not notice (Linux only)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGCONT), 0, 0, 0)


def signalled_when_parent_dies(command: Sequence[str], number: signal.Signals, first: str = "") -> list[str]:
    """A command whose process gets a signal when this process dies, however it dies; the same command outside Linux.

    command: begins with the path of a file; first: Python code that runs before it, with `ctypes` and `os` imported.
    """
    if sys.platform != "linux":
        return [*command]
    code = _SIGNALLED.format(first=first)
    return [sys.executable, "-I", "-S", "-c", code, str(int(number)), str(os.getpid()), *command]
