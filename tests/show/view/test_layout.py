"""The names of tabs and panels, and a layout with only one of them."""

from __future__ import annotations

from typing import Any

import pytest

from evedrop.errors import UsageError
from evedrop.show.view.layout import Blueprint, Layout, as_typed


def view(title: str | None, origin: str) -> dict[str, dict[str, Any]]:
    """A view of a blueprint."""
    return {"ViewBlueprint": {"space_origin": origin, **({"display_name": title} if title else {})}}


def container(kind: str, *contents: str, title: str | None = None) -> dict[str, dict[str, Any]]:
    """A container of a blueprint; Rerun gives a single child as a word."""
    inside: str | list[str] = contents[0] if len(contents) == 1 else list(contents)
    part = {"container_kind": kind, "contents": inside}
    if kind == "Tabs":
        part["active_tab"] = contents[1]
    return {"ContainerBlueprint": part | ({"display_name": title} if title else {})}


def tabbed() -> Blueprint:
    """A verdict above two tabs. The second tab is open, and both have events."""
    return {
        "/viewport": {"ViewportBlueprint": {"root_container": "root"}},
        "/time_panel": {"TimePanelBlueprint": {"state": "Collapsed"}},
        "/container/root": container("Vertical", "view/verdict", "container/tabs"),
        "/container/tabs": container("Tabs", "container/scene", "container/numbers"),
        "/container/scene": container("Horizontal", "view/smart", "view/events", title="Scene"),
        "/container/numbers": container("Vertical", "view/error", "view/again", "view/scene", title="Numbers"),
        "/view/verdict": view("Verdict", "title"),
        "/view/smart": view("smart believes", "plane"),
        "/view/smart/ViewContents": {"ViewContents": {"query": "plane/**"}},
        "/view/error": view("Squared error   log10", "/"),
        "/view/events": view("Events", "events"),
        "/view/again": view("Events", "events"),
        "/view/scene": view("Scene", "plane"),
    }


@pytest.mark.parametrize(
    ("title", "name"),
    [
        ("Squared error   log10, dim: 95 % bands", "squared-error"),
        ("Root of tr P   dim: theory   −1: 0.1 m · 1: 10 m", "root-of-tr-p"),
        ("What happens: SOC (%)", "what-happens"),
        ("The last packet, and what each knows", "last-packet"),
        ("Evidence of an attack; watermark", "evidence-of-an-attack"),
        ("mallory (smart) believes   grey: truth", "mallory"),
        ("Delay of delivered messages (ms)   dim: 99 %, bright: median", "delay-of-delivered-messages"),
        ("Losses in the last 24 s   coloured as the lanes", "losses"),
        ("Eve_2 believes", "eve_2"),
        ("squared-error", "squared-error"),
    ],
)
def test_a_name_is_the_beginning_of_the_title(title: str, name: str) -> None:
    """As somebody types it; a name is its own name."""
    assert as_typed(title) == name
    assert as_typed(name) == name


def test_tabs_come_first_and_what_is_shown_twice_has_one_name() -> None:
    """A panel with the name of a tab gets a number."""
    assert Layout(tabbed()).names == ["scene", "numbers", "verdict", "smart", "events", "squared-error", "scene-2"]


def contents(blueprint: Blueprint) -> set[str]:
    """Paths of the views and containers."""
    return {path for path in blueprint if path.count("/") == 2}


@pytest.mark.parametrize("name", ["numbers", None])
def test_a_tab_has_what_all_tabs_share(name: str | None) -> None:
    """The verdict stays above it, and the other tab is left out; without a name it is the tab that is open."""
    before = tabbed()
    layout = Layout(before).alone(name)
    assert contents(layout) == {
        "/container/root",
        "/container/tabs",
        "/container/numbers",
        *(f"/view/{view}" for view in ("verdict", "error", "again", "scene")),
    }
    assert layout["/container/tabs"]["ContainerBlueprint"] == {
        "container_kind": "Vertical",
        "contents": ["container/numbers"],
    }
    assert layout["/time_panel"] == before["/time_panel"]
    assert before == tabbed()


@pytest.mark.parametrize("name", ["smart", "Smart believes", "sm"])
def test_a_panel_is_drawn_alone(name: str) -> None:
    """With its contents; a title, or the beginning of a name, is enough."""
    layout = Layout(tabbed()).alone(name)
    assert contents(layout) == {"/container/root", "/view/smart"}
    assert "/view/smart/ViewContents" in layout
    assert layout["/container/root"]["ContainerBlueprint"] == {"container_kind": "Vertical", "contents": ["view/smart"]}


@pytest.mark.parametrize(("name", "hint"), [("squared-eror", "; did you mean squared-error?"), ("s", ""), ("", "")])
def test_a_name_that_no_panel_has_is_refused(name: str, hint: str) -> None:
    """With all names; the beginning of several names is not a name."""
    with pytest.raises(UsageError) as told:
        Layout(tabbed()).alone(name)
    names = "scene, numbers, verdict, smart, events, squared-error or scene-2"
    assert str(told.value) == f"--panel {name} is not a panel of this recording; give {names}{hint}"
