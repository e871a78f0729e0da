"""The scenario: its tables and events, and the checks across them.

Source: docs/scenario.md.
"""

from evedrop.scenario.expect import ExpectTable, direction_figure, link_figure
from evedrop.scenario.tables import Scenario

__all__ = ["ExpectTable", "Scenario", "direction_figure", "link_figure"]
