"""What some tests need that not every machine gives: root, namespaces, commands of Debian's packages. Or it is said loudly.

A test that cannot run is skipped and fails nothing; so that nobody takes this for a test that passed, a banner has the last word
of the tests, and of `.ci/run`, which looks for it.
"""

from __future__ import annotations

import fcntl
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import pytest

BANNER = "NOT TESTED HERE"
_REASON = "this machine cannot run it: "


class CannotRun(Exception):
    """A feature cannot be tested on this machine; why, in words."""


def skip(error: CannotRun) -> NoReturn:
    """Skip a test, or all that need a fixture."""
    pytest.skip(f"{_REASON}{error}")


def say_what_was_skipped(terminal: pytest.TerminalReporter) -> None:
    """Print the banner, once for each folder and reason."""
    skipped = set()
    for report in terminal.stats.get("skipped", ()):
        reason = report.longrepr[2].removeprefix("Skipped: ")
        if reason.startswith(_REASON):
            skipped.add((report.nodeid.rpartition("/")[0], reason.removeprefix(_REASON)))
    for folder, reason in sorted(skipped):
        terminal.section(f"{BANNER}: {folder}", sep="!", red=True)
        terminal.write_line(" ".join(reason.split()))


def run(*command: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command that must succeed. Raises AssertionError with all it said."""
    quiet = {"capture_output": True, "text": True, "timeout": 600.0, "stdin": subprocess.DEVNULL, **options}
    words = [str(word) for word in command]
    done = subprocess.run(words, check=False, **quiet)
    assert done.returncode == 0, f"`{shlex.join(words)}` ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done


def tried(*command: str | Path, subject: str, **options: Any) -> str:
    """What a command says on its standard output. Raises CannotRun if it fails: that is not what we test."""
    try:
        return run(*command, **options).stdout
    except subprocess.TimeoutExpired as error:
        raise CannotRun(f"{subject}: did not end within {error.timeout:g} s") from error
    except (AssertionError, OSError) as error:
        raise CannotRun(f"{subject}: {str(error)[-2000:]}") from error


def prepare(packages: Mapping[str, str]) -> None:
    """Be root, have namespaces, and have every command; packages: command → the Debian package that has it. Raises CannotRun."""
    if sys.platform != "linux" or os.getuid() != 0:
        raise CannotRun("it takes Linux and root")
    with Path(__file__).open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the second process finds the commands installed
        _install(sorted({package for command, package in packages.items() if shutil.which(command) is None}))
    tried("unshare", "--net", "--mount", "--pid", "--fork", "true", subject="namespaces cannot be made")


def _install(missing: list[str]) -> None:
    if not missing:
        return
    if shutil.which("apt-get") is None:
        raise CannotRun(f"{', '.join(missing)} are not installed, and there is no apt-get")
    # A daemon of the machine's own is neither needed nor ours to start.
    quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "RUNLEVEL": "1"}
    tried("apt-get", "update", "-q", subject="apt-get update", env=quiet)
    names = " ".join(missing)
    install = ("apt-get", "install", "-q", "-y", "--no-install-recommends", "-o", "DPkg::Lock::Timeout=120")
    tried(*install, "--download-only", *missing, subject=f"the download of {names}", env=quiet)
    # Downloaded packages are installed without a limit: killed in the middle, dpkg would need repair.
    tried(*install, *missing, subject=f"apt-get install {names}", env=quiet, timeout=None)
