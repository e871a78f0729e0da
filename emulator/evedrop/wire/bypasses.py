"""Notices ways past a wire: programs in mode peer, which find each other without it, and routers that join two sides.

A wire past which programs could have spoken has no verdict, because its journal does not show which messages they received.

Source: docs/wire.md, what programs need.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, final

import zenoh

from evedrop.wire.few_lines import FewLines
from evedrop.wire.side import SideSession

_MULTICAST: Mapping[str, Any] = {"enabled": True}
_SCOUT_SECONDS = 4.0  # Zenoh asks at once, after one second, and after two more


@final
class Bypasses:
    """The bypasses of a running wire. Threads may call its methods at the same time."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """tell: for a line about each bypass."""
        self._lines = FewLines(tell, "ways past the wire")
        self.add = self._lines.add
        """Tells a bypass; of many, only that there are more."""
        self._programs: set[tuple[str, str]] = set()
        self._allowed: dict[str, str] = {}  # program that may be a peer, and has not been heard by multicast → its side
        self._new = False  # whether one has come since the last scouting began
        self._scout: zenoh.Scout[None] | None = None
        self._until = 0.0
        self._listeners: list[object] = []  # Zenoh undeclares those that nobody holds

    def watch(self, sides: Iterable[SideSession]) -> None:
        """Notice programs in mode peer from now on, and those that are there."""
        self._listeners += [
            side.session.info.declare_transport_events_listener(
                self._scouted(side.name) if side.side.peers else self._listener(side.name), history=True
            )
            for side in sides
        ]

    def update(self) -> None:
        """Look by multicast, for some seconds, for programs that may be peers because their multicast scouting is off."""
        if self._scout is not None and time.monotonic() > self._until:
            self.close()
        if self._new and self._scout is None:
            self._new = False
            self._until = time.monotonic() + _SCOUT_SECONDS
            config = zenoh.Config.from_json5(json.dumps({"scouting": {"multicast": _MULTICAST}}))
            scout: Callable[..., Any] = zenoh.scout  # whose type hints lack the form with a callback
            with contextlib.suppress(zenoh.ZError):  # a machine without multicast, on which nobody is found
                self._scout = scout(self._answered, "peer", config)

    def close(self) -> None:
        """End the scouting, if there is one."""
        if self._scout is not None:
            self._scout.stop()
            self._scout = None

    def _listener(self, side: str) -> Callable[[zenoh.TransportEvent], None]:
        def changed(event: zenoh.TransportEvent) -> None:
            program = (side, str(event.transport.zid))
            if event.kind != zenoh.SampleKind.PUT or event.transport.whatami != zenoh.WhatAmI.PEER:
                return
            if program not in self._programs and not self._lines.is_full:  # each once, however often it connects
                self._programs.add(program)
                self.add(
                    f"the program {program[1]} at side {side} is in mode peer: such programs find each other past the wire, so "
                    'the wire has no verdict; connect it with mode "client", or switch its multicast scouting off and set '
                    f"side.{side}.peers = true"
                )

        return changed

    def _scouted(self, side: str) -> Callable[[zenoh.TransportEvent], None]:
        """Notes the peers of a side that allows them, for `update`."""

        def changed(event: zenoh.TransportEvent) -> None:
            program = str(event.transport.zid)
            if event.kind != zenoh.SampleKind.PUT:
                self._allowed.pop(program, None)
            elif event.transport.whatami == zenoh.WhatAmI.PEER:
                self._allowed[program] = side
                self._new = True

        return changed

    def _answered(self, hello: zenoh.Hello) -> None:
        """Tell a program that answers multicast scouting, if it is at a side."""
        side = self._allowed.pop(str(hello.zid), None)
        if side is not None:
            self.add(
                f"the program {hello.zid} at side {side} answers multicast scouting, although side.{side}.peers = true says that "
                "its scouting is off: programs find it past the wire, so the wire has no verdict; set "
                "scouting/multicast/enabled = false in its configuration"
            )
