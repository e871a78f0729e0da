"""A scheme played slot by slot in memory: process, encoder, links, acknowledgements, receivers; nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from evedrop.model.process import Process, Trajectory
from evedrop.model.receiver import Belief, Receiver, Reception
from evedrop.model.schemes.scheme import Packet, Scheme
from evedrop.model.streams import Batch, root_of_seed, stream_key

ROOT = root_of_seed(4)
STABLE = Process(
    np.array([[0.9, 0.3], [-0.2, 0.7]]), np.array([[1e-2, 2e-3], [2e-3, 2e-2]]), np.array([[0.1, 0.02], [0.02, 0.2]])
)

Flags = np.ndarray[Any, Any]
Acknowledge = Callable[[int, Flags, Mapping[str, Flags]], Flags]
"""(k, sent, receiver → γ_k) → the acknowledgements that reach the sensor."""


def keys_of(names: tuple[str, ...]) -> dict[str, bytes]:
    """The keys of these streams."""
    return {name: stream_key(ROOT, name) for name in names}


def honest(k: int, sent: Flags, gamma: Mapping[str, Flags]) -> Flags:
    """Every packet that the legitimate estimator receives is acknowledged, and every acknowledgement arrives."""
    return gamma["legitimate"]


@dataclass
class Played:
    """All slots of a batch: what was sent and what each receiver estimated."""

    x: list[np.ndarray] = field(default_factory=list)
    packets: list[Packet] = field(default_factory=list)
    beliefs: dict[str, list[Belief]] = field(default_factory=dict)
    received: dict[str, list[Flags]] = field(default_factory=dict)

    def squared_error(self, name: str) -> np.ndarray:
        """|x − x̂|², (slots, R)."""
        return np.array(
            [((x - belief.x_hat) ** 2).sum(0) for x, belief in zip(self.x, self.beliefs[name], strict=True)]
        )

    def trace(self, name: str) -> np.ndarray:
        """Tr P reported, (slots, R)."""
        return np.array([np.trace(belief.P) for belief in self.beliefs[name]])


def play(
    scheme: Scheme,
    batch: Batch,
    gamma: Mapping[str, np.ndarray],
    eavesdroppers: Mapping[str, Receiver] | None = None,
    acknowledge: Acknowledge = honest,
) -> Played:
    """Play a scheme; gamma: receiver → what its link lets through, (slots, R)."""
    keys = keys_of(scheme.secret_streams)
    process = scheme.process
    trajectory = Trajectory(process, stream_key(ROOT, "process"), batch, scheme.initial_state(keys, batch))
    encoder = scheme.encoder(keys, batch)
    receivers = {"legitimate": scheme.estimator(keys_of(scheme.estimator_streams), batch), **(eavesdroppers or {})}
    beliefs = {name: receiver.prior() for name, receiver in receivers.items()}
    played = Played(beliefs={name: [] for name in receivers}, received={name: [] for name in receivers})
    for k in range(batch.slots):
        x = trajectory.advance().copy()
        packet = encoder.encode(k, x, trajectory.predicted)
        sent = np.ones(batch.trials, bool) if packet.sent is None else packet.sent
        received = {name: gamma[name][k] & sent for name in receivers}
        for name, receiver in receivers.items():
            # A packet that is not received must not matter, whatever its content.
            z = np.where(received[name], packet.z, np.nan)
            header = None if packet.header is None else np.where(received[name], packet.header, -(2**62))
            beliefs[name] = receiver.step(k, beliefs[name], Reception(received[name], z, header))
            played.beliefs[name].append(beliefs[name])
            played.received[name].append(received[name])
        encoder.acknowledged(k, acknowledge(k, sent, received) & sent)
        played.x.append(x)
        played.packets.append(packet)
    return played


def coins(quality: float, slots: int, trials: int, seed: int = 0) -> np.ndarray:
    """γ (slots, R) of an independent link."""
    return np.random.default_rng(seed).random((slots, trials)) < quality
