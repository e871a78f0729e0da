"""Read and check a scenario file; its mistakes are reported together.

Source: docs/scenario.md.
"""

from evedrop.scenario.loading.file import checked, load, parse, read, set_entry, tables_in, value_of
from evedrop.scenario.loading.python_scenario import prepared, register
from evedrop.scenario.tables import Scenario
from evedrop.scenarios import shipped

__all__ = [
    "Scenario",
    "checked",
    "load",
    "parse",
    "prepared",
    "read",
    "set_entry",
    "shipped",
    "tables_in",
    "value_of",
]

register()
