"""The file of `evedrop run --hosts`: which process of a run is on which host, and where the routers listen.

Source: docs/hosts.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, ValidationError

from evedrop.errors import ScenarioError, UsageError
from evedrop.live.launch.ports import RouterEndpoint, RouterEndpoints, router_endpoint
from evedrop.names import CONTROLLER, LEGITIMATE, RECORDER, RELAY, ROUTER, SENSOR
from evedrop.scenario.line_numbers import with_line_numbers
from evedrop.scenario.loading import tables_in
from evedrop.scenario.table import Table, checked_name, expected, sentences
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import listed
from evedrop.system.files import Unreadable, shown, text_of
from evedrop.system.hints import near

_MOST_BYTES = 2**20


def _word(text: str) -> str:
    # ssh would take a word that begins with a dash for an option.
    if (
        not text
        or text.startswith("-")
        or any(character.isspace() or not character.isprintable() for character in text)
    ):
        raise expected("a word that does not begin with a dash, and has no spaces")
    return text


def _line(text: str) -> str:
    if not text or not text.isprintable():
        raise expected("a text of one line")
    return text


Word = Annotated[str, Field(strict=True), AfterValidator(_word)]
Line = Annotated[str, Field(strict=True), AfterValidator(_line)]


class RouterTable(Table):
    """`[router]` and `[relay]`."""

    listen: Annotated[Word, Field(examples=["tls/0.0.0.0:7447"])]
    connect: Annotated[Word | None, Field(examples=["tls/alpha.lan:7447"])] = None
    insecure: Annotated[bool, Field(strict=True)] = False

    def endpoint(self) -> RouterEndpoint:
        """The endpoint. Raises UsageError if the router cannot listen there or the others cannot connect there."""
        return router_endpoint(self.listen, self.connect, self.insecure, ("listen =", "connect ="))


class HostTable(Table):
    """`[hosts.NAME]`."""

    address: Annotated[Word, Field(examples=["beta.lan"])]
    user: Annotated[Word | None, Field(examples=["lab"])] = None
    port: Annotated[int | None, Field(strict=True, ge=1, le=65535, examples=[22])] = None
    processes: Annotated[tuple[Word, ...], Field(min_length=1, examples=[["router", "sensor"]])]
    command: Annotated[tuple[Line, ...], Field(min_length=1, examples=[["/opt/evedrop/bin/evedrop"]])] = ("evedrop",)
    folder: Annotated[Line | None, Field(examples=["/srv/evedrop/work"])] = None
    modules: Annotated[Line | None, Field(examples=["/srv/evedrop/classes"])] = None


class HostsFile(Table):
    """The complete file."""

    ssh_config: Annotated[Line | None, Field(examples=["ssh_config"])] = None
    router: Annotated[RouterTable, Field(examples=[{"listen": "tls/0.0.0.0:7447", "connect": "tls/alpha.lan:7447"}])]
    relay: RouterTable | None = None
    hosts: Annotated[
        dict[Annotated[str, AfterValidator(checked_name)], HostTable],
        Field(min_length=1, examples=[{"beta": {"address": "beta.lan", "processes": ["smart"]}}]),
    ]


@dataclass(frozen=True)
class HostsPlan:
    """The hosts of a run, and the endpoints of its routers."""

    hosts: Mapping[str, HostTable]
    endpoints: RouterEndpoints
    ssh_config: Path | None
    """The configuration file for ssh; None for the user's own."""

    def host_of(self, process: str) -> str | None:
        """The name of a process's host; None for this machine."""
        return next((name for name, host in self.hosts.items() if process in host.processes), None)


def load_hosts(path: Path, scenario: Scenario) -> HostsPlan:
    """Read the hosts of a scenario's run. Raises ScenarioError with every mistake, UsageError if the file cannot be read."""
    source = shown(path)
    try:
        text = text_of(path, _MOST_BYTES)
    except Unreadable as error:
        raise UsageError(
            f"{source} cannot be read ({error}); --hosts takes a TOML file (evedrop docs hosts shows one)"
        ) from error
    tables = tables_in(text, source)
    with with_line_numbers(text):
        try:
            file = HostsFile.model_validate(tables)
        except ValidationError as error:
            raise ScenarioError(source, sentences(error, HostsFile)) from None
        mistakes = [*_of_processes(file, scenario)]
        endpoints = _endpoints(file, scenario, mistakes)
        if mistakes or endpoints is None:
            raise ScenarioError(source, mistakes)
    config = None if file.ssh_config is None else (path.parent / file.ssh_config).absolute()
    return HostsPlan(file.hosts, endpoints, config)


def processes_of(scenario: Scenario) -> tuple[str, ...]:
    """The processes of a run that can be on other hosts: all but the recorder."""
    relay = (RELAY,) if scenario.relayed else ()
    steered = () if scenario.controller is None else (CONTROLLER,)
    return (ROUTER, *relay, SENSOR, LEGITIMATE, *steered, *scenario.eavesdroppers)


def _of_processes(file: HostsFile, scenario: Scenario) -> list[str]:
    """Mistakes in the lists of processes: unknown names, names given twice, and missing folders of classes."""
    processes, mistakes, seen = processes_of(scenario), [], dict[str, str]()
    for name, host in file.hosts.items():
        for process in host.processes:
            where = f"hosts.{name}.processes"
            if process == RECORDER:
                mistakes.append(
                    f"{where}: names {RECORDER}, which is always on this machine, where it writes the results"
                )
            elif process not in processes:
                mistakes.append(f"{where}: names {process}; expected {listed(processes)}{near(process, processes)}")
            elif process in seen:
                mistakes.append(
                    f"{where}: names {process}, which is on {seen[process]} already; expected one host for it"
                )
            seen.setdefault(process, name)
        if scenario.modules is not None and host.modules is None:
            mistakes.append(
                f"hosts.{name}.modules: is missing; expected the folder there of the modules that the scenario names"
            )
    return mistakes


def _endpoints(file: HostsFile, scenario: Scenario, mistakes: list[str]) -> RouterEndpoints | None:
    """The endpoints of the routers; adds the mistakes in them to the others, and returns None if there are any."""
    made: dict[str, Any] = {}
    for name, table in {ROUTER: file.router, RELAY: file.relay}.items():
        try:
            made[name] = None if table is None else table.endpoint()
        except UsageError as error:
            entry, equals, problem = str(error).replace("--insecure", "insecure = true").partition(" = ")
            mistakes.append(f"{name}.{entry}: {problem}" if equals else f"{name}: {entry}")
    if scenario.relayed and file.relay is None:
        mistakes.append(
            'relay: is missing; expected [relay] with listen = "tls/HOST:PORT": the scenario has two routers'
        )
    if file.relay is not None and not scenario.relayed:
        mistakes.append("relay: the scenario has one router; leave it out, or add --set network.routers=2")
    if mistakes:
        return None
    endpoints = RouterEndpoints(made[ROUTER], made[RELAY])
    try:
        endpoints.check(scenario.relayed)
    except UsageError as error:
        mistakes.append(f"relay: {str(error).removeprefix('--relay: ').replace('--relay ', '')}")
        return None
    return endpoints
