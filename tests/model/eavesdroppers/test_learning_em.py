"""The eavesdropper that learns by expectation-maximisation, against the Bayesian one, least squares, and itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.bayesian import Bayesian
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge
from evedrop.model.eavesdroppers.learner import CAPACITY, RIDGE, divided, factored
from evedrop.model.eavesdroppers.learning_em import LearningEm, climbing_slots
from evedrop.model.kernels.factored import Factor, Factors, covariance
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Belief, Receiver, Reception
from evedrop.model.schemes.cipher import Cipher
from evedrop.model.streams import Batch
from tests.builders import MARGINAL, stream_keys
from tests.model.listening import EXAMPLE, Slot, followed, keys, slots

STABLE = Process(np.array([[0.95, 0.1], [-0.1, 0.9]]), 0.05 * np.eye(2), 0.3 * np.eye(2))
EVERYTHING = ["A", "Q", "mu_d", "initial_covariance"]


def learner(
    process: Process, batch: Batch, knows: Sequence[str] = (), keeps: int = 32, mu_d: float = 0.6
) -> LearningEm:
    """A learning eavesdropper."""
    return LearningEm(Knowledge(process, mu_d, {"knows": [*knows], "keeps": keeps}, {}), batch)


def relative(estimates: Floats, true: Floats) -> Floats:
    """|found − true| / |true| of matrices (n, n, R), by the Frobenius norm, (R,)."""
    error: Floats = np.linalg.norm(estimates - true[:, :, None], axis=(0, 1)) / np.linalg.norm(true)
    return error


def learned_by(receiver: Receiver, belief: Belief) -> tuple[Floats, Floats, Floats]:
    """A, Q and μ_d as learned."""
    assert isinstance(receiver, Eavesdropper)
    learned = receiver.learned(belief)
    return learned["A"], learned["Q"], learned["mu_d"]


def last_of(receiver: Receiver, heard: Sequence[Slot]) -> Belief:
    """Its belief after all slots."""
    belief = receiver.prior()
    for slot in heard:
        belief = receiver.step(slot.k, belief, Reception(slot.gamma, slot.z))
    return belief


@pytest.mark.parametrize("process", [EXAMPLE, MARGINAL, STABLE])
def test_if_it_knows_everything_it_is_the_bayesian_eavesdropper(process: Process) -> None:
    """The estimates, covariances and actions of sixty slots, to 1e-7 of their size, with as many components."""
    batch = Batch(60, 20)
    both = {
        "learner": learner(process, batch, EVERYTHING),
        "bayesian": Bayesian(Knowledge(process, 0.6, {}, {}), batch, CAPACITY),
    }
    for slot, beliefs in followed(both, slots(process, 0.6, 0.8, batch)):
        first, two = beliefs.values()
        size = np.abs(slot.x).max() + np.sqrt(np.abs(two.P).max())
        assert np.allclose(first.x_hat, two.x_hat, rtol=0.0, atol=1e-7 * size)
        assert np.allclose(first.P, two.P, rtol=0.0, atol=1e-7 * size * size)
        assert np.array_equal(first.action, two.action)


@pytest.mark.parametrize("knows", [["mu_d"], ["mu_d", "A"], ["mu_d", "Q"]])
def test_without_innovations_and_losses_it_is_least_squares(knows: list[str]) -> None:
    """μ_d = 1: A and Q are the ridge regression of each state on the one before, and what is known stays."""
    K, R = 16, 5
    batch = Batch(K, R)
    heard = list(slots(STABLE, 1.0, 1.0, batch))
    eavesdropper = learner(STABLE, batch, knows, K, 1.0)
    A, Q, mu_d = learned_by(eavesdropper, last_of(eavesdropper, heard))
    x = np.array([slot.x for slot in heard])
    assert (mu_d == 1.0).all()
    for r in range(R):
        before, after = x[:-1, :, r], x[1:, :, r]
        weight = RIDGE * float(np.mean(x[:4, :, r] ** 2))
        H = before.T @ before + weight * np.eye(2)
        wanted = STABLE.A if "A" in knows else np.linalg.solve(H, before.T @ after + weight * np.eye(2)).T
        away, still = after - before @ wanted.T, np.eye(2) - wanted
        assert np.allclose(A[:, :, r], wanted, rtol=1e-9)
        noise = STABLE.Q if "Q" in knows else (away.T @ away + weight * still @ still.T) / K
        assert np.allclose(Q[:, :, r], noise, rtol=1e-9, atol=1e-12)


@pytest.mark.thorough
def test_it_learns() -> None:
    """The longer it listens, the less its estimates err, and then it errs little more than one that knows everything."""
    batch = Batch(96, 40)
    receivers = {
        "learner": learner(STABLE, batch, keeps=64),
        **{name: STRATEGIES[name](Knowledge(STABLE, 0.6, {}, keys(1)), batch) for name in ("bayesian", "constant")},
    }
    off, errors = {}, {name: np.zeros(40) for name in receivers}
    for slot, beliefs in followed(receivers, slots(STABLE, 0.6, 0.9, batch)):
        A, Q, mu_d = learned_by(receivers["learner"], beliefs["learner"])
        off[slot.k + 1] = [
            np.median(errors) for errors in (relative(A, STABLE.A), relative(Q, STABLE.Q), np.abs(mu_d - 0.6))
        ]
        for name, belief in beliefs.items():
            errors[name] += ((belief.x_hat - slot.x) ** 2).sum(axis=0) * (slot.k >= 64)
    assert off[96][0] < off[32][0] < off[16][0]
    assert off[96][1] < off[32][1] < off[16][1]
    assert off[96][0] < 0.15
    assert off[96][1] < 0.6
    assert off[96][2] < 0.1
    assert np.median(errors["learner"]) < 2.0 * np.median(errors["bayesian"]) < 0.5 * np.median(errors["constant"])


@pytest.mark.long
def test_it_learns_nothing_from_masked_packets() -> None:
    """Against the cipher it does not come nearer to A, and it errs more than an eavesdropper that does not listen."""
    batch = Batch(40, 20)
    own = stream_keys(3, ("process", "mask"))
    encoder, trajectory = Cipher(STABLE).encoder(own, batch), Trajectory(STABLE, own["process"], batch)
    eavesdropper = learner(STABLE, batch)
    belief, error, still = eavesdropper.prior(), 0.0, 0.0
    for k in range(40):
        x = trajectory.advance()
        packet = encoder.encode(k, x, trajectory.predicted)
        belief = eavesdropper.step(k, belief, Reception(np.ones(20, np.bool_), packet.z))
        error += float(((belief.x_hat - x) ** 2).sum())
        still += float((x**2).sum())
    assert error > still
    assert np.median(relative(learned_by(eavesdropper, belief)[0], STABLE.A)) > 0.5


@pytest.mark.parametrize(
    "process",
    [
        MARGINAL,
        pytest.param(Process(np.array([[0.9]]), np.array([[0.1]]), np.array([[1.0]])), marks=pytest.mark.long),
    ],
)
def test_a_trial_has_the_same_bits_alone_and_among_others(process: Process) -> None:
    """x̂, P, the action and what was learned, over climbs and the steps after them."""
    whole, K = Batch(24, 6), 24
    heard = list(slots(process, 0.5, 0.7, whole))
    many, single = (learner(process, batch, keeps=16) for batch in (whole, Batch(K, 1)))
    among = last_of(many, heard)
    for r in (0, 5):
        part = slice(r, r + 1)
        own = [slot._replace(z=slot.z[:, part], gamma=slot.gamma[part]) for slot in heard]
        alone = last_of(single, own)
        sets = [(of.x_hat, of.P, of.action, *learned_by(reader, of)) for reader, of in ((many, among), (single, alone))]
        assert all(value[..., part].tobytes() == two.tobytes() for value, two in zip(*sets, strict=True))


@pytest.mark.parametrize(
    ("process", "mu_e"),
    [
        pytest.param(EXAMPLE, 0.9, marks=pytest.mark.long),
        pytest.param(EXAMPLE, 0.2, marks=pytest.mark.long),
        (MARGINAL, 0.02),
    ],
)
@pytest.mark.filterwarnings("error")
def test_it_stays_finite(process: Process, mu_e: float) -> None:
    """With a process that grows, and with hardly a packet, whatever it takes the process to be."""
    batch = Batch(90, 20)
    eavesdropper = learner(process, batch, keeps=16)
    belief = eavesdropper.prior()
    for slot in slots(process, 0.5, mu_e, batch):
        belief = eavesdropper.step(slot.k, belief, Reception(slot.gamma, slot.z))
        assert all(np.isfinite(part).all() for part in (*belief[:2], *learned_by(eavesdropper, belief)))
        size = np.trace(belief.P)
        assert (np.linalg.eigvalsh(np.moveaxis(belief.P, -1, 0))[:, 0] >= -1e-9 * size).all()


def test_a_known_state_is_known() -> None:
    """Once it is told x_k, its estimate is x_k, and the next one A x_k with the A that it has learned."""
    batch = Batch(30, 4)
    heard = list(slots(STABLE, 0.6, 0.9, batch))
    eavesdropper = learner(STABLE, batch, keeps=16)
    told = eavesdropper.knowing(29, heard[-1].x, last_of(eavesdropper, heard))
    assert np.array_equal(told.x_hat, heard[-1].x)
    assert not told.P.any()
    after = eavesdropper.step(30, told, Reception(np.zeros(4, bool), np.zeros((2, 4))))
    assert np.allclose(after.x_hat, np.einsum("ijr,jr->ir", learned_by(eavesdropper, told)[0], told.x_hat))


def test_one_that_joins_late_climbs_as_late() -> None:
    """A process that starts at slot 7 knows I and nothing else until it has listened to as many slots as any other."""
    batch, age = Batch(30, 3), climbing_slots(2, 16)[0]
    eavesdropper = learner(STABLE, batch, keeps=16)
    belief = eavesdropper.prior(7)
    for slot in slots(STABLE, 0.6, 1.0, batch):
        if slot.k >= 7:
            belief = eavesdropper.step(slot.k, belief, Reception(slot.gamma, slot.z))
            still = (learned_by(eavesdropper, belief)[0] == np.eye(2)[:, :, None]).all()
            assert still == (slot.k - 7 + 1 < age)


def test_when_it_climbs() -> None:
    """Eight slots for each state, a power of two, then doubled for as long as it keeps the slots."""
    assert climbing_slots(1, 64) == [8, 16, 32, 64]
    assert climbing_slots(2, 100) == [16, 32, 64]
    assert climbing_slots(3, 20) == [20]


@pytest.mark.parametrize(
    ("given", "entry", "message"),
    [
        (
            {"knows": "A"},
            "knows",
            'is "A"; expected a list of names among ["A", "Q", "mu_d", "initial_covariance"], or []',
        ),
        ({"knows": ["B"]}, "knows", 'is ["B"]; expected'),
        ({"knows": [1]}, "knows", "is [1]; expected"),
        ({"keeps": 7}, "keeps", "is 7; expected a whole number of slots from 8 to 4096"),
        ({"keeps": 9.5}, "keeps", "is 9.5; expected a whole number of slots from 8 to 4096"),
        ({"keeps": True}, "keeps", "is true; expected"),
    ],
)
def test_mistakes_in_its_parameters(given: dict[str, Any], entry: str, message: str) -> None:
    """Unknown names, and invalid numbers of slots."""
    (mistake,) = LearningEm.mistakes(given)
    assert mistake[0] == entry
    assert mistake[1].startswith(message)
    assert not LearningEm.mistakes({"knows": ["A", "mu_d"], "keeps": 8})


def test_factors_of_a_matrix_and_division_by_it() -> None:
    """U D Uᵀ is the matrix, unless a D would be too small; M P⁻¹ P is M."""
    random = np.random.default_rng(5)
    F = random.standard_normal((3, 3, 7))
    M = np.einsum("icr,jcr->ijr", F, F)
    P = factored(M, np.zeros(7))
    assert np.allclose(covariance(P), M)
    assert np.allclose(np.einsum("icr,cjr->ijr", divided(F, P), M), F)
    flat = factored(np.zeros((2, 2, 1)), np.array([0.5]))
    assert isinstance(flat, Factors)
    assert np.allclose(covariance(flat)[:, :, 0], 0.5 * np.eye(2))
    assert Factor([[1.0]], [2.0]).diagonal == [2.0]


def test_estimates_out_of_all_proportion_to_the_packets_are_made_smaller() -> None:
    """To four times the largest packet, by one that estimates A; one that is told A keeps what follows from it."""
    x_hat, P = np.array([[1e9], [0.5]]), np.array([[[1e18], [1e9]], [[1e9], [4.0]]])
    largest = np.array([[2.0], [3.0]])
    bounded_mean, bounded_covariance = learner(MARGINAL, Batch(4, 1)).in_proportion(x_hat, P, largest)
    assert bounded_mean.tolist() == [[8.0], [0.5]]
    assert np.allclose(bounded_covariance[:, :, 0], [[64.0, 8.0], [8.0, 4.0]])
    told = learner(MARGINAL, Batch(4, 1), ["A"]).in_proportion(x_hat, P, largest)
    assert all(np.array_equal(value, other) for value, other in zip(told, (x_hat, P), strict=True))
