"""The users and passwords of a router are nowhere on disk, however its process ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from evedrop.live.network.access import users_file

KILLED = """
import os, signal
from evedrop.live.network.access import users_file
with users_file({"legitimate": "secret"}) as users:
    print(users.read_text(), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_users_can_be_read_while_the_session_opens() -> None:
    """A line for each, from the beginning, each time it is opened on Linux."""
    with users_file({"legitimate": "secret", "eve": "other"}) as users:
        assert users.read_text() == "legitimate:secret\neve:other\n"
    assert not users.exists()


def test_a_router_that_is_killed_leaves_no_passwords(tmp_path: Path) -> None:
    """Killed before Zenoh has read them, when nothing can be cleaned up any more."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == -signal.SIGKILL
    assert done.stdout == b"legitimate:secret\n\n"
    assert list(tmp_path.iterdir()) == []
