"""The programs of a run and of a wire take threads, time, chance, processes, the disk and Zenoh from `world()` alone."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("emulator/evedrop/live", "emulator/evedrop/results", "emulator/evedrop/wire", "peers")
MODULES = {"secrets", "threading"}
"""Modules of which nothing may be used."""
NAMES = {
    *(f"os.{name}" for name in ("_exit", "fork", "getpid", "kill", "urandom")),
    *(f"os.{name}" for name in ("ftruncate", "makedirs", "mkdir", "remove", "rename", "replace", "truncate", "unlink")),
    *(f"queue.{name}" for name in ("LifoQueue", "PriorityQueue", "Queue", "SimpleQueue")),
    *(f"signal.{name}" for name in ("alarm", "set_wakeup_fd", "signal")),
    *(f"time.{name}{unit}" for name in ("monotonic", "perf_counter", "time") for unit in ("", "_ns")),
    "msgspec.convert",  # as `converted` in system/structs.py
    "shutil.move",
    "shutil.rmtree",
    "time.sleep",
    *(f"zenoh.{name}" for name in ("init_log_from_env_or", "open", "scout", "try_init_log_from_env")),
}
"""What may not be used of other modules."""
CHANGES = {"mkdir", "rmdir", "touch", "unlink", "write_bytes", "write_text"}
"""Methods of a path that change files, for which there is `world().disk`."""
HANDLERS = "zenoh.handlers."
"""Its classes are types; they may not be called."""
EXCEPTIONS = {
    "emulator/evedrop/live/launch/compose.py write_text": "a command of its own, which starts no run",
    "emulator/evedrop/live/network/connection.py touch": "a heartbeat, which has no contents",
    "emulator/evedrop/results/folder.py rmdir": "a command removes the folder that it made if nothing is in it",
    "emulator/evedrop/live/protocol/codec.py threading": "a packer for each thread; simulated ones can share it",
}
"""File and name → why it may be used there."""


def used(tree: ast.Module) -> Iterator[str]:
    """What a module uses of the machine itself."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names):
                yield from (alias.name for alias in names if alias.name in MODULES)
            case ast.ImportFrom(module=str(module), names=names):
                yield from (module for _ in names[:1] if module in MODULES)
                yield from (f"{module}.{alias.name}" for alias in names if f"{module}.{alias.name}" in NAMES)
            case ast.Attribute() if (name := ast.unparse(node)) in NAMES:
                yield name
            case ast.Call(func=ast.Attribute(attr=str(change))) if change in CHANGES:
                yield change
            case ast.Call(func=ast.Attribute() as called) if (name := ast.unparse(called)).startswith(HANDLERS):
                yield name


def test_programs_use_the_machine_through_their_world() -> None:
    """Except as listed, each with its reason; and the list has no entry that is gone from the code."""
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    assert len(paths) > 50
    present = {
        f"{path.relative_to(ROOT)} {name}" for path in paths for name in used(ast.parse(path.read_text("utf-8")))
    }
    assert present - {*EXCEPTIONS} == set(), "take it from world(), or say in EXCEPTIONS why it may be used"
    assert {*EXCEPTIONS} - present == set(), "remove these from EXCEPTIONS"


@pytest.mark.parametrize(
    ("text", "uses"),
    [
        ("import threading", ["threading"]),
        ("from threading import Lock, Thread", ["threading"]),
        ("from queue import Empty", []),
        ("from queue import Empty, SimpleQueue", ["queue.SimpleQueue"]),
        ("import time\ntime.strftime('%H')", []),
        ("now = time.monotonic", ["time.monotonic"]),
        ("world().time()", []),
        ("os._exit(1)", ["os._exit"]),
        ("os.replace(new, path)", ["os.replace"]),
        ("world().disk.replace(new, path)", []),
        ("(folder / name).unlink()", ["unlink"]),
        ("zenoh.open(config)", ["zenoh.open"]),
        ("world().zenoh.open(config)", []),
        ("channel: zenoh.handlers.FifoChannel[zenoh.Sample] = made", []),
        ("zenoh.handlers.FifoChannel(8)", ["zenoh.handlers.FifoChannel"]),
        ("process.send_signal(signal.SIGKILL)", []),
    ],
)
def test_what_counts_as_the_machine_itself(text: str, uses: list[str]) -> None:
    """Lines as they stand in programs."""
    assert list(used(ast.parse(text))) == uses
