"""docker-compose.yml brought up for real: the run it makes, what it refuses, and what befalls it."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from evedrop.cli.api import montecarlo
from evedrop.live.launch.compose import write_compose
from evedrop.scenario.loading import load
from tests.builders import digests_of
from tests.conftest import wait_until
from tests.containers.project import ENDLESS, ROLES, Project

pytestmark = pytest.mark.containers

SHORT = "--slots 600 --pace 0"
LONG = "--slots 3000 --pace 0.005"

Make = Callable[..., Project]


def complete(project: Project, slots: int, scenario: str | Path = "two-eavesdroppers") -> None:
    """Check that the newest results are those of the same trials, computed here in memory."""
    results = project.results()
    summary = results.summary
    assert summary["ended"] == "complete"
    folder = project.folder / f"memory-{len(list((project.folder / 'runs').iterdir()))}"
    memory = montecarlo(scenario, slots=slots, trials=1, out=folder)
    assert digests_of(results) == digests_of(memory)
    assert not any(link["unexplained"] for link in summary["links"].values())


def test_up_alone_runs_the_demo(project: Make) -> None:
    """It ends by itself, with the digests of the same trials in memory, and again; its results are looked at by its image."""
    demo = project(EVEDROP_OPTIONS=SHORT, EVEDROP_USER="4321:4321")
    for runs in (1, 2):
        demo.compose("up")
        assert {service: demo.state(service)["ExitCode"] for service in ROLES} == dict.fromkeys(ROLES, 0)
        complete(demo, 600)
        assert len(list((demo.folder / "runs").iterdir())) == runs
    everything = (demo.folder / "runs", *(demo.folder / "runs").rglob("*"))
    assert {path.stat().st_uid for path in everything} == {4321}, "Docker made ./runs as root"
    assert demo.results().folder.stat().st_mode & 0o777 == 0o700
    # Word by word as docs/containers.md has it, in the background.
    demo.compose("run", "--detach", "--rm", "--service-ports", "finished", f"/runs/{demo.results().folder.name}")
    demo.shown()


def test_the_recipe_for_a_script_gives_table_and_status(project: Make) -> None:
    """Word by word as docs/containers.md has it: all that the recorder says, the table too, and the status of the run."""
    tested = project(EVEDROP_OPTIONS=f"{SHORT} --set expect=[{{metric='smart.mean_squared_error',below=0}}]")
    tested.compose("up", "--detach")
    output = tested.compose("logs", "--follow", "recorder").stdout
    identity = tested.compose("ps", "--all", "--quiet", "recorder").stdout.strip()
    assert tested.docker("wait", identity) == "1"
    complete(tested, 600)
    ended = output.index('"ended"')
    digest = tested.results().summary["peers"]["smart"]["digest"]
    for words in ("1 of 1 expectations FAILED", digest[:12], "the estimator is", "results: /runs/two-eavesdroppers-"):
        assert output.index(words) > ended


def test_a_scenario_of_ones_own(project: Make) -> None:
    """A file in the folder of docker-compose.yml."""
    own = project(EVEDROP_OPTIONS=SHORT, EVEDROP_SCENARIO="mine/two.toml")
    (own.folder / "mine").mkdir()
    shutil.copy("scenarios/two-eavesdroppers.toml", own.folder / "mine" / "two.toml")
    own.compose("up")
    assert own.results().folder.name.startswith("two-")
    complete(own, 600)


def test_files_for_a_scenario_with_controller_and_relay(tmp_path: Path, project: Make) -> None:
    """Files made for a scenario of one's own run it: with two routers, a controller, and a receiver named as a service is."""
    text = Path("scenarios/microgrid.toml").read_text(encoding="utf-8")
    own = tmp_path / "own.toml"
    own.write_text(re.sub(r"\bsmart(?=[.\]])", "view", text), encoding="utf-8")
    changes = {"network.routers": 2, "slots": 96, "expect": []}
    write_compose(load(own, changes), str(own), True, tmp_path / "grid", False)
    grid = Project.of(tmp_path / "grid", project().docker, EVEDROP_OPTIONS="--pace 0")
    try:
        grid.compose("up")
        processes = ("router", "relay", "sensor", "legitimate", "controller", "eavesdropper-view", "recorder")
        assert {service: grid.state(service)["ExitCode"] for service in processes} == dict.fromkeys(processes, 0)
        complete(grid, 96, grid.folder / "own.toml")
    finally:
        grid.down()


SERVICES = "docker-compose.yml has services for: legitimate recorder router sensor smart suspicious; write files"
WRONG = {
    "one.toml": f"one.toml has the processes: legitimate recorder router sensor smart, and {SERVICES}",
    "vehicle": f"vehicle has the processes: legitimate naive recorder router sensor smart suspicious, and {SERVICES}",
    "two.toml": f"two.toml has two routers, and {SERVICES}",
    "two-eavesdropers": "no scenario two-eavesdropers",
}
"""Scenario → the message that refuses it."""


def test_of_a_scenario_that_does_not_fit_nothing_is_started(project: Make) -> None:
    """One line says why; so does one for a user that does not exist."""
    own = project()
    shutil.copy("scenarios/cut.toml", own.folder / "one.toml")
    two = Path("scenarios/two-eavesdroppers.toml").read_text(encoding="utf-8")
    (own.folder / "two.toml").write_text(f"{two}\n[network]\nrouters = 2\n", encoding="utf-8")
    for scenario, reason in WRONG.items():
        own.environment["EVEDROP_SCENARIO"] = scenario
        done = own.compose("up", may_fail=True)
        assert done.returncode != 0
        assert own.state("briefs")["ExitCode"] == 2
        (line,) = own.log("briefs").splitlines()[-1:]
        assert line.startswith(f"evedrop: {reason}")
    own.environment["EVEDROP_USER"] = "somebody"
    own.compose("up", may_fail=True)
    assert "evedrop: EVEDROP_USER is somebody, and must be numbers" in own.log("briefs")
    assert not any((own.folder / "runs").iterdir())
    assert own.docker("ps", "--quiet") == ""


def test_a_killed_container_ends_the_run_and_the_next_one_goes_well(project: Make) -> None:
    """It is named, what was measured is on disk, everybody leaves; and another `up` makes a whole run."""
    own = project(EVEDROP_OPTIONS=ENDLESS)
    own.compose("up", "--detach")
    own.running()
    own.docker("kill", own.container("smart"))
    assert own.ended("recorder") == 3
    assert "smart cut off from the network for 2 s" in own.log("recorder")
    assert own.results().slots.num_rows > 0
    assert {service: own.ended(service) for service in ROLES} == {**dict.fromkeys(ROLES, 3), "smart": 137}
    again = project(EVEDROP_OPTIONS=SHORT)
    again.compose("up")
    complete(again, 600)


def test_a_router_started_again_and_a_network_that_was_away_change_nothing(project: Make) -> None:
    """Kill and start the router's container, take an eavesdropper's off its network and put it back: the same digests."""
    own = project(EVEDROP_OPTIONS=LONG)
    own.compose("up", "--detach")
    own.running()
    own.docker("kill", own.container("router"))
    own.docker("start", own.container("router"))
    own.running(own.progress())
    smart, network = own.container("smart"), f"{own.environment['COMPOSE_PROJECT_NAME']}_to-smart"
    own.docker("network", "disconnect", network, smart)
    health = ("docker", "-H", own.docker.address, "exec", smart, "evedrop", "health", "/brief/brief.json")
    wait_until(lambda: subprocess.run(health, capture_output=True, check=False).returncode, "an eavesdropper cut off")
    own.docker("network", "connect", network, smart)
    assert own.ended("recorder") == 0, own.log("recorder")
    complete(own, 3000)
