"""The command `evedrop`, also available as `python -m evedrop`."""

from __future__ import annotations

# The C module under `signal`; see `evedrop.interrupts`.
import _signal as signal  # type: ignore[import-not-found]
import os
import sys

from evedrop.interrupts import heed_signals, heeded

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn


def program() -> NoReturn:
    """Run the command line, and exit."""
    heed_signals()

    from evedrop.cli.main import is_role, main  # noqa: PLC0415 - the handlers come first

    status = main()
    if is_role(sys.argv[1:]):
        # Threads of the process may still be in Zenoh; an interpreter that exits meanwhile aborts (Python 3.11).
        os._exit(status)
    for number in heeded():  # the command is over: ignore signals while the interpreter exits
        signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


if __name__ == "__main__":
    program()
