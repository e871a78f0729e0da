"""The scenario of a results folder, for whoever looks at results: read as data, without importing anything that it names.

Somebody else may have written the folder. A class of its own in it would run with all the rights of the user who looks.

Source: docs/your-own/rules.md, results are data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from evedrop.errors import ScenarioError, UsageError
from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.links import LOSS_MODELS
from evedrop.model.registry import no_modules
from evedrop.model.schemes import SCHEMES
from evedrop.names import LEGITIMATE
from evedrop.scenario.across import horizon_mistakes
from evedrop.scenario.dry_run import foreign
from evedrop.scenario.input_files import read_recordings, read_tables
from evedrop.scenario.loading import checked, locate_files, read, tables_in
from evedrop.scenario.process_noise import replace_filter_noise
from evedrop.scenario.table import sentences
from evedrop.scenario.tables import Scenario
from evedrop.system.files import shown

_ANY_SCHEME, _ANY_STRATEGY = "plain", "naive"
_ANY_LINK = {"quality": 1.0}
_PLAIN_LINK = ("quality", "loss")  # of a link, what a view shows


@dataclass(frozen=True)
class RecordedScenario:
    """The scenario in a results folder."""

    scenario: Scenario
    """A scenario to look at, never to run: built-in classes take the places of all other ones, whose words are in `words`."""
    words: Mapping[str, str]
    """Receiver → the scheme, for the legitimate estimator, or the strategy, as the folder names it."""
    unknown_links: frozenset[str]
    """The receivers whose link has a loss model that is not built in: its quality and its ways are unknown."""
    complete: bool
    """Whether all its classes are built in, so that `scenario` is what was run."""

    @property
    def noise(self) -> float:
        """The trace of Q: the squared error of one step."""
        return float(np.trace(self.scenario.process.process.Q))


def recorded(folder: Path, *, beyond_horizon: bool = True) -> RecordedScenario:
    """The scenario of a results folder; imports no class that is not built in.

    beyond_horizon: as for `load`.

    Raises UsageError if there is no scenario.toml, ScenarioError with its mistakes.
    """
    path = folder / "scenario.toml"
    source = shown(path)
    tables = tables_in(read(path), source)
    tables.pop("modules", None)
    locate_files(tables, folder)
    with no_modules():
        if not foreign(tables):
            scenario = checked(tables, source, beyond_horizon=beyond_horizon, folder=folder)
            return RecordedScenario(scenario, _words(tables), frozenset(), complete=True)
        words = _words(tables)
        unknown = _without_classes(tables)
        mistakes = [*read_recordings(tables), *read_tables(tables), *replace_filter_noise(tables)]
        try:
            scenario = Scenario.model_validate(tables)
        except ValidationError as error:
            raise ScenarioError(source, [*sentences(error, Scenario), *mistakes]) from None
        if not beyond_horizon:
            mistakes += horizon_mistakes(scenario.process.process, scenario.slots)
        if mistakes:
            raise ScenarioError(source, mistakes)
    return RecordedScenario(scenario, words, frozenset(unknown), complete=False)


def recorded_noise(folder: Path) -> float:
    """The trace of Q of the scenario in a results folder; 0 if it cannot be read."""
    try:
        return recorded(folder).noise
    except UsageError:
        return 0.0


def recorded_units(folder: Path) -> list[str]:
    """The unit of each state of the scenario in a results folder; empty if it gives none, or cannot be read."""
    try:
        return recorded(folder).scenario.process.units or []
    except UsageError:
        return []


def recorded_strategies(folder: Path) -> Mapping[str, str]:
    """Receiver → its strategy, as the scenario in a results folder names it; empty if it cannot be read."""
    try:
        return recorded(folder).words
    except UsageError:
        return {}


def _words(tables: Mapping[str, Any]) -> dict[str, str]:
    """Receiver → its scheme or strategy, as far as the tables are valid."""
    encoding, others = tables.get("encoding"), tables.get("eavesdroppers")
    words = {LEGITIMATE: str(encoding.get("scheme"))} if isinstance(encoding, Mapping) else {}
    for name, table in others.items() if isinstance(others, Mapping) else ():
        if isinstance(table, Mapping):
            words[name] = str(table.get("strategy"))
    return words


def _without_classes(tables: dict[str, Any]) -> set[str]:
    """Put built-in classes in the places of all other ones, and leave out events with such, in place.

    Returns the receivers whose loss model was replaced. What is not valid stays, for the check of the tables.
    """
    unknown, plain = set(), set()
    encoding, legitimate, others = (tables.get(name) for name in ("encoding", LEGITIMATE, "eavesdroppers"))
    if isinstance(encoding, dict) and _is_foreign(SCHEMES, encoding.get("scheme")):
        tables["encoding"] = {"scheme": _ANY_SCHEME}
    receivers = {LEGITIMATE: legitimate, **(others if isinstance(others, dict) else {})}
    for name, table in receivers.items():
        if not isinstance(table, dict):
            continue
        if _is_foreign(STRATEGIES, table.get("strategy")) or _is_foreign(READERS, table.get("reads_as")):
            strategy = (
                {"strategy": "colluding", "reads_as": _ANY_STRATEGY}
                if "links" in table
                else {"strategy": _ANY_STRATEGY}
            )
            kept = {entry: table[entry] for entry in ("link", "links", "window") if entry in table}
            table.clear()
            table.update({**strategy, **kept})
        links = table.get("links")
        for link in [table.get("link"), *(links if isinstance(links, list) else [])]:
            if isinstance(link, dict) and foreign(link):
                plain.add(name)
                if _plain_link(link):
                    unknown.add(name)
    events = tables.get("event")
    if isinstance(events, list):
        tables["event"] = _plain_events(events, plain)
    return unknown


def _plain_events(events: list[Any], plain: set[str]) -> list[Any]:
    """The events without own classes; of changes of links that lack something, those of losses.

    plain: the receivers of such links. Links whose changes are left out are such links, too.
    """
    lacking = plain.union(*(_links_in(event) for event in events if foreign(event)))
    kept = []
    for event in events:
        if foreign(event):
            continue
        if isinstance(event, dict) and isinstance(event.get("set"), dict) and not lacking.isdisjoint(_links_in(event)):
            changes = {entry: value for entry, value in event["set"].items() if entry in _PLAIN_LINK}
            if changes:
                kept.append({**event, "set": changes})
        else:
            kept.append(event)
    return kept


def _links_in(event: Any) -> set[str]:
    """The receivers whose links a table of an event changes, as far as it is valid."""
    names = event.get("link") if isinstance(event, dict) else None
    return {name for name in (names if isinstance(names, list) else [names]) if isinstance(name, str)}


def _plain_link(link: dict[str, Any]) -> bool:
    """Leave out of a link all but its losses, in place; returns whether these have a model that is not built in."""
    loss = link.get("loss")
    if isinstance(loss, dict) and _is_foreign(LOSS_MODELS, loss.get("model")):
        link.clear()
        link.update(_ANY_LINK)
        return True
    for entry in link.keys() - set(_PLAIN_LINK):
        del link[entry]
    return False


def _is_foreign(registry: Any, name: Any) -> bool:
    return isinstance(name, str) and registry.foreign(name)
