"""How often a verdict on secrecy is in error, over many studies of scenarios whose truth is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from evedrop.model.process import Floats
from evedrop.scenario.loading import checked
from evedrop.score.after_start import ERROR_RATE
from evedrop.score.secrecy import Claim, SignTestOf, relative_verdict, sign_of_mean, sign_of_median
from evedrop.score.sums import WINDOWS, merged, window_means
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import TrialsTask, carry_out
from tests.builders import MARGINAL, process_table

TRIALS, SLOTS = 200, 81
SURE = 1e-6
"""How often a test of this file may fail although the rates are as promised."""


@cache
def differences(studies: int) -> Floats:
    """Errors of an eavesdropper less those of the estimator, window by window and trial by trial, (studies, WINDOWS, TRIALS).

    Both have the same link quality, and every packet is a state: their errors have the same distribution, and depend on each
    other because the process is one.
    """
    scenario = checked(
        {
            "title": "alike",
            "slots": SLOTS,
            "seed": 11,
            "trials": studies * TRIALS,
            "process": process_table(MARGINAL),
            "encoding": {"scheme": "plain"},
            "legitimate": {"link": {"quality": 0.7}},
            "eavesdroppers": {"alike": {"strategy": "naive", "link": {"quality": 0.7}}},
        },
        "alike",
    )
    parts = []
    for start in range(0, scenario.trials, 2000):
        task = TrialsTask(scenario.model_dump(mode="json"), start, min(start + 2000, scenario.trials), Mode.EXACT)
        tallies = [block.run_tally.tallies for block in carry_out(task, lambda _: None, lambda: False).blocks]
        legitimate, other = (merged([tally[name] for tally in tallies]) for name in ("legitimate", "alike"))
        parts.append(window_means(other) - window_means(legitimate))
    whole = np.concatenate(parts, axis=1)
    return whole.reshape(WINDOWS, studies, TRIALS).swapaxes(0, 1)


def counted(verdicts: list[Claim]) -> dict[Claim, int]:
    """How often each verdict was reached."""
    return {verdict: verdicts.count(verdict) for verdict in Claim}


def most(studies: int) -> int:
    """The most errors in this many studies, at the promised rate."""
    return int(binom.ppf(1.0 - SURE, studies, ERROR_RATE))


STUDIES = pytest.mark.parametrize("studies", [200, pytest.param(1000, marks=pytest.mark.long)])


@pytest.mark.thorough
@STUDIES
@pytest.mark.parametrize("test", [sign_of_mean, sign_of_median])
def test_failed_is_said_in_error_no_more_often_than_promised(studies: int, test: SignTestOf) -> None:
    """Without a difference in any window; with the whole rate for each window, 1000 studies would have too many."""
    samples = differences(studies)
    result = counted([relative_verdict(sample, test, SLOTS)[0] for sample in samples])
    assert result[Claim.FAILED] <= most(studies)
    assert result[Claim.HELD] <= most(studies)
    alone = sum(any(test(row).below <= ERROR_RATE for row in sample) for sample in samples)
    assert alone > result[Claim.FAILED]
    if studies == 1000:
        assert alone > most(studies)
        low, high = binomtest(result[Claim.FAILED], studies).proportion_ci(0.999)
        assert low <= ERROR_RATE <= high


@STUDIES
def test_held_is_said_in_error_no_more_often_than_promised(studies: int) -> None:
    """Without a difference in one window, and with a large one in all others: the worst case for this claim."""
    samples = differences(studies).copy()
    samples[:, 1:] += 1.0
    result = counted([relative_verdict(sample, sign_of_mean, SLOTS)[0] for sample in samples])
    assert 0 < result[Claim.HELD] <= most(studies)
    assert result[Claim.FAILED] <= binom.ppf(1.0 - SURE, studies, ERROR_RATE / WINDOWS)
