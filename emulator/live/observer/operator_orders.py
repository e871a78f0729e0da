"""What the operator has asked for and waits to be told about, and steps: a run that is let go on for some slots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evedrop.live.network.declared import Question
from evedrop.live.network.operator import Answer, Request


@dataclass(frozen=True)
class Order:
    """A request with the question that it is the answer to. Final; is to be answered once."""

    request: Request
    _question: Question

    def done(self, slot: int, said: str) -> None:
        """It holds from this slot on."""
        self._question.answer(Answer(slot, said).pack())

    def refuse(self, *mistakes: str) -> None:
        """It cannot be done, and nothing was changed."""
        self._question.answer(Answer(refused=mistakes).pack())

    def tell(self, status: Mapping[str, Any]) -> None:
        """How the run is doing."""
        self._question.answer(Answer(status=status).pack())


@dataclass(frozen=True)
class OperatorStep:
    """Slots that are let through: from `first`, before which the run was held, to before `until`."""

    order: Order
    first: int
    until: int

    def passed(self, end: int) -> str:
        """What has passed when all slots below `end` have."""
        last = end - 1
        if last < self.first:
            return "no slot passed"
        return f"slot {last} passed" if last == self.first else f"slots {self.first} to {last} passed"
