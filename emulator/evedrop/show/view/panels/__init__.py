"""The panels of the view. An installed package adds panels with entry points in the group `evedrop.panels`."""

from __future__ import annotations

from evedrop.model.registry import Registry
from evedrop.show.view.panels.curves import (
    ApplicationPanels,
    Levels,
    SquaredError,
    StateOverTime,
    TraceOfP,
    WhatMovesThePlant,
)
from evedrop.show.view.panels.drawing import DrawnPlant
from evedrop.show.view.panels.fates import LastPacket, Packets, WhoKnowsWhat
from evedrop.show.view.panels.panel import ViewPanel
from evedrop.show.view.panels.plane import GroundMap, StatePlane
from evedrop.show.view.panels.texts import Events, Legend, VerdictLine

PANELS: Registry[ViewPanel] = Registry(
    "panel",
    ViewPanel,  # type: ignore[type-abstract]
    "evedrop.panels",
    {
        "verdict": VerdictLine,
        "knowledge": WhoKnowsWhat,
        "fates": LastPacket,
        "plant": WhatMovesThePlant,
        "drawing": DrawnPlant,
        "levels": Levels,
        "applications": ApplicationPanels,
        "error": SquaredError,
        "trace": TraceOfP,
        "packets": Packets,
        "plane": StatePlane,
        "state": StateOverTime,
        "map": GroundMap,
        "events": Events,
        "legend": Legend,
    },
)
"""In the order in which they are placed, from the top of each column and the left of each row; those of packages follow."""
