"""How many messages a link delivers: against measured fates for every model, and against sums over all pairs of messages."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Fate
from evedrop.model.process import Floats
from evedrop.model.slot.link import Change
from evedrop.wire.deliveries import KeyDeliveries, bounds, normal_bounds
from tests.examples import mostly_long
from tests.wire.wire_links import LOSSES, key_fates, wire_link

SEED = 5
TRIALS = 10_000
KEYS = 60
POOR: dict[str, Any] = {"loss": LOSSES["gilbert-elliott"], "corrupt": 0.2}
RANGES = (range(100), range(150, 151), range(160, 700), range(800, 2000))


def expected(settings: Mapping[str, Any], changes: Iterable[Change], ranges: Sequence[range]) -> tuple[float, float]:
    """Mean and variance of the messages that get through."""
    stream = KeyDeliveries(settings, changes, ranges)
    return stream.mean, stream.variance


def exact_counts(settings: Mapping[str, Any], changes: Sequence[Change], taken: Sequence[int]) -> Floats:
    """The probability of each number of deliveries of a chain, message by message: over counts and states."""
    chain = loss_of(settings["loss"]).chain
    assert chain is not None
    odds = np.zeros((len(taken) + 1, len(chain.stationary)))
    odds[0], at = chain.stationary, taken[0]
    for n in taken:
        odds = odds @ np.linalg.matrix_power(chain.transitions, n - at)
        corrupt = next((change.settings for change in changes[::-1] if change.at <= n), None) or settings
        quality = chain.quality * (1.0 - corrupt.get("corrupt", 0.0))
        through = odds * quality
        odds = odds * (1.0 - quality)
        odds[1:] += through[:-1]
        at = n
    counts: Floats = odds.sum(axis=1)
    return counts


def between(counts: Floats) -> tuple[int, int]:
    """The bounds of 99 % of a distribution."""
    odds = np.cumsum(counts)
    return int(np.searchsorted(odds, 0.005, side="right")), int(np.searchsorted(odds, 0.995))


@pytest.mark.parametrize("count", [5, 162, 700])
@pytest.mark.parametrize("model", ["bernoulli", "gilbert-elliott", "markov"])
def test_bounds_of_a_chain_are_those_of_its_distribution(model: str, count: int) -> None:
    """Message by message, with gaps and corruption that changes; of one key, and of three added up."""
    settings = {"loss": LOSSES[model], "corrupt": 0.05}
    changes = [Change(count // 2, {"loss": LOSSES[model], "corrupt": 0.3})]
    ranges = [range(1, count // 3 + 1), range(count // 3 + 2, count)]
    counts = exact_counts(settings, changes, [n for some in ranges for n in some])
    stream, number = KeyDeliveries(settings, changes, ranges), sum(map(len, ranges))
    assert bounds([stream], number) == between(counts)
    other = KeyDeliveries(settings, [], [range(count)])
    both = np.convolve(np.convolve(counts, counts), exact_counts(settings, [], range(count)))
    assert bounds([stream, stream, other], 2 * number + count) == between(both)


@pytest.mark.parametrize("count", mostly_long([20, 162, 1000], [20, 162]))
@pytest.mark.parametrize("keys", [1, 3])
@pytest.mark.parametrize("model", LOSSES)
def test_at_most_one_wire_of_two_hundred_is_below_its_bounds_and_as_many_above(
    model: str, keys: int, count: int
) -> None:
    """Of 10,000 wires, with 4.5 standard errors; the bounds are no wider than that asks for."""
    settings = {"loss": LOSSES[model]}
    rng, delivered = np.random.default_rng(SEED), np.zeros(TRIALS, np.int64)
    for _ in range(keys):
        loss = loss_of(settings["loss"])
        for first in range(0, count, 20):
            uniforms = rng.random((20, loss.uniforms_per_slot, TRIALS))
            delivered += (loss.fates(first, uniforms)[: count - first] == Fate.DELIVERED).sum(axis=0)
    low, high = bounds([KeyDeliveries(settings, [], [range(count)])] * keys, keys * count)
    most = 0.005 + 4.5 * math.sqrt(0.005 * 0.995 / TRIALS)
    assert (delivered < low).mean() <= most
    assert (delivered > high).mean() <= most
    least = 0.005 - 4.5 * math.sqrt(0.005 * 0.995 / TRIALS)
    if np.ptp(delivered):
        assert (delivered <= low).mean() >= least
        assert (delivered >= high).mean() >= least


@pytest.mark.parametrize("burst", [4, 300])
def test_bounds_of_many_messages_are_those_of_the_distribution_to_a_twentieth(burst: int) -> None:
    """Where the counts have a grid: against the same chain's distribution, message by message."""
    settings = {"loss": {"model": "gilbert-elliott", "p": 1.0 / (9 * burst), "r": 1.0 / burst}}
    stream = KeyDeliveries(settings, [], [range(6000)])
    assert stream.variance > 0.0
    apart = np.subtract(bounds([stream], 6000), between(exact_counts(settings, [], range(6000))))
    assert np.abs(apart).max() <= max(1.0, 0.05 * math.sqrt(stream.variance))


def test_bounds_of_short_runs_in_bursts_hold() -> None:
    """A tenth lost, four at a time: a normal variable's lower bound would be missed by two wires of a hundred."""
    stream = KeyDeliveries({"loss": {"model": "gilbert-elliott", "p": 0.0278, "r": 0.25}}, [], [range(162)])
    low, high = bounds([stream], 162)
    assert (low, high) == between(
        exact_counts({"loss": {"model": "gilbert-elliott", "p": 0.0278, "r": 0.25}}, [], range(162))
    )
    assert low < normal_bounds(stream.mean, stream.variance, 162)[0] - 3.0


def test_bounds_without_a_distribution_are_those_of_a_normal_variable() -> None:
    """A chain of many states, and a sample."""
    many = np.full((9, 9), 1.0 / 9.0)
    for stream in (
        KeyDeliveries({"loss": {"model": "markov", "transitions": many.tolist(), "loss": [0.5] * 9}}, [], [range(100)]),
        KeyDeliveries({"loss": LOSSES["bernoulli"]}, [], [range(200)], [100]),
    ):
        assert bounds([stream], 100) == normal_bounds(stream.mean, stream.variance, 100)


@pytest.mark.parametrize("model", LOSSES)
def test_measured_deliveries(model: str) -> None:
    """The deliveries of all keys together are within the 99 % bounds, and scatter as the distribution says; for every model."""
    settings = {"loss": LOSSES[model], "corrupt": 0.05}
    changes = [Change(900, {"loss": LOSSES[model], "corrupt": 0.3}), Change(1400, POOR)]
    codes = np.empty((KEYS, 2000), np.uint8)
    for key in range(KEYS):
        fates = key_fates(wire_link(settings), f"key/{key}", "put", SEED, changes=changes)
        codes[key] = [fates.next()[0] for _ in range(2000)]
    for ranges in ([range(2000)], RANGES):
        stream = KeyDeliveries(settings, changes, ranges)
        taken = np.concatenate([np.arange(some.start, some.stop) for some in ranges])
        delivered = (codes[:, taken] == Fate.DELIVERED).sum(axis=1)
        low, high = bounds([stream] * KEYS, KEYS * len(taken))
        assert low <= delivered.sum() <= high
        spread, wide = float(np.var(delivered)) / stream.variance, 4.0 * math.sqrt(2.0 / KEYS)
        assert spread < 1.0 + wide
        if loss_of(LOSSES[model]).chain is not None or len(ranges) == 1:
            assert spread > 1.0 - wide


@pytest.mark.parametrize("model", ["bernoulli", "gilbert-elliott", "markov"])
def test_variance_of_a_chain_with_gaps(model: str) -> None:
    """It is the sum of the covariances of all pairs of messages, with powers of the transitions; to 1e-9."""
    chain = loss_of(LOSSES[model]).chain
    assert chain is not None
    settings = {"loss": LOSSES[model], "corrupt": 0.05}
    changes = [Change(40, {"loss": LOSSES[model], "corrupt": 0.5}), Change(45, {"loss": LOSSES[model]})]
    ranges = (range(3, 10), range(17, 18), range(30, 50))
    taken = [n for some in ranges for n in some]
    passes = [0.95 if n < 40 else 0.5 if n < 45 else 1.0 for n in taken]
    mean = float(chain.stationary @ chain.quality)
    total = 0.0
    for i, p in zip(taken, passes, strict=True):
        for j, q in zip(taken, passes, strict=True):
            if i == j:
                total += p * mean * (1.0 - p * mean)
            else:
                ahead = np.linalg.matrix_power(chain.transitions, abs(i - j))
                both = float((chain.stationary * chain.quality) @ ahead @ chain.quality)
                total += p * q * (both - mean * mean)
    result = expected(settings, changes, ranges)
    assert result[0] == pytest.approx(mean * sum(passes), rel=1e-12)
    assert result[1] == pytest.approx(total, rel=1e-9)


def test_variance_of_a_recording_that_begins_anywhere() -> None:
    """For one range it is that over all places where the recording may begin; with gaps it is at least that."""
    outcomes = "1110010" * 3 + "0000"
    settings = {"loss": {"model": "trace", "outcomes": outcomes, "random_start": True}, "corrupt": 0.4}
    for ranges in ([range(5, 19)], [range(3), range(24, 28), range(40, 41)]):
        counts = [
            sum(int(outcomes[(n + begin) % len(outcomes)]) for some in ranges for n in some)
            for begin in range(len(outcomes))
        ]
        exact = 0.6**2 * float(np.var(counts)) + 0.6 * 0.4 * float(np.mean(counts))
        mean, variance = expected(settings, [], ranges)
        assert mean == pytest.approx(0.6 * float(np.mean(counts)))
        if len(ranges) == 1:
            assert variance == pytest.approx(exact)
        else:
            assert variance > exact


def test_a_sample_of_messages_that_are_never_lost_does_not_vary() -> None:
    """The mean of 7 of 25 messages is rounded to more than 7, which once gave a variance below 0, and ended the wire."""
    sample = KeyDeliveries({"loss": {"model": "bernoulli", "quality": 1.0}}, [], [range(25)], [7])
    assert bounds([sample], 7) == pytest.approx((7.0, 7.0), abs=1e-4)


@pytest.mark.parametrize("taken", ["at random", "in turn", "later fewer"])
@pytest.mark.parametrize("model", ["bernoulli", "gilbert-elliott"])
def test_bounds_of_samples_hold(model: str, taken: str) -> None:
    """Of 4000 wires whose losses change half way, 99 % are within them; they scatter at least as the sample's variance says."""
    count, wires, rng = 2000, 4000, np.random.default_rng(SEED)
    first, second = ({"loss": LOSSES[name]} for name in (model, "markov"))
    passed = np.empty((count, wires), np.bool_)
    for begin, settings in ((0, first), (count // 2, second)):
        loss = loss_of(settings["loss"])
        for start in range(begin, begin + count // 2, 20):
            passed[start : start + 20] = loss.fates(start, rng.random((20, loss.uniforms_per_slot, wires))) == 0
    n = np.arange(count)
    numbers = {
        "at random": np.flatnonzero(rng.random(count) < 0.4),
        "in turn": n[::3],
        "later fewer": n[(n < count // 2) | (n % 5 == 0)],
    }[taken]
    ranges, counts = [], []
    for start in range(0, count, 50):
        within = numbers[(numbers >= start) & (numbers < start + 50)]
        ranges.append(range(int(within[0]), int(within[-1]) + 1))
        counts.append(len(within))
    stream = KeyDeliveries(first, [Change(count // 2, second)], ranges, counts)
    delivered = passed[numbers].sum(axis=0)
    assert stream.mean == pytest.approx(delivered.mean(), abs=4.5 * math.sqrt(stream.variance / wires))
    low, high = bounds([stream], len(numbers))
    assert ((low <= delivered) & (delivered <= high)).mean() >= 0.99 - 4.5 * math.sqrt(0.01 / wires)
    assert 0.9 < stream.variance / float(np.var(delivered)) < 1.5


def test_a_change_of_the_loss_model_begins_a_new_memory() -> None:
    """Variances on both sides add up; a change of something else leaves them tied."""
    bursts = {"loss": LOSSES["gilbert-elliott"]}
    whole = expected(bursts, [], [range(100)])
    other = expected(bursts, [], [range(500, 600)])
    between = [Change(100, {"loss": LOSSES["pattern"]}), Change(500, bursts)]
    apart = expected(bursts, between, [range(100), range(500, 600)])
    assert apart == pytest.approx((whole[0] + other[0], whole[1] + other[1]))
    tied = expected(bursts, [Change(100, {**bursts, "duplicate": 0.5})], [range(200)])
    assert tied == pytest.approx(expected(bursts, [], [range(200)]))
    assert tied[1] > 1.01 * (whole[1] + other[1])


def test_many_messages() -> None:
    """The numbers of messages of a day's traffic take no time and no memory."""
    day = 4_000_000_000
    mean, variance = expected({"loss": LOSSES["gilbert-elliott"]}, [], [range(day)])
    rate = expected({"loss": LOSSES["gilbert-elliott"]}, [], [range(1)])[0]
    assert mean == pytest.approx(rate * day)
    million = expected({"loss": LOSSES["gilbert-elliott"]}, [], [range(1_000_000)])[1]
    assert variance == pytest.approx(day / 1_000_000 * million, rel=1e-3)


def test_bounds() -> None:
    """They hold 99 % of a normal distribution, stay within the possible counts, and meet where nothing is random."""
    assert normal_bounds(500.0, 100.0, 1000) == pytest.approx((500 - 26.258, 500 + 26.258), abs=1e-3)
    assert normal_bounds(0.2, 0.2, 1000)[0] == 0.0
    assert normal_bounds(999.8, 0.2, 1000)[1] == 1000.0
    assert normal_bounds(7.0, 0.0, 10) == pytest.approx((7.0, 7.0), abs=1e-4)
    assert expected({"loss": LOSSES["bernoulli"]}, [], []) == (0.0, 0.0)
