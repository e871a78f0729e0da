"""Tells the user a limited number of lines about one matter: programs that connect again and again must not fill the history.

Source: docs/wire.md, what programs need.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, final

MOST: Final = 20
"""The lines that are told one by one."""


@final
class FewLines:
    """Tells lines; beyond `MOST`, only that there were more. Threads may call its methods at the same time."""

    def __init__(self, tell: Callable[[str], None], what: str) -> None:
        """tell: for each line; what: the matter, in the plural, such as "ways past the wire"."""
        self._tell, self._what = tell, what
        self._told = 0
        self._lock = threading.Lock()

    @property
    def is_full(self) -> bool:
        """Whether further lines are not told."""
        return self._told > MOST

    def add(self, line: str) -> None:
        """Tell a line."""
        with self._lock:
            self._told += 1
            at = self._told
        if at <= MOST:
            self._tell(line)
        elif at == MOST + 1:
            self._tell(f"there were more than {MOST} {self._what}; further ones are not listed")
