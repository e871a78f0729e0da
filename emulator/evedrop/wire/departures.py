"""Names programs whose connection to a side ended while many messages waited, and programs that connected again.

A Zenoh program that cannot pass on a message with `BLOCK` for 5 seconds ends its connection, and the wire ends that of a reader
in the same way. Zenoh does not tell a wire why a connection ended. So the wire says what it knows: which program it was, how much
waited at its side, and whether it came back, which a program that has ended does not do.

Source: docs/wire.md, what Zenoh drops by itself.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Final, final

import zenoh

from evedrop.live.network.clock import SYSTEM_CLOCK, Clock
from evedrop.wire.backlog import Backlog
from evedrop.wire.few_lines import FewLines
from evedrop.wire.side import SideSession

MANY: Final = 4096
"""Messages that wait at a side when a program is named at once: half of what may wait. Few wait when a program simply ends."""
MOST_GONE: Final = 1024
"""Programs that are remembered after their connection ended."""


@final
class _Gone:
    """A program whose connection ended."""

    __slots__ = ("answers", "name", "side", "told", "waited", "waited_for", "when")

    def __init__(self, name: str, side: str, when: float, waited_for: int, answers: int) -> None:
        """waited_for: messages that waited for programs at its side; answers: the counts that are still to come."""
        self.name, self.side, self.when, self.waited_for, self.answers = name, side, when, waited_for, answers
        self.waited = 0
        """Messages from its side that waited for the wire."""
        self.told = False
        """Whether it was named when its connection ended."""

    @property
    def circumstances(self) -> str:
        """What waited when its connection ended, such as " while 12 messages from this side waited for the wire"."""
        waited = [
            words
            for number, words in (
                (self.waited, f"{self.waited:,} messages from this side waited for the wire"),
                (self.waited_for, f"{self.waited_for:,} messages waited for programs at this side"),
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
        self._here: set[tuple[str, str]] = set()
        self._gone: dict[tuple[str, str], _Gone] = {}
        self._lock = threading.Lock()
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
            elif program not in self._here:  # the events of its connection, which come by another thread, were faster
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
            self._here.add(program)
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
            self._here.discard(program)
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
