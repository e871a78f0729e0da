"""A scenario with one more event, which somebody adds while it runs.

Source: docs/control.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.errors import ScenarioError
from evedrop.loading.file import checked
from evedrop.plugins import named_in
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import listed

ADDED = ("set", "cut", "heal")
"""What can be added to a run that goes on: what happens on links."""


def with_event(scenario: Scenario, event: Mapping[str, Any], at: int) -> Scenario:
    """The scenario in which the event, which says not when it is, happens at a slot too, after all else in that slot.

    Raises ScenarioError with every mistake, in the words for events of a file but without the new one's number.
    """
    tables = scenario.model_dump(mode="json", exclude_none=True)
    number = len(tables["event"])
    strange = [name for name in event if name not in (*ADDED, "link")]
    if strange:
        known = listed(["link with set", *ADDED[1:]])
        raise ScenarioError("event", [f"{name}: is nothing that can be done now; expected {known}" for name in strange])
    if scenario.modules is None and any(named_in(event)):
        name = next(iter(named_in(event)))
        raise ScenarioError(
            "event", [f"set: names {name}, and the run was started without modules; expected a built-in class"]
        )
    tables["event"].append({**event, "at": at})
    try:
        # What float64 can follow depends on no event, and was asked when the run was started.
        return checked(tables, "event", beyond_horizon=True)
    except ScenarioError as error:
        mistakes = [line.removeprefix(f"event.{number}.") for line in error.mistakes]
        raise ScenarioError(error.source, mistakes) from error
