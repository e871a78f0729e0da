"""Losses by distance: against a slot-by-slot reference, the exact quality of every slot, and how rates scatter."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad

from evedrop.model.links import loss_of
from evedrop.model.links.distance import Distance, delivery_probability
from evedrop.model.links.loss_model import Fate
from evedrop.model.links.way import Way
from evedrop.model.streams import Stream, root_of_seed, stream_key, uniforms
from tests.examples import examples

KEY = stream_key(root_of_seed(31), "link/eve")
STANDS: dict[str, Any] = {
    "model": "distance",
    "sender": [0.0, 0.0],
    "receiver": [100.0, 20.0],
    "reference_snr": 75.0,
    "exponent": 3.0,
    "threshold": 10.0,
}
WALKS = {**STANDS, "receiver": [[5, 60.0, 0.0], [40, 60.0, 100.0], [90, -200.0, 5.0]]}
PASSES = {**WALKS, "sender": [[0, 0.0, 50.0], [60, 60.0, 50.0]], "reference_distance": 20.0, "reference_snr": 25.0}
SHADOWED = {"shadowing": 7.0, "shadowing_block": 12}


def drawn(slots: range, trials: int) -> np.ndarray[Any, Any]:
    """The link's uniforms, (slots, 2, trials)."""
    return uniforms(Stream(KEY, range(trials), 2).words(slots)).transpose(0, 2, 1)


def place(given: list[Any], k: int) -> tuple[float, float]:
    """Where one is in slot k."""
    rows = given if isinstance(given[0], list) else [[0, *given]]
    slots = [row[0] for row in rows]
    x, y = (float(np.interp(k, slots, [row[i] for row in rows])) for i in (1, 2))
    return x, y


def snr(spec: dict[str, Any], u: np.ndarray[Any, Any], k: int, first: int) -> float:
    """The signal-to-noise ratio in dB of slot k in one trial, whose uniforms are (slots, 2) from `first` on."""
    nearest = spec.get("reference_distance", 1.0)
    d = max(math.dist(place(spec["sender"], k), place(spec["receiver"], k)), nearest)
    fading, shadowing = (
        u[max(first, k - k % spec.get(name, 1)) - first, column]
        for column, name in enumerate(("fading_block", "shadowing_block"))
    )
    power = -math.log1p(-fading)
    z = stats.norm.ppf((math.floor(shadowing * 2**52) + 0.5) / 2**52)
    decibels = (
        spec["reference_snr"] - 10.0 * spec["exponent"] * math.log10(d / nearest) + spec.get("shadowing", 0.0) * z
    )
    return decibels + 10.0 * math.log10(power) if power > 0.0 else -math.inf


@settings(deadline=None, max_examples=examples(50))
@given(
    spec=st.sampled_from([STANDS, WALKS, PASSES]),
    shadowing=st.sampled_from([0.0, 0.5, 7.0, 30.0]),
    blocks=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    first=st.integers(0, 60),
    slots=st.integers(1, 50),
    data=st.data(),
)
def test_fates_are_those_of_the_textbook(
    spec: dict[str, Any], shadowing: float, blocks: tuple[int, int], first: int, slots: int, data: st.DataObject
) -> None:
    """Decibels added up in each slot are above the threshold where a packet is delivered, however slots are asked for."""
    whole = {**spec, "shadowing": shadowing, "shadowing_block": blocks[0], "fading_block": blocks[1]}
    u, model, parts, start = drawn(range(first, first + slots), 3), loss_of(whole), [], 0
    while start < slots:
        stop = data.draw(st.integers(start + 1, slots))
        parts.append(model.fates(first + start, u[start:stop]))
        start = stop
    delivered = np.concatenate(parts) == Fate.DELIVERED
    for k in range(slots):
        for r in range(3):
            above = snr(whole, u[:, :, r], first + k, first) - whole["threshold"]
            assert abs(above) < 1e-9 or delivered[k, r] == (above > 0.0)


def test_uniforms_that_are_zero_are_fates_too() -> None:
    """The smallest random number gives no power at all, which is a loss, and the least shadowing."""
    assert loss_of({**STANDS, **SHADOWED}).fates(0, np.zeros((1, 2, 1))).tolist() == [[Fate.LOST]]


@pytest.mark.parametrize("spec", [STANDS, WALKS, PASSES], ids=["stands", "walks", "passes"])
@pytest.mark.parametrize("shadow", [{}, SHADOWED, {**SHADOWED, "fading_block": 3}], ids=["clear", "shadowed", "slow"])
def test_a_million_packets_have_the_quality_of_their_slots(spec: dict[str, Any], shadow: dict[str, Any]) -> None:
    """In each of 100 slots 10⁴ trials are delivered as `quality_at` says, at 1e-6 confidence for all of them together."""
    loss, slots, trials = loss_of({**spec, **shadow}), 100, 10_000
    delivered = (loss.fates(0, drawn(range(slots), trials)) == Fate.DELIVERED).sum(axis=1)
    quality = loss.quality_at(range(slots))
    off = (delivered - trials * quality) / np.sqrt(trials * quality * (1.0 - quality) + 1e-12)
    assert np.abs(off).max() < 5.7


@pytest.mark.parametrize("standard_deviation", [0.0, 0.1, 1.0, 2.3, 6.9])
def test_the_quality_is_exact(standard_deviation: float) -> None:
    """Compared with adaptive integration over the shadowing, standard deviations in nepers up to those of 30 dB: within 1e-11."""
    for middle in np.linspace(-6.0 * standard_deviation - 2.0, 4.0 * standard_deviation + 2.0, 9):
        needed = math.exp(middle)
        if standard_deviation == 0.0:
            expected = math.exp(-needed)
        else:
            knee = float(np.clip(middle / standard_deviation, -8.5, 8.5))
            expected = quad(
                lambda z, c=needed: math.exp(-c * math.exp(-standard_deviation * z)) * stats.norm.pdf(z),
                -9.0, 9.0, points=sorted({-8.9, knee, 8.9}), limit=500, epsabs=1e-14,
            )[0]  # fmt: skip
        assert delivery_probability(np.array([needed]), standard_deviation)[0] == pytest.approx(expected, abs=1e-11)


@pytest.mark.parametrize(
    "more",
    [
        pytest.param({}, id="memoryless", marks=pytest.mark.long),
        pytest.param({"fading_block": 7}, id="slow fading", marks=pytest.mark.long),
        pytest.param(SHADOWED, id="shadowed", marks=pytest.mark.long),
        pytest.param({**SHADOWED, "fading_block": 3}, id="both"),
        pytest.param({**SHADOWED, "shadowing_block": 500}, id="one block", marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("spec", [STANDS, WALKS], ids=["stands", "walks"])
@pytest.mark.thorough
def test_rates_scatter_as_they_must(spec: dict[str, Any], more: dict[str, Any]) -> None:
    """The variance of 20 000 trials' rates is that of the formula, at 1e-6 confidence by its own standard error."""
    loss, slots, trials = loss_of({**spec, **more}), range(3, 133), 20_000
    rates = (loss.fates(0, drawn(range(slots.stop), trials))[slots.start :] == Fate.DELIVERED).mean(axis=0)
    centred = rates - rates.mean()
    variance = float((centred**2).mean())
    error = math.sqrt((float((centred**4).mean()) / variance**2 - 1.0) / trials)
    assert abs(variance / loss.rate_variance(slots) - 1.0) < 4.9 * error
    assert loss.memoryless == (more == {})


def test_the_variance_of_parts_adds_up() -> None:
    """Blocks of shadowing are independent: over whole blocks the counts' variances add, standing as walking."""
    for spec in (STANDS, WALKS):
        loss = loss_of({**spec, **SHADOWED, "fading_block": 4})
        parts = [loss.rate_variance(range(k, k + 12)) * 12**2 for k in range(0, 240, 12)]
        assert loss.rate_variance(range(240)) * 240**2 == pytest.approx(sum(parts), rel=1e-12)
    day = loss_of({**STANDS, **SHADOWED})
    assert day.rate_variance(range(86_400_000)) == pytest.approx(day.rate_variance(range(12)) / 7_200_000, rel=1e-9)


def test_blocks_that_do_not_nest_have_a_bound() -> None:
    """Shadowing of 4 slots and fading of 6: above the variance that is found, below that of everything held for 12."""
    spec = {**STANDS, "shadowing": 7.0, "shadowing_block": 4, "fading_block": 6}
    rates = (loss_of(spec).fates(0, drawn(range(120), 20_000)) == Fate.DELIVERED).mean(axis=0)
    held = loss_of({**spec, "shadowing_block": 12, "fading_block": 12})
    assert float(rates.var()) < loss_of(spec).rate_variance(range(120)) < held.rate_variance(range(120))


def test_the_mean_quality_is_that_of_the_walk() -> None:
    """Of a receiver at rest it is that of every slot; of a moving one, that of the slots up to the last waypoint."""
    for spec, slots in ((STANDS, 1), (WALKS, 91)):
        loss = loss_of({**spec, **SHADOWED})
        assert loss.quality == pytest.approx(float(loss.quality_at(range(slots)).mean()), rel=1e-12)
    far = loss_of({**STANDS, "receiver": [[0, 1e3, 0.0], [10**9, 0.0, 1e3]]})
    assert 0.0 < far.quality < 1.0


def test_links_with_the_same_uniforms_fade_alike() -> None:
    """Of two receivers behind one another the nearer one gets all that the farther one gets."""
    u = drawn(range(50), 200)
    near, far = (
        loss_of({**STANDS, **SHADOWED, "receiver": [x, 0.0]}).fates(0, u) == Fate.DELIVERED for x in (90.0, 130.0)
    )
    assert (near | ~far).all()
    assert near.sum() > far.sum()


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 50), st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=1, max_size=6))
def test_ways_are_straight_between_waypoints(rows: list[tuple[int, float, float]]) -> None:
    """As numpy interpolates: standing before the first and after the last."""
    ordered = sorted({row[0]: list(row) for row in rows}.values())
    slots = np.arange(60.0)
    for axis, coordinate in enumerate(Way(ordered).at(slots), 1):
        expected = np.interp(slots, [row[0] for row in ordered], [row[axis] for row in ordered])
        np.testing.assert_allclose(coordinate, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "entry", "message"),
    [
        ({"sender": 3}, "sender", "is 3; expected a position [x, y] in metres, or waypoints [[slot, x, y], …]"),
        ({"sender": []}, "sender", "is []; expected a position"),
        ({"sender": [1.0]}, "sender", "is [1.0]; expected a position"),
        ({"sender": ["a", 1.0]}, "sender", 'is ["a", 1.0]; expected a position'),
        ({"receiver": [1e10, 0.0]}, "receiver", "is [10000000000.0, 0.0]; expected a position"),
        ({"receiver": [[0, 1.0]]}, "receiver", "waypoint 0 is [0, 1.0]; expected [slot, x, y], a whole number from 0"),
        ({"receiver": [[0.5, 1.0, 2.0]]}, "receiver", "waypoint 0 is [0.5, 1.0, 2.0]; expected [slot, x, y]"),
        ({"receiver": [[0, 1, 2], 3]}, "receiver", "waypoint 1 is 3; expected [slot, x, y]"),
        ({"receiver": [[4, 1, 2], [4, 5, 6]]}, "receiver", "waypoint 1 is of slot 4, not after slot 4; expected slots"),
        ({"receiver": [[k, 1, 2] for k in range(10_001)]}, "receiver", "has 10001 waypoints; expected at most 10000"),
        ({"receiver": [0, 0.0]}, "receiver", "is where the sender is, in slot 0; expected another place"),
        ({"receiver": [[2, 9.0, 9.0], [7, 0.0, 0.0]]}, "receiver", "is where the sender is, in slot 7"),
        ({"reference_snr": "loud"}, "reference_snr", 'is "loud"; expected a number from -300 to 300'),
        ({"exponent": -1.0}, "exponent", "is -1.0; expected a number from 0 to 10"),
        ({"threshold": math.nan}, "threshold", "is nan; expected a number from -300 to 300"),
        ({"reference_distance": 0.0}, "reference_distance", "is 0.0; expected a number from 0.001 to 1000000000"),
        ({"shadowing": 31}, "shadowing", "is 31; expected a number from 0 to 30"),
        ({"shadowing_block": 0}, "shadowing_block", "is 0; expected a whole number of slots from 1 to 1000000"),
        ({"fading_block": 2.0}, "fading_block", "is 2.0; expected a whole number of slots from 1 to 1000000"),
    ],
)
def test_a_mistake_is_named(changes: dict[str, Any], entry: str, message: str) -> None:
    """One mistake, at its entry, with what was found and what was expected."""
    given = {name: value for name, value in {**STANDS, **changes}.items() if name != "model"}
    ((place, sentence),) = Distance.mistakes(given)
    assert place == entry
    assert sentence.startswith(message)


def test_all_mistakes_are_named_at_once() -> None:
    """Each entry that is wrong, and what is missing hides nothing."""
    given = {"sender": 0, "receiver": [[1, 2, 3], [0, 2, 3]], "exponent": True, "fading_block": 0}
    assert [entry for entry, _ in Distance.mistakes(given)] == ["sender", "receiver", "exponent", "fading_block"]
    assert Distance.mistakes(dict(Distance.parameters)) == []
