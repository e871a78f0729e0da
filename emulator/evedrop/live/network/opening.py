"""Opens the sessions of Zenoh: of every command and process, so that each says in a sentence why Zenoh cannot begin.

Zenoh panics if it cannot start a thread or read `ZENOH_RUNTIME`: no handler of errors but that of `BaseException` sees this.
"""

from __future__ import annotations

import zenoh

from evedrop.errors import RunError
from evedrop.system.environment import check_zenoh_runtime
from evedrop.system.lacks import lack_of


def open_session(config: zenoh.Config) -> zenoh.Session:
    """Open a session.

    Raises zenoh.ZError, UsageError if `ZENOH_RUNTIME` is malformed, and RunError if the machine lacks threads or memory.
    """
    check_zenoh_runtime()
    try:
        return zenoh.open(config)
    except zenoh.ZError:
        raise
    except BaseException as error:
        if (lack := lack_of(error)) is None:
            raise
        raise RunError(lack) from error
