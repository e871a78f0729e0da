"""Ends a wire that no longer answers, and names the part that hangs, such as Zenoh or the disk.

Each thread of the wire marks the work that it has in hand, and further threads put questions to each side and the journal. If a
piece of work takes too long, the process ends at once: its journal is on disk at every instruction.

Source: docs/wire/results.md, a wire that hangs.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NoReturn, Self, final

from evedrop.system.output import say
from evedrop.system.world import world

ANSWER_SECONDS = 60.0
"""How long a side may take to answer: nothing crosses meanwhile."""
WORK_SECONDS = 300.0
"""How long a thread may have one thing in hand: a large message to a slow reader takes its time."""
END_SECONDS = 30.0
"""How long anything but the journal may be in hand once the wire is to end."""
_TICK = 0.5  # seconds
_ASK_SECONDS = 2.0  # between two questions to a side
_LAST_SECONDS = 5.0  # for the last steps of a process that ends at once


@final
@dataclass(slots=True, eq=False)
class Duty:
    """The work of a thread."""

    where: str
    """The place in the words of a message, such as "in the journal"."""
    seconds: float = WORK_SECONDS
    """How long it may have one thing in hand."""
    end_seconds: float = END_SECONDS
    """The same once the wire is to end."""
    waits: bool = False
    """Whether it waits for the other duties, and so does not hang while any of them moves."""
    in_hand: object = None
    """A new object for each piece of work, and None while the thread waits for work."""

    @contextlib.contextmanager
    def busy(self) -> Iterator[None]:
        """Have something in hand while the block runs."""
        self.in_hand = object()
        try:
            yield
        finally:
            self.in_hand = None


@final
class Watchdog:
    """Watches duties; use it as a context manager.

    Time counts in ticks of its own thread, so a suspended process or a busy machine does not count as a hang.
    """

    def __init__(self, end: Callable[[str], object]) -> None:
        """end: called once, with what has hung and for how long."""
        self._end = end
        self._duties: dict[Duty, tuple[object, int]] = {}  # what it had in hand, and for how many ticks
        self._lock = world().lock()
        self._ending = False
        self._over = world().event()
        self._asks_no_more = world().event()
        self._thread = world().thread(self._run, name="watchdog")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._asks_no_more.set()

    def watch(self, *duties: Duty) -> None:
        """Watch further duties."""
        with self._lock:
            self._duties.update(dict.fromkeys(duties, (None, 0)))

    def ask(self, where: str, question: Callable[[], object], seconds: float = ANSWER_SECONDS) -> None:
        """Ask something again and again, on a thread of its own: it must come to an end within some seconds."""
        duty = Duty(where, seconds)
        self.watch(duty)

        def go_on() -> None:
            while not self._asks_no_more.wait(_ASK_SECONDS):
                with duty.busy(), contextlib.suppress(Exception):  # an error is an answer
                    question()

        world().thread(go_on, name="questions").start()

    @contextlib.contextmanager
    def doing(self, duty: Duty) -> Iterator[None]:
        """Watch what the block does."""
        self.watch(duty)
        with duty.busy():
            yield

    def hurry(self) -> None:
        """Ask nothing more, for the wire is to end, and allow duties only their `end_seconds`."""
        self._ending = True
        self._asks_no_more.set()

    def _run(self) -> None:
        while not self._over.wait(_TICK):
            hung = self._tick()
            if hung and not self._over.is_set():
                self._end(f"nothing has moved {hung[0].where} for {self._allowed(hung[0]):g} s")
                return

    def _tick(self) -> list[Duty]:
        """Look at all duties; returns those that have hung, the ones that wait for others last."""
        with self._lock:
            now = {duty: duty.in_hand for duty in self._duties}
            moved = any(now[duty] is not before for duty, (before, _) in self._duties.items())
            for duty, (before, ticks) in self._duties.items():
                moves = now[duty] is None or now[duty] is not before or (duty.waits and moved)
                self._duties[duty] = (now[duty], 0 if moves else ticks + 1)
            hung = [duty for duty, (_, ticks) in self._duties.items() if ticks * _TICK >= self._allowed(duty)]
        return sorted(hung, key=lambda duty: duty.waits)

    def _allowed(self, duty: Duty) -> float:
        return duty.end_seconds if self._ending else duty.seconds


def end_at_once(sentence: str, status: int, *steps: Callable[[], object]) -> NoReturn:
    """End this process, after some last steps and a sentence; a step that hangs does not keep it.

    status: the exit status.
    """

    def tell() -> None:
        say(sentence)
        for stream in (sys.stderr, sys.stdout):
            stream.flush()

    try:
        threads = [world().thread(step, name="last step") for step in (*steps, tell)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(_LAST_SECONDS)
    finally:
        world().process.exit(status)
