"""The command `evedrop`, which `python -m evedrop` is too."""

from __future__ import annotations

# What `signal` wraps; see `evedrop.interrupts`.
import _signal as signal  # type: ignore[import-not-found]
import os
import sys

from evedrop.interrupts import heed_signals, heeded

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn


def program() -> NoReturn:
    """Run the command line, and end."""
    heed_signals()

    from evedrop.cli.main import is_role, main  # noqa: PLC0415 - the handlers come first

    status = main()
    if is_role(sys.argv[1:]):
        # Threads of a process may still be in Zenoh, and an interpreter that ends meanwhile aborts (Python 3.11).
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError, AttributeError):
                continue
        os._exit(status)
    for number in heeded():  # the command is over, whatever comes while the interpreter ends
        signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


if __name__ == "__main__":
    program()
