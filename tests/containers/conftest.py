"""Docker, the image, and a project to bring up; where Docker cannot run, the tests are skipped with a loud message."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.containers.machine import BASE, PACKAGES, Docker, checkout, take_away_leftovers
from tests.containers.project import Project, projects
from tests.debian import base, mirror, own_release, python_version
from tests.folders import temporary_folder
from tests.privileged import CannotRun, prepare, run, skip

_TIMES = pytest.StashKey[dict[str, float]]()
_FETCH_SECONDS = 600.0


@pytest.fixture(scope="session")
def docker(request: pytest.FixtureRequest) -> Iterator[Docker]:
    """A daemon that has the image `evedrop`."""
    times: dict[str, float] = {}
    request.config.stash[_TIMES] = times
    with temporary_folder("evedrop-docker-") as folder:
        try:
            prepare(PACKAGES)
            take_away_leftovers()
            daemon = Docker(folder)
        except CannotRun as error:
            skip(error)
        try:
            _image(daemon, folder, times)
            yield daemon
        except CannotRun as error:
            skip(error)
        finally:
            daemon.end()


def _image(daemon: Docker, folder: Path, times: dict[str, float]) -> None:
    """Build the image of a copy of the checkout, on Debian's packages and without a network. Raises CannotRun."""
    copy, begun = checkout(folder), time.monotonic()
    fetching = subprocess.Popen(
        [
            *(sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"),
            *("--require-hashes", "--no-deps", "--only-binary", ":all:"),
            *(
                "--requirement",
                str(copy / "tools" / "constraints" / "project.txt"),
                "--dest",
                str(copy / "build" / "wheels"),
            ),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        daemon("import", str(_debian(folder)), BASE)
        errors, _ = fetching.communicate(timeout=_FETCH_SECONDS)
    except subprocess.TimeoutExpired as error:
        raise CannotRun(
            f"the packages of tools/constraints/project.txt were not fetched within {_FETCH_SECONDS:g} s of the base image"
        ) from error
    finally:
        fetching.kill()
        fetching.wait()
    if fetching.returncode:
        raise CannotRun(f"the packages of tools/constraints/project.txt cannot be fetched: {errors[-2000:]}")
    times["base image and packages"], begun = time.monotonic() - begun, time.monotonic()
    environment = {**os.environ, "DOCKER_HOST": daemon.address, "EVEDROP_BASE": BASE, "DOCKER_BUILDKIT": "0"}
    run("docker-compose", "build", cwd=copy, env=environment)
    times["image"] = time.monotonic() - begun


def _debian(folder: Path) -> Path:
    """Debian of this machine's release, with its Python, as a tar. Raises CannotRun if that Python is not ours."""
    tar = base(folder, mirror(own_release()), own_release(), ("python3", "python3-venv"))
    # pip fetches packages for the Python it runs in.
    ours = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if (version := python_version(tar)) != ours:
        raise CannotRun(f"Debian's Python is {version}, and the one that runs the tests is {ours}")
    return tar


@pytest.fixture
def project(tmp_path: Path, docker: Docker) -> Iterator[Callable[..., Project]]:
    """Makes the project of a test; takes it down afterwards."""
    with projects(tmp_path, docker) as make:
        yield make


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """How long the preparations took."""
    for name, seconds in config.stash.get(_TIMES, {}).items():
        terminalreporter.write_line(f"{name}: {seconds:.0f} s")
