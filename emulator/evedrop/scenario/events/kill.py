"""`kill` and `restart`: a receiver's process is ended, and started again."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from evedrop.model.links.loss_model import Fate
from evedrop.names import ProcessAction
from evedrop.scenario.events.effects import Leave, Return
from evedrop.scenario.events.event import Act, EventKind, Fault

State = Annotated[Literal["prior", "last"] | None, Field(examples=["last"])]
"""What the receiver knows when it is started again: nothing, or its last estimate."""
_ALONE = {"state": "is given without a restart; remove the line"}


def _restart(event: EventKind, at: int, state: str | None) -> Act:
    effect = Return(Fate.DOWN, ProcessAction.START, Kill.kind, state == "last")
    return Act(at, Restart.kind, event.names, f"{Restart.kind} {event.names[0]}", effect)


class Kill(EventKind):
    """`kill`: the receiver's process is ended. It comes back at the end of the event, or with a restart."""

    kill: Annotated[str, Field(examples=["legitimate"])]
    state: State = None

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
    state: State = None

    kind = "restart"
    does = Return
    names_in = "restart"
    alone = _ALONE

    def acts(self) -> Iterator[Act]:
        """The restart."""
        yield _restart(self, self.first, self.state)
