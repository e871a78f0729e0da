"""Flipped acknowledgements: the channel, the policies that live with it, the optimal reader, and the published numbers."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop import montecarlo
from evedrop.errors import ScenarioError
from evedrop.model.acknowledgements import AckChannel, AckChannelSpec, rates_of
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Process
from evedrop.model.reference_code import ReferenceCode
from evedrop.model.schemes import scheme_of
from evedrop.model.schemes.mixed_packets import forged_fraction
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_forms import reference_covariances, reference_limit
from evedrop.model.theory.covariances import Outcomes, theoretical_covariances
from evedrop.scenario.loading import checked
from evedrop.studies.papers.luecke2022 import TransmissionPolicy, mean_traces
from tests.builders import UNSTABLE, digests_of, listener, tables_of
from tests.examples import mostly_long
from tests.model.acknowledged_runs import MIXED, carried
from tests.model.mixed_runs import covariances
from tests.model.slot_loop import STABLE, Played, play

SLOTS, TRIALS, FLIP = 200, 500, 0.2
KEY = bytes(range(32))
RANDOM = {"scheme": "random-code", "plain_probability": 0.4}
THRESHOLD = {"scheme": "threshold-code", "lost_belief": 0.1, "assumed_quality": 0.8, "assumed_flip": 0.2}


def arrived(attack: str, quality: float = 1.0, flip: float = 0.0, spans: Any = None) -> np.ndarray:
    """The acknowledgements of slots in which every other packet is received, (slots, trials)."""
    channel = AckChannel(AckChannelSpec(quality, attack, None, spans, flip), KEY, Batch(SLOTS, TRIALS))
    gamma = np.arange(TRIALS) % 2 == 0
    return np.array([channel.arrived(k, None, gamma, gamma) for k in range(SLOTS)])


def test_a_flip_turns_each_acknowledgement_over_with_its_probability() -> None:
    """Independently in every slot and trial: δ = γ(1 − e) + (1 − γ)e, e of probability p within 4.5 standard errors."""
    gamma = np.arange(TRIALS) % 2 == 0
    flipped = arrived("flip", flip=FLIP) ^ gamma
    standard_deviation = np.sqrt(FLIP * (1 - FLIP) / (SLOTS * TRIALS / 2))
    for received in (gamma, ~gamma):
        assert abs(flipped[:, received].mean() - FLIP) < 4.5 * standard_deviation
    assert abs(np.corrcoef(flipped[1:].ravel(), flipped[:-1].ravel())[0, 1]) < 4.5 / np.sqrt(SLOTS * TRIALS)
    assert np.array_equal(arrived("flip", flip=1.0), np.broadcast_to(~gamma, flipped.shape))
    assert np.array_equal(arrived("flip", 0.7, flip=0.0), arrived("none", 0.7))
    later = arrived("flip", 0.7, FLIP, [(100, SLOTS)])
    assert np.array_equal(later[:100], arrived("none", 0.7)[:100])
    assert np.array_equal(later[100:], arrived("flip", 0.7, FLIP)[100:])


def test_the_rates_of_flipped_acknowledgements() -> None:
    """An acknowledgement arrives with μ(1 − p) + (1 − μ)p, of a packet that the eavesdropper heard as often as any."""
    rates = rates_of("flip", 0.8, 0.6, 0.9, FLIP)
    assert rates.arrives == pytest.approx(0.9 * (0.8 * 0.8 + 0.2 * 0.2))
    assert rates.legitimate == pytest.approx((0.9 * 0.8 * 0.8, 0.9 * 0.2 * 0.2))
    assert rates.eavesdropper == pytest.approx((0.6 * rates.arrives, 0.4 * rates.arrives))


def played_over(
    process: Process, spec: dict[str, Any], gamma: np.ndarray, heard: np.ndarray, acks: np.ndarray
) -> Played:
    """A scheme with one eavesdropper of references, over given events, all (slots, R)."""
    batch = Batch(*gamma.shape)
    eve = STRATEGIES["reference"](Knowledge(process, 1.0, {}, {}), batch)
    return play(
        scheme_of(process, spec), batch, {"legitimate": gamma, "eve": heard}, {"eve": eve}, lambda k, *_: acks[k]
    )


def test_the_threshold_policy_follows_its_belief() -> None:
    """B ← c after an acknowledged state, c + b(1 − c) after an acknowledged code, else the same; the state is sent iff b > θ."""
    rng = np.random.default_rng(3)
    gamma, acks = rng.random((2, 40, 30)) < 0.7
    c = forged_fraction(0.8, 0.2)
    assert c == pytest.approx(0.2 * 0.2 / (0.8 * 0.8 + 0.2 * 0.2))
    assert forged_fraction(0.0, 0.0) == 0.0
    packets = played_over(STABLE, THRESHOLD, gamma, gamma, acks).packets
    for r in range(30):
        b, t = 0.0, -1
        for k, packet in enumerate(packets):
            assert packet.header is not None
            plain = t == -1 or b > 0.1
            assert packet.header[:, r].tolist() == [t, 0 if plain else 1]
            if acks[k, r]:
                b, t = c + (0.0 if plain else b * (1.0 - c)), k


@pytest.mark.parametrize("spec", [RANDOM, THRESHOLD])
@pytest.mark.parametrize("process", [UNSTABLE, STABLE, MIXED])
def test_user_and_eavesdropper_are_optimal(process: Process, spec: dict[str, Any]) -> None:
    """Estimate and covariance are those of the state given all packets heard, whatever is lost, blocked or forged."""
    slots, n = 9, process.n
    gamma, heard, acks = np.random.default_rng(8).random((3, slots, 150)) < 0.6
    played = played_over(process, spec, gamma, heard, acks)
    joint = np.kron(np.eye(slots), process.Q)
    joint[:n, :n] = process.initial_covariance
    states = [np.hstack([np.eye(n), np.zeros((n, n * (slots - 1)))])]
    for k in range(1, slots):
        states.append(process.A @ states[-1])
        states[-1][:, k * n : (k + 1) * n] += np.eye(n)
    codes = {(t, k): carried(process, t, k) for k in range(slots) for t in range(k)}
    for name, received in (("legitimate", gamma), ("eve", heard)):
        for r in range(150):
            rows, values = [np.zeros((n, n * slots))], [np.zeros(n)]
            for k in np.flatnonzero(received[:, r]).tolist():
                header = played.packets[k].header
                assert header is not None
                t, content = header[:, r].tolist()
                rows.append(states[k] - codes[t, k] @ states[t] if content else states[k])
                values.append(played.packets[k].z[:, r])
            H, z, x = np.vstack(rows), np.concatenate(values), states[-1]
            gain = x @ joint @ H.T @ np.linalg.pinv(H @ joint @ H.T, rcond=1e-13, hermitian=True)
            belief = played.beliefs[name][-1]
            assert np.allclose(belief.x_hat[:, r], gain @ z, rtol=0, atol=1e-7)
            assert np.allclose(belief.P[:, :, r], x @ joint @ x.T - gain @ H @ joint @ x.T, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("process", "open_loop"), [(UNSTABLE, True), (MIXED, True), (STABLE, False), (MIXED, False)])
def test_the_upper_bound_of_the_random_policy(process: Process, open_loop: bool) -> None:
    """Over every course of four slots: the expectation of a reader that adds its reference, never below the optimal one."""
    slots, mu, mu_e, alpha = 4, 0.7, 0.6, 0.4
    heard, other, plain = np.array(list(itertools.product([False, True], repeat=3 * slots))).T.reshape(3, slots, -1)
    q = mu * (1 - FLIP) + (1 - mu) * FLIP
    code = ReferenceCode(process, open_loop)
    for quality, acks, chance, acknowledged in (
        (mu, heard ^ other, FLIP, (mu * (1 - FLIP), (1 - mu) * FLIP)),
        (mu_e, other, q, (q * mu_e, q * (1 - mu_e))),
    ):
        factors = [np.where(happened, p, 1 - p) for happened, p in ((heard, quality), (other, chance), (plain, alpha))]
        chances = np.prod(factors, axis=(0, 1))
        assert chances.sum() == pytest.approx(1.0)
        L = None if open_loop else code.at
        bound = reference_covariances(process, quality, acknowledged, slots, alpha, L)
        optimal = covariances(process, plain, acks, heard, open_loop)
        shape = (process.n, process.n, len(chances))
        P, R = np.zeros(shape), np.zeros(shape)
        began = np.zeros(len(chances), bool)
        for k in range(slots):
            carried = np.einsum("ij,jkr,lk->ilr", code.at(k) if k else np.eye(process.n), R, code.at(k or 1))
            carried = carried if k else np.zeros(shape)
            predicted = np.einsum("ij,jkr,lk->ilr", process.A, P, process.A) + process.Q[:, :, None]
            predicted = predicted if k else np.broadcast_to(process.initial_covariance[:, :, None], shape)
            clear = plain[k] | ~began
            P = np.where(heard[k], np.where(clear, 0.0, carried), predicted)
            R = np.where(acks[k], P, carried)
            began |= acks[k]
            assert np.allclose(P @ chances, bound[k], rtol=1e-12, atol=1e-15)
            traces = np.trace(optimal[k])
            assert (traces <= np.trace(P) * (1 + 1e-9) + 1e-15).all()
        assert traces @ chances < (1.0 - 1e-3) * np.trace(bound[-1])


def test_the_upper_bound_holds_in_simulation() -> None:
    """The mean traces of both receivers after some slots, above by many standard errors, and of the same size."""
    alpha, code = 0.5, ReferenceCode(STABLE)
    means = mean_traces(STABLE, TransmissionPolicy(alpha=alpha), (0.8, 0.6), 400, 50)
    for mean, quality, acknowledged in zip(means, (0.8, 0.6), ((0.72, 0.02), (0.74 * 0.6, 0.74 * 0.4)), strict=True):
        bound = np.trace(reference_covariances(STABLE, quality, acknowledged, 100, alpha, code.at)[50:].mean(axis=0))
        assert mean.mean() + 5.0 * mean.std() / 20.0 < bound
        assert bound < 3.0 * mean.mean()


@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.5])
def test_the_limit_of_the_upper_bound(alpha: float) -> None:
    """With L = A: that of the recursion, unbounded from the factor 1 on, and that of `plain` if no acknowledgement is forged."""
    for process in (STABLE, MIXED, UNSTABLE):
        for quality, acknowledged in ((0.8, (0.72, 0.02)), (0.6, (0.444, 0.296))):
            result = reference_limit(process, quality, acknowledged, alpha)
            late = np.trace(reference_covariances(process, quality, acknowledged, 400, alpha)[[300, 399]], 0, 1, 2)
            if np.isinf(result):
                assert process is not STABLE
                assert late[1] > 1.01 * late[0]
            else:
                assert late[1] == pytest.approx(result, rel=1e-9)
    spared = theoretical_covariances(UNSTABLE, Outcomes.plain(0.8), 400)[-1]
    assert reference_limit(UNSTABLE, 0.8, (0.8, 0.0), alpha) == pytest.approx(np.trace(spared))


def test_a_limit_that_is_too_large_is_not_computed() -> None:
    """An operator of more than 512 rows; what has no bound has none in any size."""
    n = 17
    for factor, limit in ((0.9, np.nan), (1.0, np.inf)):
        process = Process(factor * np.eye(n), np.eye(n), np.eye(n))
        assert reference_limit(process, 0.8, (0.72, 0.02)) == pytest.approx(limit, nan_ok=True)


def test_without_unencrypted_states_the_bound_is_the_expectation() -> None:
    """α = 0 and L = A: the recursion of state-secrecy codes."""
    result = reference_covariances(UNSTABLE, 0.9, (0.6, 0.1), 5, 0.0, lambda _: UNSTABLE.A)
    assert np.array_equal(result, reference_covariances(UNSTABLE, 0.9, (0.6, 0.1), 5))


PUBLISHED = [
    (0.8, {"plain_probability": 0.1}, 0.870, 2.317),
    (0.8, {"plain_probability": 0.3}, 0.368, 0.853),
    (0.8, {"plain_probability": 0.5}, 0.279, 0.486),
    (0.8, {"lost_belief": 0.05}, 0.259, 0.397),
    (0.8, {"lost_belief": 0.1}, 0.308, 0.755),
    (0.8, {"lost_belief": 0.2}, 0.466, 1.672),
    (0.6, {"plain_probability": 0.3}, 0.360, 1.709),
    (0.6, {"lost_belief": 0.1}, 0.304, 1.684),
]
"""The eavesdropper's link, the policy, and the mean traces of both receivers: A = 0.9, Q = 1, μ = 0.8, p = 0.1."""


def flipped(mu_e: float, policy: dict[str, float], **more: Any) -> dict[str, Any]:
    """The published example as a scenario."""
    random = "plain_probability" in policy
    encoding = {"scheme": "random-code"} if random else {"scheme": "threshold-code", "assumed_quality": 0.8}
    tables = tables_of(
        Process(np.array([[0.9]]), np.eye(1), np.array([[1.0 / 0.19]])),
        encoding={**encoding, **({} if random else {"assumed_flip": 0.1}), **policy},
        acknowledgements={"link": {"quality": 1.0}, "attack": "flip", "flip": 0.1},
        legitimate={"link": {"quality": 0.8}},
        eavesdroppers={"eve": listener("reference", mu_e)},
    )
    return {**tables, **more}


def traces_of(
    mu_e: float, policy: dict[str, float], slots: int, trials: int, out: Path
) -> tuple[np.ndarray, np.ndarray]:
    """The mean of tr P over the slots, both receivers, and its standard error, by the means over slots of each."""
    result = montecarlo(checked(flipped(mu_e, policy, slots=slots, seed=3), "it"), trials=trials, out=out)
    table = result.slots.to_pydict()
    means = {name: [] for name in ("legitimate", "eve")}  # type: dict[str, list[float]]
    for peer, trace, slot in zip(table["peer"], table["mean_trace_covariance"], table["slot"], strict=True):
        if slot >= 50:  # from then on it is stationary
            means[peer].append(trace)
    # Blocks of 50 slots are nearly independent.
    blocks = np.array([np.array(series).reshape(-1, 50).mean(axis=1) for series in means.values()])
    return blocks.mean(axis=1), blocks.std(axis=1, ddof=1) / np.sqrt(blocks.shape[1])


@pytest.mark.parametrize(
    ("mu_e", "policy", "legitimate", "eve"), mostly_long([PUBLISHED[1], PUBLISHED[4]], [PUBLISHED[1]])
)
def test_the_published_numbers(
    mu_e: float, policy: dict[str, float], legitimate: float, eve: float, tmp_path: Path
) -> None:
    """40,000 slots, within 4.5 standard errors, and 1 % for the standard error of the published numbers."""
    trace, error = traces_of(mu_e, policy, 550, 80, tmp_path)
    assert (error < 0.03 * trace).all()
    assert (np.abs(trace - [legitimate, eve]) < 4.5 * error + 0.01 * trace).all()


@pytest.mark.long
@pytest.mark.parametrize(("mu_e", "policy", "legitimate", "eve"), PUBLISHED)
def test_all_published_numbers(
    mu_e: float, policy: dict[str, float], legitimate: float, eve: float, tmp_path: Path
) -> None:
    """200,000 slots: within 2 %, or 4.5 standard errors of the difference of two such runs, whichever is more.

    A published number is the mean of one run of 200,000 slots, whose standard error is up to 2 % itself.
    """
    trace, error = traces_of(mu_e, policy, 2050, 100, tmp_path)
    assert (error < 0.02 * trace).all()
    assert (np.abs(trace - [legitimate, eve]) < np.maximum(0.02 * trace, 4.5 * np.sqrt(2.0) * error)).all()


@pytest.mark.thorough
def test_live_and_memory_are_the_same_bits(tmp_path: Path) -> None:
    """For both policies under flips, from slot 10 on."""
    from evedrop import run

    for number, policy in enumerate(({"plain_probability": 0.4}, {"lost_belief": 0.1})):
        jam = {"from": 10, "to": 50, "jam": "acknowledgements"}
        scenario = checked(flipped(0.7, policy, slots=60, trials=3, event=[jam]), "it")
        live = run(scenario, out=tmp_path / f"live{number}")
        memory = montecarlo(scenario, trials=3, out=tmp_path / f"memory{number}")
        assert digests_of(live) == digests_of(memory)
        assert all(digests_of(live).values())


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"attack": "flip", "flip": 1.5}, "flip: is 1.5; expected a number from 0 to 1, such as 0.1"),
        ({"attack": "flip", "flip": -0.1}, "flip: is -0.1; expected a number from 0 to 1, such as 0.1"),
        ({"attack": "flip"}, "acknowledgements.flip: is missing; the attack flip needs the probability"),
        (
            {"attack": "all", "flip": 0.1},
            'acknowledgements.flip: is set, but the attack "all" flips nothing; remove the line',
        ),
    ],
)
def test_flips_are_checked(more: dict[str, Any], message: str) -> None:
    """A probability, for the attack that flips, and for no other."""
    wrong = flipped(0.8, {"plain_probability": 0.4}, slots=60)
    wrong["acknowledgements"] = {"link": {"quality": 1.0}, **more}
    with pytest.raises(ScenarioError) as raised:
        checked(wrong, "it")
    assert message in str(raised.value)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (
            {"plain_probability": 0.0},
            "plain_probability: is 0.0, so the state is never sent again once there is a reference",
        ),
        ({"plain_probability": 1.2}, "plain_probability: is 1.2; expected a number from 0 to 1"),
        ({"lost_belief": 1.0}, "lost_belief: is 1.0, which no belief exceeds, so the state is never sent again"),
        ({"lost_belief": -0.2}, "lost_belief: is -0.2; expected a number from 0 to 1"),
    ],
)
def test_a_policy_that_never_sends_the_state_is_refused(policy: dict[str, float], message: str) -> None:
    """With the bound, and what to write instead."""
    with pytest.raises(ScenarioError) as raised:
        checked(flipped(0.8, policy, slots=60), "it")
    assert message in str(raised.value)
    assert "expected a number" in str(raised.value)
