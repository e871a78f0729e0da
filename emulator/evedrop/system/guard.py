"""A shell that removes a folder when this process is dead, however it died: it holds the other end of a pipe to it."""

from __future__ import annotations

import signal
import subprocess
from contextlib import suppress
from pathlib import Path

from evedrop.system.environment import own_environment
from evedrop.system.parents import signalled_when_parent_dies

_GUARD_SECONDS = 5.0
# A process that is still starting may write into the folder while it is being removed, so try again.
_GUARD = (
    "while read -r _; do :; done; tries=0; "
    'while [ -e "$1" ] && [ $tries -lt 50 ]; do rm -rf -- "$1" 2>/dev/null || sleep 0.2; tries=$((tries + 1)); done'
)


def guard_of(folder: Path) -> subprocess.Popen[bytes]:
    """Start the shell that removes the folder when the launcher is dead; called before the folder is made."""
    # A suspended shell would not notice that the launcher is dead.
    return subprocess.Popen(
        signalled_when_parent_dies(["/bin/sh", "-c", _GUARD, "sh", str(folder)], signal.SIGCONT),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env=own_environment(),
    )


def dismiss(guard: subprocess.Popen[bytes]) -> None:
    """End the shell, which removes what is left of the folder."""
    assert guard.stdin is not None  # noqa: S101 - it was started with a pipe
    guard.stdin.close()
    guard.send_signal(signal.SIGCONT)
    try:
        guard.wait(_GUARD_SECONDS)
    except subprocess.TimeoutExpired:
        guard.kill()
        with suppress(subprocess.TimeoutExpired):
            guard.wait(_GUARD_SECONDS)
