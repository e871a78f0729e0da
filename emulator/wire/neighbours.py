"""Programs that are connected to several sides, and routers that join sides outside the wire.

A program at two sides gets a message from each. A router at two sides passes messages between them by itself, and every message
that the wire passed on would come back to it: the links between such sides carry nothing.

Source: docs/wire.md, no loops.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import final

import zenoh

from evedrop.wire.lanes import LinkState
from evedrop.wire.side import SideSession

_LABEL = re.compile(rb'label = "([0-9a-f]+)"')


@final
class Neighbours:
    """Looks at who is connected to the sides, and tells what has changed."""

    def __init__(
        self, sides: Mapping[str, SideSession], states: Sequence[LinkState], tell: Callable[[str], None]
    ) -> None:
        self._sides, self._states, self._tell = sides, states, tell
        self._told: set[tuple[str, str, str]] = set()

    def update(self) -> None:
        """Look again; cut the links between sides that are joined outside the wire, and let those go on that no longer are."""
        programs, routers = {}, {}
        for name, side in self._sides.items():
            transports = side.session.info.transports()
            programs[name] = {str(one.zid) for one in transports if one.whatami != zenoh.WhatAmI.ROUTER}
            routers[name] = {str(one.zid) for one in transports if one.whatami == zenoh.WhatAmI.ROUTER} | self._reached(
                side
            )
        found = set()
        for one, other in combinations(self._sides, 2):
            joined = routers[one] & (routers[other] | {self._sides[other].zid}) or routers[other] & {
                self._sides[one].zid
            }
            for state in self._states:
                if {state.link.source, state.link.target} == {one, other}:
                    state.looped = bool(joined)
            found |= {(f"router {zid}", one, other) for zid in joined}
            found |= {(f"program {zid}", one, other) for zid in programs[one] & programs[other]}
        for who, one, other in sorted(found - self._told):
            self._tell(_sentence(who, one, other))
        for who, one, other in sorted(self._told - found):
            self._tell(f"the {who} no longer joins the sides {one} and {other}")
        self._told = found

    @staticmethod
    def _reached(side: SideSession) -> set[str]:
        """The other routers that a side's router knows a way to."""
        graphs = side.ask("/linkstate/north").values()
        return {label.decode() for graph in graphs for label in _LABEL.findall(graph)} - {side.zid}


def _sentence(who: str, one: str, other: str) -> str:
    if who.startswith("router"):
        return (
            f"the {who} joins the sides {one} and {other} outside the wire, so messages would go round; the links between them "
            f"carry nothing (fate LOOPED) until it is disconnected from one of them"
        )
    return (
        f"the {who} is connected to the sides {one} and {other}: it gets a message from both, and its own messages come back to "
        "it; connect it to one side"
    )
