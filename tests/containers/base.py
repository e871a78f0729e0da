"""The file system that the image is built upon: Debian's own packages with Python, made where nothing can be harmed.

debootstrap runs as root and mounts /proc and /sys in what it makes. If it is killed half-way, they stay mounted, and removing
the folder then removes from the machine's own /proc. So here it has mounts and processes of its own, and writes to
memory: when its first process ends, however it ends, the kernel ends all others, and mounts and files are gone.
"""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

from tests.privileged import CannotRun, tried

ROOT = Path(__file__).parents[2]
SECONDS = 600.0
"""How long a file system may take to make."""
NEEDED_KILOBYTES = 3_000_000

_ALONE = (
    *("setpriv", "--pdeathsig", "KILL"),  # however the tests end, it ends with them
    *("unshare", "--mount", "--propagation", "private", "--pid", "--fork", "--kill-child", "--mount-proc"),
)
_BOOTSTRAP = """
set -eu
mount -t tmpfs -o size=2g tmpfs "$1"
debootstrap --variant=minbase --include=python3,python3-venv "$2" "$1" "$3"
chroot "$1" python3 -c 'import sys; print("python", "%d.%d" % sys.version_info[:2])'
tar -C "$1" --one-file-system \
  --exclude='./var/cache/apt/*' --exclude='./var/lib/apt/lists/*' --exclude='./usr/share/doc/*' --exclude='./usr/share/locale/*' \
  -cf "$4" .
"""
"""Arguments: an empty folder, the release, the mirror, the tar to write."""


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


def base(folder: Path) -> Path:
    """The file system as a tar, kept in build/ for the next time; folder: for what is temporary. Raises CannotRun."""
    address, release = mirror()
    kept = ROOT / "build" / f"test-base-{release}-{platform.machine()}.tar"
    if not kept.exists():
        if (available := _available_kilobytes()) < NEEDED_KILOBYTES:
            raise CannotRun(f"debootstrap takes {NEEDED_KILOBYTES} kB of memory here, and {available} kB are available")
        kept.parent.mkdir(exist_ok=True)
        half = kept.with_name(f"{kept.name}-{os.getpid()}")
        try:
            bootstrap(folder, address, release, half)
            half.replace(kept)
        finally:
            half.unlink(missing_ok=True)
    return kept


def bootstrap(folder: Path, address: str, release: str, tar: Path, seconds: float = SECONDS) -> None:
    """Make the file system; folder: where an empty folder can be made, which it is mounted on. Raises CannotRun."""
    system = folder / "system"
    system.mkdir()
    command = (*_ALONE, "sh", "-c", _BOOTSTRAP, "sh", system, release, address, tar)
    said = tried(*command, what="debootstrap", timeout=seconds)
    system.rmdir()  # nothing was ever in it that others than the command saw
    version = said.splitlines()[-1].removeprefix("python ")
    ours = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if version != ours:
        # pip chooses packages by the Python it runs in.
        raise CannotRun(f"Debian's Python is {version}, and the one that runs the tests is {ours}")


def _available_kilobytes() -> int:
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1])
    return 0
