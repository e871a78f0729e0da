"""Loss and delay models that break a rule are told which."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evedrop.model.delays import DelayModel, Normal
from evedrop.model.links.loss_model import Bernoulli, fates_of
from evedrop.model.links.markov import GilbertElliott
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes
from evedrop.model.streams import Batch
from evedrop.scenario.conformance.links import DelayChecks, LossChecks
from evedrop.scenario.conformance.problems import large
from tests.scenario.conformance.breaking import broken


class Better(Bernoulli):
    """Says that it delivers more than it does."""

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """Fewer."""
        return super().fates(first, uniforms / 0.9)


class Unsteady(GilbertElliott):
    """Has bursts, and says that it has none."""

    chain = None  # type: ignore[assignment]  # the lie


class Seesaw(Bernoulli):
    """Is better in every second slot, and says the mean of all slots."""

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """By the slot."""
        odd = np.arange(first, first + len(uniforms)) % 2
        return fates_of(uniforms[:, 0] >= (self.quality + 0.2 - 0.4 * odd)[:, None])


class InPlace(Bernoulli):
    """Counts slots in an array, in place."""

    def __init__(self, quality: float) -> None:
        super().__init__(quality)
        self.count = np.zeros(1)

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """Every third packet of those asked for is lost."""
        lost = np.empty((len(uniforms), uniforms.shape[2]), np.bool_)
        for row in range(len(lost)):
            self.count += 1.0
            lost[row] = (self.count % 3.0 == 0.0).item() | (uniforms[row, 0] >= self.quality)
        del first
        return fates_of(lost)


class Forgetful(Bernoulli):
    """Remembers in place only whether the last packet was lost, which most copies do not show."""

    def __init__(self, quality: float) -> None:
        super().__init__(quality)
        self.lost = np.zeros(1000, np.bool_)

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """After a loss, every second packet is lost."""
        lost, last = np.empty((len(uniforms), uniforms.shape[2]), np.bool_), self.lost[: uniforms.shape[2]]
        for row, numbers in enumerate(uniforms[:, 0]):
            lost[row] = last[:] = numbers >= np.where(last, 0.5, self.quality)
        del first
        return fates_of(lost)


class Whole(Bernoulli):
    """Loses the last of the slots that it is asked for."""

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """By how many they are."""
        codes = super().fates(first, uniforms).copy()
        codes[-1] = 1
        return codes


@pytest.mark.parametrize(
    ("kind", "parameters", "rule", "message"),
    [
        (Better, {"quality": 0.8}, "quality agrees with simulation", "quality_at() says 0.8"),
        (Seesaw, {"quality": 0.7}, "quality agrees with simulation", "slot 0: delivers 0.9"),
        (Unsteady, {"p": 0.05, "r": 0.1}, "quality agrees with simulation", "give `chain`"),
        (InPlace, {"quality": 0.9}, "independent copies", "never change an array of it in place"),
        (Forgetful, {"quality": 0.9}, "independent copies", "a copy made before slot 2"),
        (Whole, {"quality": 0.9}, "blocks of any length", "not on how many slots"),
    ],
)
def test_a_loss_model_that_breaks_a_rule_is_told_which(
    kind: Any, parameters: dict[str, float], rule: str, message: str
) -> None:
    """As a scheme is."""
    assert message in broken(LossChecks(kind, parameters).verdicts())[rule]


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        *[(Bernoulli, {"quality": 1.0 - lost}) for lost in (1e-5, 1e-4, 1e-3, 0.1)],
        *[(GilbertElliott, {"p": p, "r": r}) for p, r in ((1e-4, 0.01), (1e-3, 0.5), (0.001, 0.001), (0.3, 0.3))],
    ],
)
def test_a_right_loss_model_passes_with_any_random_numbers(kind: Any, parameters: dict[str, float]) -> None:
    """Also if losses are rare: if 1 % of all right models failed, one of these would with a probability over 99.9 %."""
    checks, problem = LossChecks(kind, parameters), large()[0]
    for number in range(100):
        checks.rate(replace(problem, batch=Batch(60, 600, 600 * number)))


class Early(Normal):
    """Says that more is there in time than is."""

    def arrived(self, lag: int) -> float | None:
        """As if a slot later."""
        return super().arrived(lag + 1)


class Uneven(DelayModel):
    """Is slow in every second slot, and states the mean of all slots."""

    def delays(self, first: int, numbers: Floats) -> Floats:
        """By the slot."""
        odd = np.arange(first, first + len(numbers)) % 2
        return np.where(numbers < (0.8 - 0.6 * odd)[:, None], 0.5, 3.5)

    def arrived(self, lag: int) -> float | None:
        """Half of them after the first slot."""
        return 0.5 if lag < 3 else 1.0


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        (Early, {"mean": 2.0, "standard_deviation": 1.0}, "and arrived("),
        (Uneven, {}, "return None if slots differ"),
    ],
)
def test_a_delay_model_that_breaks_a_rule_is_told_which(kind: Any, parameters: dict[str, float], message: str) -> None:
    """As a loss model is."""
    assert message in broken(DelayChecks(kind, parameters).verdicts())["delays agree with simulation"]
