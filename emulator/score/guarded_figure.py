"""Guards a run against a figure of an installed package that raises an error or gives no number.

From then on the figure is None. Everything else is measured and saved; then the run fails, with an error that names the figure.

Source: docs/your-own.md, a figure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar, final

import numpy as np

from evedrop.errors import NoAnswer
from evedrop.figures import figure
from evedrop.figures.figure import FigureTally, ScoredSlots
from evedrop.model.process import Floats
from evedrop.model.registry import place_of

T = TypeVar("T")


@final
class GuardedTally(FigureTally):
    """The tally of a package's figure, which never raises an error."""

    def __init__(self, name: str, trials: int) -> None:
        """name: the figure's name."""
        self._name, self._trials = name, trials
        self.failure = ""
        """Why the figure is None, if it failed."""
        self._tally: FigureTally | None = None

    def add(self, slots: ScoredSlots) -> None:
        """Add the next slots."""
        self._asked(lambda: self._begun.add(slots))

    @classmethod
    def merged(cls, parts: Sequence[GuardedTally]) -> GuardedTally:
        """The totals of disjoint sets of trials, in their order."""
        whole = cls(parts[0]._name, sum(part._trials for part in parts))
        whole.failure = next((part.failure for part in parts if part.failure), "")
        tallies = whole._asked(lambda: [part._begun for part in parts])
        whole._tally = whole._asked(lambda: type(tallies[0]).merged(tallies)) if tallies else None
        return whole

    @property
    def value(self) -> float | None:
        """The figure over the slots so far; None if there is none, or if it is not a number."""
        found = self._asked(lambda: _number(self._begun.value))
        return None if found is None or math.isnan(found) else found

    @property
    def of_trials(self) -> Floats | None:
        """The figure of every trial, (R,); None if it failed."""
        return self._asked(lambda: _numbers(self._begun.of_trials, self._trials))

    @property
    def _begun(self) -> FigureTally:
        if self._tally is None:
            found: object = figure(self._name).tally(self._trials)
            if not isinstance(found, FigureTally):
                raise NoAnswer(f"tally() gave {found!r:.40}; expected a FigureTally")
            self._tally = found
        return self._tally

    def _asked(self, ask: Callable[[], T]) -> T | None:
        if not self.failure:
            try:
                return ask()
            except Exception as error:
                self.failure = f"the figure {self._name} of an installed package failed: {place_of(error)}"
        return None


def _number(found: object) -> float | None:
    if found is None or (isinstance(found, (int, float, np.number)) and not isinstance(found, bool)):
        return None if found is None else float(found)
    raise NoAnswer(f"value gave {found!r:.40}; expected a number, or None")


def _numbers(found: object, trials: int) -> Floats:
    if isinstance(found, np.ndarray) and found.shape == (trials,):
        return found.astype(np.float64)
    raise NoAnswer(f"of_trials gave {found!r:.40}; expected an array of {trials} numbers")
