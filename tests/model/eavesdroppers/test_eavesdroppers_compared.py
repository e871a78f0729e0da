"""Constant, likelihood, colluding and replay-informed eavesdroppers: what each is there to show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Fate, pooled
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Reception
from evedrop.model.slot.link import link_of
from evedrop.model.streams import Batch, Stream, uniforms
from evedrop.model.theory.covariances import Outcomes, state_covariances, theoretical_traces
from tests.builders import MARGINAL, MICROGRID
from tests.model.listening import EXAMPLE, Slot, followed, keys, slots

HALVES = {"quality": 0.6, "model": "bernoulli"}, {"quality": 0.5, "model": "bernoulli"}
BURSTS = {"model": "gilbert-elliott", "p": 0.1, "r": 0.4}


def errors(slot: Slot, x_hat: Floats) -> Floats:
    """Squared, (R,)."""
    squared: Floats = ((slot.x - x_hat) ** 2).sum(axis=0)
    return squared


def test_the_constant_one_knows_what_is_public() -> None:
    """x̂ = 0 and P = Σ_k whatever it hears, and theory says tr Σ_k; for μ_d < 1/2 it beats naive in the end."""
    batch = Batch(60, 50)
    reader = READERS["constant"](Knowledge(MARGINAL, 0.3, {}, {}), batch)
    sigma = state_covariances(MARGINAL, 60)
    for slot, beliefs in followed({"constant": reader}, slots(MARGINAL, 0.3, 0.9, batch)):
        assert not beliefs["constant"].x_hat.any()
        assert np.allclose(beliefs["constant"].P, sigma[slot.k][:, :, None], rtol=1e-12)
    outcomes = STRATEGIES["constant"].outcomes({}, 0.3)
    assert outcomes is not None
    assert np.allclose(theoretical_traces(MARGINAL, outcomes(0.9), 60), np.trace(sigma, axis1=1, axis2=2), rtol=1e-12)
    naive = theoretical_traces(MARGINAL, Outcomes.eavesdropper(0.9, 0.3, 1.0, 1.0), 2000)
    assert naive[-1] > np.trace(state_covariances(MARGINAL, 2000)[-1])


@pytest.mark.parametrize(
    ("process", "mu_d", "mu_e", "count"),
    [(MICROGRID, 0.5, 0.6, 300), (EXAMPLE, 0.7, 0.9, 61)],
    ids=["microgrid", "numerical"],
)
@pytest.mark.thorough
def test_a_hard_test_locks_on_to_false_tracks(process: Process, mu_d: float, mu_e: float, count: int) -> None:
    """Ten of 300 trials and more end with an error 100 times smart's median, and it reports a tenth of it or less.

    Over the last 30 slots; the Bayesian one, on the same packets, is never lost.
    """
    batch = Batch(count, 300)
    receivers = {
        name: READERS[name](Knowledge(process, mu_d, {}, keys(1)), batch)
        for name in ("likelihood", "bayesian", "smart")
    }
    late = {name: np.zeros(300) for name in receivers}
    reported = np.zeros(300)
    for slot, beliefs in followed(receivers, slots(process, mu_d, mu_e, batch)):
        if slot.k >= count - 30:
            reported += np.trace(beliefs["likelihood"].P) / 30
            for name, belief in beliefs.items():
                late[name] += errors(slot, belief.x_hat) / 30
    lost = late["likelihood"] > 100.0 * np.median(late["smart"])
    assert lost.sum() >= 10
    assert np.median(reported[lost] / late["likelihood"][lost]) < 0.1
    assert np.all(late["bayesian"] < 100.0 * np.median(late["smart"]))


def test_pooled_fates_are_those_of_any() -> None:
    """Delivered if one link delivers, else lost for the reason of the first; what is pooled is not changed."""
    fates = [np.array(rows, np.uint8).reshape(2, 4) for rows in ([0, 1, 1, 0, 1, 1, 0, 0], [1, 0, 1, 0, 1, 0, 1, 1])]
    before = [fate.copy() for fate in fates]
    assert pooled(fates).tolist() == [[0, 0, 1, 0], [1, 0, 0, 0]]
    assert all(np.array_equal(fate, kept) for fate, kept in zip(fates, before, strict=True))


@pytest.mark.parametrize(
    "links", [HALVES, (*HALVES, HALVES[0]), (HALVES[0], BURSTS), (BURSTS, BURSTS)], ids=["2", "3", "mixed", "bursts"]
)
def test_pooled_links_deliver_what_any_delivers(links: tuple[dict[str, Any], ...]) -> None:
    """Fates are those of the links one by one on their own random numbers, and as many as quality and chain say."""
    batch, key = Batch(400, 200), keys(1)["link"]
    spec = {"model": "pooled", "links": list(links)}
    codes = link_of(spec, key, batch).fates(range(400)).codes
    models = [loss_of(link) for link in links]
    width = sum(model.uniforms_per_slot for model in models)
    drawn = np.ascontiguousarray(uniforms(Stream(key, range(200), width).words(range(400))).transpose(0, 2, 1))
    delivered, start = np.zeros((400, 200), bool), 0
    for model in models:
        delivered |= model.fates(0, drawn[:, start : start + model.uniforms_per_slot]) == Fate.DELIVERED
        start += model.uniforms_per_slot
    assert np.array_equal(codes == Fate.DELIVERED, delivered)
    pool = loss_of(spec)
    assert pool.quality == pytest.approx(1.0 - np.prod([1.0 - model.quality for model in models]))
    assert pool.chain is not None
    assert pool.chain.stationary @ pool.chain.quality == pytest.approx(pool.quality)
    assert pool.chain.stationary @ pool.chain.transitions == pytest.approx(pool.chain.stationary)
    # Bursts of two slots or so: the 400 slots of a trial count as 100 independent ones at least.
    assert abs(delivered.mean() - pool.quality) < 4.5 * np.sqrt(pool.quality * (1.0 - pool.quality) / (200 * 100))


def test_no_theory_where_one_of_the_links_has_none() -> None:
    """A pattern follows no chain, and so no pool with it does."""
    assert loss_of({"model": "pooled", "links": [HALVES[0], {"model": "pattern", "outcomes": "10"}]}).chain is None


def test_one_betrayed_state_barely_hurts_the_innovation_scheme() -> None:
    """Slot 20: the error is 0, in every trial; sixty slots later it is what it would have been, to 0.1 %."""
    batch, parameters = Batch(81, 1000), {"reads_as": "bayesian", "learns_at": 20}
    knowledge = Knowledge(MARGINAL, 0.3, parameters, {})
    informed, other = STRATEGIES["replay-informed"](knowledge, batch), READERS["bayesian"](knowledge, batch)
    first, two = informed.prior(), other.prior()
    for slot in slots(MARGINAL, 0.3, 0.9, batch):
        truth = slot.x if slot.k == 20 else None
        first = informed.step(slot.k, first, Reception(slot.gamma, slot.z, truth=truth))
        two = other.step(slot.k, two, Reception(slot.gamma, slot.z))
        if slot.k == 20:
            assert not errors(slot, first.x_hat).any()
            assert not first.P.any()
            assert errors(slot, two.x_hat).mean() > 1e-3
    assert np.median(errors(slot, first.x_hat) / errors(slot, two.x_hat)) == pytest.approx(1.0, rel=1e-3)


def test_a_state_that_was_not_betrayed_is_missed() -> None:
    """Told by its slot, so that a network that forgets to hand it over does not go unnoticed."""
    reader = STRATEGIES["replay-informed"](
        Knowledge(MARGINAL, 0.3, {"reads_as": "constant", "learns_at": 0}, {}), Batch(2, 1)
    )
    with pytest.raises(ValueError, match="slot 0: the state was to be betrayed"):
        reader.step(0, reader.prior(), Reception(np.ones(1, bool), np.zeros((2, 1))))


@pytest.mark.parametrize("reads_as", ["bayesian", "likelihood"])
def test_one_betrayed_state_breaks_twin_tracks(reads_as: str) -> None:
    """A fair coin sends x_k or its twin y_k of the same noise; an eavesdropper that learns one state tells the tracks apart.

    Without coin and twin its error is at least half of tr A^k Σ0 Aᵏᵀ; with one state known it is below a hundredth of that.
    """
    process, batch, learns_at = Process(np.eye(2), 1e-5 * np.eye(2), np.eye(2)), Batch(60, 400), 10
    trajectory, random = Trajectory(process, keys(1)["process"], batch), np.random.default_rng(3)
    parameters = {"reads_as": reads_as, "learns_at": learns_at}
    receivers = {
        "informed": STRATEGIES["replay-informed"](Knowledge(process, 0.5, parameters, {}), batch),
        "other": READERS[reads_as](Knowledge(process, 0.5, {}, {}), batch),
    }
    beliefs = {name: receiver.prior() for name, receiver in receivers.items()}
    apart: Floats = np.zeros((2, 400))
    errors = dict.fromkeys(receivers, 0.0)
    for k in range(60):
        x = trajectory.advance()
        if k == 0:
            apart = random.standard_normal((2, 400)) - x
        z = np.where(random.random(400) < 0.5, x, x + apart)
        for name, receiver in receivers.items():
            truth = x if name == "informed" and k == learns_at else None
            beliefs[name] = receiver.step(k, beliefs[name], Reception(np.ones(400, bool), z, truth=truth))
            if k > learns_at:
                errors[name] += float(((x - beliefs[name].x_hat) ** 2).sum()) / (49 * 400)
    assert errors["other"] > 0.9
    assert errors["informed"] < 0.01
