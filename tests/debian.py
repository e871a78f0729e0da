"""File systems of Debian's own packages, made by debootstrap where nothing can be harmed, and kept in build/.

The containers' image is built on such a file system, and fresh machines run in one. debootstrap runs as root and mounts /proc and
/sys in what it makes. If it is killed half-way, they stay mounted, and removing the folder then removes from the machine's own
/proc. So here it has mounts and processes of its own, and writes to memory: when its first process ends, however it ends, the
kernel ends all others, and mounts and files are gone.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import tarfile
from collections.abc import Sequence
from pathlib import Path

from tests.privileged import CannotRun, tried

ROOT = Path(__file__).parents[1]
SECONDS = 600.0
"""How long a file system may take to make."""
NEEDED_KILOBYTES = 3_000_000

IN_NAMESPACES = (
    *("setpriv", "--pdeathsig", "KILL"),  # however the tests end, it ends with them
    *("unshare", "--mount", "--propagation", "private", "--pid", "--fork", "--kill-child", "--mount-proc"),
)
"""The words that start a command with mounts and processes of its own."""
_BOOTSTRAP = """
set -eu
mount -t tmpfs -o size=2g tmpfs "$1"
debootstrap --variant=minbase --include="$5" "$2" "$1" ${3:+"$3"}
tar -C "$1" --one-file-system \
  --exclude='./var/cache/apt/*' --exclude='./var/lib/apt/lists/*' --exclude='./usr/share/doc/*' --exclude='./usr/share/locale/*' \
  -cf "$4" .
"""
"""Arguments: an empty folder, the release, the mirror or nothing, the tar to write, the packages."""


def own_release() -> str:
    """The name of the release that this machine runs, such as `bookworm`; empty if it says none."""
    return platform.freedesktop_os_release().get("VERSION_CODENAME", "")


def mirror(release: str) -> str:
    """The address from which this machine's apt has the packages of a release. Raises CannotRun."""
    pattern = ("indextargets", "--format", "$(CODENAME) $(COMPONENT) $(REPO_URI)", "Created-By: Packages")
    lines = tried("apt-get", *pattern, subject="apt-get indextargets").splitlines()
    if not lines:
        tried("apt-get", "update", "-q", subject="apt-get update")
        lines = tried("apt-get", *pattern, subject="apt-get indextargets").splitlines()
    for line in lines:
        codename, component, address = line.split(maxsplit=2)
        if (codename, component) == (release, "main"):
            return address
    raise CannotRun(f"apt knows no mirror of {release}")


def debian_mirror() -> str:
    """The mirror from which this machine has Debian; empty if it is another system: debootstrap has a mirror of its own."""
    return mirror(own_release()) if platform.freedesktop_os_release().get("ID") == "debian" else ""


def base(folder: Path, address: str, release: str, packages: Sequence[str]) -> Path:
    """A release's file system as a tar, kept in build/ for the next time.

    folder: for what is temporary; packages: what it has besides Debian's minimum. Raises CannotRun.
    """
    contents = hashlib.sha256(" ".join(packages).encode()).hexdigest()[:8]
    kept = ROOT / "build" / f"test-base-{release}-{platform.machine()}-{contents}.tar"
    if not kept.exists():
        require_memory(NEEDED_KILOBYTES, "debootstrap")
        kept.parent.mkdir(exist_ok=True)
        half = kept.with_name(f"{kept.name}-{os.getpid()}")
        try:
            bootstrap(folder, address, release, half, packages)
            half.replace(kept)
        finally:
            half.unlink(missing_ok=True)
    return kept


def bootstrap(
    folder: Path, address: str, release: str, tar: Path, packages: Sequence[str] = (), seconds: float = SECONDS
) -> None:
    """Make the file system; folder: where an empty folder can be made, which it is mounted on. Raises CannotRun."""
    system = folder / "system"
    system.mkdir()
    command = (*IN_NAMESPACES, "sh", "-c", _BOOTSTRAP, "sh", system, release, address, tar, ",".join(packages))
    tried(*command, subject="debootstrap", timeout=seconds, env={**_proxies(), **os.environ})
    system.rmdir()  # nothing was ever in it that others than the command saw


def python_version(tar: Path) -> str:
    """The version of a file system's Python, such as `3.13`."""
    with tarfile.open(tar) as files:
        return files.getmember("./usr/bin/python3").linkname.removeprefix("python")


def _proxies() -> dict[str, str]:
    """Apt's proxies as variables of the environment; debootstrap does not ask apt."""
    words = ("http_proxy", "Acquire::http::Proxy", "https_proxy", "Acquire::https::Proxy")
    lines = tried("apt-config", "shell", *words, subject="apt-config").splitlines()
    return dict(line.split("=", 1) for line in shlex.split(" ".join(lines)))


def require_memory(kilobytes: int, subject: str) -> None:
    """Raises CannotRun if less is available."""
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:") and (available := int(line.split()[1])) < kilobytes:
            raise CannotRun(f"{subject} takes {kilobytes} kB of memory here, and {available} kB are available")
