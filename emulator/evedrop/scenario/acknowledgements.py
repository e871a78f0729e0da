"""`[acknowledgements]` of a scenario.

Source: docs/scenario.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import AfterValidator, Field

from evedrop.model.acknowledgements import ATTACKS, OVERHEARING
from evedrop.scenario.table import Found, Probability, Table, one_of
from evedrop.scenario.words import as_toml


class AckChannelTable(Table):
    """`link = {…}` of the acknowledgements: each is lost independently or arrives at once."""

    quality: Annotated[Probability, Field(examples=[0.9])]


class AcknowledgementsTable(Table):
    """`[acknowledgements]`: their channel to the sensor, for schemes that need them, and an attack on it."""

    link: Annotated[AckChannelTable, Field(examples=[{"quality": 0.9}])]
    attack: Annotated[str, Field(strict=True, examples=["critical"]), AfterValidator(one_of(ATTACKS))] = "none"
    jammer: Annotated[str | None, Field(strict=True, examples=["smart"])] = None
    flip: Annotated[Probability | None, Field(examples=[0.1])] = None
    false_alarms: Annotated[float, Field(strict=True, ge=10.0, le=1e9, examples=[1e4])] = 1e4

    def mistakes(self) -> Iterator[Found]:
        """Mistakes in the entries of attacks: two need a jammer with a link of its own, `flip` a probability."""
        if self.attack == "flip" and self.flip is None:
            yield (
                "flip",
                "is missing; the attack flip needs the probability of flipping an acknowledgement, such as flip = 0.1",
            )
        elif self.attack != "flip" and self.flip is not None:
            yield "flip", f"is set, but the attack {as_toml(self.attack)} flips nothing; remove the line"
        elif self.attack in OVERHEARING and self.jammer is None:
            yield (
                "jammer",
                f"is missing; the attack {self.attack} needs the eavesdropper that it serves, by what that hears",
            )
        elif self.attack not in OVERHEARING and self.jammer is not None:
            yield (
                "jammer",
                f"is set, but the attack {as_toml(self.attack)} does not depend on what it hears; remove the line",
            )
