"""A simulated world for the program that makes it: where its caller waits, all others go on, and time passes.

The caller is a process of this world. The scheduler has a greenlet of its own, to which a wait of the caller leads, as that of
any other thread.

Source: docs/maintainers/simulated-world.md, tests of wires.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing.process
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO, cast, final
from unittest.mock import patch

import zenoh
from greenlet import getcurrent, greenlet

from evedrop.errors import RunError, UsageError
from evedrop.system.disk import REAL_DISK
from evedrop.system.world import inside
from evedrop.virtual.processes import ProcessOutput, Program, VirtualMachine, VirtualProcess
from evedrop.virtual.scheduler import VirtualScheduler, VirtualTask, VirtualThread
from evedrop.virtual.world import VirtualWorld
from evedrop.virtual.zenoh import VirtualZenoh
from evedrop.virtual.zenoh.session import VirtualSession

_REAL: tuple[tuple[Any, str, str], ...] = (
    (time, "sleep", "time.sleep"),
    (threading.Thread, "start", "threading.Thread.start"),
    (threading.Condition, "wait", "a wait of threading or queue"),
    (subprocess.Popen, "__init__", "subprocess.Popen"),
    (os, "system", "os.system"),
    (os, "posix_spawn", "os.posix_spawn"),
    (os, "fork", "os.fork"),
    (multiprocessing.process.BaseProcess, "start", "a process of multiprocessing"),
    (select, "select", "select.select"),
    (select, "poll", "select.poll"),
    (asyncio, "run", "asyncio.run"),
    (asyncio.BaseEventLoop, "run_forever", "an event loop of asyncio"),
)
"""What takes real time: place, name, and how users know it."""
_MOST_TURNS = 100_000
"""At one moment: more are those of a program that goes on without waiting."""

_MORE_SECONDS = 120.0
"""How long each further wait may last, such as one for the end of a wire."""


@final
class CallerWorld:
    """A simulated world that its caller is in while `entered` lasts; its disk is that of the machine."""

    def __init__(self, seed: int, program: Program) -> None:
        """seed: of the order in which programs go on; program: what `evedrop` is there."""
        self.scheduler = VirtualScheduler(seed)
        self.machine = VirtualMachine(self.scheduler, program)
        self.zenoh = VirtualZenoh(self.scheduler)
        self.world = VirtualWorld(self.scheduler, self.machine, self.zenoh, REAL_DISK)
        self.error: BaseException | None = None
        """What the caller's wait is to end with, if it waits in vain."""
        self.trusted: list[VirtualTask] = []
        """Processes that know which world they are in, and may do what is refused to programs."""
        self._last = 0.0
        self._streams = sys.stdout, sys.stderr
        self._process = VirtualProcess(self.scheduler, self.scheduler.process("test"))
        self._caller, self._system_thread = getcurrent(), threading.get_ident()
        self._thread = self._become_thread()
        self._over = False
        self._moment, self._turns = 0.0, 0

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Let the caller be in this world while the block runs.

        There, `zenoh.open` opens simulated sessions, and whatever would wait in real time raises UsageError.
        """
        self.machine.adopt(self._process)
        self.scheduler.hub = hub = greenlet(self._let_others_go_on)
        with contextlib.ExitStack() as stack:
            self.world.temporary = Path(stack.enter_context(TemporaryDirectory(prefix="evedrop-")))
            stack.enter_context(inside(self.world))
            stack.enter_context(self._instead(zenoh, "open", self._open))
            for name in ("FifoChannel", "RingChannel", "Callback"):
                stack.enter_context(self._instead(zenoh.handlers, name, getattr(self.zenoh.handlers, name)))
            for place, name, what in _REAL:
                stack.enter_context(self._instead(place, name, _refused(what)))
            try:
                yield
            finally:
                self._over = True
                hub.switch()

    def _open(self, config: zenoh.Config) -> VirtualSession:
        """Open a session; as from Zenoh's `open`, it returns when the declarations of the others have come."""
        session = self.zenoh.open(config)
        for _ in session.liveliness().get("nobody") or ():  # the answer comes after them
            pass
        return session

    def _instead(
        self, place: Any, name: str, other: Callable[..., object]
    ) -> contextlib.AbstractContextManager[object]:
        """Have another function in the place of one while a block runs, for the test and its programs."""
        real, mine, scheduler = getattr(place, name), self._system_thread, self.scheduler

        def chosen(*arguments: Any, **entries: Any) -> object:
            theirs = threading.get_ident() == mine and scheduler.current and scheduler.current.task not in self.trusted
            return (other if theirs else real)(*arguments, **entries)

        return patch.object(place, name, chosen)

    def _become_thread(self) -> VirtualThread:
        """Let the caller be the thread that goes on now."""
        scheduler = self.scheduler
        thread = VirtualThread(scheduler, self._process.task, "main", lambda: None)
        thread.greenlet = self
        scheduler.current = thread
        return thread

    def switch(self) -> None:
        """Let the caller go on, until it waits: as a greenlet does."""
        self._outside(self._caller.switch)

    def _outside(self, go_on: Callable[[], object]) -> None:
        """Let the caller go on with its own standard streams."""
        inside_streams = sys.stdout, sys.stderr
        sys.stdout, sys.stderr = self._streams
        go_on()
        self._streams = sys.stdout, sys.stderr
        sys.stdout, sys.stderr = inside_streams

    def _let_others_go_on(self) -> None:
        """What the scheduler's greenlet does, from the caller's first wait on."""
        scheduler = self.scheduler
        scheduler.current = None
        self._streams = sys.stdout, sys.stderr
        sys.stdout, sys.stderr = (cast(TextIO, ProcessOutput(self.machine, stream)) for stream in self._streams)
        while not self._over:
            try:
                scheduler.run(float("inf"), self._is_caller_to_go_on)
            except BaseException as error:  # such as Ctrl-C
                self.error = error
            if self.error is not None and not self._over:
                why, self.error = self.error, None
                self._interrupt(why)
        scheduler.take_down()
        sys.stdout, sys.stderr = self._streams

    def standard_output(self) -> TextIO:
        """The caller's."""
        return self._streams[0]

    def _is_caller_to_go_on(self) -> bool:
        """Whether it is to go on, although what it waits for has not come."""
        now = self.scheduler.now
        if now != self._moment:
            self._moment, self._turns = now, 0
        self._turns += 1
        if self._turns > _MOST_TURNS:
            self._turns = 0
            self.error = UsageError(f"at {now:g} virtual seconds, no time passes: a program goes on without waiting")
        return self._over or self.error is not None

    def _interrupt(self, error: BaseException) -> None:
        """Let the caller go on with an error in what it waits for."""
        self._thread.over = True  # what it waited for comes in vain
        self._thread = self._become_thread()
        self._outside(lambda: self._caller.throw(error))
        self.scheduler.current = None

    def allow(self, seconds: float) -> None:
        """Let the caller wait for so long from now; a wait that lasts longer ends with UsageError."""
        self._last = max(self._last, self.scheduler.now + seconds)
        self.scheduler.at(self._last, self._end_wait)

    def _end_wait(self) -> None:
        now = self.scheduler.now
        if now >= self._last:
            self.error = UsageError(
                f"the test still waits after {now:g} virtual seconds, when all wires have ended by themselves; give one of them "
                "more `seconds`, or wait for less"
            )
            self.allow(_MORE_SECONDS)

    def expect_no_error(self) -> None:
        """Raise RunError if a thread of this world has ended by an exception."""
        for thread, error in self.scheduler.errors:
            raise RunError(f"{thread}: {type(error).__name__}: {error}") from error


def _refused(what: str) -> Callable[..., object]:
    """A function that refuses to wait in real time."""

    def refuse(*_: object, **__: object) -> object:
        raise UsageError(
            f"{what} in the simulated world, where no virtual time passes meanwhile; wait by the wire's `clock.sleep` or for a "
            "message, and let `start` start programs"
        )

    return refuse
