"""The hosts of a run over ssh, all of which are this machine: their file, their folders, their connections and their processes.

A folder for temporary files stands for each host: every process there has it in its environment. Source: docs/hosts.md.
"""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import final

from evedrop.names import RELAY, ROUTER
from evedrop.system.ports import free_port
from tests.faults import ours
from tests.processes import parent_of
from tests.proxy import Cable
from tests.sshd import Sshd

SSH, PROGRAM, SESSION, CONNECTION = "ssh", "evedrop host", "sshd", "connection"
HOST_FORK_SERVER, HOST_CLEANER = "fork server", "cleaner"
PARTS = (SSH, PROGRAM, SESSION, CONNECTION, HOST_FORK_SERVER, HOST_CLEANER)
"""The parts of a host that faults disturb: a target is `PART of HOST`.

The launcher's client; the program that starts processes there; the server's processes for this connection; the connection, which
leads through a cable; the program's fork server, and the shell that removes its private folder.
"""
_OF = " of "


def target_on(part: str, host: str) -> str:
    """The target of a fault that disturbs a part of a host."""
    return f"{part}{_OF}{host}"


def part_of(target: str) -> str:
    """The part of a host that is disturbed, such as `ssh`; empty if the target is a process or something else."""
    return target.rpartition(_OF)[0]


def host_of(target: str) -> str:
    """The host of which a part is disturbed; empty if the target is a process or something else."""
    return target.rpartition(_OF)[2] if _OF in target else ""


@final
class Hosts:
    """The hosts of one run."""

    def __init__(self, placed: Mapping[str, tuple[str, ...]], folder: Path, server: Sshd) -> None:
        """placed: host → the processes on it; folder: of the run; server: lets the run in on every host."""
        self.path = folder / "hosts.toml"
        """What `--hosts` takes."""
        self.temporaries = {host: folder / host for host in placed}
        """The folder for temporary files of each host."""
        self._scripts = {host: str(folder / f"{host}.sh") for host in placed}
        self._server = server.process.pid
        self._cables = {host: Cable(server.port) for host in placed}
        config = folder / "ssh_config"
        # The client connects to a cable, whose port the server's key is not known for.
        config.write_text(f"{server.config.read_text()}  HostKeyAlias [{server.address}]:{server.port}\n")
        text = [f"ssh_config = {json.dumps(config.name)}"]
        for router in (ROUTER, RELAY):
            if any(router in processes for processes in placed.values()):
                text += [f"[{router}]", f'listen = "tls/127.0.0.1:{free_port()}"']
        for host, processes in placed.items():
            self.temporaries[host].mkdir()
            Path(self._scripts[host]).write_text(_script(self.temporaries[host]))
            text += [f"[hosts.{host}]", f'address = "{server.address}"', f"processes = {json.dumps(processes)}"]
            text += [f'command = ["sh", {json.dumps(self._scripts[host])}]', f"port = {self._cables[host].port}"]
        self.path.write_text("\n".join(text))

    def cable(self, host: str) -> Cable:
        """The cable of the connection with a host."""
        return self._cables[host]

    def pids(self, part: str, host: str) -> list[int]:
        """The living processes of a part of a host: one or none, except that sshd may have two for a connection."""
        if part == SSH:
            script = self._scripts[host]
            clients = (process for process in ours.descendants() if Path(process.words[0]).name == "ssh")
            return [process.pid for process in clients if script in process.words]
        there = list(ours.marked(self.temporaries[host]))
        if part == HOST_FORK_SERVER:
            return [process.pid for process in there if process.is_fork_server]
        if part == HOST_CLEANER:
            return [process.pid for process in there if process.is_cleaner]
        programs = [process.pid for process in there if process.words[-3:] == ("-m", "evedrop", "host")]
        return programs if part == PROGRAM else [pid for program in programs for pid in self._serving(program)]

    def _serving(self, program: int) -> list[int]:
        """The server's processes above a program that it started."""
        above = list[int]()
        with suppress(OSError):
            while (program := parent_of(program)) not in (self._server, os.getpid(), 0):
                if Path(f"/proc/{program}/comm").read_text().startswith("sshd"):
                    above.append(program)
        return above

    def close(self) -> None:
        """Let go of the connections."""
        for cable in self._cables.values():
            cable.close()


def _script(temporary: Path) -> str:
    """What starts Evedrop on a host; it uses the package that the campaign uses."""
    variables = {"TMPDIR": str(temporary), "PYTHONDONTWRITEBYTECODE": "1"}
    if "PYTHONPATH" in os.environ:
        variables["PYTHONPATH"] = os.environ["PYTHONPATH"]
    exports = "".join(f"export {name}={shlex.quote(value)}\n" for name, value in variables.items())
    return f'{exports}exec {shlex.join([sys.executable, "-m", "evedrop"])} "$@"\n'
