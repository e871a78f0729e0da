"""Simulated other hosts: each with a disk, and a server that lets ssh in, starts Evedrop's program and passes on what both say.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty
from typing import IO, cast, final

from evedrop.live.launch.other_hosts import SILENCE_SECONDS, Greeting, line_of, serve_launcher
from evedrop.system.ssh_client import SshClient
from evedrop.system.waiting import Alarm
from evedrop.virtual.disk import VirtualDisk
from evedrop.virtual.endings import status_of
from evedrop.virtual.host_parts import PROGRAM, SESSION, SSH, part_on
from evedrop.virtual.pipes import Pipe, PipeFile
from evedrop.virtual.processes import VirtualMachine, VirtualProcess
from evedrop.virtual.scheduler import VirtualQueue, VirtualScheduler
from evedrop.virtual.world import TEMPORARY
from evedrop.virtual.zenoh import VirtualZenoh

_CONNECT_SECONDS, _DELAY_SECONDS = 0.2, 1e-3
_FAILED = 255
"""The status of an ssh whose connection failed."""
_MOST_BYTES = 1 << 15
_LOST = "lost"
OTHER_VERSION = "0.0.1"


@final
class _Way:
    """What is under way from one end of a connection to the other, in order."""

    def __init__(self, scheduler: VirtualScheduler) -> None:
        self._scheduler, self._arrived = scheduler, VirtualQueue(scheduler)
        self._last = 0.0
        self._held: list[bytes | int | str] | None = None

    def send(self, what: bytes | int | str) -> None:
        """Send some bytes, or how it ended."""
        scheduler = self._scheduler
        self._last = max(self._last, scheduler.now + scheduler.random.expovariate(1.0 / _DELAY_SECONDS))
        scheduler.at(self._last, lambda: self._arrive(what))

    def _arrive(self, what: bytes | int | str) -> None:
        if self._held is None:
            self._arrived.put(what)
        else:
            self._held.append(what)

    def freeze(self) -> None:
        """Let nothing through."""
        self._held = [] if self._held is None else self._held

    def thaw(self) -> None:
        """Let through what was held up, and all else."""
        held, self._held = self._held or [], None
        for what in held:
            self._arrived.put(what)

    def lose(self) -> None:
        """The connection is gone, and nothing is under way any more."""
        if self._held is None:
            self._arrived.put(_LOST)

    def receive(self, seconds: float | None = None) -> bytes | int | str:
        """Wait for what arrives. Raises Empty."""
        what: bytes | int | str = self._arrived.get(timeout=seconds)
        return what


@final
class HostConnection:
    """A connection of ssh with the server on a host: bytes, the end of input, and how the program ended."""

    def __init__(self, scheduler: VirtualScheduler) -> None:
        self._scheduler = scheduler
        self.orders, self.answers = _Way(scheduler), _Way(scheduler)
        self.frozen_until = 0.0

    @property
    def frozen(self) -> bool:
        """Whether nothing gets through."""
        return self._scheduler.now < self.frozen_until

    def cut(self) -> None:
        """Both ends are told that it is gone."""
        self.orders.lose()
        self.answers.lose()

    def freeze(self, seconds: float | None) -> None:
        """Let nothing through for some time, or for good, though it seems open."""
        self.orders.freeze()
        self.answers.freeze()
        self.frozen_until = max(self.frozen_until, self._scheduler.later(seconds))
        self._scheduler.after_seconds(seconds, self._thaw)

    def _thaw(self) -> None:
        if not self.frozen:
            self.orders.thaw()
            self.answers.thaw()


@final
class OtherHost:
    """A host that ssh can reach."""

    def __init__(self, machine: VirtualMachine, zenoh: VirtualZenoh, name: str, root: Path, oddity: str) -> None:
        """root: an empty folder for its disk; oddity: one of `ODDITIES`, or empty."""
        self.name, self._machine, self._zenoh, self.oddity = name, machine, zenoh, oddity
        self._scheduler = machine.scheduler
        self.disk = VirtualDisk(self._scheduler, root, host=name)
        self.temporary = self.disk.root / TEMPORARY
        self.temporary.mkdir(0o700)
        self.connection = HostConnection(self._scheduler)
        self.has_power = True
        self._server: VirtualProcess | None = None

    @property
    def responds(self) -> bool:
        """Whether the server answers ssh."""
        server = self._server
        return not self.connection.frozen and server is not None and server.task.alive and not server.task.stopped

    def lose_power(self) -> None:
        """End all its processes: nobody is told."""
        self.has_power = False
        self.connection.freeze(None)
        self._zenoh.unplug(self.name, None)
        self.disk.power_cut()

    def let_in(self) -> None:
        """Start the server's process for a connection, and Evedrop's program; called by ssh."""
        scheduler, machine = self._scheduler, self._machine
        orders, answers = Pipe(scheduler), Pipe(scheduler)
        server = self._server = VirtualProcess(scheduler, scheduler.process(part_on(SESSION, self.name), self.name))
        program = VirtualProcess(
            scheduler, scheduler.process(part_on(PROGRAM, self.name), self.name), None, orders, answers
        )
        server.task.held += [orders.close_writing, answers.close_reading, self._leave]
        server.task.held.append(lambda: scheduler.go_on(program.task))

        def serve() -> int:
            machine.begin(part_on(PROGRAM, self.name), self._program, program)
            scheduler.thread("orders", lambda: self._pass_orders(orders)).start()
            while data := answers.read(_MOST_BYTES):
                self.connection.answers.send(data)
            status = program.wait()
            self.connection.answers.send(program.printed)
            self.connection.answers.send(cast("int", status))
            return 0

        machine.begin(part_on(SESSION, self.name), serve, server)

    def _leave(self) -> None:
        self.connection.answers.send(_LOST)

    def _pass_orders(self, orders: Pipe) -> None:
        """Until ssh sends no more; without a connection, the server ends, and so does the program's input."""
        while (data := self.connection.orders.receive()) != _LOST:
            if not data:
                orders.close_writing()
            with suppress(OSError):
                orders.write(cast("bytes", data))
        self._machine.current.exit(_FAILED)

    def _program(self) -> int:
        process = self._machine.current
        if self.oddity == "no evedrop":
            process.print("sh: 1: exec: evedrop: not found\n")
            return 127
        if self.oddity == "another version":
            with suppress(BrokenPipeError):  # the launcher may be gone
                process.send_event(line_of(Greeting(OTHER_VERSION)))
            Alarm(lambda: process.signal(signal.SIGKILL)).set(SILENCE_SECONDS)
            while process.read_input(_MOST_BYTES):
                pass
            return 0
        with suppress(OSError):
            for number in range(NOISE.get(self.oddity, 0)):
                process.send_event(b"Welcome %d\n" % number)

        def serve() -> int:
            serve_launcher()
            return 0

        return status_of(serve)


NOISE: Mapping[str, int] = {"a chatty shell": 5, "a shell that only talks": 300}
"""Oddity → how many lines the login shell prints before the program begins."""
ODDITIES: Mapping[str, bool] = {
    "no evedrop": False,
    "another version": False,
    "refuses ssh": False,
    **{oddity: count < 100 for oddity, count in NOISE.items()},
}
"""What may be odd about a host → whether a run can use it."""


@final
class VirtualSsh:
    """A simulated process of ssh."""

    def __init__(self, machine: VirtualMachine, host: OtherHost, command: Sequence[str]) -> None:
        """Start it, with the command for the system's ssh."""
        scheduler = self._scheduler = machine.scheduler
        self._host = host
        self._orders, answers = Pipe(scheduler), Pipe(scheduler)
        self.answers = cast("IO[bytes]", PipeFile(answers))
        self._to_launcher = answers
        options = dict(word.split("=") for word in command if word.startswith("ServerAlive"))
        self._asks_after, self._most_unanswered = (int(options[f"ServerAlive{of}"]) for of in ("Interval", "CountMax"))
        name = part_on(SSH, host.name)
        launcher = machine.current
        self._process = VirtualProcess(scheduler, scheduler.process(name), None, self._orders, self._to_launcher)
        self._process.task.held.append(lambda: host.connection.orders.send(_LOST))
        launcher.task.held.append(self.kill)
        machine.begin(name, self._work, self._process)

    # What it does

    def _work(self) -> int:
        scheduler, host = self._scheduler, self._host
        scheduler.sleep(scheduler.random.expovariate(1.0 / _CONNECT_SECONDS))
        if host.oddity == "refuses ssh" or not host.has_power:
            self._process.print(f"ssh: connect to host {host.name} port 22: Connection refused\n")
            return _FAILED
        host.let_in()
        scheduler.thread("orders", self._pass_orders).start()
        for what in self._arriving():
            if isinstance(what, bytes):
                try:
                    self._to_launcher.write(what)
                except BrokenPipeError:
                    return _FAILED
            elif isinstance(what, int):
                return what
            elif what == _LOST:
                self._process.print(f"Connection to {host.name} closed by remote host.\n")
                return _FAILED
            else:
                self._process.print(what)
        self._process.print(f"Timeout, server {host.name} not responding.\n")
        return _FAILED

    def _pass_orders(self) -> None:
        while data := self._orders.read(_MOST_BYTES):
            self._host.connection.orders.send(data)
        self._host.connection.orders.send(b"")

    def _arriving(self) -> Iterator[bytes | int | str]:
        """What arrives, until the server has not answered for too long."""
        unanswered = 0
        while unanswered <= self._most_unanswered:  # then the next question would be due, and the real one gives up
            try:
                yield self._host.connection.answers.receive(self._asks_after)
                unanswered = 0
            except Empty:
                unanswered = 0 if self._host.responds else unanswered + 1

    # What the launcher asks

    def send(self, data: bytes, seconds: float) -> bool:
        """Send bytes to the host."""
        return self._orders.write(data, seconds) == len(data)

    def hang_up(self) -> None:
        """Send nothing more."""
        self._orders.close_writing()

    @property
    def said(self) -> str:
        """What was written to standard error."""
        return self._process.printed

    def poll(self) -> int | None:
        """Its exit status."""
        return self._process.task.status

    def kill(self) -> None:
        """End it."""
        self._process.signal(signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        status = self._process.wait(timeout)
        if status is None:
            raise subprocess.TimeoutExpired("ssh", timeout or 0.0)
        return status

    def close(self) -> None:
        """Nothing is to be closed."""


@final
class OtherHosts:
    """All hosts of a run but the launcher's."""

    def __init__(
        self,
        machine: VirtualMachine,
        zenoh: VirtualZenoh,
        disks: dict[str, VirtualDisk],
        root: Path,
        oddities: Mapping[str, str],
    ) -> None:
        """disks: gets their disks; root: a folder for these; oddities: host → what is odd about it, or an empty text."""
        self._machine = machine
        self._hosts: dict[str, OtherHost] = {}
        for name, oddity in oddities.items():
            folder = root / f"host {name}"
            folder.mkdir()
            self._hosts[name] = OtherHost(machine, zenoh, name, folder, oddity)
            disks[name] = self._hosts[name].disk

    def __getitem__(self, name: str) -> OtherHost:
        return self._hosts[name]

    def __iter__(self) -> Iterator[OtherHost]:
        return iter(self._hosts.values())

    def ssh(self, command: Sequence[str]) -> SshClient:
        """Start ssh with a command, whose last word but one is the host. Raises OSError."""
        return VirtualSsh(self._machine, self._hosts[command[-2]], command)
