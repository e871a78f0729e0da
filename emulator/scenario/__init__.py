"""The scenario: its tables and events, and the checks across them.

Source: docs/scenario.md.
"""

from evedrop.scenario.expect import ExpectTable, link_figure
from evedrop.scenario.tables import SECRET_BYTES, Scenario

__all__ = [
    "SECRET_BYTES",
    "ExpectTable",
    "Scenario",
    "link_figure",
]
