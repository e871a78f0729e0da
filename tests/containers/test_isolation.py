"""Who can reach what while docker-compose.yml is up, and what is left when it is taken down in the middle."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.conftest import wait_until
from tests.containers.machine import Docker
from tests.containers.project import ENDLESS, ROLES, Project, projects

pytestmark = pytest.mark.containers

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


@pytest.fixture(scope="module")
def going(tmp_path_factory: pytest.TempPathFactory, docker: Docker) -> Iterator[Project]:
    """A run that does not end by itself; taken down in the middle, it leaves what was measured."""
    with projects(tmp_path_factory.mktemp("going"), docker) as make:
        one = make(EVEDROP_OPTIONS=ENDLESS)
        one.compose("up", "--detach")
        one.running()
        yield one
    assert one.results().summary["ended"] == "interrupted"
    assert one.results().slots.num_rows > 0


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


def test_the_view_is_on_loopback_alone(going: Project) -> None:
    """The page answers at the address that the observer tells, and nothing else of the machine's listens for others."""
    address = next(line for line in going.said("observer").splitlines() if '"view"' in line)
    assert "http://127.0.0.1:17450/?url=" in address
    going.shown()
