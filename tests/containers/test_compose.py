"""docker-compose.yml brought up for real: the run it makes, who can reach what in it, and what befalls it."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from emulator.api import montecarlo
from tests.conftest import wait_until
from tests.containers.machine import Docker
from tests.containers.project import ROLES, Project

pytestmark = pytest.mark.containers

SHORT = "--slots 600 --pace 0"
ENDLESS = "--slots 1000000 --pace 0.002 --set longest_outage=2.0"
LONG = "--slots 3000 --pace 0.005"

Make = Callable[..., Project]


def digests(summary: dict[str, Any]) -> dict[str, str]:
    """Receiver → digest."""
    return {name: peer["digest"] for name, peer in summary["peers"].items()}


def complete(project: Project, slots: int) -> None:
    """Check that the newest results are those of the same trials, computed here in memory."""
    summary = project.results().summary
    assert summary["ended"] == "complete"
    folder = project.folder / f"memory-{len(list((project.folder / 'runs').iterdir()))}"
    assert digests(summary) == digests(montecarlo("two-eavesdroppers", slots=slots, trials=1, out=folder).summary)
    assert not any(link["unexplained"] for link in summary["links"].values())


def test_up_alone_runs_the_demo(project: Make) -> None:
    """It ends by itself, with the digests of the same trials in memory; and again, without anything taken down before."""
    demo = project(EVEDROP_OPTIONS=SHORT, EVEDROP_USER="4321:4321")
    for runs in (1, 2):
        demo.compose("up")
        assert {service: demo.state(service)["ExitCode"] for service in ROLES} == dict.fromkeys(ROLES, 0)
        complete(demo, 600)
        assert len(list((demo.folder / "runs").iterdir())) == runs
    assert {path.stat().st_uid for path in (demo.folder / "runs").rglob("*")} == {4321}


def test_a_scenario_of_ones_own(project: Make) -> None:
    """A file beside docker-compose.yml; of three eavesdroppers nothing is started, and it is said why."""
    own = project(EVEDROP_OPTIONS=SHORT, EVEDROP_SCENARIO="mine/two.toml")
    (own.folder / "mine").mkdir()
    text = Path("scenarios/two-eavesdroppers.toml").read_text()
    (own.folder / "mine" / "two.toml").write_text(text)
    own.compose("up")
    assert own.results().folder.name.startswith("two-")
    (own.folder / "mine" / "two.toml").write_text(
        text + '[eavesdroppers.third]\nstrategy = "naive"\nlink.quality = 0.5\n'
    )
    done = own.compose("up", may_fail=True)
    assert done.returncode != 0
    assert "mine/two.toml has 3 eavesdroppers: suspicious smart third" in own.said("briefs")
    assert len(list((own.folder / "runs").iterdir())) == 1


PROBE = """
import concurrent.futures, json, pathlib, selectors, socket, sys, time
def known(name):
    try:
        return bool(socket.getaddrinfo(name, 7447))
    except OSError:
        return False
names = sys.argv[1].split()
with concurrent.futures.ThreadPoolExecutor(len(names)) as looking:
    found = {"names": [name for name, there in zip(names, looking.map(known, names)) if there], "reached": []}
with selectors.DefaultSelector() as waiting:
    for address in sys.argv[2].split():
        host, port = address.split(":")
        link = socket.socket()
        link.setblocking(False)
        link.connect_ex((host, int(port)))
        waiting.register(link, selectors.EVENT_WRITE, address)
    deadline = time.monotonic() + 3.0
    while (left := deadline - time.monotonic()) > 0.0 and waiting.get_map():
        for key, _ in waiting.select(left):
            if key.fileobj.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0:
                found["reached"].append(key.data)
            waiting.unregister(key.fileobj)
found["files"] = sorted(str(path) for path in pathlib.Path("/brief").rglob("*"))
found["briefs"] = [json.loads(pathlib.Path(path).read_text())["process"] for path in found["files"]]
found["rights"] = [line.split()[1] for line in open("/proc/self/status") if line.startswith(("CapEff", "Uid"))]
print(json.dumps(found))
"""
"""What a process of a container can look up and connect to, and which briefs it has."""


@pytest.fixture
def going(project: Make) -> Project:
    """A run that does not end by itself."""
    one = project(EVEDROP_OPTIONS=ENDLESS)
    one.compose("up", "--detach")
    one.running()
    return one


def addresses(going: Project, service: str) -> dict[str, str]:
    """Network → address of a service."""
    networks = going.docker.inspected("container", going.container(service))["NetworkSettings"]["Networks"]
    return {name.rpartition("_")[2]: network["IPAddress"] for name, network in networks.items()}


def test_who_can_reach_what(going: Project) -> None:
    """Every role reaches the router and no other, has its own brief alone, and no rights; all come to be healthy."""
    everybody = {service: addresses(going, service) for service in ROLES}
    others = [f"{host}:{port}" for found in everybody.values() for host in found.values() for port in (7447, 17450)]

    def look(service: str) -> str:
        # Of an unknown name Docker asks who is not to be reached from here, and that takes as long as is waited.
        quick = ("exec", "-e", "RES_OPTIONS=timeout:1 attempts:1", going.container(service))
        return going.docker(*quick, "python", "-c", PROBE, " ".join(ROLES), " ".join(others))

    with ThreadPoolExecutor() as looking:
        seen = dict(zip(ROLES[1:], looking.map(look, ROLES[1:]), strict=True))
    for service in ROLES[1:]:
        found = json.loads(seen[service])
        assert found["names"] == sorted({"router", service}, key=ROLES.index)
        own = {f"{everybody['router'][f'to-{service}']}:7447"}
        if service == "observer":
            own |= {f"{host}:17450" for host in everybody[service].values()}
        assert set(found["reached"]) == own
        assert found["files"] == ["/brief/brief.json"]
        process = {"eavesdropper-1": "suspicious", "eavesdropper-2": "smart"}.get(service, service)
        assert found["briefs"] == [process]
        assert found["rights"] == ["1000", "0" * 16]
    for service in ROLES:
        wait_until(
            lambda service=service: going.state(service)["Health"]["Status"] == "healthy", f"a healthy {service}"
        )


PAGE = """
import urllib.request
try:
    print(urllib.request.urlopen('http://127.0.0.1:17450/').read())
except OSError as error:
    print(error)
"""
PAGE_ANSWERS = "Rerun"


def listening(project: Project) -> set[str]:
    """The ports of the machine that are listened on; all of them on loopback."""
    table = project.docker.inside("cat", "/proc/net/tcp").splitlines()[1:]
    found = [line.split()[1].split(":") for line in table if line.split()[3] == "0A"]
    assert {address for address, _ in found} <= {"0100007F"}
    return {str(int(port, 16)) for _, port in found}


def test_the_view_is_on_loopback_alone(going: Project) -> None:
    """The page answers at the address that the observer tells, and nothing else of the machine's listens for others."""
    address = next(line for line in going.said("observer").splitlines() if '"view"' in line)
    assert "http://127.0.0.1:17450/?url=" in address
    wait_until(lambda: PAGE_ANSWERS in going.docker.inside("python3", "-c", PAGE), "a page")
    assert listening(going) == {"17450", "17451"}


def test_a_finished_run_is_looked_at_without_an_installation(project: Make) -> None:
    """As docs/containers.md says: the observer's service shows a results folder instead of conducting a run."""
    one = project(EVEDROP_OPTIONS=SHORT)
    one.compose("up")
    folder = one.results().folder.name
    how = ("run", "--detach", "--rm", "--no-deps", "--service-ports", "observer")
    one.compose(*how, "view", f"/runs/{folder}", "--serve", "0.0.0.0:17450")
    wait_until(lambda: listening(one) == {"17450", "17451"}, "the ports of a view")
    wait_until(lambda: PAGE_ANSWERS in one.docker.inside("python3", "-c", PAGE), "a page")


def test_a_killed_container_ends_the_run_and_the_next_one_goes_well(project: Make) -> None:
    """It is named, what was measured is on disk, everybody leaves; and `up` once more makes a whole run."""
    one = project(EVEDROP_OPTIONS=ENDLESS)
    one.compose("up", "--detach")
    one.running()
    one.docker("kill", one.container("eavesdropper-2"))
    assert one.ended("observer") == 3
    assert "smart cut off from the network for 2 s" in one.said("observer")
    assert one.results().slots.num_rows > 0
    assert {service: one.ended(service) for service in ROLES} == {**dict.fromkeys(ROLES, 3), "eavesdropper-2": 137}
    again = project(EVEDROP_OPTIONS=SHORT)
    again.compose("up")
    complete(again, 600)


def test_a_router_started_again_and_a_network_that_was_away_change_nothing(project: Make) -> None:
    """Kill and start the router's container, take an eavesdropper's off its network and put it back: the same digests."""
    one = project(EVEDROP_OPTIONS=LONG)
    one.compose("up", "--detach")
    one.running()
    one.docker("kill", one.container("router"))
    one.docker("start", one.container("router"))
    one.running(one.progress())
    smart, network = one.container("eavesdropper-2"), f"{one.environment['COMPOSE_PROJECT_NAME']}_to-eavesdropper-2"
    one.docker("network", "disconnect", network, smart)
    health = ("docker", "-H", one.docker.address, "exec", smart, "evedrop", "health", "/brief/brief.json")
    wait_until(lambda: subprocess.run(health, capture_output=True, check=False).returncode, "an eavesdropper cut off")
    one.docker("network", "connect", network, smart)
    assert one.ended("observer") == 0, one.said("observer")
    complete(one, 3000)


def test_nothing_is_left(project: Make, docker: Docker) -> None:
    """Down takes containers, networks and volumes along, of a run in the middle as well."""
    one = project(EVEDROP_OPTIONS=ENDLESS)
    one.compose("up", "--detach")
    one.running()
    one.down()
    name = one.environment["COMPOSE_PROJECT_NAME"]
    label = f"label=com.docker.compose.project={name}"
    for kind in (("container", "--all"), ("network",), ("volume",)):
        assert docker(kind[0], "ls", *kind[1:], "--quiet", "--filter", label) == ""
    assert one.results().summary["ended"] == "interrupted"
