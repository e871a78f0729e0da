"""A wire in the simulated world, for tests: an hour of it takes seconds.

Source: docs/wire/python.md, an hour in seconds.
"""

from __future__ import annotations

import inspect
import signal
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Generic, ParamSpec, Self, TextIO, TypeVar, cast, final

from evedrop.errors import RunError, UsageError
from evedrop.system.signals import INTERRUPTED
from evedrop.virtual.caller import CallerWorld
from evedrop.virtual.processes import ChildProcess, Program, VirtualProcess
from evedrop.virtual.scheduler import Ended
from evedrop.wire.plan import WirePlan
from evedrop.wire.running import RunningWire, described_wire

P = ParamSpec("P")
T = TypeVar("T")
_PATIENCE = 60.0
LONGEST_SECONDS = 7200.0
"""The virtual seconds after which a simulated wire ends by itself, and what waits for it is in vain."""
_MOST_GLANCES = 100_000
"""At a clock, while no time passes: more are those of a program that waits without sleeping."""


@final
class SimulatedClock:
    """Virtual time, with the functions that programs use of the module `time`."""

    def __init__(self, world: CallerWorld) -> None:
        self._world = world.world
        self._moment, self._glances = -1.0, 0

    def monotonic(self) -> float:
        """Virtual seconds since the test began."""
        now = self._world.monotonic()
        if now != self._moment:
            self._moment, self._glances = now, 0
        self._glances += 1
        if self._glances > _MOST_GLANCES:
            raise UsageError(
                f"no time passes while a program asks for it {_MOST_GLANCES:,} times; let it sleep, or wait for a message"
            )
        return now

    def time(self) -> float:
        """Virtual seconds since 1970."""
        self.monotonic()
        return self._world.time()

    def sleep(self, seconds: float) -> None:
        """Let virtual time pass."""
        self._world.sleep(seconds)


@final
class SimulatedProgram(Generic[T]):
    """A program at a simulated wire, in a process of its own."""

    def __init__(self, world: CallerWorld, name: str, work: Callable[[], T]) -> None:
        self.name = name
        self._world, self._work = world, work
        self._results: list[T] = []
        self.error: BaseException | None = None
        """What ended it, unless `result` has raised it."""
        scheduler = world.scheduler
        self._process = VirtualProcess(scheduler, scheduler.process(name), cast(BinaryIO, _Echo(world.standard_output)))
        world.machine.begin(name, self._run, self._process)

    def _run(self) -> int:
        status = self._ended()
        self._world.zenoh.close_sessions(self._process.task)  # as the end of an interpreter does, but not a signal
        return status

    def _ended(self) -> int:
        """Do the work; returns the exit status."""
        try:
            result = self._work()
            if inspect.iscoroutine(result) or inspect.isgenerator(result):
                result.close()  # or Python warns of what was never awaited
                raise UsageError(f"{self.name} is no ordinary function: simulated programs do not run coroutines")
            self._results.append(result)
        except Ended:
            raise
        except SystemExit as end:
            self.error = end if end.code else None
            return end.code if isinstance(end.code, int) else int(end.code is not None)
        except KeyboardInterrupt as interrupt:  # Ctrl-C is for the test
            self._world.error = interrupt
            return INTERRUPTED
        except BaseException as error:  # told by `result`, or at the end of the test
            self.error = error
            return 1
        return 0

    @property
    def is_running(self) -> bool:
        """Whether it runs."""
        return self._process.task.alive

    def send_signal(self, number: int) -> None:
        """Send it a signal, such as SIGSTOP and SIGCONT."""
        self._process.signal(number)

    def kill(self) -> None:
        """Kill it: nothing of it goes on."""
        self.send_signal(signal.SIGKILL)

    def result(self, seconds: float | None = None) -> T:
        """Wait until it has ended, and return what it returned; or raise what it raised.

        seconds: virtual ones, after which it raises RunError; None: as long as wires may last. RunError, too, if it was killed.
        """
        self._process.wait(seconds)
        if self.is_running:
            raise RunError(f"{self.name} still runs after {seconds:g} virtual seconds")
        error, self.error = self.error, None
        if error is not None:
            raise error
        if not self._results:
            raise RunError(f"{self.name} ended with status {self._process.task.status}")
        return self._results[0]


@final
class SimulatedWire(RunningWire):
    """A wire in a simulated process, and programs at it."""

    def __init__(self, plan: WirePlan, folder: Path, seconds: float | str, world: CallerWorld) -> None:
        super().__init__(plan, folder, seconds, self._started)
        self.clock = SimulatedClock(world)
        """For the programs, in place of the module `time`."""
        self._world = world
        self._programs: list[SimulatedProgram[object]] = []

    def start(self, program: Callable[P, T], *arguments: P.args, **entries: P.kwargs) -> SimulatedProgram[T]:
        """Start a function as a program in a process of its own."""
        name = getattr(program, "__name__", type(program).__name__)
        started = SimulatedProgram(self._world, name, lambda: program(*arguments, **entries))
        self._programs.append(cast("SimulatedProgram[object]", started))
        return started

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Kill the programs, and end the wire. Raises what one of them raised, or else as for a real wire."""
        for program in self._programs:
            program.kill()
        failed = next((program.error for program in self._programs if program.error is not None), None)
        super().__exit__(kind, error or failed, trace)
        if error is None:
            if failed is not None:
                raise failed
            self._world.expect_no_error()

    def _started(self, *words: str) -> ChildProcess:
        """Start the process of the wire."""
        self._world.allow(self._seconds + _PATIENCE)
        wire = ChildProcess(self._world.machine, "wire", *words)
        self._world.trusted.append(wire.process.task)
        return wire


@final
class SimulatedWires:
    """Opens wires in one simulated world, which begins with the first one; use it as a context manager."""

    def __init__(self, program: Program) -> None:
        """program: what `evedrop` is there."""
        self._program = program
        self._stack = ExitStack()
        self._world: CallerWorld | None = None

    def open(
        self,
        source: str | Path | WirePlan | None = None,
        *,
        out: str | Path | None = None,
        seconds: float | str = LONGEST_SECONDS,
        order: int = 1,
        **entries: Any,
    ) -> SimulatedWire:
        """Open a wire, which ends with the `with` statement; the arguments are those of `evedrop.wire`.

        seconds: virtual ones. order: a number for the order in which programs go on and messages arrive; the first wire's counts.
        """
        plan, folder = described_wire(source, out, entries)
        if self._world is None:
            self._world = CallerWorld(order, self._program)
            self._stack.enter_context(self._world.entered())
        return self._stack.enter_context(SimulatedWire(plan, folder, seconds, self._world))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)


@final
class _Echo:
    """The log of a program, whose text comes to the standard output of the test."""

    def __init__(self, stream: Callable[[], TextIO]) -> None:
        self._stream = stream

    def write(self, data: bytes) -> None:
        """Pass text on."""
        self._stream().write(data.decode())

    def flush(self) -> None:
        """Everything is passed on already."""

    def close(self) -> None:
        """The test's standard output stays open."""
