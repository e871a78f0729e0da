"""How much a scheme keeps secret from an adversary."""

from __future__ import annotations

from enum import StrEnum


class SecrecyKept(StrEnum):
    """How much a scheme keeps secret from an adversary, in a word."""

    PERFECT = "perfect"
    RELATIVE = "relative"
    UNDECIDED = "too few trials to tell"
    BROKEN = "broken"


MARKS = {SecrecyKept.PERFECT: "●", SecrecyKept.RELATIVE: "◐", SecrecyKept.UNDECIDED: "?", SecrecyKept.BROKEN: "✕"}
"""Verdicts as marks that can be distinguished without colours."""
