"""Read and check a scenario file; all its mistakes are reported at once.

Source: docs/scenario.md.
"""

from evedrop.loading.file import (
    built_in_text,
    checked,
    load,
    parse,
    read,
    set_entry,
    shipped,
    tables_in,
    value_of,
    write_new,
)
from evedrop.loading.python_scenario import prepared, register
from evedrop.scenario.tables import Scenario

__all__ = [
    "Scenario",
    "built_in_text",
    "checked",
    "load",
    "parse",
    "prepared",
    "read",
    "set_entry",
    "shipped",
    "tables_in",
    "value_of",
    "write_new",
]

register()
