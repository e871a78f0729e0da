"""A μ_d for each slot of a run: the schedule, the scheme, the eavesdroppers that know it, and the expectations."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.checks import probabilities_mistakes
from evedrop.model.eavesdroppers import READERS
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge
from evedrop.model.links import loss_of
from evedrop.model.modulated import ModulatedCovariance
from evedrop.model.outcomes import eavesdropper_outcomes, legitimate_outcomes
from evedrop.model.receiver import Belief, Reception
from evedrop.model.schedule import Schedule, equal_slots, in_slot, in_slots, mean_of
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.slot.link_distribution import LinkDistribution
from evedrop.model.streams import Batch
from evedrop.model.theory.schedules import SlotRecursion
from tests.builders import MARGINAL, UNSTABLE, stream_keys

MU_D = (1.0, 0.0, 0.0, 0.3, 0.3, 0.9, 1.0, 0.2)
SLOTS, MU = len(MU_D), 0.85
KEYS = stream_keys(4, ("schedule", "noise", "coin"))
PARAMETERS: dict[str, dict[str, Any]] = {"suspicious": {"use_state": 0.8, "use_innovation": 0.3}}
KNOWING = ("smart", "suspicious", "genie", "bayesian", "likelihood")


def knowledge_of(name: str, mu_d: float | tuple[float, ...]) -> Knowledge:
    """The knowledge of an eavesdropper, whether μ_d differs or not."""
    of_slots = mu_d if isinstance(mu_d, tuple) else None
    return Knowledge(MARGINAL, mean_of(mu_d), PARAMETERS.get(name, {}), KEYS, of_slots)


def test_types_are_drawn_by_the_probability_of_their_slot() -> None:
    """Each slot's packets are those of a schedule with that μ_d in all slots, one by one and in blocks."""
    batch = Batch(SLOTS + 3, 200)
    block = Schedule(KEYS["schedule"], MU_D, batch).block(range(SLOTS + 3))
    single = Schedule(KEYS["schedule"], MU_D, batch)
    for k in range(SLOTS + 3):
        # The last number holds for later slots, which a dry run may have.
        alike = Schedule(KEYS["schedule"], MU_D[min(k, SLOTS - 1)], batch).at(k)
        assert np.array_equal(block[k], alike)
        assert np.array_equal(single.at(k), alike)


def test_the_mean_leaves_out_the_first_slot() -> None:
    """The packet of slot 0 is the state whatever its number says; a list for one slot has a mean all the same."""
    assert mean_of(MU_D) == pytest.approx(np.mean(MU_D[1:]))
    assert mean_of((0.5,)) == 0.5
    assert mean_of(0.3) == 0.3
    assert in_slots(0.3, range(2, 5)).tolist() == [0.3] * 3
    assert in_slots(MU_D, range(2, 5)).tolist() == [0.0, 0.3, 0.3]


@settings(deadline=None)
@given(st.lists(st.sampled_from([0.0, 0.3, 1.0]), min_size=1, max_size=12), st.integers(0, 6), st.integers(0, 12))
def test_parts_of_equal_probability_are_all_slots_in_order(numbers: list[float], first: int, count: int) -> None:
    """They cover the slots, each has one μ_d, and neighbours differ."""
    mu_d, slots = tuple(numbers), range(first, first + count)
    parts = equal_slots(mu_d, slots)
    assert [k for part in parts for k in part] == list(slots)
    values = [{in_slot(mu_d, k) for k in part} for part in parts if part]
    assert all(len(part) == 1 for part in values)
    assert all(part != other for part, other in pairwise(values))
    assert equal_slots(0.5, slots) == [slots]


def followed(eavesdropper: Eavesdropper, slots: range, belief: Belief, heard: list[Reception]) -> list[Belief]:
    """Its beliefs, slot by slot."""
    followed = []
    for k in slots:
        belief = eavesdropper.step(k, belief, heard[k])
        followed.append(belief)
    return followed


@pytest.mark.parametrize("name", KNOWING)
def test_eavesdroppers_use_the_probability_of_the_slot(name: str) -> None:
    """In every slot an eavesdropper does what it would do with that μ_d in all slots, from the same belief."""
    batch, rng = Batch(SLOTS, 40), np.random.default_rng(2)
    heard = [Reception(rng.random(40) < MU, rng.standard_normal((2, 40))) for _ in range(SLOTS)]
    reader = READERS[name](knowledge_of(name, MU_D), batch)
    beliefs = [reader.prior(), *followed(reader, range(SLOTS), reader.prior(), heard)]
    for k in range(SLOTS):
        alike = READERS[name](knowledge_of(name, MU_D[k]), batch)
        (after,) = followed(alike, range(k, k + 1), beliefs[k], heard)
        assert np.array_equal(after.x_hat, beliefs[k + 1].x_hat)
        assert np.array_equal(after.P, beliefs[k + 1].P)
    at_once, _ = READERS[name](knowledge_of(name, MU_D), batch).follow(
        range(SLOTS), reader.prior(), np.array([h.gamma for h in heard]), np.array([h.z for h in heard])
    )
    assert np.array_equal(at_once.P, np.array([belief.P for belief in beliefs[1:]]))


@pytest.mark.parametrize("reader", ["legitimate", "smart", "naive", "suspicious", "genie"])
def test_expectations_are_those_of_the_design(reader: str) -> None:
    """Behind independent losses the expectations of a run are those that `design --schedule` computes for it."""
    scheme = Innovation(UNSTABLE, MU_D)

    def outcomes_in(innovation: Innovation) -> Any:
        if reader == "legitimate":
            return legitimate_outcomes(innovation)
        return eavesdropper_outcomes(innovation, reader, PARAMETERS.get(reader, {}))

    distribution = LinkDistribution.steady(loss_of({"model": "bernoulli", "quality": MU}).chain)  # type: ignore[arg-type]
    in_slot: Any = scheme.in_slot
    covariance = ModulatedCovariance(UNSTABLE, distribution, outcomes_in(scheme), lambda k: outcomes_in(in_slot(k)))
    expected = SlotRecursion(UNSTABLE, lambda mu_d: outcomes_in(Innovation(UNSTABLE, mu_d))(MU), SLOTS)
    assert np.allclose(covariance.next_traces(SLOTS), expected.traces(np.array([MU_D]))[0], rtol=1e-12)


def test_a_scheme_with_one_probability_is_its_own_in_every_slot() -> None:
    """Otherwise it has the slot's number; the scheme itself states the mean over the slots."""
    constant, changing = Innovation(UNSTABLE, 0.4), Innovation(UNSTABLE, list(MU_D))
    assert constant.in_slot(3) is constant
    assert [changing.in_slot(k).state_probability for k in range(SLOTS)] == list(MU_D)
    assert changing.outcomes(0.5) == Innovation(UNSTABLE, mean_of(MU_D)).outcomes(0.5)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([0.1, 1.0, 0, 1], None),
        (0.3, None),
        ([], "is an empty list"),
        ([0.1, 1.5], "is 1.5 for slot 1"),
        ([True], "is true for slot 0"),
        ("x", "expected a number from 0 to 1"),
    ],
)
def test_mistakes_in_lists(value: Any, message: str | None) -> None:
    """A number or a list of numbers is accepted, and a mistake names its slot."""
    result = probabilities_mistakes({"it": value}, "it")
    assert (not result) if message is None else (message in result[0][1])
