"""The expected error of each trial given what happened to its packets, and the probability of its actual error."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Codes
from evedrop.scenario.loading import load
from evedrop.score.conditional import ConditionalError, conditional_error_of
from evedrop.simulate.simulation import Simulation
from tests.builders import MARGINAL, UNSTABLE

SLOTS, TRIALS = 40, 4000


def actions(seed: int, trials: int = TRIALS) -> Codes:
    """States, innovations, losses and discarded packets."""
    codes: Codes = np.random.default_rng(seed).choice(4, (SLOTS, trials), p=[0.3, 0.3, 0.2, 0.2]).astype(np.uint8)
    return codes


def errors(process: Process, action: Codes, seed: int) -> Floats:
    """The sum of squared errors of each trial, simulated error by error, (R,)."""
    A, Q, start = process.A, process.Q, process.initial_covariance
    rng, trials = np.random.default_rng(seed), action.shape[1]
    e, total = np.zeros((len(A), trials)), np.zeros(trials)
    for k, codes in enumerate(action):
        noise = np.linalg.cholesky(Q if k else start) @ rng.standard_normal((len(A), trials))
        e = A @ e + np.where((codes == Action.INNOVATION) & (k > 0), 0.0, noise)
        e = np.where(codes == Action.STATE, 0.0, e)
        total += (e * e).sum(axis=0)
    return total


@pytest.mark.parametrize("process", [MARGINAL, UNSTABLE], ids=["marginal", "unstable"])
def test_probabilities_are_not_too_small(process: Process) -> None:
    """Simulated errors are in the tails no more often than their probability says, and in wide ones nearly as often.

    Exceeded by 4.5 standard errors of the count of trials with a probability of about 1 in 150 000.
    """
    action = actions(1)
    own = ConditionalError(process, process.initial_covariance, TRIALS)
    own.add_actions(action)
    probability = own.probability(errors(process, action, 2))
    for level in (0.5, 0.1, 0.01, 0.001):
        fraction = float((probability < level).mean())
        assert fraction <= level + 4.5 * np.sqrt(level * (1.0 - level) / TRIALS), level
        assert fraction > 0.3 * level or level < 0.1


def test_the_expectation_is_the_mean_of_many_trials_with_the_same_events() -> None:
    """4000 trials with the actions of one: their mean error is the expected one."""
    action = np.repeat(actions(3, 1), TRIALS, axis=1)
    own = ConditionalError(MARGINAL, MARGINAL.initial_covariance, TRIALS)
    own.add_actions(action)
    result = errors(MARGINAL, action, 4)
    assert result.mean() == pytest.approx(own.expected[0], abs=4.5 * result.std() / np.sqrt(TRIALS))
    assert 0.5 < result.var() / own.variance[0] < 1.3  # a bound; beyond 1 by chance only


@pytest.mark.parametrize("length", [1, 7, SLOTS])
def test_blocks_of_slots_and_sets_of_trials_do_not_matter(length: int) -> None:
    """To the bit: slots in parts, and trials in sets, one of them of one trial, that are merged."""
    action = actions(5, 20)
    whole = ConditionalError(UNSTABLE, UNSTABLE.initial_covariance, 20)
    whole.add_actions(action)
    parts = [ConditionalError(UNSTABLE, UNSTABLE.initial_covariance, count) for count in (8, 11, 1)]
    for part, trials in zip(parts, (slice(0, 8), slice(8, 19), slice(19, 20)), strict=True):
        for first in range(0, SLOTS, length):
            part.add_actions(action[first : first + length, trials])
    merged = ConditionalError.merged(parts)
    assert merged.slots == whole.slots == SLOTS
    assert np.array_equal(merged.expected, whole.expected)
    given = np.linspace(0.1, 10.0, 20)
    assert np.array_equal(merged.probability(given), whole.probability(given))


def test_without_an_expected_error_there_is_no_probability() -> None:
    """A trial that heard every state."""
    own = ConditionalError(MARGINAL, MARGINAL.initial_covariance, 1)
    own.add_actions(np.full((5, 1), Action.STATE, np.uint8))
    assert own.expected == [0.0]
    assert np.isnan(own.probability(np.zeros(1))).all()


@pytest.mark.parametrize("scenario", ["numerical", "eavesdroppers", "partial-encryption", "twin-track", "bursts"])
def test_a_receiver_that_is_built_in_has_the_covariances_that_its_actions_imply(scenario: str) -> None:
    """To the bit: so its own traces are as good as those that are computed from its actions."""
    played = load(scenario, {"slots": 70, "trials": 5})
    own = {name: conditional_error_of(played, name, 5) for name in played.receivers}
    given = {name: conditional_error_of(played, name, 5) for name in played.receivers}
    for chunk in Simulation(played, range(5)).chunks():
        for name, values in chunk.receivers.items():
            computed, told = own[name], given[name]
            if computed is not None and told is not None:
                computed.add_actions(values.action)
                told.add_actions(values.action, values.trace)
    compared = [name for name, error in own.items() if error is not None and error.slots == 70]
    assert compared
    for name in compared:
        computed, told = own[name], given[name]
        assert computed is not None
        assert told is not None
        assert np.array_equal(computed.expected, told.expected), name
        assert np.array_equal(computed.variance, told.variance), name
