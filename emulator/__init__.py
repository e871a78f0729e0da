"""Evedrop: a network emulator for secrecy in remote state estimation.

    from emulator import run, montecarlo, compare, design, load_results

Names are loaded when they are used: a peer imports this package too, and needs none of them.
"""

from __future__ import annotations

# Not from typing, whose import would take longer than all else before a command heeds signals; type checkers know the name.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

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
        import importlib  # noqa: PLC0415 - as above

        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
