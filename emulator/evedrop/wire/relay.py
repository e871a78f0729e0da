"""A running wire: the sessions of its sides, and everything that crosses between them.

Source: docs/wire/semantics.md, messages.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Self, final

from evedrop.live.network.connecting import LOGGED
from evedrop.system.output import warn
from evedrop.system.waiting import wait_for_thread
from evedrop.system.world import world
from evedrop.wire.departures import Departures
from evedrop.wire.journal import WireJournal
from evedrop.wire.liveliness import LivelinessRelay
from evedrop.wire.neighbours import Bypasses, Neighbours
from evedrop.wire.plan import WirePlan
from evedrop.wire.publications import PublicationRelay, Publishers
from evedrop.wire.queries import QueryRelay
from evedrop.wire.ros2 import EntityLog, service_key
from evedrop.wire.running_link import RunningLink
from evedrop.wire.send_queue import LAST_SECONDS, SendQueue
from evedrop.wire.side import SideSession
from evedrop.wire.timeline import Moment
from evedrop.wire.watchdog import Duty

_POLL_SECONDS = 0.2
_RECEIVERS = (
    32  # threads of Zenoh: a program that waits for the wire holds one, and with none left all sides would wait
)
_LAST_SECONDS = 1.0  # for the messages that wait for the wire when it ends; a longer backlog is not worth the wait


@contextlib.contextmanager
def open_sides(plan: WirePlan) -> Iterator[Mapping[str, SideSession]]:
    """The sessions of a wire's sides, by their names. Programs can connect; nothing crosses before there is a `WireRelay`.

    Raises UsageError if a side cannot be opened.
    """
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {_RECEIVERS}))")  # read with the first session
    world().zenoh.init_log_from_env_or(LOGGED)
    with contextlib.ExitStack() as stack:
        yield {name: stack.enter_context(SideSession(side, plan.largest)) for name, side in plan.sides.items()}


@final
class WireRelay:
    """What crosses between the open sides of a wire; use it as a context manager.

    `apply` may be called by any thread.
    """

    def __init__(
        self,
        plan: WirePlan,
        journal: WireJournal,
        sides: Mapping[str, SideSession],
        tell: Callable[[str], None] = warn,
        happened: Callable[[str], None] = lambda _: None,
    ) -> None:
        """tell: for what the user must know while the wire runs; happened: for lines about programs that lost their connection.

        These begin with the seconds since the wire started.
        """
        self.plan, self.sides = plan, sides
        self.duties: Sequence[Duty] = ()
        """What its threads do, once it is open."""
        self.links: Mapping[str, RunningLink] = {link.name: RunningLink(link, plan, journal) for link in plan.links}
        """By their names."""
        self.failures: list[str] = []
        """Why messages of a side no longer cross, in sentences: the wire has failed."""
        self._journal, self._tell, self._happened = journal, tell, happened
        self._stack = contextlib.ExitStack()
        self._duty = Duty("in the list of what programs declare")
        self._ended = world().event()
        self._woken = world().event()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            self._open(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @property
    def endpoints(self) -> Mapping[str, tuple[str, ...]]:
        """Side → where programs connect."""
        return {name: side.endpoints for name, side in self.sides.items()}

    def apply(self, moment: Moment) -> None:
        """Cut the links that are cut from now on, restore the others, and give all of them their settings."""
        for name, state in self.links.items():
            state.cut = name in moment.cut
            state.change(moment.settings[name])

    def _open(self, stack: contextlib.ExitStack) -> None:
        plan, journal, links = self.plan, self._journal, self.links
        send_queues = {name: SendQueue(name, plan, journal.records, self._tell) for name in plan.sides}
        stack.callback(self._end_send_queues, [*send_queues.values()])
        publishers = {name: Publishers(side.session) for name, side in self.sides.items()}
        self._queries = QueryRelay(self.sides, links, send_queues, plan, journal, self._tell)
        stack.callback(self._queries.close)
        relays = [
            PublicationRelay(side, links, publishers, send_queues, plan, journal, self._fail)
            for side in self.sides.values()
        ]
        for relay in relays:
            stack.callback(relay.close)
        stack.callback(self._leave, relays)
        of_sides = [side.duty for side in self.sides.values()]
        of_send_queues = [duty for send_queue in send_queues.values() for duty in send_queue.duties]
        of_relays = [duty for relay in relays for duty in relay.duties]
        self.duties = [*of_sides, *of_relays, *of_send_queues, self._queries.duty, self._duty]
        self._bypasses = Bypasses(self._note_bypass)
        self._neighbours = Neighbours(self.sides, [*links.values()], self._tell, self._bypasses)
        self._liveliness = LivelinessRelay(self.sides, plan, self._woken.set, EntityLog(journal.folder).add)
        stack.callback(self._liveliness.close)
        self._poll()
        self._queries.start()
        for relay in relays:
            relay.start()
        self._bypasses.watch(self.sides.values())
        stack.callback(self._bypasses.close)
        backlogs = {name: relay.backlogs for name, relay in zip(self.sides, relays, strict=True)}
        departures = Departures(backlogs, lambda side: send_queues[side].waiting, self._note_departure)
        departures.watch(self.sides.values())
        thread = world().thread(self._keep_up, name="wire")
        thread.start()
        stack.callback(wait_for_thread, thread)
        stack.callback(self._woken.set)
        stack.callback(self._ended.set)
        stack.callback(departures.close)

    def _fail(self, line: str) -> None:
        self.failures.append(line)
        self._tell(line)

    def _note_bypass(self, line: str) -> None:
        """Tell a way past the wire, and note it in the journal."""
        self._journal.note(line, bypass=True)
        self._tell(line)

    def _note_departure(self, line: str) -> None:
        self._happened(f"{self._journal.seconds:.1f} s: {line}")

    def _leave(self, relays: Sequence[PublicationRelay]) -> None:
        """Limit the time in which messages that wait still cross."""
        until = world().monotonic() + _LAST_SECONDS
        for relay in relays:
            relay.leave(until)

    def _end_send_queues(self, send_queues: Sequence[SendQueue]) -> None:
        """End what sends to the sides, all at once: each may have to wait for its programs."""
        for send_queue in send_queues:
            send_queue.end()
        deadline = world().monotonic() + LAST_SECONDS
        for send_queue in send_queues:
            send_queue.close(deadline)

    def _poll(self) -> None:
        """Follow what programs declare.

        Queryables come before tokens: a program that sees a service's token may query it at once.
        """
        self._liveliness.note()
        held = self._liveliness.tokens.items()
        services = ((side, service_key(token)) for side, tokens in held for token in tokens)
        self._queries.update((side, key) for side, key in services if key is not None)
        self._liveliness.mirror()

    def _keep_up(self) -> None:
        due, told = 0.0, ""
        while not self._ended.is_set():
            self._woken.wait(max(0.0, due - world().monotonic()))
            self._woken.clear()
            try:
                with self._duty.busy():
                    self._poll()
                    if world().monotonic() >= due:
                        self._neighbours.update()
                        self._bypasses.update()
                        due, told = world().monotonic() + _POLL_SECONDS, ""
            except Exception as error:  # whatever it is: the next look may succeed
                due, line = world().monotonic() + _POLL_SECONDS, f"Zenoh does not say what programs declare ({error!r})"
                if line != told and not self._ended.is_set():
                    self._tell(f"{line}; trying again")
                told = line
