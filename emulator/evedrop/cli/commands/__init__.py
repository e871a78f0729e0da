"""The commands: a module for each, or for a few that belong together. Each module has a tuple `COMMANDS`.

An installed package adds commands with an entry point in the group `evedrop.commands` that names such a module.
"""

from __future__ import annotations

from collections.abc import Mapping

ROLES = ("router", "relay", "sensor", "legitimate", "eavesdropper", "controller", "recorder")
"""The roles of processes; each is a command that runs one."""

GROUP = "evedrop.commands"

MODULES: Mapping[str, str] = {
    "list": "scenarios",
    "show": "scenarios",
    "new": "scenarios",
    "check": "scenarios",
    "demo": "run",
    "run": "run",
    "montecarlo": "study",
    "test": "testing",
    "wire": "wire",
    "compare": "study",
    "sweep": "study",
    "design": "design",
    "cost": "study",
    "learned": "study",
    "figures": "paper",
    "paper": "paper",
    "links": "fit",
    "process": "fit",
    "link": "steer",
    "partition": "steer",
    "heal": "steer",
    "pause": "steer",
    "resume": "steer",
    "step": "steer",
    "status": "steer",
    "view": "view",
    "export": "results",
    "report": "results",
    "diff": "results",
    "docs": "docs",
    "completion": "docs",
    "selftest": "selftest",
    "brief": "process",
    "health": "process",
    "host": "process",
    **dict.fromkeys(ROLES, "process"),
}
"""First word of a command → its module in this package, in the order of `--help`."""
