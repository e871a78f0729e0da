"""`spoof`: the sensor's measurements are attacked, as the table of an application describes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from evedrop.scenario.application import APPLICATIONS, applications_in
from evedrop.scenario.events.attack import Attack
from evedrop.scenario.events.effects import Spoofing
from evedrop.scenario.events.event import Surroundings


class Spoof(Attack):
    """`spoof`: the attack lasts only during such events."""

    spoof: Annotated[str, Field(examples=["measurements"])]

    kind = "spoof"
    attacked = Spoofing.attacked
    does = Spoofing

    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless an attack on measurements is described."""
        if not surroundings.monitored:
            able = [
                f"[{name}]"
                for name, application in applications_in(APPLICATIONS.names).items()
                if application.has_monitor
            ]
            yield f"no attack is described; expected a table {' or '.join(able)} with an attack as well"
