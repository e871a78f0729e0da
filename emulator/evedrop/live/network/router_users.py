"""Tasks of both router and relay: write the passwords of the users they let in, and leave after those users."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

_FAREWELL_SECONDS = 10.0


@contextmanager
def users_file(users: Mapping[str, str]) -> Iterator[Path]:
    """The file of users and passwords that Zenoh reads once, when the session opens.

    It has no name in any folder, so nothing of it is left however the process ends: the path is that of an open file.
    """
    with tempfile.TemporaryFile("w", encoding="utf-8") as file:
        file.writelines(f"{user}:{password}\n" for user, password in users.items())
        file.flush()
        file.seek(0)  # where a path of an open file shares its position
        yield Path(f"/dev/fd/{file.fileno()}")


def until_all_left(present: Mapping[str, bool], linked: Callable[[], bool] = lambda: False) -> None:
    """Wait until no process is present and no other router is linked, for a few seconds at most.

    Two routers that close their link at the same time fail in Zenoh 1.10, so one must leave first.
    """
    deadline = time.monotonic() + _FAREWELL_SECONDS
    while (any(present.values()) or linked()) and time.monotonic() < deadline:
        time.sleep(0.005)
