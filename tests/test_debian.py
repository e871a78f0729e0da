"""The base image is made, killed and removed without harm to the machine; debootstrap is a stand-in that takes forever."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import final

import pytest

from tests.conftest import wait_until
from tests.debian import ROOT, bootstrap
from tests.folders import mounted_below, remove
from tests.privileged import CannotRun, prepare, run, skip

DEBOOTSTRAP = """#!/bin/sh
# As debootstrap does it: arguments --variant, --include, release, folder, mirror.
exec 3>"$ALIVE"
mkdir "$4/proc" "$4/sys" && mount -t proc proc "$4/proc" && mount -t sysfs sys "$4/sys" || exit
(trap '' TERM; exec sleep 1000 >/dev/null 2>&1) &
echo mounted >&3
wait
"""
"""It holds a pipe open as long as it, or what it started, is alive."""

MAKES = """
import sys
from pathlib import Path
from tests.debian import bootstrap
folder = Path(sys.argv[1])
bootstrap(folder, "http://mirror.invalid", "bookworm", folder / "base.tar")
"""

IN_A_NAMESPACE = ("unshare", "--mount", "--propagation", "private")


@final
class StartedDebootstrap:
    """What is known of a stand-in of debootstrap that was started."""

    def __init__(self, folder: Path) -> None:
        self._pipe = folder / "alive"
        os.mkfifo(self._pipe)
        self._reader = os.open(self._pipe, os.O_RDONLY | os.O_NONBLOCK)

    @property
    def environment(self) -> dict[str, str]:
        """What the stand-in needs."""
        return {"ALIVE": str(self._pipe)}

    def mounted(self) -> bool:
        """Whether it has mounted what it mounts."""
        try:
            return os.read(self._reader, 100) == b"mounted\n"
        except BlockingIOError:
            return False

    def over(self) -> bool:
        """Whether all that it started are gone."""
        try:
            return os.read(self._reader, 100) == b""
        except BlockingIOError:
            return False

    def close(self) -> None:
        """Forget it."""
        os.close(self._reader)


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StartedDebootstrap]:
    """A stand-in for debootstrap that mounts what debootstrap mounts, and never ends; the machine's mounts stay as they are."""
    try:
        prepare({})
    except CannotRun as error:
        skip(error)
    program = tmp_path / "bin" / "debootstrap"
    program.parent.mkdir()
    program.write_text(DEBOOTSTRAP)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    with unharmed(tmp_path):
        debootstrap = StartedDebootstrap(tmp_path)
        for name, value in debootstrap.environment.items():
            monkeypatch.setenv(name, value)
        yield debootstrap
        debootstrap.close()


@contextmanager
def unharmed(folder: Path) -> Iterator[None]:
    """Check that nothing is mounted in a folder afterwards, and that the machine has the /proc and /sys that it had."""

    def of_the_machine() -> list[str]:
        lines = Path("/proc/self/mountinfo").read_text().splitlines()
        return [line for line in lines if line.split()[4] in {"/", "/proc", "/sys"}]

    before = of_the_machine()
    yield
    assert mounted_below(folder) == []
    assert of_the_machine() == before
    assert Path("/proc/1/stat").exists()


@pytest.mark.thorough
def test_a_slow_debootstrap_is_given_up_and_leaves_nothing(started: StartedDebootstrap, tmp_path: Path) -> None:
    """It is said that it was slow; neither a mount nor a process nor a file is left."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    with pytest.raises(CannotRun, match="debootstrap: did not end within 2 s"):
        bootstrap(folder, "http://mirror.invalid", "bookworm", folder / "base.tar", seconds=2.0)
    assert started.mounted(), "it must be given up in the middle"
    wait_until(started.over, "the end of all that it started")
    assert mounted_below(folder) == []
    assert [path.name for path in folder.rglob("*")] == ["system"]
    remove(folder)
    assert not folder.exists()


def test_killed_tests_leave_no_mount_and_no_process(started: StartedDebootstrap, tmp_path: Path) -> None:
    """Kill -9 of the process that makes the base, in the middle: debootstrap ends with it, and so do its mounts."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    command = (sys.executable, "-c", MAKES, folder)
    with subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}) as maker:
        wait_until(started.mounted, "a debootstrap under way")
        maker.send_signal(signal.SIGKILL)
    wait_until(started.over, "the end of all that it started")
    assert mounted_below(folder) == []
    assert [path.name for path in folder.rglob("*")] == ["system"]


def test_a_debootstrap_that_fails_is_no_failure_of_ours(
    started: StartedDebootstrap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it said is the reason why nothing is tested."""
    (tmp_path / "bin" / "debootstrap").write_text("#!/bin/sh\necho 'E: no such mirror' >&2\nexit 1\n")
    (tmp_path / "temporary").mkdir()
    with pytest.raises(CannotRun, match="E: no such mirror"):
        bootstrap(tmp_path / "temporary", "http://mirror.invalid", "bookworm", tmp_path / "base.tar")


def test_apts_proxies_are_for_debootstrap_too(
    started: StartedDebootstrap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are in a configuration of its own; a variable of the environment outranks them."""
    programs = {
        "apt-config": "echo \"http_proxy='http://a b.invalid:1'\"; echo \"https_proxy='http://apt.invalid:2'\"",
        "debootstrap": 'echo "<$http_proxy> <$https_proxy>" >&2; exit 1',
    }
    for name, script in programs.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.delenv("http_proxy", raising=False)
    monkeypatch.setenv("https_proxy", "http://ours.invalid:3")
    (tmp_path / "temporary").mkdir()
    with pytest.raises(CannotRun, match=r"<http://a b\.invalid:1> <http://ours\.invalid:3>"):
        bootstrap(tmp_path / "temporary", "http://mirror.invalid", "bookworm", tmp_path / "base.tar")


REMOVES = """
import subprocess, sys
from pathlib import Path
from tests.folders import mounted_below, remove
folder, kept = Path(sys.argv[1]), Path(sys.argv[2])
point = folder / "a place"
subprocess.run(["mount", *sys.argv[3:], point], check=True)
(point / "treasure").write_text("kept")
assert mounted_below(folder) == [point], mounted_below(folder)
try:
    remove(folder)
except AssertionError as error:
    assert str(point) in str(error), error
else:
    raise SystemExit("it was removed")
assert (point / "treasure").read_text() == "kept"
assert (folder / "other").exists()
subprocess.run(["umount", point], check=True)
remove(folder)
assert not folder.exists()
"""


@pytest.mark.parametrize("kind", ["another file system", "the same file system"])
def test_a_folder_with_a_mount_in_it_is_not_removed(started: StartedDebootstrap, kind: str, tmp_path: Path) -> None:
    """Not by a byte, be it a bind mount, whose device is the folder's own; and removed when nothing is mounted any more."""
    folder, kept = tmp_path / "temporary", tmp_path / "kept"
    for made in (folder / "a place", folder / "other", kept):
        made.mkdir(parents=True)
    mount = ("-t", "tmpfs", "tmpfs") if kind == "another file system" else ("--bind", kept)
    script = (sys.executable, "-c", REMOVES, folder, kept, *mount)
    run(*IN_A_NAMESPACE, *script, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert not folder.exists()
    assert [path.name for path in kept.iterdir()] == ([] if kind == "another file system" else ["treasure"])
