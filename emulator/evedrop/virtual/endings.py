"""The exit status of a command in the simulated world.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections.abc import Callable

from evedrop.errors import EvedropError, Interrupted, RunError
from evedrop.system.lacks import lack_of, report_refusal
from evedrop.system.output import say


def status_of(work: Callable[[], int]) -> int:
    """Do the work of a command, and say what it raises, as the command line does; returns its exit status."""
    try:
        return work()
    except EvedropError as error:
        say(error.illustrated)
        return error.exit_status
    except KeyboardInterrupt:
        return Interrupted.exit_status
    except BaseException as error:
        if (lack := lack_of(error)) is not None:
            say(lack)
            return RunError.exit_status
        if not isinstance(error, OSError):
            raise
        return report_refusal(error)
