"""A scenario with one more event, added by an operator while it runs.

Source: docs/control.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.errors import ScenarioError
from evedrop.loading.file import checked
from evedrop.plugins import named_in
from evedrop.scenario.events import EVENTS
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import listed


def with_event(scenario: Scenario, event: Mapping[str, Any], at: int) -> Scenario:
    """The scenario with the event added at a slot, after everything else in that slot; the event itself states no time.

    Raises ScenarioError with every mistake, worded as for the events of a file but without the new event's number.
    """
    tables = scenario.model_dump(mode="json", exclude_none=True)
    number = len(tables["event"])
    kinds = [kind for kind in EVENTS.values() if kind.by_operator]
    strange = [name for name in event if not any(name in kind.own_entries() for kind in kinds)]
    if strange:
        known = listed([" with ".join(kind.own_entries()) for kind in kinds])
        raise ScenarioError("event", [f"{name}: cannot be done now; expected {known}" for name in strange])
    if scenario.modules is None and any(named_in(event)):
        name = next(iter(named_in(event)))
        raise ScenarioError(
            "event", [f"set: names {name}, and the run was started without modules; expected a built-in class"]
        )
    tables["event"].append({**event, "at": at})
    try:
        # The horizon does not depend on events, and was checked when the run was started.
        return checked(tables, "event", beyond_horizon=True)
    except ScenarioError as error:
        mistakes = [line.removeprefix(f"event.{number}.") for line in error.mistakes]
        raise ScenarioError(error.source, mistakes) from error
