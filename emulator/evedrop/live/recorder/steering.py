"""Steers a run: when it is held and every process has reported all earlier slots, carries out due events, and lets it continue.

So an event takes effect exactly between two slots, whether it is the scenario's or the operator's. While the sensor holds, only
packets delayed by links are under way. Some requests of the operator await an answer: steps, in which a held run continues for
some slots, and the status of the run.

Source: docs/control.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

from evedrop.errors import RunError, ScenarioError
from evedrop.live.network.operator import Order
from evedrop.live.network.session import READY_SECONDS
from evedrop.live.protocol.commands import Again, Go, Hold, LinkChange
from evedrop.live.protocol.keys import COMMAND_BYTES
from evedrop.live.protocol.launcher_events import ProcessRequest
from evedrop.live.protocol.requests import LinkRequest, PauseRequest, ResumeRequest, StepRequest
from evedrop.live.recorder.conductor import Conductor
from evedrop.model.checks import LAST_SLOT
from evedrop.model.slot.link import Change
from evedrop.names import CONTROLLER, ROUTER, SENSOR, ProcessAction
from evedrop.scenario.events.event import Act
from evedrop.scenario.loading import with_event
from evedrop.scenario.progress_events import Held, OnEvent, RunEvent
from evedrop.scenario.tables import Scenario
from evedrop.system.world import world

STEP_SECONDS = 1.0
"""The most that counts between two polls: time in which the recorder itself did not run does not count."""


HeldUpBy = Callable[[Sequence[str]], tuple[tuple[str, ...], str]]
"""Processes that are late at a hold → those that hold them up, and what these say; empty if nobody was asked."""


@dataclass(frozen=True)
class OperatorStep:
    """A step: the run continues from `first`, before which it was held, and is held again before `until`."""

    order: Order
    first: int
    until: int

    def passed(self, end: int) -> str:
        """The slots of the step that have passed, in words, when all slots below `end` have passed."""
        last = end - 1
        if last < self.first:
            return "no slot passed"
        return f"slot {last} passed" if last == self.first else f"slots {self.first} to {last} passed"


@final
class Steering:
    """Carries out the events of the scenario and the requests of the operator while the run is held.

    on_event: sends events to the launcher, such as an act on a process, which the launcher confirms; see `done`.
    keep: called with the amended scenario each time the operator has changed it.
    paused: whether the run begins paused; the sensor's brief then has a hold before slot 0.
    """

    def __init__(
        self,
        scenario: Scenario,
        conductor: Conductor,
        on_event: OnEvent,
        keep: Callable[[Scenario], None],
        *,
        paused: bool = False,
    ) -> None:
        self._scenario, self._conductor, self._on_event, self._keep = scenario, conductor, on_event, keep
        self._due = scenario.timeline.holds
        self.at: int | None = None
        """The slot before which the sensor holds; None while it does not."""
        self._pending: list[Act] = []
        self._left: dict[str, int] = {}
        self._waiting: tuple[Act, ProcessAction] | None = None
        self._confirmed = True
        self._patience = max(READY_SECONDS, scenario.longest_outage)
        self._waited = 0.0
        """Seconds that count of a wait for reports at a hold, or for an act."""
        self._polled = 0.0
        self._orders: deque[Order] = deque()
        self._asked = False
        self._step: OperatorStep | None = None
        self._last = -1
        self._changed: set[str] = set()
        self._gone: Go | None = None
        """The last `Go` that was sent to the sensor."""
        self.paused = paused
        """Whether the run stays held until the operator resumes it."""
        self.events: list[RunEvent] = []
        """The events so far."""

    def held(self, k: int) -> None:
        """Take the sensor's report that it holds before slot k, which may come more than once."""
        if k <= self._last:
            return
        self.at, self._last, self._asked = k, k, False
        self._pending = list(self._due.pop(k, []))
        self.restart_limit()
        if self.paused:  # only a run that began paused is paused here: all later pauses take effect at a hold
            self._pause(k, "pause the run")

    def left(self, name: str, k: int) -> None:
        """Note that a receiver has left before slot k, the first slot of its absence."""
        self._left[name] = k

    def has_left(self, name: str, k: int) -> bool:
        """Whether a receiver has left before slot k."""
        return self._left.get(name) == k

    @property
    def awaits_belief(self) -> bool:
        """Whether the run is held until a receiver has sent its final belief."""
        return self.at is not None and bool(self._pending) and not self._may(self._pending[0])

    def done(self, number: int) -> None:
        """Take the launcher's confirmation of an act on a process; number: that of the event, from 1 on."""
        self._confirmed = self._confirmed or number == len(self.events)

    def take_order(self, order: Order, reported: int) -> None:
        """Take a request from the operator, which is carried out at the next hold; ask the sensor to hold.

        reported: all slots below it are joined.
        """
        # A run that begins paused is paused although it is not held yet: then the resume waits for the hold before slot 0.
        if isinstance(order.request, ResumeRequest) and self.at is None and not self._orders and not self.paused:
            self._forget_step(reported, "the run was resumed")
            order.done(reported, "the run is not paused")
            return
        self._orders.append(order)
        if self.at is None and not self._asked:
            self._asked = True
            self._conductor.send_to(SENSOR, Hold())

    def carry_on(
        self,
        reported: int,
        places: Callable[[], Mapping[str, int]],
        held_up_by: HeldUpBy = lambda late: (tuple(late), ""),
    ) -> None:
        """Carry out as many events as possible, given that all slots below `reported` are joined.

        places: process → the first slot that it has not reported; held_up_by: see there. Raises RunError if they do not become
        possible in time.
        """
        if self.at is None:
            return
        if reported < self.at:
            # A controller does not report at barriers, and receivers to which a router passes nothing on have nothing to report.
            behind = [name for name, k in places().items() if k < self.at and name != CONTROLLER]
            behind = [ROUTER] if ROUTER in behind else behind
            self._fail(f"{' and '.join(behind)} did not report all slots before it", held_up_by, behind)
            return
        while self._settled():
            if self._pending and not self._may(self._pending[0]):
                name = self._pending[0].names[0]
                self._fail(f"{name} has not sent its final belief", held_up_by, [name])
                return
            if self._pending:
                self._do(self.at, self._pending.pop(0))
            elif self._step is not None and self.at >= self._step.until:
                self._step_is_over(self._step, self.at)
            elif self._orders:
                self._obey(self.at, self._orders.popleft())
            else:
                if not self.paused:
                    self._release()
                return

    def answer_open_orders(self, reported: int, *, complete: bool) -> None:
        """Answer all open requests, because the run has ended.

        reported: all slots below it are joined; complete: whether these are all slots of the run.
        """
        if self._step is not None:
            text = self._step.passed(reported)
            if complete:
                self._step.order.done(reported, f"{text}; the run is over")
            else:
                self._step.order.refuse(f"{text}; the run was ended before the step was over")
        self._step = None
        while self._orders:
            self._orders.popleft().refuse("the run ended first; nothing was done")

    def _settled(self) -> bool:
        """Whether the last act on a process has taken effect."""
        if self._waiting is None:
            return True
        act, action = self._waiting
        there = action.connected
        if self._confirmed and (there is None or self._conductor.present[act.names[0]] is there):
            if act.effect.present:
                self._conductor.absent -= set(act.names)
            self._waiting = None
            return True
        if self._confirmed:
            self._fail(f"{act.text}: not done yet; look at logs/{act.names[0]}.log")
        else:  # nothing has happened to the process, which is not to blame
            self._fail(
                f"{act.text}: the launcher has not confirmed that; it, or the host of {act.names[0]}, may be suspended"
            )
        return False

    def _fail(self, problem: str, held_up_by: HeldUpBy | None = None, late: Sequence[str] = ()) -> None:
        """Raise RunError if the run has been waiting for too long; problem: the missing condition; late: who owes it.

        Time in which a process was missing, or the recorder itself did not run, does not count.
        """
        now = world().monotonic()
        step, self._polled = min(now - self._polled, STEP_SECONDS), now
        self._waited += 0.0 if self._conductor.missing else step
        if self._waited > self._patience:
            silent, say = ((), "") if held_up_by is None else held_up_by(late)
            problem = f"{problem} ({say})" if say else problem
            failure = RunError(
                f"{self._patience:.0f} s after the run was held before slot {self.at}, {problem}; look at the logs"
            )
            failure.at_fault = silent
            raise failure

    def _may(self, act: Act) -> bool:
        """Whether an act may begin: a receiver is ended or stopped only after it has left, in case it missed the hold."""
        return act.effect.present is not False or all(self._left.get(name) == act.at for name in act.names)

    def _do(self, k: int, act: Act) -> None:
        self._note(k, act.text, "scenario")
        if act.effect.present is False:
            self._conductor.absent |= set(act.names)
        action = act.effect.action
        if action is not None:
            self._waiting, self._confirmed = (act, action), False
            self.restart_limit()
            self._on_event(ProcessRequest(action, act.names[0], k, len(self.events)))

    def _obey(self, k: int, order: Order) -> None:
        """Carry out a request of the operator before slot k."""
        match order.request:
            case LinkRequest(event):
                self._change(k, order, event)
            case PauseRequest():
                text = f"held already, before slot {k}" if self.paused else f"held before slot {k}"
                if not self.paused:
                    self._pause(k, "pause the run")
                self._forget_step(k, "the run was paused")
                order.done(k, text)
            case ResumeRequest():
                if self.paused:
                    self._note(k, "resume the run", "operator")
                self.paused = False
                self._forget_step(k, "the run was resumed")
                order.done(k, f"the run goes on with slot {k}")
            case StepRequest() if self._step is not None:
                order.refuse(
                    f"another step is under way, to slot {self._step.until - 1}; wait for its end, or pause first"
                )
            case StepRequest(slots):
                self._note(k, f"step {slots} slots" if slots > 1 else "step 1 slot", "operator")
                self._step, self.paused = OperatorStep(order, k, min(k + slots, LAST_SLOT)), False

    def _change(self, k: int, order: Order, event: Mapping[str, Any]) -> None:
        """Add an event at slot k to the scenario, and send the router the changes of its links from then on."""
        try:
            changed = with_event(self._scenario, event, k)
        except ScenarioError as error:
            order.refuse(*error.mistakes)
            return
        act = next(changed.event[-1].acts())
        names = self._changed | set(act.names)
        # If a connection is lost later, all of them are sent in one message.
        if len(Again(LAST_SLOT, LAST_SLOT, _changes_of(changed, names)).pack()) > COMMAND_BYTES:
            order.refuse(
                f"the changes of {' and '.join(sorted(names))} have more than {COMMAND_BYTES} bytes, and the router would not "
                "get them: each event of a link contains its recorded losses; expected fewer events, or a shorter recording"
            )
            return
        self._keep(changed)
        self._scenario = changed
        self._note(k, act.text, "operator")
        for name in act.names:
            self._changed.add(name)
            changes = tuple(change for change in changed.timeline.changes[name] if change.at >= k)
            self._conductor.send_to(ROUTER, LinkChange(name, changes))
        order.done(k, f"from slot {k} on: {act.text}")

    def _pause(self, k: int, text: str | None = None) -> None:
        self.paused = True
        self._on_event(Held(k))
        if text is not None:
            self._note(k, text, "operator")

    def _step_is_over(self, step: OperatorStep, k: int) -> None:
        self._step = None
        self._pause(k)
        step.order.done(k, f"{step.passed(k)}; held before slot {k}")

    def _forget_step(self, k: int, why: str) -> None:
        """Answer the request for the present step, if any, which will not be completed."""
        if self._step is not None:
            self._step.order.done(k, f"{self._step.passed(k)}; {why} before the step was over")
        self._step = None

    def _note(self, k: int, text: str, by: str) -> None:
        self.events.append(RunEvent(k, text, by))

    def _release(self) -> None:
        self.at = None
        until = None if self._step is None else self._step.until
        self._gone = Go(self._last, tuple(sorted(self._conductor.absent)), until)
        self._go()

    def _go(self) -> None:
        if self._gone is not None:
            self._conductor.send_to(ROUTER, Go(self._gone.slot))
            self._conductor.send_to(SENSOR, self._gone)

    @property
    def changes(self) -> dict[str, tuple[Change, ...]]:
        """Link that the operator has changed → all its changes."""
        return _changes_of(self._scenario, self._changed)

    def restart_limit(self) -> None:
        """Let processes have the whole time limit of the hold, such as those that were cut off."""
        self._waited, self._polled = 0.0, world().monotonic()

    def remind(self) -> None:
        """Send the last commands again, which may have been lost with a connection.

        The last `Go` is sent even if the sensor holds again: a router that was restarted may still wait at the previous hold.
        """
        self._go()
        if self._asked:
            self._conductor.send_to(SENSOR, Hold())


def _changes_of(scenario: Scenario, names: Collection[str]) -> dict[str, tuple[Change, ...]]:
    """Link → all its changes, of these receivers."""
    timeline = scenario.timeline.changes
    return {name: tuple(timeline[name]) for name in sorted(names)}
