"""The events of a receiver's process: `kill` and `restart` end it and start it again; `pause` and `resume` stop and continue it.

A process that continues has all it knew. One that is started again begins from the prior, or from its last belief.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from evedrop.model.links.loss_model import Fate
from evedrop.names import ProcessAction
from evedrop.scenario.events.event import Act, EventKind, Fault, Leave, Return

State = Annotated[Literal["prior", "last"] | None, Field(examples=["last"])]
"""What the receiver knows when it is started again: nothing, or its last estimate."""
_ALONE = {"state": "is given without a restart; remove the line"}


def _restart(event: EventKind, at: int, state: str | None) -> Act:
    effect = Return(Fate.DOWN, ProcessAction.START, Kill.kind, state == "last")
    return Act(at, Restart.kind, event.names, f"{Restart.kind} {event.names[0]}", effect)


class Kill(EventKind):
    """`kill`: the receiver's process is ended. It comes back at the end of the event, or with a restart."""

    kill: Annotated[str, Field(examples=["legitimate"])]
    """Ends a receiver's process (SIGKILL)."""
    state: State = None
    """The state with which it is restarted: `prior` (default), or its `last` estimate."""

    kind = "kill"
    does = Leave
    lasts = True
    names_in = "kill"
    fault = Fault(0, may_have=("state",))
    alone = _ALONE

    def acts(self) -> Iterator[Act]:
        """The kill, and the restart."""
        yield self.begin(f"kill {self.kill}", Leave(Fate.DOWN, ProcessAction.END))
        if self.to is not None:
            yield _restart(self, self.to, self.state)


class Restart(EventKind):
    """`restart`: the receiver's process is started again."""

    restart: Annotated[str, Field(examples=["legitimate"])]
    """Starts a killed receiver's process again."""
    state: State = None
    """The state with which it begins: `prior` (default), or its `last` estimate."""

    kind = "restart"
    does = Return
    names_in = "restart"
    alone = _ALONE

    def acts(self) -> Iterator[Act]:
        """The restart."""
        yield _restart(self, self.first, self.state)


def _resume(event: EventKind, at: int) -> Act:
    effect = Return(Fate.PAUSED, ProcessAction.CONTINUE, Pause.kind, keeps_state=True)
    return Act(at, Resume.kind, event.names, f"{Resume.kind} {event.names[0]}", effect)


class Pause(EventKind):
    """`pause`: the receiver's process is stopped."""

    pause: Annotated[str, Field(examples=["legitimate"])]
    """Stops a receiver's process (SIGSTOP)."""

    kind = "pause"
    does = Leave
    lasts = True
    names_in = "pause"
    fault = Fault(1)

    def acts(self) -> Iterator[Act]:
        """The stop, and the continuation."""
        yield self.begin(f"pause {self.pause}", Leave(Fate.PAUSED, ProcessAction.STOP, keeps_state=True))
        if self.to is not None:
            yield _resume(self, self.to)


class Resume(EventKind):
    """`resume`: the receiver's process continues."""

    resume: Annotated[str, Field(examples=["legitimate"])]
    """Lets a paused receiver's process continue (SIGCONT), with all it knew."""

    kind = "resume"
    does = Return
    names_in = "resume"

    def acts(self) -> Iterator[Act]:
        """The continuation."""
        yield _resume(self, self.first)
