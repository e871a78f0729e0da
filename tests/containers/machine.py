"""A Docker of our own, for one session of tests: from Debian's packages, in namespaces, gone without a trace.

what is there of the host      the kernel, the file system
what is our own                network, processes, mounts: no rule, bridge or container is ever seen outside
where images come from         debootstrap and `docker import`; Python's packages are fetched beforehand
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any, final

from tests.conftest import wait_until
from tests.debian import ROOT
from tests.folders import remove
from tests.privileged import CannotRun, run

PACKAGES = {"dockerd": "docker.io", "docker-compose": "docker-compose", "debootstrap": "debootstrap", "ip": "iproute2"}
"""Command → the Debian package that has it."""
BASE = "evedrop-base"
_START_SECONDS = 60.0

_INIT = """
mount -t proc proc /proc && ip link set lo up || exit
echo nameserver 127.0.0.1 >"$1/resolv.conf" && mount --bind "$1/resolv.conf" /etc/resolv.conf || exit
if [ "$(awk '/^MemAvailable/ {print $2}' /proc/meminfo)" -gt 10000000 ]; then mount -t tmpfs tmpfs "$1/data"; fi
shift
exec "$@"
"""
"""The first command of the namespaces; its argument is the daemon's folder, and then what it becomes.

Where there is room, images are in memory: that is faster, and gone at once. Names are asked of the machine itself, as where
systemd-resolved runs: that is when Docker 20.10 lets a container's questions out of a network that is internal.
"""


def checkout(folder: Path) -> Path:
    """A copy of this checkout, as a clone of it would be."""
    copy = folder / "evedrop"
    copy.mkdir()
    names = run("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", cwd=ROOT).stdout
    for name in names.split("\0"):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)
    return copy


@final
class Docker:
    """A daemon that runs until `end`."""

    def __init__(self, folder: Path) -> None:
        """Start it. Raises CannotRun with its last words if it does not start."""
        self.folder = folder
        self.address = f"unix://{folder}/docker.sock"
        self._group = f"evedrop-{os.getpid()}"
        self._log = folder / "dockerd.log"
        data = folder / "data"
        data.mkdir()
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [
                    # However the tests end, it ends with them.
                    *("setpriv", "--pdeathsig", "KILL"),
                    *("unshare", "--net", "--mount", "--propagation", "private", "--pid", "--fork", "--kill-child"),
                    *("sh", "-c", _INIT, "sh", str(folder)),
                    *("dockerd", "--data-root", str(data), "--exec-root", str(folder / "exec")),
                    *("--host", self.address, "--pidfile", str(folder / "docker.pid"), "--bridge", "none"),
                    # By systemd's means it would ask for control groups of process ids that are not those it has here.
                    *("--exec-opt", "native.cgroupdriver=cgroupfs", "--cgroup-parent", f"/{self._group}"),
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        deadline = time.monotonic() + _START_SECONDS
        while subprocess.run(["docker", "-H", self.address, "version"], capture_output=True, check=False).returncode:
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.end()
                raise CannotRun(f"dockerd does not start:\n{self._log.read_text()[-2000:]}")
            time.sleep(0.1)

    @property
    def pid(self) -> int:
        """The daemon's process id."""
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text()
        return int(children.split()[0])

    def __call__(self, *arguments: str, **options: Any) -> str:
        """What `docker` says. Raises AssertionError if it fails."""
        return run("docker", "-H", self.address, *arguments, **options).stdout.strip()

    def inspected(self, kind: str, name: str) -> dict[str, Any]:
        """What `docker inspect` says of one thing."""
        objects: list[dict[str, Any]] = json.loads(self(kind, "inspect", name))
        return objects[0]

    def entering(self, mounts: bool = False) -> tuple[str, ...]:
        """The words that start a command on the daemon's host: in its network; with its mounts too, though without a /proc."""
        inner = (f"--mount=/proc/{self.pid}/ns/mnt",) if mounts else ()
        return ("nsenter", f"--net=/proc/{self.pid}/ns/net", *inner)

    def inside(self, *command: str, mounts: bool = False) -> str:
        """What a command says on the daemon's host."""
        return run(*self.entering(mounts), *command).stdout

    def end(self) -> None:
        """End it with all that runs in it, and remove all it wrote."""
        # All others are in a process namespace whose first process is the daemon: the kernel ends them with it.
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")
        with contextlib.suppress(OSError):
            for pid in children.read_text().split():
                os.kill(int(pid), signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        remove(self.folder / "data")
        wait_until(lambda: _removed(self._group), "no control group left")


def take_away_leftovers() -> None:
    """Control groups of tests that were killed."""
    for name in {path.name for path in Path("/sys/fs/cgroup").glob("**/evedrop-*")}:
        if not Path("/proc", name.removeprefix("evedrop-")).exists():
            _removed(name)


def _removed(group: str) -> bool:
    """Try to remove a control group; whether it is gone."""
    left = [path for path in Path("/sys/fs/cgroup").glob(f"**/{group}") if path.is_dir()]
    for path in left:
        for folder in (*sorted(path.rglob("*/"), reverse=True), path):
            with contextlib.suppress(OSError):
                folder.rmdir()
    return not any(path.exists() for path in left)
