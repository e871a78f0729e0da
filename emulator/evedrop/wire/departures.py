"""Names programs whose connection to a side ended while many messages waited, and programs that connected again.

A Zenoh program that cannot pass on a message with `BLOCK` for 5 seconds ends its connection, and the wire ends that of a reader
in the same way. Zenoh does not tell a wire why a connection ended. So the wire says what it knows: which program it was, how much
waited at its side, and whether it came back, which a program that has ended does not do.

Zenoh does not tell how full a channel is, either. So the messages are counted when somebody asks: those that are taken from then
on until the channel is empty. Messages that come meanwhile count, too. Programs that connect again and again must not fill the
history, so each matter has a limited number of lines.

Source: docs/wire/semantics.md, what Zenoh drops by itself, and what programs need.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, final

import zenoh

from evedrop.counting import counted
from evedrop.system.waiting import SYSTEM_CLOCK, Clock
from evedrop.system.world import world
from evedrop.wire.side import SideSession
from evedrop.wire.watchdog import Duty

MOST: Final = 20
"""The lines that are told one by one."""


@final
class FewLines:
    """Tells lines; beyond `MOST`, only that there were more. Threads may call its methods at the same time."""

    def __init__(self, tell: Callable[[str], None], subject: str) -> None:
        """tell: for each line; subject: the matter, in the plural, such as "ways past the wire"."""
        self._tell, self._what = tell, subject
        self._told = 0
        self._lock = world().lock()

    @property
    def is_full(self) -> bool:
        """Whether further lines are not told."""
        return self._told > MOST

    def add(self, line: str) -> None:
        """Tell a line."""
        with self._lock:
            self._told += 1
            at = self._told
        if at <= MOST:
            self._tell(line)
        elif at == MOST + 1:
            self._tell(f"there were more than {MOST} {self._what}; further ones are not listed")


@final
class Backlog:
    """The messages that a thread has not taken yet. `ask` may be called by any thread."""

    def __init__(self, handler: Any, most: int) -> None:
        """handler: of a subscriber with a channel; most: the messages that the channel has room for."""
        self._handler, self._most = handler, most
        self._counts: list[tuple[Callable[[int], None], int]] = []
        """Counts that have begun: who wants the answer, and how many messages were taken so far."""
        self._is_empty = False
        self._lock = world().lock()

    def ask(self, answer: Callable[[int], None]) -> None:
        """Let `answer` have the number of messages that wait now: at once if there is none, or else when they are taken."""
        with self._lock:
            if not self._is_empty:
                self._counts.append((answer, 0))
                return
        answer(0)

    def take_all(self, take: Callable[[zenoh.Sample], None], duty: Duty) -> None:
        """Take all messages until the subscription ends, with the thread that calls this. duty: has each in hand."""
        look, wait, counts = self._handler.try_recv, self._handler.recv, self._counts
        while True:
            try:
                sample = look()
                if sample is None:
                    self._note_empty()
                    sample = wait()
                    self._is_empty = False
            except zenoh.ZError:  # it has ended, and all is taken
                break
            duty.in_hand = sample
            take(sample)
            duty.in_hand = None
            if counts:
                self._count()
        self._note_empty()

    def _count(self) -> None:
        """Count a message that was taken."""
        with self._lock:
            counts = [(answer, taken + 1) for answer, taken in self._counts]
            self._counts[:] = [count for count in counts if count[1] < self._most]
        for answer, taken in counts:
            if taken == self._most:
                answer(taken)

    def _note_empty(self) -> None:
        with self._lock:
            self._is_empty = True
            counts = [*self._counts]
            self._counts.clear()
        for answer, taken in counts:
            answer(taken)


MANY: Final = 4096
"""Messages that wait at a side when a program is named at once: half of what may wait. Few wait when a program simply ends."""
MOST_GONE: Final = 1024
"""Programs that are remembered after their connection ended."""


@final
@dataclass(slots=True)
class _Gone:
    """A program whose connection ended."""

    name: str
    side: str
    when: float
    waited_for: int
    """Messages that waited for programs at its side."""
    answers: int
    """The counts that are still to come."""
    waited: int = 0
    """Messages from its side that waited for the wire."""
    told: bool = False
    """Whether it was named when its connection ended."""

    @property
    def circumstances(self) -> str:
        """What waited when its connection ended, such as " while 12 messages from this side waited for the wire"."""
        waited = [
            words
            for number, words in (
                (self.waited, f"{counted(self.waited, 'message')} from this side waited for the wire"),
                (self.waited_for, f"{counted(self.waited_for, 'message')} waited for programs at this side"),
            )
            if number
        ]
        return f" while {' and '.join(waited)}" if waited else ""


@final
class Departures:
    """The programs that have lost their connection to a running wire. Threads may call its methods at the same time."""

    def __init__(
        self,
        backlogs: Mapping[str, Sequence[Backlog]],
        waiting_for: Callable[[str], int],
        tell: Callable[[str], None],
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        """backlogs: side → its messages that wait for the wire; waiting_for: side → the number of messages that wait for it.

        tell: for a line about each program.
        """
        self._backlogs, self._waiting_for, self._clock = backlogs, waiting_for, clock
        self._lines = FewLines(tell, "programs that lost their connection")
        self._links: dict[tuple[str, str], str] = {}  # side and program → from where it is connected
        self._gone: dict[tuple[str, str], _Gone] = {}
        self._lock = world().lock()
        self._ended = False
        self._listeners: list[object] = []  # Zenoh undeclares those that nobody holds

    def watch(self, sides: Iterable[SideSession]) -> None:
        """Follow the connections of sides from now on."""
        for side in sides:
            info = side.session.info
            self._listeners += [
                info.declare_link_events_listener(partial(self._linked, side.name), history=True),
                info.declare_transport_events_listener(partial(self._changed, side.name), history=True),
            ]

    def close(self) -> None:
        """Name no more programs: the wire itself is about to end the connections."""
        self._ended = True

    def _linked(self, side: str, event: zenoh.LinkEvent) -> None:
        """Note from where a program is connected; this is no longer known when its connection has ended."""
        link, program = event.link, (side, str(event.link.zid))
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT:
                user = "" if link.auth_identifier is None else f", as {link.auth_identifier}"
                self._links[program] = f", {link.dst}{user}"
            elif program in self._gone:  # the events of its connection, which come by another thread, were faster
                self._links.pop(program, None)

    def _changed(self, side: str, event: zenoh.TransportEvent) -> None:
        if self._ended:
            return
        program = (side, str(event.transport.zid))
        if event.kind == zenoh.SampleKind.PUT:
            self._connected(program)
        else:
            self._left(program, str(event.transport.whatami))

    def _connected(self, program: tuple[str, str]) -> None:
        with self._lock:
            gone = self._gone.pop(program, None)
        if gone is None:
            return
        circumstances = "" if gone.told else gone.circumstances
        self._lines.add(
            f"{gone.name} is connected to the side {gone.side} again, {self._clock.monotonic() - gone.when:.1f} s after its "
            f"connection ended{circumstances}; messages that it sent at that time may be in no journal"
        )

    def _left(self, program: tuple[str, str], mode: str) -> None:
        side, zid = program
        backlogs = self._backlogs[side]
        with self._lock:
            name = f"the program {zid} ({mode}{self._links.pop(program, '')})"
            gone = _Gone(name, side, self._clock.monotonic(), self._waiting_for(side), len(backlogs))
            self._gone.pop(program, None)
            self._gone[program] = gone
            if len(self._gone) > MOST_GONE:
                del self._gone[next(iter(self._gone))]
        for backlog in backlogs:
            backlog.ask(partial(self._counted, gone))

    def _counted(self, gone: _Gone, number: int) -> None:
        """Take the number of messages that waited in one of the backlogs."""
        with self._lock:
            gone.waited += number
            gone.answers -= 1
            gone.told = not gone.answers and max(gone.waited, gone.waited_for) >= MANY
        if gone.told:
            self._lines.add(
                f"the connection of {gone.name} to the side {gone.side} ended{gone.circumstances}; messages that it had still to "
                "send are in no journal"
            )
