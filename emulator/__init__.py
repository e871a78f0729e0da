"""Evedrop: a network emulator for secrecy in remote state estimation.

    from emulator import run, montecarlo, compare, design, load_results

Names are loaded when they are used: a peer imports this package too, and needs none of them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emulator.api import compare, design, montecarlo, run
    from emulator.runs.results import load_results

__all__ = ["compare", "design", "load_results", "montecarlo", "run"]

_HOMES = {
    "compare": "emulator.api",
    "design": "emulator.api",
    "load_results": "emulator.runs.results",
    "montecarlo": "emulator.api",
    "run": "emulator.api",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
