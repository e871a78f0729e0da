"""Checks the classes of a scenario in memory that are not built in: an error in any slot names class, slots and trials.

Encoders and receivers are checked as in a live run (`evedrop.scenario.conformance.checked`); the further requirements of a
simulation are checked here.

Source: docs/your-own/rules.md, mistakes.
"""

from __future__ import annotations

import contextlib
from typing import Any, final

import numpy as np

from evedrop.model.receiver import Flags, Receiver
from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.scheme import Encoder, Scheme
from evedrop.model.streams import Batch
from evedrop.names import LEGITIMATE
from evedrop.scenario.conformance.checked import (
    asking,
    checked_eavesdropper,
    checked_encoder,
    checked_estimator,
    eavesdropper_in_words,
    is_foreign,
    scheme_in_words,
)
from evedrop.scenario.conformance.problems import Problem, expect_actions
from evedrop.scenario.conformance.rules import expect_array, expect_finite
from evedrop.scenario.dry_run import foreign
from evedrop.scenario.tables import Scenario


@final
class Guard:
    """Checks the results of a scenario's classes that are not built in; does nothing for a scenario without such classes."""

    def __init__(self, scenario: Scenario, scheme: Scheme, batch: Batch) -> None:
        self._active = foreign(scenario.model_dump(exclude_unset=True))
        self._scenario, self._scheme, self._batch = scenario, scheme, batch
        self._problem = Problem(scenario.process.process, batch)
        self._own_scheme = SCHEMES.foreign(scenario.encoding.scheme)
        self._classes = {LEGITIMATE: scheme_in_words(scenario.encoding.scheme)}
        self._watched = {LEGITIMATE} if self._own_scheme else set[str]()
        for name, table in scenario.eavesdroppers.items():
            self._classes[name] = eavesdropper_in_words(name, table.strategy, table.parameters)
            if is_foreign(table.strategy, table.parameters):
                self._watched.add(name)

    def asking(self, receiver: str, slots: range) -> contextlib.AbstractContextManager[None]:
        """Turn an error in the block into one that names the receiver's class, the slots and the trials."""
        return asking(self._classes[receiver], slots, self._batch) if self._active else contextlib.nullcontext()

    def encoder(self, encoder: Encoder) -> Encoder:
        """The encoder; if its class is not built in, one that checks all its packets."""
        return checked_encoder(encoder, self._scenario.encoding.scheme, self._scheme, self._problem)

    def estimator(self, estimator: Receiver) -> Receiver:
        """The legitimate estimator; if its class is not built in, one that checks all its beliefs."""
        return checked_estimator(estimator, self._scenario.encoding.scheme, self._problem)

    def eavesdropper(self, name: str, receiver: Receiver) -> Receiver:
        """The same for an eavesdropper."""
        table = self._scenario.eavesdroppers[name]
        return checked_eavesdropper(receiver, name, table.strategy, table.parameters, self._problem)

    def shared(self, k: int, nu: Any, chi: Any | None = None) -> None:
        """Raise RunError unless these are valid ν_k and χ_k of the scheme."""
        if not self._own_scheme:
            return
        n, trials = self._problem.process.n, self._batch.trials
        with self.asking(LEGITIMATE, range(k, k + 1)):
            expect_array(f"slot {k}: nu()", nu, np.bool_, (trials,), _EACH)
            if chi is not None:
                expect_array(f"slot {k}: chi()", chi, np.float64, (n, trials), "n states, R trials")
                expect_finite(f"slot {k}: chi()", chi, self._batch.first_trial)

    def acted(self, receiver: str, k: int, action: Any, gamma: Flags) -> None:
        """Raise RunError unless this is a receiver's valid answer to a slot's γ."""
        if receiver in self._watched:
            with self.asking(receiver, range(k, k + 1)):
                expect_array(f"slot {k}: act()", action, np.uint8, (self._batch.trials,), _EACH)
                expect_actions(range(k, k + 1), action[None], gamma[None], self._problem)


_EACH = "one for each of the R trials"
