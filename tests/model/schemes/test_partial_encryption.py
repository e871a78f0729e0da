"""Partial encryption: its packets, its estimator, the exact reader of the unencrypted packets, and the theory of that reader."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.eavesdroppers import READERS
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.outcomes import eavesdropper_outcomes
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Action, Belief, Receiver, Reception
from evedrop.model.schemes import scheme_of
from evedrop.model.schemes.partial_encryption import UNENCRYPTED_INNOVATION, PartialEncryption
from evedrop.model.schemes.scheme import Packet
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_forms import ClearStatesForm
from evedrop.model.theory.covariances import Outcomes, state_covariances, theoretical_traces
from tests.builders import DRIFTING, MARGINAL, MICROGRID, UNSTABLE, stream_keys
from tests.examples import examples
from tests.model import rationals
from tests.model.rationals import trace
from tests.model.theory.test_theory_exact_rationals import Model, models

KEYS = stream_keys(3, ("schedule", "mask", "process"))
READER = "clear-states"


def scheme(process: Process, encrypted: list[int], mu_d: float) -> PartialEncryption:
    """The scheme."""
    scheme_ = scheme_of(process, {"scheme": "partial-encryption", "encrypted": encrypted, "state_probability": mu_d})
    assert isinstance(scheme_, PartialEncryption)
    return scheme_


def reader_of(process: Process, batch: Batch) -> Receiver:
    """The reader of the unencrypted packets."""
    return READERS[READER](Knowledge(process, 1.0, {}, {}), batch)


def sent(encryption: PartialEncryption, batch: Batch) -> Iterator[tuple[int, Floats, Floats, Packet]]:
    """Slot, state, prediction and packet of every slot."""
    encoder, trajectory = encryption.encoder(KEYS, batch), Trajectory(encryption.process, KEYS["process"], batch)
    for k in range(batch.slots):
        x = trajectory.advance()
        yield k, x, trajectory.predicted, encoder.encode(k, x, trajectory.predicted)


def beliefs(
    receiver: Receiver, encryption: PartialEncryption, gamma: Floats, batch: Batch
) -> Iterator[tuple[Floats, Packet, Belief]]:
    """State, packet and belief of every slot, for receptions γ (slots, R)."""
    belief = receiver.prior()
    for k, x, _, packet in sent(encryption, batch):
        belief = receiver.step(k, belief, Reception(gamma[k] > 0, packet.z, packet.header))
        yield x, packet, belief


def test_packets_show_what_is_not_encrypted() -> None:
    """Unencrypted states and innovations as they are; the header names the encrypted ones; slot 0 is a state."""
    batch = Batch(40, 30)
    for k, x, predicted, packet in sent(scheme(DRIFTING, [0, 2], 0.5), batch):
        assert packet.header is not None
        np.testing.assert_array_equal(packet.header[0], np.where(packet.nu, UNENCRYPTED_INNOVATION, 0b101))
        np.testing.assert_array_equal(packet.z[1], np.where(packet.nu, x[1] - predicted[1], x[1]))
        np.testing.assert_array_equal(packet.z[:, packet.nu], (x - predicted)[:, packet.nu])
        assert not np.isclose(packet.z[::2, ~packet.nu], x[::2, ~packet.nu], atol=1e-6).any()
        assert k or not packet.nu.any()
    for _, x, _, packet in sent(scheme(DRIFTING, [], 1.0), batch):
        np.testing.assert_array_equal(packet.z, x)


@pytest.mark.parametrize("encrypted", [[], [0], [0, 1]])
def test_the_user_loses_nothing(encrypted: list[int]) -> None:
    """Its error is that of Theorem IV.1: 0 after a state, A e after an innovation."""
    batch = Batch(60, 50)
    encrypting = scheme(MARGINAL, encrypted, 0.4)
    gamma = (np.random.default_rng(1).random((60, 50)) < 0.7).astype(float)
    error = None
    for x, packet, belief in beliefs(encrypting.estimator(KEYS, batch), encrypting, gamma, batch):
        miss = x - belief.x_hat
        state = belief.action == Action.STATE
        np.testing.assert_allclose(miss[:, state], 0.0, atol=1e-12)
        if error is not None:
            decoded = belief.action == Action.INNOVATION
            np.testing.assert_allclose(miss[:, decoded], MARGINAL.A @ error[:, decoded], atol=1e-12)
            np.testing.assert_array_equal(decoded, packet.nu & (belief.action != Action.LOST))
        else:
            np.testing.assert_array_equal(state, gamma[0] > 0)
        error = miss
    assert encrypting.outcomes(0.7) == Outcomes.legitimate(0.7, 0.4)


@pytest.mark.parametrize(
    ("process", "encrypted"), [(MARGINAL, [0]), (DRIFTING, [0, 2]), (DRIFTING, [1]), (DRIFTING, [])]
)
def test_the_reader_is_the_textbook_filter(process: Process, encrypted: list[int]) -> None:
    """With a selection matrix and an inverse, over a lossy link with both types of packets."""
    batch, n = Batch(40, 8), process.n
    encrypting = scheme(process, encrypted, 0.6)
    gamma = (np.random.default_rng(2).random((40, 8)) < 0.7).astype(float)
    clear = [i for i in range(n) if i not in encrypted]
    C = np.eye(n)[clear]
    x_hat, P = np.zeros((n, 8)), np.repeat(process.initial_covariance[None], 8, axis=0)
    for k, (_, packet, belief) in enumerate(beliefs(reader_of(process, batch), encrypting, gamma, batch)):
        for r in range(8):
            innovation = gamma[k, r] and packet.nu[r]
            if k:
                x_hat[:, r] = process.A @ x_hat[:, r] + (packet.z[:, r] if innovation else 0.0)
                P[r] = process.A @ P[r] @ process.A.T + (0.0 if innovation else process.Q)
            if gamma[k, r] and not packet.nu[r]:
                gain = P[r] @ C.T @ np.linalg.pinv(C @ P[r] @ C.T)
                x_hat[:, r] += gain @ (packet.z[clear, r] - x_hat[clear, r])
                P[r] -= gain @ C @ P[r]
        np.testing.assert_allclose(belief.x_hat, x_hat, atol=1e-9)
        np.testing.assert_allclose(belief.P.transpose(2, 0, 1), P, atol=1e-10)


CHAIN = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.0, 0.0, 0.97]])
"""A vehicle that only its acceleration moves at random."""
BESIDE = np.array([[1.0, 0.0, 0.1, 0.3], [0.0, 1.0, 0.2 * 1.1, 0.6 * 1.1], [0.0, 0.0, 0.9, 0.0], [0.0, 0.0, 0.0, 0.95]])
"""Two positions that are moved by the same combination of two other states, but for rounding."""


@pytest.mark.parametrize(
    ("A", "noise", "encrypted", "limit"),
    [
        (CHAIN, [0.0, 0.0, 1.0], [0], math.inf),
        (CHAIN, [0.0, 0.0, 1.0], [1], 0.0),
        (CHAIN, [0.0, 0.0, 1.0], [2], 1.0),
        (BESIDE, [0.0, 0.0, 1.0, 1.0], [2, 3], 6.5),
    ],
)
def test_an_unencrypted_state_that_follows_from_others_takes_nothing_away(
    A: Floats, noise: list[float], encrypted: list[int], limit: float
) -> None:
    """Receiver and theory know what a Kalman filter in pseudo-inverses knows, where Q is singular, and the error is as large."""
    n, slots, trials = len(A), 40, 300
    process = Process(A, np.diag(noise), np.eye(n), singular_noise=True)
    clear, P, traces = np.eye(n)[[i for i in range(n) if i not in encrypted]], np.eye(n), []
    for k in range(slots):
        P = A @ P @ A.T + np.diag(noise) if k else P
        P = P - P @ clear.T @ np.linalg.pinv(clear @ P @ clear.T, rcond=1e-12) @ clear @ P
        P = (P + P.T) / 2.0
        traces.append(float(np.trace(P)))
    batch, hidden = Batch(slots, trials), np.isin(np.arange(n), encrypted)
    theory = ClearStatesForm(process, hidden, 1.0, 1.0, slots)
    np.testing.assert_allclose(theory.traces, traces, rtol=1e-5, atol=1e-12)
    assert theory.limit == pytest.approx(limit, rel=1e-3, abs=1e-12)
    errors = []
    followed = beliefs(reader_of(process, batch), scheme(process, encrypted, 1.0), np.ones((slots, trials)), batch)
    for wanted, (x, _, belief) in zip(traces, followed, strict=True):
        np.testing.assert_allclose(np.trace(belief.P), wanted, rtol=1e-5, atol=1e-12)
        errors.append(((belief.x_hat - x) ** 2).sum(axis=0))
    assert np.mean(errors) == pytest.approx(np.mean(traces), rel=0.2)


def test_the_reader_says_what_it_did() -> None:
    """The state where all is unencrypted or without a header; nothing used where all is encrypted; a betrayed state is known."""
    batch = Batch(3, 4)
    reader = reader_of(MARGINAL, batch)
    gamma, z = np.array([True, True, True, False]), np.ones((2, 4))
    header = np.array([[0b00, 0b01, 0b11, 0b00]])
    belief = reader.step(0, reader.prior(), Reception(gamma, z, header))
    assert belief.action.tolist() == [Action.STATE, Action.INNOVATION, Action.DISCARDED, Action.LOST]
    assert not belief.P[:, :, 0].any()
    np.testing.assert_allclose(belief.P[:, :, 3], MARGINAL.initial_covariance)
    assert reader.step(1, belief, Reception(gamma, z, None)).action.tolist() == [1, 1, 1, 0]
    eavesdropper = READERS[READER](Knowledge(MARGINAL, 1.0, {}, {}), batch)
    belief_known = eavesdropper.knowing(1, z, belief)
    lost = Reception(np.zeros(4, np.bool_), z, header)
    np.testing.assert_allclose(eavesdropper.step(2, belief_known, lost).P[:, :, 1], MARGINAL.Q, rtol=1e-12)
    np.testing.assert_allclose(reader.prior(3).P[:, :, 0], state_covariances(MARGINAL, 3)[2], rtol=1e-12)


def test_its_error_has_the_covariance_that_it_reports() -> None:
    """Over 4000 trials behind a lossy link, in the last slot: z within 4.5 for each entry of the error's square."""
    batch = Batch(12, 4000)
    scheme_ = scheme(UNSTABLE, [0], 0.6)
    gamma = (np.random.default_rng(3).random((12, 4000)) < 0.6).astype(float)
    for x, _, belief in beliefs(reader_of(UNSTABLE, batch), scheme_, gamma, batch):
        error = x - belief.x_hat
    difference = error[:, None] * error[None] - belief.P
    scatter = difference.std(axis=2, ddof=1) / math.sqrt(4000)
    assert np.all(np.abs(difference.mean(axis=2)) < 4.5 * scatter)


def test_one_encrypted_message_is_enough() -> None:
    """Only slot 0 is encrypted, all links are perfect: the estimator has no error, and the eavesdropper's is A^k Σ0 A^kᵀ."""
    batch = Batch(30, 5)
    encrypting = scheme(UNSTABLE, [0, 1], 0.0)
    everything = np.ones((30, 5))
    legitimate, other = encrypting.estimator(KEYS, batch), reader_of(UNSTABLE, batch)
    grown = UNSTABLE.initial_covariance
    for (x, packet, own), (_, _, theirs) in zip(
        beliefs(legitimate, encrypting, everything, batch), beliefs(other, encrypting, everything, batch), strict=True
    ):
        np.testing.assert_allclose(own.x_hat, x, rtol=1e-9)
        assert not own.P.any()
        np.testing.assert_allclose(theirs.P[:, :, 0], grown, rtol=1e-9)
        grown = UNSTABLE.A @ grown @ UNSTABLE.A.T
        assert packet.nu.all() or not packet.nu.any()
    assert np.trace(grown) > 1e6
    outcomes = encrypting.reader_outcomes(READER, 1.0)
    assert outcomes is not None
    assert theoretical_traces(UNSTABLE, outcomes, 31)[30] == pytest.approx(np.trace(grown), rel=1e-9)
    assert theoretical_traces(UNSTABLE, encrypting.outcomes(1.0), 31)[30] == 0.0
    assert scheme(UNSTABLE, [0], 0.0).closed_form(READER, 1.0, 5).limit == math.inf  # type: ignore[union-attr]


def test_outcomes_are_known_where_all_or_nothing_is_encrypted() -> None:
    """Everything encrypted: states tell nothing, innovations tell w; for other readers, and between, none are known."""
    assert scheme(MARGINAL, [], 0.3).reader_outcomes(READER, 0.8) == Outcomes.legitimate(0.8, 0.3)
    hidden = Outcomes(1.0 - 0.8 * 0.75, state=0.0, misled=0.0, decoded=0.8 * 0.75, initial=1.0)
    assert scheme(MARGINAL, [0, 1], 0.25).reader_outcomes(READER, 0.8) == hidden
    assert scheme(MARGINAL, [0], 0.25).reader_outcomes(READER, 0.8) is None
    assert scheme(MARGINAL, [0, 1], 0.0).reader_outcomes(READER, 1.0) is None  # without noise a marginal error stays
    assert scheme(MARGINAL, [0], 0.25).reader_outcomes("naive", 0.8) is None
    assert scheme(MARGINAL, [0], 0.25).closed_form("naive", 0.8, 3) is None
    result = eavesdropper_outcomes(scheme(MARGINAL, [], 0.3), "colluding", {"reads_as": READER})
    assert result is not None
    assert result(0.5) == Outcomes.legitimate(0.5, 0.3)
    assert eavesdropper_outcomes(scheme(MARGINAL, [0], 0.3), READER, {}) is None


def form(
    process: Process, hidden: list[int], mu_d: float, received: float | None = 1.0, slots: int = 25
) -> ClearStatesForm:
    """The theory of the reader."""
    return ClearStatesForm(process, np.isin(np.arange(process.n), hidden), mu_d, received, slots)


@settings(deadline=None, max_examples=examples(25))
@given(models(lowest=0.5), st.sampled_from([0.0, 1.0]), st.integers(0, 7))
def test_what_theory_knows_in_exact_fractions(model: Model, mu_d: float, bits: int) -> None:
    """Schur complements of the unencrypted states, for noise of any condition."""
    n = model.process.n
    hidden = [i for i in range(n) if bits >> i & 1]
    clear = [i for i in range(n) if i not in hidden]

    def read(P: rationals.Matrix) -> rationals.Matrix:
        if not clear:
            return P
        C = [[Fraction(int(i == j)) for j in range(n)] for i in clear]
        gain = rationals.times(P, rationals.transposed(C), rationals.inverted(rationals.congruent(C, P)))
        return rationals.combined((1, P), (-1, rationals.times(gain, C, P)))

    P = read(model.initial)
    for value in form(model.process, hidden, mu_d, slots=8).traces:
        size = float(trace(P))
        assert value == pytest.approx(size, rel=1e-6, abs=1e-12 * float(trace(model.initial)))
        P = rationals.congruent(model.A, P)
        if mu_d == 1.0:
            P = read(rationals.combined((1, P), (1, model.Q)))


@pytest.mark.parametrize("mu_d", [0.0, 1.0])
def test_theory_is_exact_over_a_perfect_link(mu_d: float) -> None:
    """The covariance of the reader, the same in every trial; behind a lossy link, and with both types, it is a lower bound."""
    batch = Batch(25, 20)
    for process in (MARGINAL, DRIFTING, UNSTABLE):
        formed = form(process, [0], mu_d)
        assert not formed.bound
        assert not formed.infinite_variance
        encrypting = scheme(process, [0], mu_d)
        heard = beliefs(reader_of(process, batch), encrypting, np.ones((25, 20)), batch)
        traces = [np.trace(belief.P) for _, _, belief in heard]
        np.testing.assert_allclose(traces, np.repeat(formed.traces[:, None], 20, axis=1), rtol=1e-9)
        lossy = (np.random.default_rng(4).random((25, 20)) < 0.6).astype(float)
        for chance in (mu_d, 0.5):
            lower = form(process, [0], chance, 0.6)
            assert lower.bound
            encrypting = scheme(process, [0], chance)
            for k, (_, _, belief) in enumerate(beliefs(reader_of(process, batch), encrypting, lossy, batch)):
                assert np.all(np.trace(belief.P) >= lower.traces[k] * (1.0 - 1e-9))


def test_the_error_grows_in_what_is_neither_seen_nor_forgotten() -> None:
    """A position does not follow from the speed, but the speed from positions; a stable state is forgotten."""
    position, speed = form(MARGINAL, [0], 1.0), form(MARGINAL, [1], 1.0)
    np.testing.assert_allclose(np.abs(position.growing[:, 0]), [1.0, 0.0], atol=1e-12)
    assert position.limit == math.inf
    assert speed.growing.shape == (2, 0)
    assert speed.limit == pytest.approx(form(MARGINAL, [1], 1.0, slots=500).traces[-1], rel=1e-6)
    # No error comes in where every innovation is known, and a marginal one stays.
    assert 0.0 < form(MARGINAL, [0], 0.5).limit < math.inf
    assert math.isnan(form(MARGINAL, [0, 1], 0.0).limit)  # it grows, but less than any power: theory does not say so
    apart = Process(np.diag([1.2, 1.1, 0.5]), np.eye(3), np.eye(3))
    for hidden, grows in (([0], [0]), ([2], []), ([1, 2], [1]), ([0, 1, 2], [0, 1])):
        for mu_d in (0.0, 0.5, 1.0):
            basis = form(apart, hidden, mu_d).growing
            np.testing.assert_allclose(basis @ basis.T, np.diag(np.isin(range(3), grows).astype(float)), atol=1e-9)
    assert form(UNSTABLE, [0], 1.0).growing.shape[1] == 0  # each state drives the other, and gives it away
    assert form(MICROGRID, [], 1.0).limit == 0.0


def test_an_error_beyond_all_doubles_is_infinite() -> None:
    """From the slot where its square would overflow."""
    steep = Process(np.diag([1e20, 0.5]), np.eye(2), np.eye(2))
    traces = form(steep, [0], 1.0, slots=20).traces
    assert np.isfinite(traces[:5]).all()
    assert np.isinf(traces[-1])


def test_slow_errors_have_no_known_limit() -> None:
    """An error that does not settle in many slots, and does not grow without bound."""
    slow = Process(np.array([[1.0 - 1e-6]]), np.eye(1), np.eye(1))
    assert math.isnan(form(slow, [0], 1.0).limit)


@pytest.mark.parametrize(
    ("given", "entry"),
    [
        ({"encrypted": [0, 0], "state_probability": 1.0}, "encrypted"),
        ({"encrypted": 0, "state_probability": 1.0}, "encrypted"),
        ({"encrypted": [-1], "state_probability": 1.0}, "encrypted"),
        ({"encrypted": [63], "state_probability": 1.0}, "encrypted"),
        ({"encrypted": [0], "state_probability": 1.5}, "state_probability"),
    ],
)
def test_parameters_that_mean_nothing(given: dict[str, object], entry: str) -> None:
    """Are named."""
    assert [name for name, _ in PartialEncryption.mistakes(given)] == [entry]


def test_costs_and_states_that_are_not_there() -> None:
    """A pad for each encrypted state; innovations are not encrypted; a state that the process does not have is a mistake."""
    encrypting = scheme(DRIFTING, [0, 2], 0.5)
    assert (encrypting.secret_bits, encrypting.header_bits) == (128, 64)
    packets = encrypting.encoder(KEYS, Batch(5, 6)).encode_block(range(5), np.zeros((5, 3, 6)), np.zeros((5, 3, 6)))
    np.testing.assert_array_equal(encrypting.encrypted(packets), ~packets.nu)
    assert not scheme(DRIFTING, [], 0.5).encrypted(packets).any()
    assert PartialEncryption.mistakes_with(DRIFTING, {"encrypted": [0, 2]}) == []
    assert "has 3" in PartialEncryption.mistakes_with(DRIFTING, {"encrypted": [0, 3]})[0][1]
    assert PartialEncryption.mistakes({"encrypted": [62]}) == []
    ((_, sentence),) = PartialEncryption.mistakes({"encrypted": [63]})
    assert "to 62, the last that a header has a bit for" in sentence
    floor, grows = scheme(MARGINAL, [0], 1.0).error_floor(10)
    np.testing.assert_array_equal(floor, form(MARGINAL, [0], 1.0, slots=10).traces)
    assert grows
