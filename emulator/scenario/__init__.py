"""The scenario: its tables, its file, its mistakes. All mistakes are reported at once.

Source: docs/scenario.md.
"""

from emulator.scenario.expect import FIGURES, ExpectTable, link_figure
from emulator.scenario.file import checked, load, parse, read, shipped, value_of, write_new
from emulator.scenario.tables import SECRET_BYTES, Scenario

__all__ = [
    "FIGURES",
    "SECRET_BYTES",
    "ExpectTable",
    "Scenario",
    "checked",
    "link_figure",
    "load",
    "parse",
    "read",
    "shipped",
    "value_of",
    "write_new",
]
