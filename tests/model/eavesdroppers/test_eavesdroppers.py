"""Eavesdroppers: what all of them must keep to, and those that take or ignore packets against the paper's table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketTaker
from evedrop.model.process import Process
from evedrop.model.receiver import Action, Belief, Receiver, Reception
from evedrop.model.streams import Batch, Stream, uniforms
from tests.builders import stream_keys
from tests.examples import mostly_long

KEYS = stream_keys(12, ("schedule", "coin"))
PROCESS = Process(
    np.array([[1.0, 0.3], [0.5, 1.001]]), np.array([[1e-3, 2e-4], [2e-4, 1e-3]]), np.array([[1.0, 0.1], [0.1, 0.5]])
)
MU_D, USE_STATE, USE_INNOVATION = 0.4, 0.8, 0.3
LEARNS_AT = 7
PARAMETERS: dict[str, dict[str, Any]] = {
    **{name: {} for name in STRATEGIES},
    "suspicious": {"use_state": USE_STATE, "use_innovation": USE_INNOVATION},
    "learning-em": {"knows": [], "keeps": 16},
    "learning-particle": {"knows": [], "particles": 3},
    "colluding": {"reads_as": "smart"},
    "replay-informed": {"reads_as": "bayesian", "learns_at": LEARNS_AT},
}
STREAMS = {
    **dict.fromkeys(STRATEGIES, ()),
    **dict.fromkeys(("smart", "genie", "colluding"), ("schedule",)),
    "suspicious": ("schedule", "coin"),
    "learning-particle": ("coin",),
}
TAKERS = ("naive", "suspicious", "smart", "constant")


def receiver(name: str, batch: Batch, **parameters: float) -> Receiver:
    """An eavesdropper that is given what its strategy names, and no more."""
    strategy = STRATEGIES[name]
    keys = {stream: KEYS[stream] for stream in STREAMS[name]}
    return strategy(Knowledge(PROCESS, MU_D, {**PARAMETERS[name], **parameters}, keys), batch)


def events(slots: int, trials: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """γ (slots, R) and any packets z (slots, n, R)."""
    rng = np.random.default_rng(seed)
    return rng.random((slots, trials)) < 0.7, rng.standard_normal((slots, 2, trials))


def parts(belief: Belief) -> list[NDArray[Any]]:
    """Estimates, covariances and actions."""
    return [belief.x_hat, belief.P, belief.action]


def beliefs(name: str, batch: Batch, gamma: np.ndarray, z: np.ndarray) -> list[Belief]:
    """After every slot."""
    reader = receiver(name, batch)
    belief, followed = reader.prior(), []
    for k in range(batch.slots):
        belief = reader.step(k, belief, heard(name, k, gamma[k], z[k]))
        followed.append(Belief(belief.x_hat.copy(), belief.P.copy(), belief.action.copy()))
    return followed


def heard(name: str, k: int, gamma: np.ndarray, z: np.ndarray) -> Reception:
    """What a strategy hears in a slot."""
    truth = np.full(z.shape, 2.0) if name == "replay-informed" and k == LEARNS_AT else None
    return Reception(gamma, z, truth=truth)


def uniform(stream: str, k: int, r: int) -> float:
    """One uniform of a stream."""
    return float(uniforms(Stream(KEYS[stream], range(r, r + 1), 1).words(range(k, k + 1)))[0, 0, 0])


def uses(name: str, k: int, r: int) -> bool:
    """b_k of the paper's table, from the schedule's and the coin's own numbers."""
    nu = k > 0 and uniform("schedule", k, r) >= MU_D
    if name in {"naive", "constant"}:
        return name == "naive"
    if name == "smart":
        return not nu
    return uniform("coin", k, r) < (USE_INNOVATION if nu else USE_STATE)


TESTED_ELSEWHERE = {"learning-em", "learning-particle", "tracker"}
"""Slow strategies whose own tests have a trial alone, too."""


@pytest.mark.parametrize("name", TAKERS)
@settings(deadline=None)
@given(seed=st.integers(0, 2**31), first=st.integers(0, 10_000))
def test_estimate_and_reported_covariance_are_the_papers(name: str, seed: int, first: int) -> None:
    """Used: (z, 0); lost or discarded: (A x̂, A P Aᵀ + Q); before slot 0: (0, Σ0), not predicted."""
    slots, A, Q = 12, PROCESS.A, PROCESS.Q
    gamma, z = events(slots, 2, seed)
    followed = beliefs(name, Batch(slots, 2, first), gamma, z)
    for r in range(2):
        x_hat, P = np.zeros(2), PROCESS.initial_covariance
        for k in range(slots):
            if k:
                x_hat, P = A @ x_hat, A @ P @ A.T + Q
            action = Action.LOST
            if gamma[k, r]:
                action = Action.STATE if uses(name, k, first + r) else Action.DISCARDED
            if action == Action.STATE:
                x_hat, P = z[k, :, r], np.zeros((2, 2))
            assert followed[k].action[r] == action
            assert np.allclose(followed[k].x_hat[:, r], x_hat, rtol=1e-12, atol=1e-13)
            assert np.allclose(followed[k].P[:, :, r], P, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", mostly_long(PARAMETERS, {*PARAMETERS} - TESTED_ELSEWHERE))
@pytest.mark.thorough
def test_a_trial_alone_is_the_same_trial(name: str) -> None:
    """Beliefs of a trial are the same bits alone, among 6 and among 400; of a learner, which is slow, among 40."""
    slots, trials = (60, 40) if STRATEGIES[name].costly else (300, 400)
    gamma, z = events(slots, trials)
    among = beliefs(name, Batch(slots, trials, 50), gamma, z)
    for first, count in ((77, 1), (44 + trials, 6)):
        part = slice(first - 50, first - 50 + count)
        alone = beliefs(name, Batch(slots, count, first), gamma[:, part].copy(), z[:, :, part].copy())
        for own, other in zip(alone, among, strict=True):
            assert own.x_hat.tobytes() == other.x_hat[:, part].tobytes()
            assert own.P.tobytes() == other.P[:, :, part].tobytes()
            assert np.array_equal(own.action, other.action[part])


@pytest.mark.parametrize("name", mostly_long(PARAMETERS, {*PARAMETERS} - {"learning-em"}))
def test_what_is_lost_does_not_matter(name: str) -> None:
    """Of a packet that was lost not a bit enters the belief, not even NaN."""
    gamma, z = events(40, 30)
    poisoned = np.where(gamma[:, None, :], z, np.nan)
    for belief, other in zip(
        beliefs(name, Batch(40, 30), gamma, z), beliefs(name, Batch(40, 30), gamma, poisoned), strict=True
    ):
        assert all(left.tobytes() == right.tobytes() for left, right in zip(parts(belief), parts(other), strict=True))


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_slot_can_be_computed_again(name: str) -> None:
    """Same belief in, same bits out, also after later slots; and what went in is not changed by it."""
    gamma, z = events(30, 20)
    reader, kept = receiver(name, Batch(30, 20)), []
    belief = reader.prior()
    for k in range(30):
        kept.append((belief, [part.tobytes() for part in (*parts(belief), *belief.memory)]))
        belief = reader.step(k, belief, heard(name, k, gamma[k], z[k]))
    kept.append((belief, [part.tobytes() for part in (*parts(belief), *belief.memory)]))
    for k in (29, 11, 12, 0, 7, 1):
        again = reader.step(k, kept[k][0], heard(name, k, gamma[k], z[k]))
        assert [part.tobytes() for part in (*parts(again), *again.memory)] == kept[k + 1][1]
    for belief, before in kept:
        assert [part.tobytes() for part in (*parts(belief), *belief.memory)] == before


@pytest.mark.parametrize("name", STRATEGIES)
def test_what_it_remembers_has_the_trials_last(name: str) -> None:
    """Of any shape, so that a network can hand a batch's memory on, or a part of it."""
    gamma, z = events(12, 20)
    reader = receiver(name, Batch(12, 20))
    belief = reader.prior()
    for k in range(12):
        assert all(part.shape[-1] == 20 for part in belief.memory)
        belief = reader.step(k, belief, heard(name, k, gamma[k], z[k]))
    assert np.array_equal(belief.action == Action.LOST, ~gamma[11])


@pytest.mark.parametrize("name", STRATEGIES)
def test_it_needs_what_it_names_and_no_more(name: str) -> None:
    """Without one of its keys or parameters an eavesdropper cannot be built; most are given nothing."""
    strategy, parameters = STRATEGIES[name], PARAMETERS[name]
    assert strategy.streams(parameters) == STREAMS[name]
    assert set(strategy.parameters) == set(parameters)
    for stream in STREAMS[name]:
        keys = {other: KEYS[other] for other in STREAMS[name] if other != stream}
        with pytest.raises(KeyError, match=stream):
            strategy(Knowledge(PROCESS, MU_D, parameters, keys), Batch(2, 1))
    for parameter in strategy.parameters:
        rest = {entry: value for entry, value in parameters.items() if entry != parameter}
        with pytest.raises(KeyError, match=parameter):
            strategy(Knowledge(PROCESS, MU_D, rest, KEYS), Batch(2, 1))


@pytest.mark.parametrize("name", STRATEGIES)
def test_who_looks_at_packets_says_so(name: str) -> None:
    """The action of a taker is known from γ; that of a reader is not, and asking for it is an error."""
    reader, gamma = receiver(name, Batch(2, 3)), np.ones(3, bool)
    follows = STRATEGIES[name].follows_gamma(PARAMETERS[name])
    assert follows == (name in {*TAKERS, "colluding"})
    if name in {
        "bayesian",
        "clear-states",
        "learning-em",
        "learning-particle",
        "likelihood",
        "power-test",
        "reference",
        "selective",
        "tracker",
        "replay-informed",
    }:
        with pytest.raises(NotImplementedError, match="γ alone does not tell its action"):
            reader.act(0, gamma)
    else:
        assert np.array_equal(
            reader.act(0, gamma), reader.step(0, reader.prior(), Reception(gamma, np.zeros((2, 3)))).action
        )


def test_a_delegate_is_its_reader() -> None:
    """Colluding with one reader is that reader, to the bit; so is the replay-informed one until it learns a state."""
    gamma, z = events(12, 9)
    for name, twin in (("colluding", "smart"), ("replay-informed", "bayesian")):
        pairs = list(zip(beliefs(name, Batch(12, 9), gamma, z), beliefs(twin, Batch(12, 9), gamma, z), strict=True))
        same = [
            all(np.array_equal(a, b) for a, b in zip(parts(first), parts(two), strict=True)) for first, two in pairs
        ]
        assert same[:LEARNS_AT] == [True] * LEARNS_AT
        assert same[LEARNS_AT] == (name == "colluding")
    assert set(STRATEGIES) == {*READERS, "colluding", "replay-informed"}


@pytest.mark.parametrize("name", TAKERS)
def test_use_probabilities_are_what_it_does(name: str) -> None:
    """P(b = 1 given ν) of theory is how often it uses states and innovations: binomial, at 1e-6 confidence."""
    slots, trials = 60, 2000
    batch = Batch(slots, trials)
    reader = receiver(name, batch)
    belief = reader.prior()
    nu = uniforms(Stream(KEYS["schedule"], range(trials), 1).words(range(slots)))[:, :, 0] >= MU_D
    used = np.empty((slots, trials), bool)
    for k in range(slots):
        belief = reader.step(k, belief, Reception(np.ones(trials, bool), np.zeros((2, trials))))
        used[k] = belief.action == Action.STATE
    taker = STRATEGIES[name]
    assert issubclass(taker, PacketTaker)
    for kind, probability in enumerate(taker.use_probabilities(PARAMETERS[name])):
        chosen = used[1:][nu[1:] == bool(kind)]
        if probability in {0.0, 1.0}:
            assert np.all(chosen == bool(probability))
        else:
            assert stats.binomtest(int(chosen.sum()), chosen.size, probability).pvalue > 1e-6
    if name == "suspicious":  # in slot 0 every packet is the state
        assert stats.binomtest(int(used[0].sum()), trials, USE_STATE).pvalue > 1e-6
    else:
        assert used[0].all() == (name != "constant")


def test_certain_suspicion_is_smart_or_naive() -> None:
    """With μ_b = 1 the suspicious one is smart at μ̄_b = 0 and naive at μ̄_b = 1, to the bit."""
    gamma, z = events(50, 20)
    for use_innovation, twin in ((0.0, "smart"), (1.0, "naive")):
        reader = receiver("suspicious", Batch(50, 20), use_state=1.0, use_innovation=use_innovation)
        belief = reader.prior()
        for k, expected in enumerate(beliefs(twin, Batch(50, 20), gamma, z)):
            belief = reader.step(k, belief, Reception(gamma[k], z[k]))
            assert all(np.array_equal(left, right) for left, right in zip(parts(belief), parts(expected), strict=True))


def test_a_betrayed_state_is_asked_for_by_its_slot() -> None:
    """By the replay-informed one alone."""
    assert {name: STRATEGIES[name].betrayed(PARAMETERS[name]) for name in STRATEGIES} == {
        **dict.fromkeys(STRATEGIES, None),
        "replay-informed": LEARNS_AT,
    }


def test_closed_forms_of_readers_are_known_or_not() -> None:
    """A taker has one by definition, the genie by its leak; a delegate has its reader's."""
    names = {name for name in STRATEGIES if STRATEGIES[name].outcomes(PARAMETERS[name], MU_D) is not None}
    assert names == {*TAKERS, "genie", "colluding"}
