"""What some faults need that not every machine has: a mount namespace, a disk that can break, a limit of processes, an sshd.

A case whose facility is missing is skipped, and the campaign says so at its end.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.privileged import CannotRun
from tests.sshd import sshd

_SHUT_DOWN = 0x8004587D  # EXT4_IOC_SHUTDOWN, with EXT4_GOING_FLAGS_NOLOGFLUSH: from now on everything is EIO
_NO_LOG_FLUSH = (2).to_bytes(4, "little")
_DISK_BYTES = 48 * 2**20
_PIDS = (Path("/sys/fs/cgroup/pids"), Path("/sys/fs/cgroup"))


@dataclass(frozen=True)
class Facilities:
    """The facilities of this machine."""

    small_disks: bool
    """Whether small disks can be mounted; otherwise the size of files is limited."""
    lacks: Mapping[str, str]
    """Facility that is missing → why, in words."""


def facilities(mounts: bool, folder: Path) -> Facilities:
    """Find out what there is; mounts: whether we are in a mount namespace of our own; folder: for trials."""
    trials: Mapping[str, Callable[[], object]] = {
        "a disk that breaks": lambda: _try_disk(mounts, folder),
        "a limit of processes": _try_processes,
        "sshd": lambda: _try_sshd(folder),
    }
    lacks = {}
    for name, attempt in trials.items():
        try:
            attempt()
        except (CannotRun, OSError) as error:
            lacks[name] = " ".join(str(error).split())
    return Facilities(mounts, lacks)


def _try_disk(mounts: bool, folder: Path) -> None:
    if not mounts:
        raise CannotRun("mounting takes root and a mount namespace")
    if shutil.which("mkfs.ext4") is None:
        raise CannotRun("there is no mkfs.ext4 (Debian's e2fsprogs)")
    place = folder / "breakable"
    place.mkdir()
    mount_breakable(place)
    try:
        break_disk(place)
    finally:
        subprocess.run(["umount", "--lazy", place], check=False)
        place.rmdir()


def mount_breakable(folder: Path) -> None:
    """Mount a small disk that can break, on a file beside its folder. Raises CannotRun."""
    image = folder.with_name(f"{folder.name}.image")
    with image.open("wb") as file:
        file.truncate(_DISK_BYTES)
    for command in (["mkfs.ext4", "-q", "-F", str(image)], ["mount", "-o", "loop", str(image), str(folder)]):
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            raise CannotRun(f"{command[0]} fails: {done.stderr.strip()}")


def break_disk(folder: Path) -> None:
    """From now on every access to the disk of a folder fails with EIO. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.ioctl(descriptor, _SHUT_DOWN, _NO_LOG_FLUSH)
    finally:
        os.close(descriptor)


def _try_sshd(folder: Path) -> None:
    place = folder / "sshd"
    place.mkdir()
    try:
        with sshd(place):
            pass
    finally:
        shutil.rmtree(place)


def _try_processes() -> None:
    if os.geteuid() == 0:
        process_group(f"evedrop-{os.getpid()}-try", 10).rmdir()


def process_group(name: str, limit: int) -> Path:
    """A control group with a limit of processes and threads, which counts for root as well. Raises CannotRun."""
    for place in _PIDS:
        group = place / name
        try:
            group.mkdir()
        except OSError:
            continue
        try:
            (group / "pids.max").write_text(str(limit))
        except OSError:
            group.rmdir()
            continue
        return group
    raise CannotRun("no control group with a limit of processes can be made")


def limited(command: list[str], memory: int | None, processes: int | None, name: str) -> tuple[list[str], Path | None]:
    """A command that runs under limits, and its control group, to be removed afterwards.

    memory: megabytes of address space; processes: how many processes and threads may run.
    """
    # Not with ulimit: the shell of Debian 13 cannot limit processes.
    limits: list[str] = []
    group = None
    if memory is not None:
        limits.append(f"--as={memory * 1_024_000}")
    if processes is not None and os.geteuid() == 0:
        group = process_group(name, processes)
        command = ["sh", "-c", f'echo $$ > {group}/cgroup.procs && exec "$@"', "sh", *command]
    elif processes is not None:
        limits.append(f"--nproc={_threads_of_ours() + processes}")
    return (["prlimit", *limits, "--", *command] if limits else command), group


def _threads_of_ours() -> int:
    """How many threads this user has: the system's limit is of all of them together."""
    count = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if folder.stat().st_uid == os.getuid():
                count += len(list((folder / "task").iterdir()))
        except OSError:
            continue
    return count
