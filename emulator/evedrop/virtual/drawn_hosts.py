"""The other hosts of a drawn run: their file, which may have a mistake, what is odd about them, and their faults.

Source: docs/hosts.md.
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, final

from evedrop.live.launch.hosts_file import processes_of
from evedrop.names import RELAY, ROUTER
from evedrop.scenario.tables import Scenario
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.faults import (
    HangUpProcess,
    InterruptProcess,
    KillProcess,
    StopAndKillProcess,
    StopProcess,
    TerminateProcess,
)
from evedrop.virtual.host_faults import HOST_KINDS
from evedrop.virtual.host_parts import HOST_FORK_SERVER, LISTENS, PROGRAM, SESSION, SSH, host_of, part_of, part_on
from evedrop.virtual.other_hosts import ODDITIES
from evedrop.virtual.processes import LAUNCHER

_ONE_IN = 8
"""How many runs there are for each with other hosts."""
_NAMES = ("alpha", "beta")
_PART_KINDS: Mapping[type[Disturbance], float] = {
    KillProcess: 3,
    StopProcess: 4,
    StopAndKillProcess: 1,
    TerminateProcess: 1,
    HangUpProcess: 1,
    InterruptProcess: 1,
}
_PARTS = (SSH, PROGRAM, SESSION, HOST_FORK_SERVER)
_MOST_FAULTS, _FIRST = 2, 5
_AT_ONCE, _CONNECTED = 0.1, 25
"""The fraction of faults that end the launcher, and the events within which it does not wait for all hosts any more."""


class Mistake(NamedTuple):
    """A mistake in a hosts file."""

    right: str
    """What is replaced, where it occurs."""
    wrong: str
    message: str
    """Part of what the run prints."""


_ROUTER = f'listen = "{LISTENS[ROUTER]}"'
_RELAY = f'[relay]\nlisten = "{LISTENS[RELAY]}"'
MISTAKES: Mapping[str, Mistake] = {
    "the recorder": Mistake("processes = [", 'processes = ["recorder", ', "names recorder, which is always on this"),
    "an unknown process": Mistake("processes = [", 'processes = ["senser", ', "senser; expected"),
    "no processes": Mistake("processes = [", "processes = []  # [", "processes"),
    "no folder of classes": Mistake("modules = ", "# ", "modules: is missing"),
    "one host twice": Mistake(
        "[hosts.",
        '[hosts.other]\naddress = "other"\nprocesses = ["sensor"]\n[hosts.third]\n'
        'address = "third"\nprocesses = ["sensor"]\n[hosts.',
        "already; expected one host",
    ),
    "no router": Mistake("[router]", "[rooter]", "rooter"),
    "an unknown entry": Mistake("address =", "adress =", "adress"),
    "no TOML": Mistake("[router]", "[router", "hosts.toml"),
    "an option for a host": Mistake('address = "', 'address = "-', "does not begin with a dash"),
    "a name of two words": Mistake("[hosts.", '[hosts."a b"]\n[hosts.', "lower-case letter"),
    "a command of two lines": Mistake(
        "[hosts.",
        '[hosts.first]\naddress = "first"\nprocesses = []\ncommand = ["a\\nb"]\n[hosts.',
        "a text of one line",
    ),
    "no endpoint": Mistake(_ROUTER, 'listen = "7447"', "router.listen"),
    "no port": Mistake(_ROUTER, 'listen = "tcp/router.lan:0"', "names no port"),
    "no name": Mistake(_ROUTER, 'listen = "tcp/router..lan:7447"', "names no host"),
    "no address": Mistake(_ROUTER, 'listen = "tcp/[router]:7447"', "endpoint"),
    "everywhere": Mistake(_ROUTER, 'listen = "tcp/0.0.0.0:7447"', "every address of a host"),
    "a wrong sixth version": Mistake(_ROUTER, 'listen = "tcp/[1::2::3]:7447"', "names no address"),
    "a certificate of an address": Mistake(_ROUTER, 'listen = "tls/[fd00::1]:7447"', "IPv6"),
    "two protocols": Mistake(_ROUTER, f'{_ROUTER}\nconnect = "tls/router.lan:7447"', "differs in protocol"),
    "no encryption": Mistake("insecure = true\n", "", "is not encrypted"),
    "no relay": Mistake(f"{_RELAY}\ninsecure = true\n", "", "relay: is missing"),
    "a needless relay": Mistake("[router]", f"{_RELAY}\ninsecure = true\n[router]", "relay"),
    "one place for two": Mistake(_RELAY, f"[relay]\n{_ROUTER}", "relay"),
    "one with a certificate": Mistake(_RELAY, '[relay]\nlisten = "tls/relay.lan:7448"', "relay"),
}
"""What is wrong → what the file has instead."""


@dataclass(frozen=True)
class DrawnHost:
    """A host of a run."""

    name: str
    processes: tuple[str, ...]
    oddity: str = ""
    """One of `ODDITIES`, or nothing."""
    detailed: bool = False
    """Whether its file says how to log in there."""


@final
@dataclass(frozen=True)
class DrawnHosts:
    """The hosts of a run."""

    hosts: tuple[DrawnHost, ...]
    mistake: str = ""
    """One of `MISTAKES`, or nothing."""

    def as_lists(self) -> list[Any]:
        """All that it has, as lists and texts."""
        return [self.mistake, [[host.name, [*host.processes], host.oddity, host.detailed] for host in self.hosts]]

    @classmethod
    def of_lists(cls, lists: Any) -> DrawnHosts:
        """What `as_lists` has made. Raises ValueError, TypeError."""
        mistake, hosts = lists
        return cls(tuple(DrawnHost(name, tuple(there), *rest) for name, there, *rest in hosts), mistake)

    def __str__(self) -> str:
        words = [f"{', '.join(host.processes)} on {host.name}" for host in self.hosts]
        words += [f"{host.name} has {host.oddity}" for host in self.hosts if host.oddity]
        return "; ".join([*words, *([f"hosts.toml has {self.mistake}"] if self.mistake else [])])

    @property
    def oddities(self) -> Mapping[str, str]:
        """Host → what is odd about it."""
        return {host.name: host.oddity for host in self.hosts}

    def processes_on(self, name: str) -> tuple[str, ...]:
        """The processes of a host; none for a text that names none."""
        return next((host.processes for host in self.hosts if host.name == name), ())

    def refused(self, scenario: Scenario) -> str | None:
        """A text that a run says which cannot begin because of its hosts; None if it can."""
        if self.mistake and MISTAKES[self.mistake].right in self._right(scenario):
            return MISTAKES[self.mistake].message
        if scenario.shards > 1:
            return "hosts carry one run"
        return next((f"host {host.name}: " for host in self.hosts if not ODDITIES.get(host.oddity, True)), None)

    def text(self, scenario: Scenario) -> str:
        """The file of `--hosts`."""
        mistake = MISTAKES.get(self.mistake, Mistake("", "", ""))
        return self._right(scenario).replace(mistake.right, mistake.wrong, 1)

    def _right(self, scenario: Scenario) -> str:
        lines = ['ssh_config = "ssh_config"'] if any(host.detailed for host in self.hosts) else []
        for router in (ROUTER, *((RELAY,) if scenario.relayed else ())):
            lines += [f"[{router}]", f'listen = "{LISTENS[router]}"', "insecure = true"]
        for host in self.hosts:
            lines += [f"[hosts.{host.name}]", f'address = "{host.name}"', f"processes = {json.dumps(host.processes)}"]
            if scenario.modules is not None:
                lines.append(f'modules = "{scenario.modules}"')
            if host.detailed:
                lines += ['user = "lab"', "port = 2222", 'folder = "/srv/work"']
                lines += ['command = ["/opt/evedrop"]']
        return "\n".join(lines) + "\n"

    def smaller(self) -> Iterator[DrawnHosts | None]:
        """Fewer and plainer hosts, the fewest first; None: no other host."""
        yield None
        if self.mistake:
            yield replace(self, mistake="")
        for at, host in enumerate(self.hosts):
            others = self.hosts[:at], self.hosts[at + 1 :]
            plainer = [replace(host, oddity="", detailed=False), replace(host, oddity="")]
            fewer = [replace(host, processes=tuple(rest)) for rest in _without_each(host.processes) if rest]
            if len(self.hosts) > 1:
                yield replace(self, hosts=(*others[0], *others[1]))
            for smaller in (*plainer, *fewer):
                if smaller != host:
                    yield replace(self, hosts=(*others[0], smaller, *others[1]))

    def fitting(self, scenario: Scenario) -> DrawnHosts | None:
        """The same with the processes that a scenario has; None if no host has any."""
        there = processes_of(scenario)
        kept = [replace(host, processes=tuple(name for name in host.processes if name in there)) for host in self.hosts]
        hosts = tuple(host for host in kept if host.processes)
        return replace(self, hosts=hosts) if hosts else None


def _without_each(processes: tuple[str, ...]) -> Iterator[list[str]]:
    for at in range(len(processes)):
        yield [*processes[:at], *processes[at + 1 :]]


def drawn_hosts(seed: int, scenario: Scenario) -> tuple[DrawnHosts | None, tuple[Disturbance, ...]]:
    """The hosts of a seed's run, and what happens to them; none for most seeds."""
    some = random.Random(f"hosts {seed}")  # noqa: S311 - to be repeated, not to be secret
    if some.random() * _ONE_IN >= 1.0 or (scenario.shards > 1 and some.random() < 0.5):
        return None, ()
    hosts = [(name, list[str]()) for name in _NAMES[: some.randint(1, len(_NAMES))]]
    for process in processes_of(scenario):
        if some.random() < 0.6:
            some.choice(hosts)[1].append(process)
    if not any(there for _, there in hosts):
        hosts[0][1].append(some.choice(processes_of(scenario)))
    drawn = [
        DrawnHost(
            name, tuple(there), some.choice(sorted(ODDITIES)) if some.random() < 0.08 else "", some.random() < 0.2
        )
        for name, there in hosts
        if there
    ]
    mistake = some.choice(sorted(MISTAKES)) if some.random() < 0.15 else ""
    faults = [_fault(some, some.choice(drawn).name) for _ in range(some.choice([0, 1, 1, _MOST_FAULTS]))]
    return DrawnHosts(tuple(drawn), mistake), tuple(faults)


def _fault(some: random.Random, host: str) -> Disturbance:
    if some.random() < _AT_ONCE:
        return InterruptProcess(LAUNCHER, some.randint(_FIRST, _CONNECTED))
    if some.random() < 0.5:
        [kind] = some.choices([*_PART_KINDS], [*_PART_KINDS.values()])
        target = part_on(some.choice(_PARTS), host)
    else:
        [of_host] = some.choices([*HOST_KINDS.values()], [kind.share for kind in HOST_KINDS.values()])
        kind, target = of_host, part_on(of_host.part, host)
    seconds = None
    if kind.lasts and (not kind.for_good or some.random() < 0.85):
        seconds = round(10.0 ** some.uniform(-2.0, 1.3), 3)
    return kind(target, int(_FIRST * 200.0 ** some.random()), seconds)


def kind_with(name: str, target: str) -> type[Disturbance] | None:
    """The kind of faults of hosts with this name that has such targets; None if there is none."""
    return HOST_KINDS.get(f"{name} {part_of(target)}") if host_of(target) else None
