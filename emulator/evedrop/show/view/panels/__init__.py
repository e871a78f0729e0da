"""The panels of the view, one file each. An installed package adds panels with entry points in the group `evedrop.panels`."""

from __future__ import annotations

from evedrop.model.registry import Registry
from evedrop.show.view.panels.applications import ApplicationPanels
from evedrop.show.view.panels.error import SquaredError
from evedrop.show.view.panels.events import Events
from evedrop.show.view.panels.fates import LastPacket
from evedrop.show.view.panels.ground_map import GroundMap
from evedrop.show.view.panels.knowledge import WhoKnowsWhat
from evedrop.show.view.panels.legend import Legend
from evedrop.show.view.panels.levels import Levels
from evedrop.show.view.panels.packets import Packets
from evedrop.show.view.panels.panel import ViewPanel
from evedrop.show.view.panels.plant import WhatMovesThePlant
from evedrop.show.view.panels.state import StateOverTime
from evedrop.show.view.panels.state_plane import StatePlane
from evedrop.show.view.panels.title import Title
from evedrop.show.view.panels.trace import TraceOfP

PANELS: Registry[ViewPanel] = Registry(
    "panel",
    ViewPanel,  # type: ignore[type-abstract]
    "evedrop.panels",
    {
        "title": Title,
        "knowledge": WhoKnowsWhat,
        "fates": LastPacket,
        "plant": WhatMovesThePlant,
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
