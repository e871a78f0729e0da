"""The totals of an application: those of a package never raise an error, so that all else is measured and saved.

Source: docs/your-own/application.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, final

from evedrop.errors import NoAnswer
from evedrop.model.process import Floats
from evedrop.model.registry import CLASS_ERRORS, place_of
from evedrop.model.slot.records import SensorSlots
from evedrop.scenario.application import APPLICATIONS, ApplicationTally, ControlledPlant, Summary, is_own
from evedrop.scenario.table import Table

T = TypeVar("T")


@final
class GuardedApplication:
    """An application's tally."""

    def __init__(self, name: str) -> None:
        """name: the application's."""
        self._name = name
        self.failure = ""
        """Why it has no entry in the summary, if it failed."""
        self._tally: ApplicationTally | None = None

    @classmethod
    def begun(cls, name: str, loop: ControlledPlant, table: Table, trials: int) -> GuardedApplication:
        """A tally of no slots yet."""
        application = cls(name)
        application._tally = application._asked(
            lambda _: _expected_tally(APPLICATIONS[name].tally(loop, table, trials))
        )
        return application

    def add(self, sensor: SensorSlots, u: Floats, applied: Floats, estimates: Mapping[str, Floats]) -> None:
        """Add the next slots. u: inputs as decided; applied: with the watermark."""
        if sensor.watermark is not None:
            self._asked(lambda tally: tally.add_monitored(sensor.states, u, sensor))
        self._asked(lambda tally: tally.add(sensor.states, applied, estimates))

    @classmethod
    def merged(cls, parts: Sequence[GuardedApplication]) -> GuardedApplication:
        """The tally of several sets of trials, in order."""
        whole = cls(parts[0]._name)
        whole.failure = next((part.failure for part in parts if part.failure), "")
        tallies = [part._tally for part in parts if part._tally is not None]
        whole._tally = whole._asked(lambda _: _expected_tally(type(tallies[0]).merged(tallies)))
        return whole

    def entry(self) -> Summary | None:
        """The summary's entry; None if it failed."""
        return self._asked(self._entry)

    def _entry(self, tally: ApplicationTally) -> Summary:
        entry, application = tally.entry(), APPLICATIONS[self._name]
        for metric in application.metrics:
            value = entry.get(metric, "nothing")
            if not isinstance(value, (int, float, type(None))):
                raise NoAnswer(f"summary() gave {value!r:.40} as {metric}; expected a number, or None")
        json.dumps(entry)
        return entry

    def _asked(self, ask: Callable[[Any], T]) -> T | None:
        """What the tally answers; None if the application has failed. An error of a built-in application is raised."""
        if not self.failure:
            try:
                return ask(self._tally)
            except CLASS_ERRORS as error:
                if is_own(APPLICATIONS[self._name]):
                    raise
                self.failure = f"the application {self._name} of an installed package failed: {place_of(error)}"
                self._tally = None
        return None


def _expected_tally(tally: object) -> ApplicationTally:
    if not isinstance(tally, ApplicationTally):
        raise NoAnswer(f"it gave {tally!r:.40} as its tally; expected an ApplicationTally")
    return tally
