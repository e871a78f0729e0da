"""The scenario: its tables, its file, its mistakes. All mistakes are reported at once.

Source: docs/scenario.md.
"""

from evedrop.loading.file import checked, load, parse, read, shipped, value_of, write_new
from evedrop.scenario.expect import FIGURES, ExpectTable, link_figure
from evedrop.scenario.tables import SECRET_BYTES, Scenario

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
