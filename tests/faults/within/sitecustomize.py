"""Loaded by the processes of a run that the campaign disturbs.

The launcher says what happens, has cables put before the router, and keeps what the hosts of a run over ssh write to stderr.
A fork server, if asked to, makes the router confuse keys.
Modules are changed when they are imported and not before, so that the launcher starts as it always does.
"""

from __future__ import annotations

import os
import sys

FOLDER = os.environ.get("EVEDROP_CAMPAIGN")
CONFUSED = os.environ.get("PYTHON_EVEDROP_CONFUSED")
"""After how many deliveries the router puts one on another receiver's key, too, and a file that says that it did.

Evedrop hands on variables of Python.
"""
MOST_CONFUSED = 5

LAUNCHES = bool(FOLDER) and sys.orig_argv[1:4] == ["-m", "evedrop", "run"]
if LAUNCHES or (CONFUSED and "evedrop.fork_server" in sys.orig_argv):
    from importlib.machinery import ModuleSpec, PathFinder
    from types import ModuleType
    from typing import Any

    def _telling(module: ModuleType) -> None:
        import json
        import time

        show = module.ProgressLine.on_event

        def on_event(line: Any, event: Any) -> None:
            with open(f"{FOLDER}/news", "a") as file:
                file.write(json.dumps({**json.loads(event.line), "at": time.monotonic()}) + "\n")
            show(line, event)

        module.ProgressLine.on_event = on_event

    def _wired(module: ModuleType) -> None:
        import dataclasses
        import json
        import socket

        honest = module.Brief.write

        def write(brief: Any, directory: Any) -> Any:
            told = {"private": str(directory), "first": brief.first_trial}
            told |= {"process": brief.process, "role": brief.role, "router": brief.router}
            with socket.socket(socket.AF_UNIX) as campaign:
                campaign.connect(f"{FOLDER}/asked")
                campaign.sendall(json.dumps(told).encode() + b"\n")
                endpoint = campaign.recv(1000).decode()
            return honest(dataclasses.replace(brief, router=endpoint), directory)

        module.Brief.write = write

    def _heard(module: ModuleType) -> None:
        import os

        begin, close = module.SshHost.__init__, module.SshHost.close

        def begun(host: Any, *given: Any) -> None:
            begin(host, *given)
            host.heard = os.dup(host._ssh.output_file.fileno())  # ours outlives that of the connection

        def closed(host: Any, deadline: float) -> None:
            close(host, deadline)
            with open(f"{FOLDER}/{host.name}.stderr", "wb") as file:
                file.write(os.pread(host.heard, 2**20, 0))
            os.close(host.heard)

        module.SshHost.__init__, module.SshHost.close = begun, closed

    def _confused(module: ModuleType) -> None:
        number, _, place = (CONFUSED or "").partition(":")
        put, every, before, count = module.Publisher.__call__, int(number), [None], [0]

        def confuse(publisher: Any, payload: bytes) -> None:
            put(publisher, payload)
            if "/downlink/" not in publisher.key:
                return
            count[0] += 1
            other: Any = before[0]
            if (
                other is not None
                and other.key != publisher.key
                and count[0] % every == 0
                and count[0] <= MOST_CONFUSED * every
            ):
                other._publisher.put(publisher._head + payload)
                with open(place, "w"):
                    pass
            before[0] = publisher

        module.Publisher.__call__ = confuse

    _CHANGES = (
        {
            "evedrop.cli.console": _telling,
            "evedrop.live.protocol.brief": _wired,
            "evedrop.live.launch.other_hosts": _heard,
        }
        if LAUNCHES
        else {"evedrop.live.network.connection": _confused}
    )

    class _Finder:
        """Finds the modules that are to be changed, and changes them when they have been run."""

        @staticmethod
        def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
            change = _CHANGES.get(name)
            spec = None if change is None else PathFinder.find_spec(name, path, target)
            if spec is not None and spec.loader is not None:
                run = spec.loader.exec_module

                def exec_module(module: ModuleType) -> None:
                    run(module)
                    change(module)  # type: ignore[misc]

                spec.loader.exec_module = exec_module  # type: ignore[method-assign]
            return spec

    sys.meta_path.insert(0, _Finder)
