"""Evedrop: a network emulator for secrecy in remote state estimation.

    from evedrop import Scenario, run, montecarlo, sweep, compare, design, load_results, wire

These names, and those of `evedrop.extend`, are the public ones; all other modules may change in any version. They are loaded when
they are used: a peer imports this package, too, and needs none of them.

Source: docs/python.md, what is stable.
"""

from __future__ import annotations

# Not from typing, whose import would take longer than all else before a command handles signals; type checkers know the name.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from evedrop.cli.api import (
        ComparisonResults,
        RunResults,
        SweepResults,
        compare,
        cost,
        design,
        design_budget,
        design_policy,
        design_schedule,
        learned,
        load_results,
        montecarlo,
        run,
        sweep,
    )
    from evedrop.errors import EvedropError, Interrupted, RunError, ScenarioError, UsageError
    from evedrop.live.launch.starter import preloaded
    from evedrop.scenario.loading import Scenario
    from evedrop.simulate.montecarlo import Plan
    from evedrop.wire.journal_reading import journal_tables
    from evedrop.wire.running import wire  # the package `wire`, which can be called: see there

__all__ = [
    "ComparisonResults", "EvedropError", "Interrupted", "Plan", "RunError", "RunResults", "Scenario", "ScenarioError",
    "SweepResults", "UsageError", "compare", "cost", "design", "design_budget", "design_policy", "design_schedule",
    "journal_tables", "learned", "load_results", "montecarlo", "preloaded", "run", "sweep", "wire",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "wire":
        import importlib  # noqa: PLC0415 - as above

        return importlib.import_module("evedrop.wire")
    if name in __all__:
        from evedrop.system.later import imported_later  # noqa: PLC0415 - as above

        return imported_later(__name__, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
