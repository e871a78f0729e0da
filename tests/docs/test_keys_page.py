"""The page of scenario keys describes every key."""

from __future__ import annotations

from evedrop.scenario.tables import Scenario
from tests.docs.site_tools import site_tool


def test_every_key_of_a_scenario_has_a_description() -> None:
    """A sentence below its declaration; keys of events and of applications included."""
    keys = site_tool("keys")
    tables = [Scenario, *keys.inner_tables(Scenario)]
    assert len(tables) > 15
    without = [
        f"{table.__name__}.{key}"
        for table in tables
        for key, description in keys.descriptions(table).items()
        if not description.endswith(".")
    ]
    assert without == []


def test_the_page_has_every_table_and_the_keys_of_events() -> None:
    """With what they mean, and links to the sections of inner tables."""
    page = site_tool("keys").keys_page()
    assert "## `[[event]]` { #event }" in page
    assert "| `cut` | Cuts a link, or a list of links" in page
    assert "## `[integrity]` { #integrity }" in page
    assert "[table](#process)" in page
