"""Installs a locked list of packages into the environment that runs this file, and says how far it is.

    .venv/bin/python tools/install.py tools/constraints/project.txt    # the list
    .venv/bin/python tools/install.py --project .                      # this project itself, and which kernels it has then

pip alone is silent for minutes, or prints several lines for each package. This prints how much there is to download, and then a
line every few seconds, the same in a terminal and in a log. If pip fails, it prints all that pip said. It imports nothing but pip
and the standard library, which are all that a new environment has.
"""

from __future__ import annotations

import argparse
import contextlib
import queue
import re
import subprocess
import sys
import sysconfig
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from pip._vendor.packaging.requirements import Requirement

MEGABYTES = {"project.txt": 450, "docs.txt": 28, "notebooks.txt": 15}
"""What each list downloads on Linux, about: it depends on the processor and on the version of Python."""
SECONDS = 5.0
"""How long nothing is said at most."""

_FETCHED = re.compile(
    r"\s*(?:Downloading|Using cached) (?P<file>\S+\.(?:whl|tar\.gz|zip)) \((?P<size>[\d.]+) (?P<unit>\w+)\)"
)
_LOCAL = re.compile(r"Processing (?P<file>/\S+\.(?:whl|tar\.gz|zip))")
_THERE = re.compile(r"Requirement already satisfied: ")
_TO_SAY = re.compile(r"\s*(WARNING|ERROR|DEPRECATION)\b")
_UNITS = {"bytes": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9}


@dataclass
class Progress:
    """How far pip is, by the lines that it prints."""

    packages: set[str]
    """The names of those to download; empty if something is built here."""
    handled: int = 0
    size: float = 0.0
    latest: str = ""
    installing: bool = False
    lines: list[str] = field(default_factory=list)

    def read(self, line: str) -> None:
        """Take note of a line of pip."""
        self.lines.append(line)
        if match := _FETCHED.match(line):
            self._handle(match["file"], float(match["size"]) * _UNITS.get(match["unit"], 0.0))
        elif match := _LOCAL.match(line):
            file = Path(match["file"])
            self._handle(file.name, float(file.stat().st_size) if file.exists() else 0.0)
        elif _THERE.match(line):
            self.handled += 1
        elif line.startswith("Installing collected packages"):
            self.installing = True

    def _handle(self, file: str, size: float) -> None:
        self.handled += 1
        self.size += size
        self.latest = f"; the last begun is {file.partition('-')[0]}, {_bytes(size)}"

    def line(self, environment: Path) -> str:
        """How far it is; environment: the folder that packages are installed into."""
        if not self.packages:
            return "still building"
        if self.installing:
            names = {_normal(folder.name.partition("-")[0]) for folder in environment.glob("*.dist-info")}
            return f"{len(names & self.packages)} of {len(self.packages)} packages installed"
        return f"{self.handled} of {len(self.packages)} packages here, {_bytes(self.size)}{self.latest}"


def packages_of(lock: str) -> set[str]:
    """The names of the packages that a locked list has for this machine and this Python, in the form of folders' names."""
    requirements = [Requirement(entry) for entry in re.findall(r"^(?![\s#-])[^\\\n]+", lock, re.MULTILINE)]
    return {
        _normal(requirement.name)
        for requirement in requirements
        if requirement.marker is None or requirement.marker.evaluate()
    }


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "_", name).lower()


def install(lock: Path) -> int:
    """Install a locked list; the exit status of pip."""
    begun = time.monotonic()
    progress = Progress(packages_of(lock.read_text(encoding="utf-8")))
    size = f", about {MEGABYTES[lock.name]} MB to download" if lock.name in MEGABYTES else ""
    _say(f"{len(progress.packages)} packages{size}, each checked against its hash ({lock.name})")
    status = _pip(progress, "--progress-bar", "off", "--require-hashes", "--no-deps", "--requirement", str(lock))
    if status == 0:
        seconds = time.monotonic() - begun
        _say(f"{len(progress.packages)} packages installed, {_bytes(progress.size)} downloaded, in {seconds:.0f} s")
    return status


def install_project(project: Path) -> int:
    """Install this project for editing, and say which kernels it has; the exit status."""
    _say("this project, and its C kernels if there is a C compiler")
    status = _pip(Progress(set()), "--no-deps", "--no-build-isolation", "--editable", str(project))
    if status == 0:
        script = (
            "from evedrop.model.kernels.choice import FALLBACK, KERNELS; "
            "print(KERNELS); raise SystemExit(KERNELS == FALLBACK)"
        )
        asked = subprocess.run([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, check=False)
        _say(f"done; the kernels are {asked.stdout.strip()}")
        if asked.returncode:
            _say("on Debian, C kernels take `apt install gcc python3-dev`, then `make -B setup`; docs/performance.md")
    return status


def _pip(progress: Progress, *arguments: str) -> int:
    """Run pip, and say every few seconds how far it is; its exit status."""
    command = [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", *arguments]
    lines: queue.Queue[str | None] = queue.Queue()
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as pip:

        def read() -> None:
            for line in pip.stdout or ():
                lines.put(line.rstrip())
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        next_time = time.monotonic() + SECONDS
        while True:
            line: str | None = ""
            with contextlib.suppress(queue.Empty):
                line = lines.get(timeout=max(0.0, next_time - time.monotonic()))
            if line is None:
                break
            progress.read(line)
            if _TO_SAY.match(line):
                _write(line)
            if time.monotonic() >= next_time:
                _say(progress.line(Path(sysconfig.get_path("purelib"))))
                next_time = time.monotonic() + SECONDS
    if pip.returncode:
        _write("\n".join(progress.lines))
        _say(f"pip failed with status {pip.returncode}; what it said is above")
    return pip.returncode


def _say(text: str) -> None:
    _write(f"setup: {text}")


def _write(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _bytes(size: float) -> str:
    return f"{size / 1e6:.0f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"


def main() -> int:
    """Install what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lock", nargs="?", type=Path)
    parser.add_argument("--project", type=Path)
    chosen = parser.parse_args()
    status = install(chosen.lock) if chosen.lock else 0
    return status or (install_project(chosen.project) if chosen.project else 0)


if __name__ == "__main__":
    sys.exit(main())
