"""The scenario: its tables, its file, its mistakes. All mistakes are reported at once.

Source: docs/scenario.md.
"""

from emulator.scenario.file import checked, load, parse, read, shipped, value_of, write_new
from emulator.scenario.tables import FIGURES, SECRET_BYTES, ExpectTable, Scenario

__all__ = [
    "FIGURES",
    "SECRET_BYTES",
    "ExpectTable",
    "Scenario",
    "checked",
    "load",
    "parse",
    "read",
    "shipped",
    "value_of",
    "write_new",
]
