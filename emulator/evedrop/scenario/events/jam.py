"""`jam`: acknowledgements are attacked, as `[acknowledgements]` describes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from evedrop.scenario.events.attack import Attack
from evedrop.scenario.events.effects import Jamming
from evedrop.scenario.events.event import Surroundings


class Jam(Attack):
    """`jam`: the attack lasts only during such events."""

    jam: Annotated[str, Field(examples=["acknowledgements"])]

    kind = "jam"
    attacked = Jamming.attacked
    does = Jamming

    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless there are acknowledgements and an attack on them."""
        scheme = surroundings.scheme
        if not scheme.needs_acknowledgements:
            name = surroundings.scheme_name
            yield f"the scheme {name} has no acknowledgements that could be jammed; remove the event"
        elif surroundings.attack == "none":
            yield 'no attack is described; expected acknowledgements.attack = "all", or another, as well'
