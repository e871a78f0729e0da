"""How many messages a link delivers: against measured fates for every model, and against sums over all pairs of messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Fate
from evedrop.model.slot.link import Change
from evedrop.wire.running_link import KeyFates
from evedrop.wire.scorekeeper import bounds, expected
from tests.wire.wire_links import LOSSES, wire_link

SEED = 5
KEYS = 60
POOR: dict[str, Any] = {"loss": LOSSES["gilbert-elliott"], "corrupt": 0.2}
RANGES = (range(100), range(150, 151), range(160, 700), range(800, 2000))


@pytest.mark.parametrize("model", LOSSES)
def test_measured_deliveries(model: str) -> None:
    """The deliveries of all keys together are within the 99 % bounds, and scatter as the distribution says; for every model."""
    settings = {"loss": LOSSES[model], "corrupt": 0.05}
    changes = [Change(900, {"loss": LOSSES[model], "corrupt": 0.3}), Change(1400, POOR)]
    codes = np.empty((KEYS, 2000), np.uint8)
    for key in range(KEYS):
        fates = KeyFates(wire_link(settings), f"key/{key}", "put", SEED, changes=changes)
        codes[key] = [fates.next()[0] for _ in range(2000)]
    for ranges in ([range(2000)], RANGES):
        mean, variance = expected(settings, changes, ranges)
        taken = np.concatenate([np.arange(some.start, some.stop) for some in ranges])
        delivered = (codes[:, taken] == Fate.DELIVERED).sum(axis=1)
        low, high = bounds(KEYS * mean, KEYS * variance, KEYS * len(taken))
        assert low <= delivered.sum() <= high
        spread, wide = float(np.var(delivered)) / variance, 4.0 * math.sqrt(2.0 / KEYS)
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
    assert bounds(500.0, 100.0, 1000) == pytest.approx((500 - 26.258, 500 + 26.258), abs=1e-3)
    assert bounds(0.2, 0.2, 1000)[0] == 0.0
    assert bounds(999.8, 0.2, 1000)[1] == 1000.0
    assert bounds(7.0, 0.0, 10) == pytest.approx((7.0, 7.0), abs=1e-4)
    assert expected({"loss": LOSSES["bernoulli"]}, [], []) == (0.0, 0.0)
