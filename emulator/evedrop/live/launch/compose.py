"""Writes the files with which Docker Compose starts a run: one container, one brief and one network for each process.

Source: docs/containers.md.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from evedrop.errors import UsageError
from evedrop.live.launch.briefs import expect_no_launcher_needed
from evedrop.live.launch.hosts_file import processes_of
from evedrop.names import RECORDER, RELAY, ROUTER, SENSOR
from evedrop.results.folder import make_private, write_private
from evedrop.results.resolved_scenario import input_texts, resolved
from evedrop.scenario.input_files import named_files
from evedrop.scenario.loading import read, tables_in
from evedrop.scenario.tables import Scenario
from evedrop.scenarios import shipped

COMPOSE_FILE = "docker-compose.yml"
MOST_NETWORKS = 30
"""How many networks fit into Docker's default address pools."""
_OTHERS = frozenset({"briefs", "view", "finished"})
"""The services other than the processes of the run."""
# YAML 1.1, which docker-compose 1.29 reads, takes these words for truth values and for nothing.
_YAML_WORDS = frozenset({"y", "n", "yes", "no", "on", "off", "true", "false", "null"})

_HEAD = """\
# A run on one machine, each process in a container of its own: `docker compose up`. It works with Compose v2 and with
# docker-compose 1.29. Made by `evedrop brief SCENARIO --compose DIR`; docs/containers.md describes it.
#
#   EVEDROP_SCENARIO   a scenario with the same processes, built in or in this folder; default {scenario}
#   EVEDROP_OPTIONS    options of `evedrop brief`, such as "--slots 500 --pace 0"
#   EVEDROP_USER       the user of the processes, who will own the results in ./runs: $(id -u):$(id -g); default 1000:1000
#   EVEDROP_MEMORY     the most memory of each container; default 2g
{head}
x-confined: &confined
  image: {image}
  init: true # the first program of a container does not end by SIGTERM otherwise
  read_only: true
  tmpfs: [/tmp]
  cap_drop: [ALL]
  security_opt: ["no-new-privileges:true"]
  mem_limit: "${{EVEDROP_MEMORY:-2g}}"
  memswap_limit: "${{EVEDROP_MEMORY:-2g}}" # no swap in addition: a process that takes too much is ended
  pids_limit: 1024 # threads count; each library has one for every processor
  # Docker asks this address for names of other hosts; from an internal network it is unreachable.
  dns: ["192.0.2.1"]

x-process: &process
  <<: *confined
  user: "${{EVEDROP_USER:-1000:1000}}"
  depends_on:
    briefs: {{condition: service_completed_successfully}}

x-client: &client
  <<: *process
  depends_on:
    briefs: {{condition: service_completed_successfully}}
    router: {{condition: service_started}} # Docker does not resolve the name of a service that has not started
"""

_FAR_CLIENT = """
x-far-client: &far-client
  <<: *process
  depends_on:
    briefs: {condition: service_completed_successfully}
    relay: {condition: service_started}
"""

_BRIEFS = """
# A network that contains its containers and nothing else: there is no route out, and the host has no address in it.
x-closed: &closed
  internal: true
  driver_opts:
    com.docker.network.bridge.inhibit_ipv4: "true"

services:
  briefs:
    <<: *confined
{build}    entrypoint: [sh, /opt/evedrop/briefs.sh]
    command: []
    user: "0:0"
    network_mode: none
    cap_add: [CHOWN, DAC_OVERRIDE]
    healthcheck: {{disable: true}}
    environment:
      EVEDROP_SCENARIO: "${{EVEDROP_SCENARIO:-{scenario}}}"
      EVEDROP_OPTIONS: "${{EVEDROP_OPTIONS:-}}"
      EVEDROP_USER: "${{EVEDROP_USER:-1000:1000}}"
    volumes:
      - .:/here:ro
      - ./runs:/runs
"""

_BUILD = """\
    build:
      context: .
      args: [EVEDROP_BASE] # without a value: the base that the Dockerfile names
"""

_VIEW = """
  # Shows the recorder's view on the host. It alone is on a network that leads to the host; it has no brief.
  view:
    <<: *confined
    user: "${EVEDROP_USER:-1000:1000}"
    entrypoint: [python, /opt/evedrop/forward.py]
    command: []
    healthcheck: {disable: true}
    depends_on:
      recorder: {condition: service_started}
    ports: &ports ["127.0.0.1:17450:17450", "127.0.0.1:17451:17451"]
    networks: [to-view, view]

  # `docker compose run --rm --service-ports finished /runs/RUN` shows a finished run.
  finished:
    <<: *confined
    user: "${EVEDROP_USER:-1000:1000}"
    profiles: [finished]
    entrypoint: [evedrop, view, --serve, "0.0.0.0:17450"]
    command: []
    healthcheck: {disable: true}
    volumes: ["./runs:/runs"]
    ports: *ports
    networks: [view]

# The briefs, in a volume each: no process sees the brief of another.
volumes:
"""

_OPEN_NETWORK = """\
  to-view: *closed
  view: # ports are published only from a network that is not internal
    driver_opts:
      com.docker.network.bridge.enable_ip_masquerade: "false"
"""


@dataclass(frozen=True)
class _Service:
    """The service of a process."""

    name: str
    process: str
    role: str
    far: bool
    """Whether it connects to the relay."""

    @property
    def network(self) -> str:
        """The network that only this process and its router share."""
        return f"to-{self.name}"


def write_compose(scenario: Scenario, source: str, changed: bool, folder: Path, overwrite: bool) -> list[Path]:
    """Write the files into a folder; returns their paths.

    source: the scenario as the user named it, a built-in name or a file; changed: whether options change it; overwrite:
    whether the folder may contain files; those with the same names are then replaced. Raises UsageError if it may not,
    if the folder cannot be written, and for a scenario that containers cannot run, or that is in the folder without its files.
    """
    _check(scenario)
    try:
        make_private(folder)
        if not overwrite and any(folder.iterdir()):
            raise UsageError(f"{folder} is not empty; give another --compose DIR, or add --overwrite")
        compose_file = folder / COMPOSE_FILE
        built_in = source in shipped()
        if built_in and not changed:
            compose_file.write_text(compose_text(scenario, source, (folder / "Dockerfile").exists()), encoding="utf-8")
            return [compose_file]
        own = folder / f"{_plain(Path(source).stem)}.toml"
        written = [compose_file]
        if not built_in and own.exists() and os.path.samefile(own, source):
            if changed:
                raise UsageError(f"{own} is the scenario itself, and would be replaced; give another --compose DIR")
            if (outside := _outside(own)) is not None:
                raise UsageError(
                    f"{own} names {outside}, which the containers cannot find; put it into {folder}, and name it by its path "
                    "from there, or give another --compose DIR, which gets a copy"
                )
        else:
            texts = {own.name: resolved(scenario), **input_texts(scenario)}
            for name, text in texts.items():
                write_private(folder / name, text)
            written += [folder / name for name in texts]
        compose_file.write_text(compose_text(scenario, own.name, (folder / "Dockerfile").exists()), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{folder} cannot be written ({error.strerror}); give another --compose DIR") from error
    return written


def compose_text(scenario: Scenario, name: str, build: bool) -> str:
    """The text of docker-compose.yml. name: of the scenario, as the container sees it; build: whether to build the image."""
    services = _services(scenario)
    head = "#   EVEDROP_BASE       the image to build upon, with Python 3.11 or later; default that of the Dockerfile\n"
    image = "#   EVEDROP_IMAGE      the image of all containers; default evedrop\n"
    parts = [
        _HEAD.format(
            scenario=name, head=head if build else image, image="evedrop" if build else '"${EVEDROP_IMAGE:-evedrop}"'
        ),
        _FAR_CLIENT if scenario.relayed else "",
        _BRIEFS.format(scenario=name, build=_BUILD if build else ""),
        *(f"      - {service.name}:/briefs/{service.process}\n" for service in services),
        *(_service(service, services) for service in services),
        _VIEW,
        *(f"  {_key(service.name)}:\n" for service in services),
        "\nnetworks:\n",
        *(f"  {service.network}: *closed\n" for service in services if service.process != ROUTER),
        _OPEN_NETWORK,
    ]
    return "".join(parts)


def network_count(scenario: Scenario) -> int:
    """How many networks the containers of a scenario have."""
    return len(_services(scenario)) - 1 + 2


def _check(scenario: Scenario) -> None:
    """Raise UsageError for a scenario that needs files or programs which containers do not have."""
    remedy = "start the processes by hand, with `evedrop brief SCENARIO --out DIR`"
    if scenario.shards > 1:
        raise UsageError(f"shards = {scenario.shards}: containers carry one run; give --set shards=1")
    if scenario.modules is not None:
        raise UsageError(f"modules = {scenario.modules}: the image does not contain classes of your own; {remedy}")
    if scenario.secret_file is not None:
        raise UsageError(f"secret_file = {scenario.secret_file}: containers do not have this file; {remedy}")
    expect_no_launcher_needed(scenario)
    if scenario.process.source == "zenoh":
        raise UsageError(f"process.zenoh: no container can reach the program that gives the states; {remedy}")


def _outside(scenario: Path) -> str | None:
    """The first file that a scenario file names elsewhere than in its own folder, which alone the containers see."""
    folder = scenario.parent
    for name in named_files(tables_in(read(scenario), str(scenario))):
        path = folder / name
        within = not Path(name).is_absolute() and path.resolve().is_relative_to(folder.resolve())
        if not within and path.exists():
            return name
    return None


def _services(scenario: Scenario) -> list[_Service]:
    """The processes, routers first; the name of a service is that of its process unless another service has it.

    Or if it has one letter: Compose v2 takes a volume of that name for a drive of Windows, and mounts nothing at the path.
    """
    processes = [*processes_of(scenario), RECORDER]
    services = []
    for process in processes:
        name = process
        while name in _OTHERS or len(name) == 1 or (name != process and name in processes):
            name = f"eavesdropper-{name}"
        role = "eavesdropper" if process in scenario.eavesdroppers else process
        services.append(_Service(name, process, role, scenario.relayed and process not in {ROUTER, RELAY, SENSOR}))
    return services


def _service(service: _Service, services: Sequence[_Service]) -> str:
    """A service as YAML."""
    base = "process" if service.process == ROUTER else "far-client" if service.far else "client"
    recorder = service.process == RECORDER
    serve, results = (', --serve, "0.0.0.0:17450"', ', "./runs:/runs"') if recorder else ("", "")
    lines = [
        f"  {_key(service.name)}:",
        f"    <<: *{base}",
        f"    command: [{service.role}, /brief/brief.json{serve}]",
        *(["    stop_grace_period: 1m # to write the results"] if recorder else []),
        f'    volumes: ["{service.name}:/brief:ro"{results}]',
        f"    networks: [{', '.join(_networks(service, services))}]",
    ]
    return "\n" + "\n".join(lines) + "\n"


def _networks(service: _Service, services: Sequence[_Service]) -> Iterator[str]:
    """The networks of a process: its own, those of the processes that connect to it, and the recorder's view's."""
    if service.process != ROUTER:
        yield service.network
    if service.process == RECORDER:
        yield "to-view"
    if service.process in {ROUTER, RELAY}:
        far = service.process == RELAY
        yield from (
            other.network for other in services if other.process not in {ROUTER, service.process} and other.far == far
        )


def _key(name: str) -> str:
    return json.dumps(name) if name in _YAML_WORDS else name


def _plain(stem: str) -> str:
    """A file name without characters that Compose would expand, and no dash at its beginning: it is no option."""
    return re.sub(r"[^A-Za-z0-9._-]", "-", stem).lstrip("-") or "own"
