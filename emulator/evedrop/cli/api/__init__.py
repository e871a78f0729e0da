"""The Python API: functions for most commands that compute, with the same name; docs/python.md lists the commands without one.

Source: docs/python.md.
"""

from evedrop.cli.api.designs import design, design_budget, design_policy, design_schedule
from evedrop.cli.api.results import ComparisonResults, RunResults, SweepResults, load_results
from evedrop.cli.api.running import compare, cost, learned, montecarlo, run, sweep

__all__ = [
    "ComparisonResults",
    "RunResults",
    "SweepResults",
    "compare",
    "cost",
    "design",
    "design_budget",
    "design_policy",
    "design_schedule",
    "learned",
    "load_results",
    "montecarlo",
    "run",
    "sweep",
]
