"""The eavesdropper that learns by a particle filter, against the Bayesian one, the distribution of its draws, and itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.bayesian import Bayesian
from evedrop.model.eavesdroppers.delegates import Delegate
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.eavesdroppers.learner import CAPACITY, Moments, known
from evedrop.model.eavesdroppers.learning_particle import LearningParticle, drawn, lattice, numbers_of
from evedrop.model.kernels.factored import Factors, covariance
from evedrop.model.process import Process
from evedrop.model.receiver import Reception
from evedrop.model.streams import Batch
from tests.builders import MARGINAL
from tests.model.eavesdroppers.test_learning_em import EVERYTHING, STABLE, last_of, learned_by, relative
from tests.model.listening import EXAMPLE, followed, keys, slots

SCALAR = Process(np.array([[0.9]]), np.array([[0.1]]), np.array([[1.0]]))


def knowing(process: Process, knows: Sequence[str] = (), particles: int = 24, mu_d: float = 0.6) -> Knowledge:
    """What it is told."""
    return Knowledge(process, mu_d, {"knows": [*knows], "particles": particles}, keys(1))


def learner(process: Process, batch: Batch, knows: Sequence[str] = (), particles: int = 24) -> LearningParticle:
    """A learning eavesdropper."""
    return LearningParticle(knowing(process, knows, particles), batch)


@pytest.mark.parametrize("process", [EXAMPLE, STABLE])
def test_if_it_knows_everything_it_is_the_bayesian_eavesdropper(process: Process) -> None:
    """The estimates, covariances and actions of forty slots, to 1e-7 of their size: all particles are the truth."""
    batch = Batch(40, 10)
    both = {
        "learner": learner(process, batch, EVERYTHING, 3),
        "bayesian": Bayesian(Knowledge(process, 0.6, {}, {}), batch, CAPACITY),
    }
    for slot, beliefs in followed(both, slots(process, 0.6, 0.8, batch)):
        first, two = beliefs.values()
        size = np.abs(slot.x).max() + np.sqrt(np.abs(two.P).max())
        assert np.allclose(first.x_hat, two.x_hat, rtol=0.0, atol=1e-7 * size)
        assert np.allclose(first.P, two.P, rtol=0.0, atol=1e-7 * size * size)
        assert np.array_equal(first.action, two.action)


def test_it_learns() -> None:
    """The longer it listens, the less its A errs, and then it errs far less than an eavesdropper that does not listen."""
    batch = Batch(96, 20)
    eavesdropper = learner(STABLE, batch, particles=48)
    receivers = {"learner": eavesdropper, "constant": STRATEGIES["constant"](Knowledge(STABLE, 0.6, {}, {}), batch)}
    off, errors = {}, {name: np.zeros(20) for name in receivers}
    for slot, beliefs in followed(receivers, slots(STABLE, 0.6, 0.9, batch)):
        A, Q, _ = learned_by(eavesdropper, beliefs["learner"])
        off[slot.k + 1] = np.median(relative(A, STABLE.A)), np.median(relative(Q, STABLE.Q))
        for name, belief in beliefs.items():
            errors[name] += ((belief.x_hat - slot.x) ** 2).sum(axis=0) * (slot.k >= 64)
    assert off[96][0] < off[24][0]
    assert off[96][1] < off[48][1]
    assert off[96][0] < 0.25
    assert np.median(errors["learner"]) < 0.5 * np.median(errors["constant"])


@pytest.mark.filterwarnings("error")
def test_it_can_follow_a_process_that_grows() -> None:
    """In the paper's example half of the trials follow the state at slot 60 to a thousandth of its size, and all are finite."""
    batch = Batch(60, 16)
    eavesdropper = learner(EXAMPLE, batch, particles=48)
    belief = eavesdropper.prior()
    for slot in slots(EXAMPLE, 0.7, 0.9, batch):
        belief = eavesdropper.step(slot.k, belief, Reception(slot.gamma, slot.z))
        assert all(np.isfinite(part).all() for part in (belief.x_hat, belief.P, *learned_by(eavesdropper, belief)))
    error = np.linalg.norm(belief.x_hat - slot.x, axis=0) / np.linalg.norm(slot.x, axis=0)
    assert np.median(error) < 1e-3


@pytest.mark.parametrize("process", [MARGINAL, SCALAR])
def test_a_trial_has_the_same_bits_alone_and_among_others(process: Process) -> None:
    """x̂, P, the action and what was learned, with resampling and moves; another coin gives others."""
    whole = Batch(24, 6)
    heard = list(slots(process, 0.5, 0.7, whole))
    many = learner(process, whole)
    among = last_of(many, heard)
    for r in (0, 5):
        part = slice(r, r + 1)
        own = [slot._replace(z=slot.z[:, part], gamma=slot.gamma[part]) for slot in heard]
        single = learner(process, Batch(24, 1, r))
        alone = last_of(single, own)
        sets = [(of.x_hat, of.P, of.action, *learned_by(reader, of)) for reader, of in ((many, among), (single, alone))]
        assert all(value[..., part].tobytes() == two.tobytes() for value, two in zip(*sets, strict=True))
    other = last_of(learner(process, Batch(24, 1, 9)), own)
    assert not np.array_equal(other.x_hat, alone.x_hat)


def test_a_known_state_is_known_and_nothing_is_forgotten() -> None:
    """Once it is told x_k, its estimate is x_k; the next is A x_k with the mean of the particles' A."""
    batch = Batch(12, 4)
    heard = list(slots(STABLE, 0.6, 0.9, batch))
    eavesdropper = learner(STABLE, batch)
    told = eavesdropper.knowing(11, heard[-1].x, last_of(eavesdropper, heard))
    assert np.array_equal(told.x_hat, heard[-1].x)
    after = eavesdropper.step(12, told, Reception(np.zeros(4, np.bool_), np.zeros((2, 4))))
    assert np.allclose(after.x_hat, np.einsum("ijr,jr->ir", learned_by(eavesdropper, told)[0], told.x_hat))


@pytest.mark.parametrize("knows", [[], ["A"], ["Q"], ["mu_d"], ["A", "Q"]])
def test_draws_have_the_distribution_of_the_posterior(knows: list[str]) -> None:
    """40 000 draws: A has mean Â and covariance Q ⊗ H⁻¹ where Q is known; D and μ_d scatter by their counts."""
    R, n = 40_000, 2
    random = np.random.default_rng(8)
    H, A = np.array([[9.0, 2.0], [2.0, 5.0]]), np.array([[0.5, 0.2], [-0.1, 0.8]])
    Q = np.array([[0.4, 0.1], [0.1, 0.3]])
    process = Process(A, Q, np.eye(2))

    def alike(M: Any) -> Any:
        return np.repeat(np.asarray(M, float)[..., None], R, axis=-1)

    lower, diagonal = alike([H[1, 0] / H[0, 0]]), alike([H[0, 0], H[1, 1] - H[1, 0] ** 2 / H[0, 0]])
    square, counts = alike(81.0 * Q), np.full(R, 80.0)
    moments = Moments(lower, diagonal, np.zeros((n, n, R)), square, counts, np.full(R, 60.0), np.full(R, 100.0))
    told = known(process, 0.6, knows)
    theta = told.start(np.ones(R))._replace(A=alike(A), mu_d=np.full(R, 0.6))
    numbers = random.standard_normal((numbers_of(n), R))
    after, parameters = drawn(moments, theta, np.ones(R), told, numbers)
    assert parameters.A.shape == (n, n, R)
    away = parameters.A.reshape(4, R) - A.reshape(4, 1)
    if "A" in knows:
        assert not away.any()
    else:
        wanted = np.kron(Q, np.linalg.inv(H))
        assert (np.abs(away.mean(axis=1)) < 5.0 * np.sqrt(np.diag(wanted) / R)).all()
        # An unknown Q scatters by 1/√40, which adds a little to the covariance.
        assert np.allclose(np.cov(away), wanted, atol=0.004 if "Q" not in knows else 0.002)
    drawn_Q = covariance(Factors(parameters.lower, parameters.diagonal))
    if "Q" in knows:
        assert np.allclose(drawn_Q, alike(Q))
    else:
        assert np.allclose(drawn_Q.mean(axis=-1), Q, rtol=0.06)
        assert np.std(drawn_Q[0, 0]) / Q[0, 0] == pytest.approx(np.sqrt(2.0 / 81.0), rel=0.15)
    if "mu_d" in knows:
        assert (parameters.mu_d == 0.6).all()
    else:
        assert parameters.mu_d.mean() == pytest.approx(0.6, abs=0.01)
        assert parameters.mu_d.std() == pytest.approx(np.sqrt(0.24 / 100.0), rel=0.1)
    # The moments are about the new A: with it, the cross moments are those of the difference.
    step = parameters.A - alike(A)
    assert np.allclose(after.cross, -np.einsum("ijr,jk->ikr", step, H))


def test_the_first_particles() -> None:
    """A around I, Q over four decades, μ_d over (0, 1); what it is told is the same in all."""
    theta = lattice(known(STABLE, 0.6, []), 400)
    assert np.allclose(theta.A.mean(axis=-1), np.eye(2), atol=0.05)
    assert np.allclose(theta.A.std(axis=-1), 0.3, atol=0.03)
    assert 1e-4 <= theta.diagonal.min() < 2e-4
    assert 0.9 < theta.diagonal.max() <= 1.0
    assert theta.mu_d.mean() == pytest.approx(0.5, abs=0.02)
    told = lattice(known(STABLE, 0.6, ["A", "Q", "mu_d"]), 5)
    assert (STABLE.A[:, :, None] == told.A).all()
    assert np.allclose(covariance(told.noise), STABLE.Q[:, :, None])
    assert (told.mu_d == 0.6).all()


def test_a_delegate_tells_what_its_reader_has_learned() -> None:
    """The colluding eavesdropper that reads as the learner has learned what the learner has; others learn nothing."""
    batch = Batch(6, 2)
    knowledge = knowing(STABLE)
    parameters = {**knowledge.parameters, "reads_as": "learning-particle"}
    group = STRATEGIES["colluding"](Knowledge(STABLE, 0.6, parameters, keys(1)), batch)
    assert isinstance(group, Delegate)
    reader = LearningParticle(knowledge, batch)
    heard = list(slots(STABLE, 0.6, 0.9, batch))
    pairs = zip(learned_by(group, last_of(group, heard)), learned_by(reader, last_of(reader, heard)), strict=True)
    assert all(np.array_equal(*pair) for pair in pairs)
    still = STRATEGIES["constant"](Knowledge(STABLE, 0.6, {}, {}), batch)
    assert still.learned(still.prior()) == {}


@pytest.mark.parametrize(
    ("given", "entry", "message"),
    [
        ({"knows": ["B"]}, "knows", 'is ["B"]; expected'),
        ({"particles": 1}, "particles", "is 1; expected a whole number from 2 to 4096"),
        ({"particles": 9.5}, "particles", "is 9.5; expected a whole number from 2 to 4096"),
        ({"particles": False}, "particles", "is false; expected"),
    ],
)
def test_mistakes_in_its_parameters(given: dict[str, Any], entry: str, message: str) -> None:
    """Unknown names, and invalid numbers of particles."""
    (mistake,) = LearningParticle.mistakes(given)
    assert mistake[0] == entry
    assert mistake[1].startswith(message)
    assert not LearningParticle.mistakes({"knows": ["A"], "particles": 2})
