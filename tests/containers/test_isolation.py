"""What each container can reach while docker-compose.yml is up, and what is left when it is taken down in the middle."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest

from tests.conftest import LIMIT, wait_until
from tests.containers.machine import Docker
from tests.containers.project import ENDLESS, ROLES, Project, projects

pytestmark = pytest.mark.containers

MEMORY = 2**30
"""Bytes that a container may take."""

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
        project = make(EVEDROP_OPTIONS=ENDLESS, EVEDROP_MEMORY=str(MEMORY))
        project.compose("up", "--detach")
        project.running()
        yield project
    assert project.results().summary["ended"] == "interrupted"
    assert project.results().slots.num_rows > 0


def addresses(going: Project, service: str) -> dict[str, str]:
    """Network → address of a service."""
    networks = going.docker.inspected("container", going.container(service))["NetworkSettings"]["Networks"]
    return {name.rpartition("_")[2]: network["IPAddress"] for name, network in networks.items()}


def is_healthy(project: Project, service: str) -> bool:
    """Whether Docker calls a service's container healthy."""
    return bool(project.state(service)["Health"]["Status"] == "healthy")


def test_who_can_reach_what(going: Project) -> None:
    """Every role reaches only the router, has only its own brief, and has no rights; all become healthy."""
    everybody = {service: addresses(going, service) for service in ROLES}
    others = [
        f"{host}:{port}" for addresses in everybody.values() for host in addresses.values() for port in (7447, 17450)
    ]

    def look(service: str) -> str:
        # Of an unknown name Docker asks who is not to be reached from here, and that takes as long as is waited.
        quick = ("exec", "-e", "RES_OPTIONS=timeout:1 attempts:1", going.container(service))
        return going.docker(*quick, "python", "-c", PROBE, " ".join(ROLES), " ".join(others))

    with ThreadPoolExecutor() as looking:
        seen = dict(zip(ROLES[1:], looking.map(look, ROLES[1:]), strict=True))
    for service in ROLES[1:]:
        view = json.loads(seen[service])
        assert view["names"] == sorted({"router", service}, key=ROLES.index)
        own = {f"{everybody['router'][f'to-{service}']}:7447"}
        if service == "recorder":
            own |= {f"{host}:17450" for host in everybody[service].values()}
        assert set(view["reached"]) == own
        assert view["files"] == ["/brief/brief.json"]
        assert view["briefs"] == [service]
        assert view["rights"] == ["1000", "0" * 16]
    for service in ROLES:
        wait_until(partial(is_healthy, going, service), f"a healthy {service}")


SERVICES = """
import socket, sys, threading
web, names = socket.create_server(("0.0.0.0", 0)), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
names.bind(("127.0.0.1", 53))
def serve():
    while True:
        web.accept()[0].close()
threading.Thread(target=serve, daemon=True).start()
print(web.getsockname()[1], flush=True)
while True:
    question = names.recv(512)[12:]
    print(question[1 : 1 + question[0]].decode(), flush=True)
"""
"""Two services of the host: one listens at every address, the other resolves names and says who asks."""

REACHES = """
import socket, sys
reached = []
for host in sys.argv[3:]:
    try:
        socket.create_connection((host, int(sys.argv[1])), 2.0).close()
        reached.append(host)
    except OSError:
        pass
try:
    socket.getaddrinfo(sys.argv[2] + ".leak.example", 80)
except OSError:
    pass
print(*reached)
"""
"""Connects to a port of several hosts, and says which accept; resolves a name that does not exist."""


def test_no_way_leads_out(going: Project) -> None:
    """No process of the run reaches the host at any address, or resolves a name through it; only the view's forwarder does."""
    docker, project = going.docker, going.environment["COMPOSE_PROJECT_NAME"]
    networks = docker("network", "ls", "-q", "--filter", f"label=com.docker.compose.project={project}").split()
    gateways = {docker.inspected("network", network)["IPAM"]["Config"][0]["Gateway"] for network in networks}
    links = json.loads(docker.inside("ip", "-json", "-4", "address"))
    hosts = {address["local"] for link in links for address in link["addr_info"] if address["local"] != "127.0.0.1"}
    assert gateways > hosts, "only what forwards the view is on a network that the host is in"
    begun = [*docker.entering(), sys.executable, "-c", SERVICES]
    with subprocess.Popen(begun, stdout=subprocess.PIPE, text=True) as services:
        try:
            assert services.stdout is not None
            port = services.stdout.readline().strip()

            def reached(service: str) -> set[str]:
                quick = ("exec", "-e", "RES_OPTIONS=timeout:1 attempts:1", going.container(service))
                answers = docker(*quick, "python", "-c", REACHES, port, service, *sorted(hosts | gateways))
                return set(answers.split())

            with ThreadPoolExecutor() as looking:
                by_service = dict(zip(ROLES, looking.map(reached, ROLES), strict=True))
            assert by_service == {service: set() for service in ROLES}
            assert reached("view") == hosts, "otherwise this test would find nothing"
            docker.inside(sys.executable, "-c", REACHES, port, "the-host-itself", mounts=True)
        finally:
            services.kill()
        assert set(services.stdout.read().split()) == {"the-host-itself"}


GREEDY = """
import sys, threading
over = threading.Event()
try:
    for number in range(5000):
        threading.Thread(target=over.wait, daemon=True).start()
except RuntimeError:
    print(number, flush=True)
over.set()
held = b"x" * int(sys.argv[1])
"""
"""Starts threads up to the limit, says how many it could start, and then takes memory."""


def test_a_container_cannot_take_the_whole_machine(going: Project) -> None:
    """Its threads and its memory end at a limit, which ends what asked for more, and not the run."""
    greedy = ("docker", "-H", going.docker.address, "exec", going.container("suspicious"), "python", "-c", GREEDY)
    done = subprocess.run([*greedy, str(MEMORY + 1)], capture_output=True, text=True, check=False, timeout=LIMIT)
    assert done.returncode == 137, done.stderr
    assert 100 < int(done.stdout) < 1024
    for service in (*ROLES, "view", "briefs"):
        limits = going.docker.inspected("container", going.container(service))["HostConfig"]
        assert (limits["Memory"], limits["MemorySwap"], limits["PidsLimit"]) == (MEMORY, MEMORY, 1024)
    going.running(going.progress())


def test_the_view_is_on_loopback_alone(going: Project) -> None:
    """The page answers at the address that the recorder tells, and nothing else of the machine's listens for others."""
    address = next(line for line in going.log("recorder").splitlines() if '"view"' in line)
    assert "http://127.0.0.1:17450/?url=" in address
    going.shown()
