"""`[acknowledgements]` of a scenario.

Source: docs/scenario.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

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

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Mistakes in the entries of attacks: two need a jammer with a link of its own, `flip` a probability."""
        attack, jammer, flip = table.get("attack", "none"), table.get("jammer"), table.get("flip")
        if attack == "flip" and flip is None:
            return [
                (
                    "flip",
                    "is missing; the attack flip needs the probability of flipping an acknowledgement, such as flip = 0.1",
                )
            ]
        if attack != "flip" and flip is not None:
            return [("flip", f"is set, but the attack {as_toml(attack)} flips nothing; remove the line")]
        if attack in [*OVERHEARING] and jammer is None:
            return [
                ("jammer", f"is missing; the attack {attack} needs the eavesdropper that it serves, by what that hears")
            ]
        if attack not in [*OVERHEARING] and jammer is not None:
            return [
                (
                    "jammer",
                    f"is set, but the attack {as_toml(attack)} does not depend on what it hears; remove the line",
                )
            ]
        return []
