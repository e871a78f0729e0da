"""The commands: a module for each, or for a few that belong together. Each module has a tuple `COMMANDS`.

An installed package adds commands with an entry point in the group `evedrop.commands` that names such a module.
"""

from __future__ import annotations

from collections.abc import Mapping

ROLES = ("router", "relay", "sensor", "legitimate", "eavesdropper", "controller", "observer")
"""The roles of processes; each is a command that runs one."""

GROUP = "evedrop.commands"

MODULES: Mapping[str, str] = {
    "list": "scenarios",
    "new": "scenarios",
    "demo": "run",
    "run": "run",
    "montecarlo": "montecarlo",
    "link": "steer",
    "partition": "steer",
    "heal": "steer",
    "pause": "steer",
    "resume": "steer",
    "step": "steer",
    "status": "steer",
    "sweep": "sweep",
    "compare": "compare",
    "design": "design",
    "cost": "cost",
    "learned": "learned",
    "figures": "figures",
    "paper": "paper",
    "view": "view",
    "diff": "diff",
    "test": "testing",
    "check": "check",
    "links": "links",
    "process": "process_fit",
    "wire": "wire",
    "selftest": "selftest",
    "brief": "process",
    "health": "process",
    **dict.fromkeys(ROLES, "process"),
}
"""First word of a command → its module in this package, in the order of `--help`."""
