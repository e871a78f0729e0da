"""One run by docker-compose, in a folder of its own, from a copy of the checkout's docker-compose.yml."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evedrop.results.reading import Results
from tests.conftest import wait_until
from tests.containers.machine import Docker
from tests.debian import ROOT
from tests.privileged import run

ROLES = ("router", "sensor", "legitimate", "suspicious", "smart", "recorder")
"""The services that are processes of a run."""

ENDLESS = "--slots 1000000 --pace 0.002 --set longest_outage=2.0"
"""Options of a run that does not end by itself."""

_PAGE = """
import urllib.request
try:
    print(urllib.request.urlopen('http://127.0.0.1:17450/').read())
except OSError as error:
    print(error)
"""


@dataclass(frozen=True)
class Project:
    """The folder, the daemon, and what `docker-compose` is told by its environment."""

    folder: Path
    docker: Docker
    environment: dict[str, str]

    @classmethod
    def of(cls, folder: Path, docker: Docker, **variables: str) -> Project:
        """A project whose services are those of the checkout, unless the folder has a docker-compose.yml."""
        if not (folder / "docker-compose.yml").exists():
            shutil.copy(ROOT / "docker-compose.yml", folder)
        names = {"COMPOSE_PROJECT_NAME": folder.name.replace("_", "-"), "DOCKER_HOST": docker.address}
        return cls(folder, docker, {**os.environ, **names, **variables})

    def compose(self, *arguments: str, may_fail: bool = False) -> subprocess.CompletedProcess[str]:
        """What `docker-compose` says."""
        command = ("docker-compose", "--ansi", "never", *arguments)
        options: dict[str, Any] = {"cwd": self.folder, "env": self.environment}
        if may_fail:
            return subprocess.run(command, capture_output=True, text=True, check=False, timeout=600, **options)
        try:
            return run(*command, **options)
        except AssertionError as error:
            completed = subprocess.run(
                ("docker-compose", "logs", "--no-color"), capture_output=True, text=True, check=False, **options
            )
            raise AssertionError(f"{error}\n{completed.stdout}") from error

    def container(self, service: str) -> str:
        """The id of a service's container."""
        project = f"label=com.docker.compose.project={self.environment['COMPOSE_PROJECT_NAME']}"
        identity = self.docker("ps", "-aq", "-f", project, "-f", f"label=com.docker.compose.service={service}")
        assert identity, f"no container of {service}"
        return identity

    def state(self, service: str) -> dict[str, Any]:
        """What Docker knows of a service's container."""
        state: dict[str, Any] = self.docker.inspected("container", self.container(service))["State"]
        return state

    def ended(self, service: str) -> int:
        """The status with which a service ends, once it has."""
        return int(self.docker("wait", self.container(service)))

    def log(self, service: str) -> str:
        """All that a service has said so far."""
        done = run("docker", "-H", self.docker.address, "logs", self.container(service))
        return done.stdout + done.stderr

    def progress(self) -> int:
        """The slots that the run has done."""
        lines = [line for line in self.log("recorder").splitlines() if line.startswith("{") and '"progress"' in line]
        return max((json.loads(line)["done"] for line in lines), default=0)

    def running(self, more_than: int = 0) -> None:
        """Wait until more than this number of slots is done."""
        wait_until(lambda: self.progress() > more_than, "a run under way")
        assert self.state("recorder")["Running"], "the run must not end before it is disturbed"

    def listening(self) -> set[str]:
        """The ports of the machine that are listened on; all of them on loopback."""
        table = self.docker.inside("cat", "/proc/net/tcp").splitlines()[1:]
        sockets = [line.split()[1].split(":") for line in table if line.split()[3] == "0A"]
        assert {address for address, _ in sockets} <= {"0100007F"}
        return {str(int(port, 16)) for _, port in sockets}

    def shown(self) -> None:
        """Wait until the view's page answers, at its address on loopback, and check that nothing else listens."""
        wait_until(lambda: "Rerun" in self.docker.inside("python3", "-c", _PAGE), "a page")
        assert self.listening() == {"17450", "17451"}

    def results(self) -> Results:
        """The newest results."""
        newest: Path = max((self.folder / "runs").iterdir(), key=lambda folder: folder.stat().st_mtime_ns)
        return Results.read(newest)

    def down(self) -> None:
        """Take everything down. Fails if a container, a network or a volume is left."""
        self.compose("down", "--volumes", "--timeout", "5")
        label = f"label=com.docker.compose.project={self.environment['COMPOSE_PROJECT_NAME']}"
        for kind in (("container", "--all"), ("network",), ("volume",)):
            left = self.docker(kind[0], "ls", *kind[1:], "--quiet", "--filter", label)
            assert not left, f"{kind[0]} {left}"


@contextmanager
def projects(folder: Path, docker: Docker) -> Iterator[Callable[..., Project]]:
    """Makes projects in a folder; takes them down when the block ends, whatever became of them."""
    made: list[Project] = []

    def make(**variables: str) -> Project:
        project = Project.of(folder, docker, **variables)
        made.append(project)
        return project

    try:
        yield make
    finally:
        for project in made:
            project.down()
