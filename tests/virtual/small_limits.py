"""Small limits for a simulated wire: what otherwise takes thousands of keys or messages happens with a few.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from evedrop.system.world import world
from evedrop.virtual.zenoh import transport
from evedrop.wire import departures, journal_words, publications, queries, ros2, tallies
from evedrop.wire.journal import WireJournal
from evedrop.wire.send_queue import SendQueue
from evedrop.wire.side import SideSession
from evedrop.wire.watchdog import Watchdog

FEW_KEYS = "few keys"
"""And few senders."""
FULL, HUNG = "short queues", "Zenoh hangs"
"""Connections are full soon; a question that the wire puts to Zenoh may have no end."""


def _perhaps_hang(side: SideSession) -> None:
    """What a side does when it is asked whether it answers."""
    del side
    if world().token(1)[0] < 64:
        world().event().wait()


_CONSTANTS: dict[str, tuple[tuple[Any, str, Any], ...]] = {
    FEW_KEYS: (
        (journal_words, "MOST_KEYS", 6),
        (publications, "MOST_PUBLISHERS", 1),
        (publications, "OFTEN", 5),
        (ros2, "MOST_SENDERS", 1),
    ),
    "few keys at a time": (
        (publications, "READY_KEYS", 3),
        (queries, "READY_KEYS", 1),
        (publications, "OFTEN", 5),
    ),
    "few departures": ((departures, "MOST", 1), (departures, "MANY", 2), (departures, "MOST_GONE", 1)),
    FULL: ((transport, "_ROOM", 3000),),
    HUNG: ((SideSession, "answer", _perhaps_hang), (Watchdog.ask, "__defaults__", (3.0,))),
    "short counts": ((tallies, "_SAMPLE", 16), (tallies, "_MOST_RANGES", 2)),
}
_ARGUMENTS: dict[str, tuple[Any, dict[str, Any]]] = {
    "short parts": (WireJournal, {"part_rows": 32}),
    FULL: (SendQueue, {"most": 3, "most_bytes": 6000, "patience": 0.5}),
}
LIMITS = tuple(dict.fromkeys((*_CONSTANTS, *_ARGUMENTS)))


@contextmanager
def small_limits(names: Collection[str]) -> Iterator[None]:
    """Let all wires have these limits while the block runs."""
    with ExitStack() as stack:
        for name in names:
            for place, constant, value in _CONSTANTS.get(name, ()):
                stack.enter_context(patch.object(place, constant, value))
            if name in _ARGUMENTS:
                place, values = _ARGUMENTS[name]
                stack.enter_context(patch.dict(place.__init__.__kwdefaults__, values))
        yield
