"""A network of this machine's own: a switch, and a namespace with an address of its own for every host.

The names hold the id of the process that made them, so runs do not meet, and what a killed one left behind is taken away by
the next.
"""

from __future__ import annotations

import itertools
import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import final

from tests.privileged import CannotRun

_PREFIX = "evedrop-test"
_NAME = re.compile(rf"{_PREFIX}-(\d+)-\d+-")
_numbers = itertools.count()


def _ip(*words: str) -> str:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"ip {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


def _take_away(name: str) -> None:
    """End the processes in a namespace, and the namespace."""
    for pid in _ip("netns", "pids", name).split():
        subprocess.run(["kill", "-9", pid], check=False, capture_output=True)
    _ip("netns", "del", name)


def take_away_leftovers() -> None:
    """Namespaces of tests that were killed."""
    for line in _ip("netns", "list").splitlines():
        name = line.split()[0]
        match = _NAME.match(name)
        if match and not Path(f"/proc/{match[1]}").exists():
            with suppress(OSError):  # others, at the same time, take it away as well
                _take_away(name)


def prove() -> None:
    """Make a network, and take it away. Raises CannotRun if the system does not let us."""
    try:
        with lan("a"):
            pass
    except OSError as error:
        raise CannotRun(f"a network of our own cannot be made: {error}") from error


@final
class Lan:
    """Hosts 10.77.0.1, 10.77.0.2, …; each on its own cable to the switch."""

    def __init__(self, hosts: tuple[str, ...]) -> None:
        self._begin = f"{_PREFIX}-{os.getpid()}-{next(_numbers)}"
        self._switch = f"{self._begin}-switch"
        self.addresses = {host: f"10.77.0.{number}" for number, host in enumerate(hosts, 1)}

    def build(self) -> None:
        """Make it. Raises OSError if the system does not let us."""
        _ip("netns", "add", self._switch)
        _ip("-n", self._switch, "link", "add", "switch", "type", "bridge")
        _ip("-n", self._switch, "link", "set", "switch", "up")
        for number, (host, address) in enumerate(self.addresses.items()):
            name, plug = self.namespace(host), f"plug{number}"
            _ip("netns", "add", name)
            _ip("-n", name, "link", "set", "lo", "up")
            _ip("link", "add", "eth0", "netns", name, "type", "veth", "peer", "name", plug, "netns", self._switch)
            _ip("-n", name, "addr", "add", f"{address}/24", "dev", "eth0")
            _ip("-n", name, "link", "set", "eth0", "up")
            _ip("-n", self._switch, "link", "set", plug, "master", "switch")
            self.plug(host)

    def take_away(self) -> None:
        """Undo it, however far it was made."""
        there = {line.split()[0] for line in _ip("netns", "list").splitlines()}
        for name in (*map(self.namespace, self.addresses), self._switch):
            if name in there:
                _take_away(name)

    def namespace(self, host: str) -> str:
        """A host's."""
        return f"{self._begin}-{host}"

    def entering(self, host: str) -> tuple[str, ...]:
        """The words that start a command on a host."""
        return ("ip", "netns", "exec", self.namespace(host))

    def run(self, host: str, *command: str) -> str:
        """What a command that is run on a host says."""
        return subprocess.run([*self.entering(host), *command], capture_output=True, text=True, check=True).stdout

    def unplug(self, host: str) -> None:
        """Pull a host's cable."""
        self._set(host, "down")

    def plug(self, host: str) -> None:
        """Plug it in."""
        self._set(host, "up")

    def _set(self, host: str, state: str) -> None:
        number = list(self.addresses).index(host)
        _ip("-n", self._switch, "link", "set", f"plug{number}", state)


@contextmanager
def lan(*hosts: str) -> Iterator[Lan]:
    """A network with these hosts, which is gone when the block ends."""
    lan = Lan(hosts)
    try:
        lan.build()
        yield lan
    finally:
        lan.take_away()
