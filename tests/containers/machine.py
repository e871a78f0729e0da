"""A Docker of our own, for one session of tests: from Debian's packages, in namespaces, gone without a trace.

what is there of the host      the kernel, the file system
what is our own                network, processes, mounts: no rule, bridge or container is ever seen outside
where images come from         debootstrap and `docker import`; Python's packages are fetched beforehand
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from tests.conftest import wait_until

ROOT = Path(__file__).parents[2]
PACKAGES = {"dockerd": "docker.io", "docker-compose": "docker-compose", "debootstrap": "debootstrap", "ip": "iproute2"}
"""Command → the Debian package that has it."""
BASE = "evedrop-base"
_START_SECONDS = 60.0

_INIT = 'mount -t proc proc /proc && ip link set lo up && exec "$@"'


class CannotRun(Exception):
    """No containers can be started on this machine; why, in words."""


def run(*command: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command that must succeed. Raises AssertionError with all it said."""
    quiet = {"capture_output": True, "text": True, "timeout": 600.0, "stdin": subprocess.DEVNULL, **options}
    done = subprocess.run([str(word) for word in command], check=False, **quiet)
    assert done.returncode == 0, f"{command} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done


def tried(*command: str | Path, what: str, **options: Any) -> str:
    """What a command says on its standard output. Raises CannotRun if it fails: that is not what we test."""
    try:
        return run(*command, **options).stdout
    except (AssertionError, OSError, subprocess.TimeoutExpired) as error:
        raise CannotRun(f"{what}: {str(error)[-2000:]}") from error


def install() -> None:
    """Have every command that is needed. Raises CannotRun."""
    if sys.platform != "linux" or os.getuid() != 0:
        raise CannotRun("it takes Linux and root")
    missing = [package for command, package in PACKAGES.items() if shutil.which(command) is None]
    if missing:
        if shutil.which("apt-get") is None:
            raise CannotRun(f"{', '.join(missing)} are not installed, and there is no apt-get")
        # A daemon of the machine's own is neither needed nor ours to start.
        quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "RUNLEVEL": "1"}
        tried("apt-get", "update", "-q", what="apt-get update", env=quiet)
        command = ("apt-get", "install", "-q", "-y", "--no-install-recommends", *missing)
        tried(*command, what=f"apt-get install {' '.join(missing)}", env=quiet)
    tried("unshare", "--net", "--mount", "--pid", "--fork", "true", what="namespaces cannot be made")


def mirror() -> tuple[str, str]:
    """Where this machine has Debian from: the address of the mirror, and the name of the release. Raises CannotRun."""
    release = platform.freedesktop_os_release().get("VERSION_CODENAME", "")
    pattern = ("indextargets", "--format", "$(CODENAME) $(COMPONENT) $(REPO_URI)", "Created-By: Packages")
    lines = tried("apt-get", *pattern, what="apt-get indextargets").splitlines()
    if not lines:
        tried("apt-get", "update", "-q", what="apt-get update")
        lines = tried("apt-get", *pattern, what="apt-get indextargets").splitlines()
    for line in lines:
        codename, component, address = line.split(maxsplit=2)
        if (codename, component) == (release, "main"):
            return address, release
    raise CannotRun(f"apt knows no mirror of {release}")


def bootstrap(folder: Path) -> Path:
    """A file system with Python from Debian's own packages, as a tar. Raises CannotRun if the mirror cannot be reached."""
    address, release = mirror()
    system, tar = folder / "system", folder / "system.tar"
    tried(
        *("debootstrap", "--variant=minbase", "--include=python3,python3-venv", release, system, address),
        what="debootstrap",
    )
    left_out = ("var/cache/apt", "var/lib/apt/lists", "usr/share/doc", "usr/share/locale")
    run("tar", "-C", system, *(f"--exclude=./{one}/*" for one in left_out), "-cf", tar, ".")
    version = run("chroot", system, "python3", "--version").stdout.split()[1].split(".")[:2]
    shutil.rmtree(system)
    if version != list(map(str, sys.version_info[:2])):
        # pip chooses packages by the Python it runs in.
        raise CannotRun(f"Debian's Python is {'.'.join(version)}, and not {sys.version_info[0]}.{sys.version_info[1]}")
    return tar


def checkout(folder: Path) -> Path:
    """A copy of this checkout, as somebody has it who clones it."""
    copy = folder / "evedrop"
    copy.mkdir()
    names = run("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", cwd=ROOT).stdout
    for name in names.split("\0"):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)
    return copy


class Docker:
    """A daemon that runs until `end`. Final."""

    def __init__(self, folder: Path) -> None:
        """Start it. Raises CannotRun with its last words if it does not start."""
        self.folder = folder
        self.address = f"unix://{folder}/docker.sock"
        self._group = f"evedrop-{os.getpid()}"
        self._log = folder / "dockerd.log"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [
                    # However the tests end, it ends with them.
                    *("setpriv", "--pdeathsig", "KILL"),
                    *("unshare", "--net", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", _INIT, "sh"),
                    *("dockerd", "--data-root", str(folder / "data"), "--exec-root", str(folder / "exec")),
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
        found: list[dict[str, Any]] = json.loads(self(kind, "inspect", name))
        return found[0]

    def inside(self, *command: str) -> str:
        """What a command says that sees the daemon's network."""
        return run("nsenter", f"--net=/proc/{self.pid}/ns/net", *command).stdout

    def end(self) -> None:
        """End it with all that runs in it, and remove all it wrote."""
        # All others are in a process namespace whose first process is the daemon: the kernel ends them with it.
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")
        with contextlib.suppress(OSError):
            for pid in children.read_text().split():
                os.kill(int(pid), signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        shutil.rmtree(self.folder / "data", ignore_errors=True)
        wait_until(self._groups_removed, "no control group left")

    def _groups_removed(self) -> bool:
        left = [path for path in Path("/sys/fs/cgroup").glob(f"**/{self._group}") if path.is_dir()]
        for path in left:
            for folder in sorted(path.rglob("*/"), reverse=True):
                with contextlib.suppress(OSError):
                    folder.rmdir()
            with contextlib.suppress(OSError):
                path.rmdir()
        return not any(path.exists() for path in left)
