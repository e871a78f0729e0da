"""The conductor's commands to the router: those to carry out at a barrier, and those that end any waiting.

Source: docs/protocol.md, control and lost connections.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable
from queue import SimpleQueue
from typing import final

from evedrop.errors import EvedropError
from evedrop.live.network.process_session import ProcessSession
from evedrop.live.protocol.commands import Again, ControlCommand, EndRun
from evedrop.names import ROUTER


class ReplayRequested(Exception):
    """The conductor asks for packets again: the message that the router waits for may have been lost."""


@final
class Commands:
    """Reads the session's commands on a thread of its own.

    knock: wakes the thread that waits for packets when the run has ended.
    waiting: queues that get a None when waiting for their next item may be in vain.
    """

    def __init__(
        self,
        session: ProcessSession,
        receivers: Collection[str],
        knock: Callable[[], None],
        waiting: Iterable[SimpleQueue[bytes | None]],
        patience: float,
    ) -> None:
        """receivers: those that a command may name.

        patience: how many seconds to wait for the conductor's command for a round that the sensor has announced.
        """
        self._session, self._receivers, self._knock, self._waiting = session, receivers, knock, tuple(waiting)
        self._patience = patience
        self._orders: SimpleQueue[tuple[int, ControlCommand] | None] = SimpleQueue()
        self._changed = threading.Condition()
        self._asked = Again(0, 0)
        self._heeded = 0
        self._ended = False
        self._failure: EvedropError | None = None
        threading.Thread(target=self._listen, name="commands", daemon=True).start()

    def _listen(self) -> None:
        try:
            while not self._ended:
                self._sort(self._session.command(self._receivers))
        except EvedropError as error:  # the working thread raises it
            self._failure = error
        with self._changed:
            self._changed.notify()
        self._wake()
        self._knock()

    def _sort(self, command: ControlCommand) -> None:
        match command:
            case Again():
                with self._changed:
                    self._asked = command
                    self._changed.notify()
                self._wake()
            case EndRun():
                self._ended = True
            case _:
                self._orders.put((self._asked.round, command))

    def _wake(self) -> None:
        self._orders.put(None)
        for queue in self._waiting:
            queue.put(None)

    def over(self) -> bool:
        """Whether the conductor has ended the run. Raises MalformedMessage if it sent a malformed command."""
        if self._failure is not None:
            raise self._failure
        return self._ended

    def check(self) -> None:
        """Raise ReplayRequested if the conductor has ended the run, or asked for packets since the last request obeyed."""
        if self.over() or self._asked.round != self._heeded:
            raise ReplayRequested

    def next(self) -> ControlCommand:
        """The next command of the current round; those of earlier rounds are skipped. Raises ReplayRequested as `check` does."""
        while True:
            with self._session.status.waiting(self._session.keys.control(ROUTER)):
                order = self._orders.get()
            self.check()
            if order is not None and order[0] == self._heeded:
                return order[1]

    def resend_of(self, number: int) -> Again | None:
        """Wait for the conductor's command for this round; None if the conductor has asked for a later one.

        Also None if it has ended the run meanwhile, or if no such command arrives within the patience.
        """
        with self._changed:
            # Sensor and router are told at the same time: if the command does not arrive, the round does not exist.
            if not self._changed.wait_for(lambda: self.over() or self._asked.round >= number, self._patience):
                return None
            if self._ended or self._asked.round > number:
                return None
            self._heeded = number
            return self._asked
