"""The limit on the keys that programs use. A wire keeps the records of a key until it ends.

Each side has its own limit, so that programs of one side cannot use up the keys of others.

Source: docs/wire.md, many keys.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import final

from evedrop.wire.advanced import numbered_as
from evedrop.wire.history import Numbered
from evedrop.wire.plan import WireLink

MOST_KEYS = 2**18
"""The keys that a wire keeps for the programs of a side; each takes some 1 kB."""
MOST_CHARACTERS = 2**25
"""The characters of these keys."""


@final
class KeyLimit:
    """The keys of a wire that are new, counted for each side. Threads may call its methods at the same time."""

    def __init__(self, links: Iterable[WireLink], earlier: Iterable[Numbered], tell: Callable[[str], None]) -> None:
        """earlier: the streams that earlier starts numbered; their keys count, too. tell: for warnings.

        The stream of `KEY/@adv/…` counts as a key until one of these comes, for there is no telling how many there were.
        """
        self._tell = tell
        self._used: dict[str, tuple[int, int]] = {}  # side → keys, characters
        self._full: set[str] = set()
        self._earlier: set[str] = set()
        self._lock = threading.Lock()
        sources = {link.name: link.source for link in links}
        for link, key, _ in earlier:
            if key not in self._earlier:
                self._earlier.add(key)
                self._take(key, sources.get(link, ""))

    def admits(self, key: str, side: str) -> bool:
        """Whether there is room for a new key that a program of a side uses; then it has its place from now on."""
        with self._lock:
            if key in self._earlier:
                return True
            if (numbered := numbered_as(key)) in self._earlier:  # the first such key has the place of its stream
                self._earlier.remove(numbered)
                return True
            keys, characters = self._used.get(side, (0, 0))
            if keys < MOST_KEYS and characters + len(key) <= MOST_CHARACTERS:
                self._take(key, side)
                return True
            if side in self._full:
                return False
            self._full.add(side)
        self._tell(
            f"programs at the side {side} have used {keys:,} keys of {characters:,} characters, and the wire keeps no more of "
            "them; messages with new keys are dropped as too_many_keys; let these programs use fewer keys"
        )
        return False

    def _take(self, key: str, side: str) -> None:
        keys, characters = self._used.get(side, (0, 0))
        self._used[side] = (keys + 1, characters + len(key))
