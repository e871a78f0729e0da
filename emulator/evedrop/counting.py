"""A number of things in words."""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """Such as "1 slot", "1,000 slots" and "2 entries"."""
    plural = f"{noun[:-1]}ies" if noun.endswith("ry") else f"{noun}s"
    return f"{count:,} {noun if count == 1 else plural}"
