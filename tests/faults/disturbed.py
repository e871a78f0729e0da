"""A live run that is disturbed: its launcher, its processes, the cables between them, what it tells, and its disk."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tests.faults import ours
from tests.faults.facilities import break_disk, limited, mount_breakable
from tests.faults.hosts import Hosts, host_of, part_of
from tests.faults.variants import Variant
from tests.proxy import Cable
from tests.sshd import Sshd

_WITHIN = Path(__file__).with_name("within")
CONFUSED_FILE = "confused"
"""In the folder of a run whose router has confused keys."""
CLEANER = "cleaner"
FORK_SERVERS = ("first fork server", "second fork server")
"""Those of the recorder and of all others: the second is forked from the first."""
_DISK_BYTES = 24 * 2**20
_ROOT = Path(__file__).parents[2]


class Disturbed:
    """A run of a variant in a folder of its own. Made by `disturbed`."""

    def __init__(
        self,
        variant: Variant,
        folder: Path,
        options: list[str],
        wired: set[str],
        disk: str | None,
        limits: Mapping[str, int],
        server: Sshd | None = None,
    ) -> None:
        """wired: processes that reach their router through a cable. server: for a variant that is spread over hosts.

        disk: `full` or `broken`, if the results have a disk of their own, on which that will happen. limits: `memory` and
        `processes`, as for `limited`; `confused`: after how many deliveries the router puts one on another receiver's key, too.
        """
        self.variant, self.folder, self._wired = variant, folder, wired
        self.temporary = folder / "temporary"
        self.temporary.mkdir(parents=True)
        self.disk = folder / "disk"
        self.disk.mkdir()
        self._kind = disk
        self._mounted = disk is not None and _mount(self.disk, disk)
        self.out = self.disk / "run"
        self.renamed = self.disk / "renamed"
        self.over = threading.Event()
        """Set when the launcher has ended."""
        self.started: float | None = None
        """When the run was started, by the monotonic clock."""
        self.finished: float | None = None
        """When its last slot was or will be done, as far as can be told."""
        self.ended: float | None = None
        """When its launcher ended."""
        self.done = 0
        """How many slots it said are done."""
        self.told: list[dict[str, Any]] = []
        """What it told, each with the time `at` which its launcher took it."""
        self.cables: dict[tuple[int, str], Cable] = {}
        self._shards: dict[str, int] = {}
        self._lock = threading.Lock()
        self.hosts = Hosts(variant.hosts, folder, server) if server is not None else None
        self._asked = socket.socket(socket.AF_UNIX)
        self._asked.bind(str(folder / "asked"))
        self._asked.listen(64)
        threading.Thread(target=self._answer, daemon=True).start()
        self.begun = time.monotonic()
        words = [sys.executable, "-m", "evedrop", "run", variant.path(folder), *variant.options, *options]
        if self.hosts is not None:
            words += ["--hosts", str(self.hosts.path)]
        words, self._group = limited(
            [*words, "--out", str(self.out)],
            limits.get("memory"),
            limits.get("processes"),
            f"evedrop-{os.getpid()}-{folder.name}",
        )
        with (folder / "stdout").open("w") as out, (folder / "stderr").open("w") as err:
            self.launcher = subprocess.Popen(
                words,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                start_new_session=True,
                env={
                    **os.environ,
                    "TMPDIR": str(self.temporary),
                    # What the campaign itself imports may come from elsewhere, too.
                    "PYTHONPATH": os.pathsep.join(filter(None, [str(_WITHIN), str(_ROOT), os.environ.get("PYTHONPATH")])),
                    "EVEDROP_CAMPAIGN": str(folder),
                    **(
                        {"PYTHON_EVEDROP_CONFUSED": f"{limits['confused']}:{folder / CONFUSED_FILE}"}
                        if "confused" in limits
                        else {}
                    ),
                    "PYTHONDONTWRITEBYTECODE": "1",  # on a full disk, Python would leave half a .pyc for the next process
                    "COLUMNS": "160",
                },
            )  # fmt: skip
        threading.Thread(target=self._listen, daemon=True).start()
        self._slots = variant.scenario(folder).slots

    def _answer(self) -> None:
        """Tell the launcher what each process is to take for its router's endpoint."""
        with suppress(OSError):
            while True:
                near, _ = self._asked.accept()
                with near, suppress(OSError, ValueError):
                    told = json.loads(near.makefile().readline())
                    near.sendall(self._endpoint(told).encode())

    def _endpoint(self, told: dict[str, Any]) -> str:
        with self._lock:
            firsts = {**self._shards, told["private"]: told["first"]}
            self._shards = firsts
        router = str(told["router"])
        if told["role"] == "router" or told["process"] not in self._wired:
            return router
        protocol, _, place = router.partition("/")
        key = (int(told["first"]), str(told["process"]))
        if key not in self.cables:
            self.cables[key] = Cable(place if protocol == "unixsock-stream" else int(place.rpartition(":")[2]))
        if protocol == "unixsock-stream":
            return self.cables[key].endpoint
        return re.sub(r"\d+$", self.cables[key].endpoint.rpartition(":")[2], router)

    def _listen(self) -> None:
        """Follow what the run tells."""
        news, read = self.folder / "news", 0
        while not self.over.is_set():
            with suppress(OSError), news.open() as file:
                file.seek(read)
                for line in file:
                    if not line.endswith("\n"):
                        break
                    read += len(line.encode())
                    self._take(json.loads(line))
            self.over.wait(0.02)

    def _take(self, told: dict[str, Any]) -> None:
        self.told.append(told)
        if told["event"] == "started":
            self.started = told["at"]
        elif told["event"] == "progress":
            self.done = max(self.done, int(told["done"]))
            if told["rate"]:
                self.finished = told["at"] + (self._slots - told["done"]) / told["rate"]
        elif told["event"] == "ended":
            self.finished = min(told["at"], self.finished or told["at"])

    @property
    def temporaries(self) -> Mapping[str, Path]:
        """Where processes put what is temporary: host → its folder, and "" → that of this machine."""
        return {"": self.temporary, **({} if self.hosts is None else self.hosts.temporaries)}

    @property
    def firsts(self) -> list[int]:
        """The first trial of each shard, in order, as far as they are known."""
        with self._lock:
            return sorted(set(self._shards.values()))

    def pids(self, name: str, shard: int = 0) -> list[int]:
        """The living processes of a name in a shard, or of a part of a host: one, or none."""
        if name == "launcher":
            return [] if self.over.is_set() else [self.launcher.pid]
        if self.hosts is not None and (host := host_of(name)):
            return self.hosts.pids(part_of(name), host)
        if name == CLEANER:
            return sorted(process.pid for process in ours.marked(self.temporary) if process.is_cleaner)
        if name in FORK_SERVERS:
            servers = sorted(process.pid for process in ours.marked(self.temporary) if process.is_fork_server)
            return servers[:1] if name == FORK_SERVERS[0] else servers[1:2]
        firsts = self.firsts
        return [
            descendant.pid
            for descendant in ours.descendants()
            if descendant.brief is not None
            and descendant.brief.stem == name
            and self._first_at(descendant.brief.parent) == (firsts[shard] if shard < len(firsts) else None)
        ]

    def _first_at(self, private: Path) -> int | None:
        """The first trial of the shard whose briefs are in a folder. A run over hosts has one shard, and a folder on each."""
        if self.hosts is not None and private.parent in self.hosts.temporaries.values():
            return next(iter(self.firsts), None)
        return self._shards.get(str(private))

    def wires(self, name: str, shard: int = 0) -> list[Cable]:
        """The cables of a process, of `everybody`, or of the connection with a host."""
        if self.hosts is not None and (host := host_of(name)):
            return [self.hosts.cable(host)]
        firsts = self.firsts
        if shard >= len(firsts):
            return []
        return [
            cable
            for (first, process), cable in list(self.cables.items())
            if first == firsts[shard] and name in (process, "everybody")
        ]

    def fill(self) -> bool:
        """Leave no room on the disk of the results; whether it has one."""
        if not self._mounted or self._kind != "full":
            return False
        with (self.disk / "filler").open("ab", buffering=0) as file, suppress(OSError):
            piece = bytes(1 << 16)
            while True:
                file.write(piece)
        with (self.disk / "filler").open("ab", buffering=0) as file, suppress(OSError):
            while True:
                file.write(b"\0")
        return True

    def free(self) -> None:
        """Make room again on a disk that is full, so that the results can be looked at."""
        (self.disk / "filler").unlink(missing_ok=True)

    def break_disk(self) -> bool:
        """Have every access to the disk of the results fail; whether it has one."""
        if not self._mounted or self._kind != "broken":
            return False
        break_disk(self.disk)
        return True

    def text(self, name: str) -> str:
        """What the launcher wrote: `stdout` or `stderr`."""
        return (self.folder / name).read_text(errors="replace")

    def close(self) -> None:
        """Let go of all but the files."""
        self.over.set()
        self._asked.close()
        for cable in self.cables.values():
            cable.close()
        if self.hosts is not None:
            self.hosts.close()
        if self._mounted:
            self._keep()
        if self._group is not None:
            with suppress(OSError):  # some process is left in it, which the judge has said
                self._group.rmdir()

    def _keep(self) -> None:
        """Move the results from their small disk to where they are kept."""
        self.free()
        kept = self.folder / "kept"
        if self._kind == "full":
            shutil.copytree(self.disk, kept, symlinks=True)
        else:
            kept.mkdir()  # what was on a broken disk can no longer be read
        subprocess.run(["umount", "--lazy", self.disk], check=True)
        self.disk.rmdir()
        kept.rename(self.disk)
        self.disk.with_name(f"{self.disk.name}.image").unlink(missing_ok=True)


def _mount(folder: Path, kind: str) -> bool:
    """Mount a small disk, in the campaign's own mount namespace."""
    if kind == "broken":
        mount_breakable(folder)
        return True
    command = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "none", str(folder)]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


@contextmanager
def disturbed(
    variant: Variant,
    folder: Path,
    options: list[str] | None = None,
    wired: set[str] | None = None,
    disk: str | None = None,
    limits: Mapping[str, int] | None = None,
    server: Sshd | None = None,
) -> Iterator[Disturbed]:
    """A run that has been started; when the block ends its cables and its disk are gone."""
    run = Disturbed(variant, folder, options or [], wired or set(), disk, limits or {}, server)
    try:
        yield run
    finally:
        run.close()
