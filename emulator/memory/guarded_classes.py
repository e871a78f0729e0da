"""Checks the results of classes that are not built in: an error in any slot is reported with class, slot and trials.

A dry run calls them for the first slots only (`evedrop.scenario.dry_run`); a live run checks each of their messages.

Source: docs/your-own.md, mistakes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, final

import numpy as np

from evedrop.conformance.packets import expect_belief, expect_packet
from evedrop.conformance.problems import Problem
from evedrop.conformance.rules import Broken, expect_array, expect_finite
from evedrop.errors import EvedropError, RunError
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.links import LOSS_MODELS
from evedrop.model.links.link import Fate
from evedrop.model.registry import place_of
from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.link import Fates, LinkSchedule
from evedrop.names import LEGITIMATE
from evedrop.scenario import Scenario
from evedrop.scenario.dry_run import foreign
from evedrop.streams import Batch


@final
class Guard:
    """Checks the results of a scenario's classes that are not built in; does nothing for a scenario without such classes."""

    def __init__(self, scenario: Scenario, scheme: Scheme, batch: Batch) -> None:
        self.active = foreign(scenario.model_dump(exclude_unset=True))
        self._scheme, self._batch = scheme, batch
        self._problem = Problem(scenario.process.process, batch)
        name = scenario.encoding.scheme
        self._own_scheme = SCHEMES.foreign(name)
        self._classes = {LEGITIMATE: f"the scheme {name}"}
        self._watched = {LEGITIMATE} if self._own_scheme else set[str]()
        for receiver, table in scenario.eavesdroppers.items():
            used = table.strategy if table.reads_as is None else table.reads_as
            self._classes[receiver] = f"{receiver}'s strategy {used}"
            if STRATEGIES.foreign(table.strategy) or STRATEGIES.foreign(used):
                self._watched.add(receiver)
        self._links = {one: list(_models_of(scenario.course(one))) for one in scenario.receivers}

    @contextlib.contextmanager
    def asking(self, receiver: str, slots: range) -> Iterator[None]:
        """Turn an error in the block into one that names the receiver's class, the slots and the trials."""
        with self._named(self._classes[receiver], slots):
            yield

    @contextlib.contextmanager
    def asking_link(self, receiver: str, slots: range) -> Iterator[None]:
        """Like `asking`, for the models of a receiver's link."""
        models = f" ({', '.join(self._links[receiver])})" if self._links[receiver] else ""
        with self._named(f"{receiver}'s link{models}", slots):
            yield

    @contextlib.contextmanager
    def _named(self, what: str, slots: range) -> Iterator[None]:
        try:
            yield
        except (EvedropError, OSError):
            raise
        except Broken as error:
            raise self._failed(what, slots, str(error)) from error
        except Exception as error:
            if not self.active:
                raise
            raise self._failed(what, slots, place_of(error)) from error

    def packet(self, k: int, packet: Any) -> None:
        """Raise RunError unless this is a valid packet of the scheme."""
        if self._own_scheme:
            self._look(LEGITIMATE, k, lambda: expect_packet(k, packet, self._scheme, self._problem))

    def belief(self, receiver: str, k: int, belief: Any) -> None:
        """Raise RunError unless this is a valid belief of a receiver."""
        if receiver in self._watched:
            self._look(receiver, k, lambda: expect_belief(f"slot {k}: Belief", belief, self._problem))

    def shared(self, k: int, nu: Any, chi: Any | None = None) -> None:
        """Raise RunError unless these are valid ν_k and χ_k of the scheme."""
        if self._own_scheme:
            self._look(LEGITIMATE, k, lambda: self._expect_shared(k, nu, chi))

    def acted(self, receiver: str, k: int, action: Any) -> None:
        """Raise RunError unless this is a receiver's valid answer to a slot's γ."""
        if receiver in self._watched:
            self._look(
                receiver, k, lambda: expect_array(f"slot {k}: act()", action, np.uint8, (self._batch.trials,), _EACH)
            )

    def fates(self, receiver: str, slots: range, fates: Fates) -> None:
        """Raise RunError unless these are valid fates of the packets of some slots on a receiver's link."""
        if not self._links[receiver]:
            return
        shape = (len(slots), self._batch.trials)
        with self.asking_link(receiver, slots):
            expect_array("fates()", fates.codes, np.uint8, shape, "slots, R trials")
            if fates.codes.size and int(fates.codes.max()) > max(Fate):
                raise Broken(f"fates(): one is {int(fates.codes.max())}; expected Fate.DELIVERED or Fate.LOST")

    def _expect_shared(self, k: int, nu: Any, chi: Any | None) -> None:
        n, trials = self._problem.process.n, self._batch.trials
        expect_array(f"slot {k}: nu()", nu, np.bool_, (trials,), _EACH)
        if chi is not None:
            expect_array(f"slot {k}: chi()", chi, np.float64, (n, trials), "n states, R trials")
            expect_finite(f"slot {k}: chi()", chi, self._batch.first_trial)

    def _look(self, receiver: str, k: int, look: Any) -> None:
        try:
            look()
        except Broken as error:
            said = str(error).removeprefix(f"slot {k}: ")
            raise self._failed(self._classes[receiver], range(k, k + 1), said) from error

    def _failed(self, what: str, slots: range, how: str) -> RunError:
        first = self._batch.first_trial
        where = f"slot {slots.start}" if len(slots) == 1 else f"slots {slots.start} to {slots.stop - 1}"
        trials = f"trial {first}" if self._batch.trials == 1 else f"trials {first} to {first + self._batch.trials - 1}"
        return RunError(f"{what} failed in {where}, {trials}: {how}; run `evedrop check` on the class")


_EACH = "one for each of the R trials"


def _models_of(course: LinkSchedule) -> Iterator[str]:
    """The names of a link's models that are not built in, at first and after changes."""
    for settings in (course.settings, *(change.settings or {} for change in course.changes)):
        yield from _names_in(settings)


def _names_in(settings: Mapping[str, Any]) -> Iterator[str]:
    loss, delay = settings.get("loss") or {}, settings.get("delay") or {}
    for spec in loss.get("links", []) if loss.get("model") == "pooled" else [loss]:
        if spec and LOSS_MODELS.foreign(spec["model"]):
            yield spec["model"]
    if delay and DELAY_MODELS.foreign(delay["model"]):
        yield delay["model"]
