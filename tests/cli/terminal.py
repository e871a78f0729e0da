"""A terminal of tests."""

from __future__ import annotations

import io


class Terminal(io.StringIO):
    """What was written to a terminal."""

    def isatty(self) -> bool:
        """It is one."""
        return True
