"""The conductor, a part of the recorder: waits for all processes, starts the run, passes on their reports, and ends it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from functools import partial
from queue import Empty
from typing import NoReturn, final

from evedrop.errors import Interrupted, RunError
from evedrop.live.network.connection import Question
from evedrop.live.network.process_session import Mailbox
from evedrop.live.network.session import Session
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import (
    Abandon,
    ControlCommand,
    EndRun,
    ProcessStatus,
    ReportStatus,
    Start,
    is_process_status,
)
from evedrop.live.protocol.notices import EndReport, Progress
from evedrop.names import RECORDER, RELAY, ROUTER, SENSOR
from evedrop.system.signals import AFTERTHOUGHT_SECONDS
from evedrop.system.threads import Queue
from evedrop.system.waiting import wait_until
from evedrop.system.world import world

_ABANDON_SECONDS = 2.0  # for processes to leave when told to
_POLL_SECONDS = 0.05  # how soon a signal is noticed
_LOST_TOGETHER_SECONDS = 1.0  # in which a router's processes are missed that are lost with it
_END_SECONDS = 0.5  # how often a process that is still present is told that the run is over
_RETURN_SECONDS = 3.0  # within which a process may return that was told to end and vanished without confirming it
_ANSWER_SECONDS = 1.0  # for missing processes to say what they wait for
_ROUTERS_SECONDS = 5.0  # for a router to confirm


@final
class Stop:
    """Set by a signal: the run must end now."""

    def __init__(self, orphaned: Callable[[], bool] = lambda: False) -> None:
        """orphaned: whether the launcher is gone, which ends the run, too."""
        self._orphaned = orphaned
        self.wanted = False

    def want(self) -> None:
        """The run must end."""
        self.wanted = True

    @property
    def asked(self) -> bool:
        """Whether the run was told to end."""
        return self.wanted or self._orphaned()

    def check(self, patience: float = 0.0) -> None:
        """Raise Interrupted if the run was told to end, or is told within `patience` seconds."""
        if wait_until(lambda: self.asked, patience, 0.01):
            raise Interrupted


@final
class Conductor:
    """Conducts a run; passes on telemetry and journal as (source, payload), and handles all other messages itself."""

    def __init__(self, session: Session, reporters: tuple[str, ...], stop: Stop, relayed: bool = False) -> None:
        """reporters: the processes that report besides router and sensor: the receivers, and a controller."""
        self._session, self._stop = session, stop
        self.present = dict.fromkeys((ROUTER, *((RELAY,) if relayed else ()), SENSOR, *reporters), False)
        """Process → whether it is on the network."""
        self.hub = RELAY if relayed else ROUTER
        """The router that the recorder is connected to, and through which it sees all others."""
        self._router: str | None = None
        self.lost: dict[str, float] = {}
        """Process that has vanished from the network → when, on the clock."""
        keys = session.keys
        self.keys = {ROUTER: keys.journal, SENSOR: keys.telemetry(SENSOR)}
        self.keys.update({name: keys.telemetry(name) for name in reporters})
        self._mailbox = Mailbox(self.keys, session.allowance)
        for source, key in self.keys.items():
            session.subscribe_with(key, partial(self._mailbox.put, source))
        for name in self.present:
            session.watch(name, partial(self._mailbox.put, name))
        self.misdelivered: dict[str, int] = {}
        """Process that has confirmed its end → how many messages it dropped because they name another key."""
        self.absent: set[str] = set()
        """Processes that are away because the scenario says so; they do not count as missing."""
        self.questions: Queue[Question] = world().queue()
        """The operator's questions."""
        session.asked(keys.control(RECORDER), self.questions.put)
        self._commands = {name: session.publisher(keys.control(name)) for name in self.present}
        self._progress = session.publisher(keys.progress(RECORDER))
        self._settled = 0

    @property
    def missing(self) -> list[str]:
        """The processes that are not on the network."""
        return [name for name, there in self.present.items() if not there and name not in self.absent]

    def router_changed(self) -> bool:
        """Whether the recorder is connected to another router than at the previous call, or at the start of the run."""
        before, self._router = self._router, self._session.router_id
        return before != self._router

    def dropped(self) -> dict[str, int]:
        """Process → how many messages it dropped because they name another key, as far as it has confirmed its end."""
        counts = {**self.misdelivered, RECORDER: self._session.dropped.count}
        return {name: count for name, count in counts.items() if count}

    @property
    def unreached(self) -> list[str]:
        """The processes that are on the network, but whose subscription to their commands is not known yet.

        Behind a relay, a process's token may be back before its subscriptions, and a command put meanwhile is lost.
        """
        return [name for name, there in self.present.items() if there and not self._reaches(name)]

    def assemble(self) -> None:
        """Wait for every process. Raises RunError, naming the missing ones, after the brief's patience."""
        deadline = world().monotonic() + self._session.patience
        while self.missing:
            self._stop.check()
            if world().monotonic() > deadline:
                names = [name for name in self.missing if not self._reaches(name)] or self._without_excuse()
                do = "start it, or look at its log" if len(names) == 1 else "start them, or look at their logs"
                failure = RunError(f"{', '.join(names)} did not appear within {self._session.patience:.0f} s; {do}")
                failure.missing = tuple(names)
                raise failure
            self._next()
        self._session.ready()
        self._router = self._session.router_id

    def _without_excuse(self) -> list[str]:
        """The missing processes that do not say that they wait for another one themselves; all if each of them says so."""
        names, excused = self.missing, set[str]()
        for name in names:
            self.send_to(name, ReportStatus())
        deadline = world().monotonic() + _ANSWER_SECONDS
        while not excused.issuperset(names) and world().monotonic() < deadline:
            message = self._next()
            if message is not None:
                source, payload = message
                answer = Reader(self.keys[source], payload)
                if is_process_status(answer) and answer.read(ProcessStatus).waits:
                    excused.add(source)
        return [name for name in names if name not in excused] or names

    def start(self) -> None:
        """Tell the sensor to begin."""
        self.send_to(SENSOR, Start())

    def next_message(self) -> tuple[str, bytes] | None:
        """The next message with its sender, or None if there was none for a moment.

        Raises Interrupted if the run was told to end.
        """
        self._stop.check()
        return self._next()

    def fail_cut_off(self, names: Collection[str], patience: float) -> NoReturn:
        """Raise RunError: these processes have been missing for `patience` seconds. Raises Interrupted if told to end now."""
        self._stop.check(AFTERTHOUGHT_SECONDS)
        failure = RunError(f"{', '.join(names)} cut off from the network for {patience:g} s; look at the logs")
        failure.missing = tuple(names)
        raise failure

    def send_to(self, name: str, command: ControlCommand) -> None:
        """Send a command to one process."""
        self._commands[name](command.pack())

    def send_to_all(self, command: ControlCommand) -> None:
        """Send a command to every process that reports and is present."""
        for name in self.keys:
            if self.present[name]:
                self.send_to(name, command)

    def report_progress(self, settled: int) -> None:
        """Tell the sensor that all slots below `settled` are scored, and reported by the controller."""
        self._settled = settled
        self.repeat_progress()

    def repeat_progress(self) -> None:
        """Send the last progress again, which may have been lost."""
        self._progress(Progress(self._settled).pack())

    def end(self, patience: float) -> None:
        """Tell all processes that the run is over, repeatedly until they have left; the routers after all others.

        patience: seconds to wait for the others, some of which may be cut off. If this process is told to end, it tells them
        once more and does not wait: its launcher might kill it before it has written the results.
        """
        others = [name for name in self.present if name not in {ROUTER, RELAY} and name not in self.absent]
        told: set[str] = set()
        deadline = world().monotonic() + patience
        sent = -math.inf
        while world().monotonic() < deadline:
            left = [name for name in others if not self._has_ended(name, told)]
            if not left and self.present[ROUTER]:
                break
            if world().monotonic() - sent > _END_SECONDS:
                sent = world().monotonic()
                for name in left:
                    if self.present[name]:
                        self.send_to(name, EndRun())
                        told.add(name)
            if self._stop.asked:
                break
            self._hear_out()
        # The relay after the router: the router's messages pass through it.
        for name in (ROUTER, RELAY):
            if name in self.present:
                self._end_router(name)

    def _has_ended(self, name: str, told: Collection[str]) -> bool:
        """Whether a process has left for good: it confirmed its end, or it vanished when told to end and did not return."""
        if self.present[name]:
            return False
        gone = world().monotonic() - self.lost.get(name, -math.inf)
        return name in self.misdelivered or (name in told and gone > _RETURN_SECONDS)

    def _end_router(self, name: str) -> None:
        """Tell a router that the run is over until it confirms it: the router by a message, the relay by its token."""
        deadline = world().monotonic() + _ROUTERS_SECONDS
        sent = cut_off = -math.inf
        while world().monotonic() < deadline and name not in self.misdelivered:
            # All tokens vanish with the connection, and return one after the other.
            if not (self._session.linked() and self.present[ROUTER]):
                cut_off = world().monotonic()
            elif name == RELAY and not self.present[name] and world().monotonic() - cut_off > _RETURN_SECONDS:
                return
            if world().monotonic() - sent > _END_SECONDS:
                sent = world().monotonic()
                self.send_to(name, EndRun())
            self._hear_out()

    def _hear_out(self) -> None:
        """Take the next message: note who confirms that the run is over, and ignore all else."""
        message = self._next()
        if message is not None:
            source, payload = message
            report = EndReport.read(Reader(self.keys[source], payload))
            if report is not None:
                self.misdelivered[source] = report.misdelivered

    def abandon(self, why: str) -> None:
        """Tell all processes that the run has been given up."""
        others = [name for name in self._commands if name not in {ROUTER, RELAY}]
        # The routers last, and the relay after the router: they may still have messages to pass on.
        for names in (others, [ROUTER], [RELAY]):
            told = [name for name in names if name in self._commands]
            for name in told:
                self.send_to(name, Abandon(why))
            wait_until(partial(self._none_reached, told), _ABANDON_SECONDS, 0.01)

    def _none_reached(self, names: Collection[str]) -> bool:
        return not any(self._reaches(name) for name in names)

    def _reaches(self, name: str) -> bool:
        """Whether a process has opened its session; it may still wait for others."""
        return self._session.reaches(self._session.keys.control(name))

    def _next(self) -> tuple[str, bytes] | None:
        """The next message, with its sender; None if none came for a moment, or if a process came or left instead."""
        try:
            name, item = self._mailbox.get(timeout=_POLL_SECONDS)
        except Empty:
            return None
        if isinstance(item, bytes):
            return name, item
        self._note(name, item)
        return None

    def wait_longer(self, seconds: float) -> None:
        """Give processes that are missing more time to come back."""
        if seconds > 0.0:
            self.lost = {name: at + seconds for name, at in self.lost.items()}

    def _restart_time_of_others(self, at: float) -> None:
        """A router that was lost at some time is back: nobody could be seen, and those lost with it can connect only now."""
        now = world().monotonic()
        unseen = max(0.0, now - at)  # `wait_longer` may have put it off
        self.lost = {
            name: now if lost > at - _LOST_TOGETHER_SECONDS else lost + unseen for name, lost in self.lost.items()
        }

    def _note(self, name: str, there: bool) -> None:
        self.present[name] = there
        if there:
            at = self.lost.pop(name, None)
            if name in {ROUTER, RELAY} and at is not None:
                self._restart_time_of_others(at)
        else:
            self.lost.setdefault(name, world().monotonic())
