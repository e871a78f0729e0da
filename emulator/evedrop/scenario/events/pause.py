"""`pause` and `resume`: a receiver's process is stopped, and continues with all it knew."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from evedrop.model.links.loss_model import Fate
from evedrop.names import ProcessAction
from evedrop.scenario.events.effects import Leave, Return
from evedrop.scenario.events.event import Act, EventKind, Fault


def _resume(event: EventKind, at: int) -> Act:
    effect = Return(Fate.PAUSED, ProcessAction.CONTINUE, Pause.kind, keeps_state=True)
    return Act(at, Resume.kind, event.names, f"{Resume.kind} {event.names[0]}", effect)


class Pause(EventKind):
    """`pause`: the receiver's process is stopped."""

    pause: Annotated[str, Field(examples=["legitimate"])]

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

    kind = "resume"
    does = Return
    names_in = "resume"

    def acts(self) -> Iterator[Act]:
        """The continuation."""
        yield _resume(self, self.first)
