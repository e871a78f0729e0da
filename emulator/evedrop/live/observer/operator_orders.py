"""The operator's requests that await an answer, and steps, in which a held run continues for some slots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from evedrop.live.network.declared import Question
from evedrop.live.network.operator import Answer
from evedrop.live.protocol.requests import OperatorRequest
from evedrop.live.protocol.status import RunStatus


@final
@dataclass(frozen=True)
class Order:
    """A request with the Zenoh question that brought it, to be answered once."""

    request: OperatorRequest
    _question: Question

    def done(self, slot: int, said: str) -> None:
        """Answer that the request takes effect from this slot on; said: what was done, in words."""
        self._question.answer(Answer(slot, said).pack())

    def refuse(self, *mistakes: str) -> None:
        """Answer that the request is refused, and that nothing was changed."""
        self._question.answer(Answer(refused=mistakes).pack())

    def tell(self, status: RunStatus) -> None:
        """Answer with the run's status."""
        self._question.answer(Answer(status=status).pack())


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
