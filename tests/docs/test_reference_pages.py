"""The pages of the reference that the site generates: keys of scenarios, commands, and the module `evedrop`."""

from __future__ import annotations

import pytest

import evedrop
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


def test_the_page_of_the_module_has_every_public_name_once() -> None:
    """Functions first; a name that a package has as well is taken from its module."""
    page = site_tool("python_page").python_page()
    names = [line.rpartition(".")[2] for line in page.splitlines() if line.startswith(":::")]
    assert sorted(names) == sorted(evedrop.__all__)
    assert page.index("::: evedrop.run\n") < page.index("::: evedrop.RunResults") < page.index("::: evedrop.RunError")


def test_the_page_of_commands_has_each_with_its_options(monkeypatch: pytest.MonkeyPatch) -> None:
    """Folded, with links to pages that help texts name."""
    monkeypatch.setenv("COLUMNS", "100")  # which the page sets
    page = site_tool("commands").commands_page()
    assert "| **make** | [`list`](#list) |" in page
    assert "## links fit\n" in page
    assert '??? note "Arguments and options"' in page
    assert "| `--workers N` |" in page
    assert "([montecarlo](../montecarlo.md))" in page


def test_a_page_that_is_not_there_is_no_link() -> None:
    """And a path in another folder is left alone."""
    linked = site_tool("doc_links").linked
    assert linked("see docs/view.md, docs/nowhere.md and my/docs/view.md.", "../") == (
        "see [view](../view.md), docs/nowhere.md and my/docs/view.md."
    )
