"""Rules for every scheme: its declarations, its keys, and that a trial is the same in any batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evedrop.model.process import Process, Trajectory
from evedrop.model.receiver import Reception
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.streams import Batch
from tests.builders import UNSTABLE
from tests.model.slot_loop import STABLE, Played, coins, keys_of, play


def made(name: str, process: Process, **changes: Any) -> Scheme:
    """A scheme with its example parameters."""
    return scheme_of(process, {"scheme": name, **SCHEMES[name].parameters, **changes})


def bits(played: Played, part: slice) -> list[bytes]:
    """Everything sent and estimated in some trials."""
    bits = []
    for packet in played.packets:
        header = np.zeros(0) if packet.header is None else packet.header[:, part]
        sent = np.zeros(0) if packet.sent is None else packet.sent[part]
        bits += [packet.z[:, part].tobytes(), packet.nu[part].tobytes(), header.tobytes(), sent.tobytes()]
    for belief in played.beliefs["legitimate"]:
        memory = [array[..., part].tobytes() for array in belief.memory]
        bits += [
            belief.x_hat[:, part].tobytes(),
            belief.P[..., part].tobytes(),
            belief.action[part].tobytes(),
            *memory,
        ]
    return bits


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("process", [STABLE, UNSTABLE])
def test_a_trial_alone_is_the_same_trial(name: str, process: Process) -> None:
    """Packets, headers and beliefs of a trial are the same bits alone, among 5 and among 300."""
    scheme, gamma = made(name, process), coins(0.7, 40, 300)
    among = play(scheme, Batch(40, 300, 100), {"legitimate": gamma})
    for first, count in ((137, 1), (200, 5)):
        part = slice(first - 100, first - 100 + count)
        alone = play(scheme, Batch(40, count, first), {"legitimate": gamma[:, part].copy()})
        assert bits(alone, slice(None)) == bits(among, part)


@pytest.mark.parametrize("name", SCHEMES)
def test_a_step_is_pure(name: str) -> None:
    """A receiver asked for a slot again gives the same belief, and changes neither its belief before nor what it heard."""
    scheme = made(name, STABLE)
    batch = Batch(12, 20)
    estimator = scheme.estimator(keys_of(scheme.estimator_streams), batch)
    played = play(scheme, batch, {"legitimate": coins(0.6, 12, 20)})
    belief = estimator.prior()
    for k, packet in enumerate(played.packets):
        gamma = played.received["legitimate"][k]
        heard = Reception(gamma, packet.z, packet.header)
        before = [array.copy() for array in (belief.x_hat, belief.P, *belief.memory)]
        first, second = estimator.step(k, belief, heard), estimator.step(k, belief, heard)
        for before_, other in zip(
            (first.x_hat, first.P, *first.memory), (second.x_hat, second.P, *second.memory), strict=True
        ):
            assert before_.tobytes() == other.tobytes()
        after = (belief.x_hat, belief.P, *belief.memory)
        assert all(array.tobytes() == other.tobytes() for array, other in zip(before, after, strict=True))
        belief = first


@pytest.mark.parametrize("name", SCHEMES)
def test_without_losses_the_user_follows_exactly(name: str) -> None:
    """Behind a perfect link every packet sent is read, up to rounding or half a quantiser's step, unless it is noise."""
    scheme = made(name, UNSTABLE)
    played = play(scheme, Batch(30, 50), {"legitimate": np.ones((30, 50), bool)})
    error = scheme.quantisation
    steps = (
        np.zeros((30, 2)) if error is None else np.sqrt(12.0 * np.einsum("kii->ki", error.covariances(UNSTABLE, 30)))
    )
    for k, belief in enumerate(played.beliefs["legitimate"]):
        received = played.received["legitimate"][k]
        if scheme.noise_distribution is not None:
            received = received & ~played.packets[k].nu
        scale = float(np.abs(played.x[k]).max()) + 30.0
        apart = np.abs(belief.x_hat - played.x[k])[:, received]
        assert (apart <= 0.5 * steps[k][:, None] + 1e-12 * scale).all()


@pytest.mark.parametrize("name", SCHEMES)
def test_streams_that_a_scheme_names_are_those_it_needs(name: str) -> None:
    """Without one of its keys neither side can be built; with exactly them both can."""
    scheme, batch = made(name, STABLE), Batch(2, 1)
    assert set(scheme.estimator_streams) <= set(scheme.secret_streams)
    for build, streams in ((scheme.encoder, scheme.secret_streams), (scheme.estimator, scheme.estimator_streams)):
        build(keys_of(streams), batch)
        for stream in streams:
            with pytest.raises(KeyError, match=stream):
                build(keys_of(tuple(other for other in streams if other != stream)), batch)


@pytest.mark.parametrize("name", SCHEMES)
def test_declarations_are_what_the_packets_show(name: str) -> None:
    """Header rows, packet sizes, and the examples of parameters, which have no mistakes; none of them may be left out."""
    scheme, batch = made(name, STABLE), Batch(3, 4)
    keys = keys_of(scheme.secret_streams)
    trajectory = Trajectory(STABLE, keys_of(("process",))["process"], batch, scheme.initial_state(keys, batch))
    x = trajectory.advance()
    packet = scheme.encoder(keys, batch).encode(0, x, trajectory.predicted)
    rows = 0 if packet.header is None else len(packet.header)
    assert rows == len(scheme.header)
    assert packet.header is None or packet.header.dtype == np.int64
    assert scheme.packet_bits == (64 * (2 + rows) if scheme.quantisation is None else 2 * 8 + 1)
    assert (scheme.secret_bits == 0) == (not scheme.estimator_streams)
    assert np.isfinite(packet.z).all()
    assert scheme.mistakes(scheme.parameters) == []
    for parameter in scheme.parameters:
        assert [name for name, _ in scheme.mistakes({parameter: object()})] == [parameter]
        with pytest.raises(TypeError):
            SCHEMES[name](STABLE, **{other: value for other, value in scheme.parameters.items() if other != parameter})
