"""Checks the classes of a scenario in memory that are not built in: an error in any slot names class, slots and trials.

Encoders and receivers are checked as in a live run (`evedrop.scenario.conformance.checked`); the further requirements of a
simulation are checked here.

Source: docs/your-own/rules.md, mistakes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, final

import numpy as np

from evedrop.model.delays import DELAY_MODELS
from evedrop.model.links import LOSS_MODELS, single_specs
from evedrop.model.links.loss_model import Fate
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.scheme import Encoder, Scheme
from evedrop.model.slot.link import Fates, LinkSchedule
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
from evedrop.scenario.conformance.rules import Broken, expect_array, expect_finite
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
        self._links = {receiver: list(_models_of(scenario.schedule(receiver))) for receiver in scenario.receivers}

    def asking(self, receiver: str, slots: range) -> contextlib.AbstractContextManager[None]:
        """Turn an error in the block into one that names the receiver's class, the slots and the trials."""
        return self._named(self._classes[receiver], slots)

    def asking_link(self, receiver: str, slots: range) -> contextlib.AbstractContextManager[None]:
        """Like `asking`, for the models of a receiver's link."""
        models = f" ({', '.join(self._links[receiver])})" if self._links[receiver] else ""
        return self._named(f"{receiver}'s link{models}", slots)

    def _named(self, subject: str, slots: range) -> contextlib.AbstractContextManager[None]:
        return asking(subject, slots, self._batch) if self._active else contextlib.nullcontext()

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

    def fates(self, receiver: str, slots: range, fates: Fates) -> None:
        """Raise RunError unless these are valid fates of the packets of some slots on a receiver's link."""
        if not self._links[receiver]:
            return
        shape = (len(slots), self._batch.trials)
        with self.asking_link(receiver, slots):
            expect_array("fates()", fates.codes, np.uint8, shape, "slots, R trials")
            if fates.codes.size and int(fates.codes.max()) > max(Fate):
                raise Broken(f"fates(): one is {int(fates.codes.max())}; expected Fate.DELIVERED or Fate.LOST")


_EACH = "one for each of the R trials"


def _models_of(schedule: LinkSchedule) -> Iterator[str]:
    """The names of a link's models that are not built in, at first and after changes."""
    for settings in (schedule.settings, *(change.settings or {} for change in schedule.changes)):
        loss, delay = settings.get("loss"), settings.get("delay")
        losses = [spec["model"] for spec in single_specs(loss)] if loss else []
        yield from filter(LOSS_MODELS.foreign, losses)
        if delay and DELAY_MODELS.foreign(delay["model"]):
            yield delay["model"]
