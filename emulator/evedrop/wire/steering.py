"""Steers a wire while it runs: carries out the events of its file when their time comes, and those of an operator at once.

`evedrop link`, `partition`, `heal` and `status` work as for a run. The operator has a router session of its own on this machine,
so no program at a side can steer the wire.

Source: docs/wire/file.md, events and control.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, final

from evedrop.errors import ScenarioError
from evedrop.live.network.access import Grant, access_control
from evedrop.live.network.connection import Question, Questions
from evedrop.live.network.control_file import Control, remove_control
from evedrop.live.network.operator import Answer, Order
from evedrop.live.network.session import listening_config
from evedrop.live.protocol.codec import Dropped
from evedrop.live.protocol.keys import QUESTION_BYTES, RunKeys, ZenohConfig
from evedrop.live.protocol.requests import LinkRequest, OperatorRequest, StatusRequest, WireLinkStatus, WireStatus
from evedrop.names import OPERATOR, RECORDER
from evedrop.system.output import warn
from evedrop.system.waiting import SYSTEM_CLOCK, Clock, wait_for_thread
from evedrop.system.world import world
from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import WirePlan
from evedrop.wire.relay import WireRelay
from evedrop.wire.scorekeeper import WireScorekeeper
from evedrop.wire.side import opened
from evedrop.wire.tables import FREE
from evedrop.wire.timeline import moment_at, times, with_request


@final
class WireConductor:
    """The time of a wire; use it as a context manager. Its methods may be called by any thread."""

    def __init__(
        self, plan: WirePlan, relay: WireRelay, say: Callable[[str], None], clock: Clock = SYSTEM_CLOCK
    ) -> None:
        """say: for a line about each event."""
        self._clock = clock
        self._plan, self._relay, self._say = plan, relay, say
        self._changed = world().condition()
        self._ended = False
        self._done = -1.0  # the time up to which all events are carried out
        self._begun = self._clock.monotonic()
        self._relay.apply(moment_at(plan, 0.0))
        self._thread = world().thread(self._run, name="events")

    def __enter__(self) -> Self:
        self._begun = self._clock.monotonic()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        wait_for_thread(self._thread)

    @property
    def seconds(self) -> float:
        """How long the wire has been running."""
        return self._clock.monotonic() - self._begun

    def change(self, event: Mapping[str, Any]) -> str:
        """Carry out an operator's event, as `with_request` takes it, at once; returns what it does. Raises ScenarioError."""
        with self._changed:
            now = self.seconds
            self._carry_out(now)
            self._plan, text = with_request(self._plan, event, now)
            self._relay.apply(moment_at(self._plan, now))
            self._done = now
            self._say(f"{now:.1f} s: {text}")
            self._changed.notify()
            return text

    def _carry_out(self, now: float) -> None:
        """Carry out the events that are due."""
        for due in times(self._plan):
            if self._done < due <= now:
                moment = moment_at(self._plan, due)
                self._done = due
                self._relay.apply(moment)
                for line in moment.lines:
                    self._say(f"{due:.1f} s: {line}")

    def _run(self) -> None:
        with self._changed:
            while not self._ended:
                self._carry_out(self.seconds)
                following = [time_ for time_ in times(self._plan) if time_ > self._done]
                self._clock.wait(self._changed, max(0.0, following[0] - self.seconds) if following else None)


_TRANSPORT: ZenohConfig = {"link": {"rx": {"max_message_size": 2 * QUESTION_BYTES}}}


@final
class WireControl:
    """The operator's access to a running wire, for the time of a `with` block."""

    def __init__(
        self,
        folder: Path,
        relay: WireRelay,
        conductor: WireConductor,
        scorekeeper: WireScorekeeper,
        journal: WireJournal,
        events: Sequence[str],
    ) -> None:
        """folder: the wire's; events: the events so far, a line each, to which lines may be added."""
        self._folder, self._relay, self._conductor = folder, relay, conductor
        self._scorekeeper, self._journal, self._events = scorekeeper, journal, events
        self._run = f"wire-{world().token(8).hex()}"
        self._key = RunKeys(self._run).control(RECORDER)
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            password = world().token(24).hex()
            access = access_control([Grant(OPERATOR, writes=(), reads=(), token=None, asks=(self._key,))])
            session, (router,) = opened(
                (FREE,),
                {OPERATOR: password},
                lambda listen, users: listening_config(listen[0], str(users), access, _TRANSPORT),
            )
            stack.enter_context(session)
            Questions(self._key, Dropped("the wire"), self._answer).declare(session)
            stack.callback(remove_control, self._folder)
            try:
                Control(self._run, router, OPERATOR, password, process=world().process.pid).write(self._folder)
            except OSError as error:
                warn(f"the wire cannot be steered, because control.json cannot be written ({error})")
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def _answer(self, question: Question) -> None:
        """Carry out a request. Zenoh only logs what is raised here."""
        order = Order.of(question)
        if order is None:
            return
        try:
            order.answer(self._carry_out(order.request))
        except ScenarioError as error:
            order.refuse(*error.mistakes)
        except Exception as error:  # the operator must not wait in vain
            order.refuse(f"the wire failed to do so: {error!r}")

    def _carry_out(self, request: OperatorRequest) -> Answer:
        if isinstance(request, StatusRequest):
            return Answer(wire=self._status())
        if not isinstance(request, LinkRequest):
            why = "programs that know nothing of a wire do not wait for it"
            return Answer(
                refused=(f"a wire cannot be held: {why}; `evedrop link` cuts a link, `evedrop partition` two sides",)
            )
        return Answer(0, self._conductor.change(request.event))

    def _status(self) -> WireStatus:
        self._journal.flush()
        states = self._relay.links
        links = {
            name: WireLinkStatus(heard, delivered, states[name].cut)
            for name, (heard, delivered) in self._scorekeeper.counts().items()
        }
        sides = {name: list(endpoints) for name, endpoints in self._relay.endpoints.items()}
        whole = self._journal.place.incomplete_since is None
        complete = "complete" if whole else "incomplete, because its folder could not be written"
        bypasses = [event.line for event in self._journal.history.events if event.bypass]
        return WireStatus(self._conductor.seconds, sides, links, list(self._events), complete, bypasses)
