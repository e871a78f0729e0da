"""The innovation scheme as eavesdroppers hear it: states, packets, losses, drawn from the model's own streams."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Belief, Flags, Receiver, Reception
from evedrop.model.schemes.innovation import Innovation
from evedrop.streams import Batch, Stream, root_of_seed, stream_key, uniforms

EXAMPLE = Process(np.array([[1.0, 0.3], [0.5, 1.001]]), 1e-3 * np.eye(2), 1e-3 * np.eye(2))
"""The paper's numerical illustration with Σ0 = Q."""
MARGINAL = Process(np.array([[1.0, 0.05], [0.0, 1.0]]), np.diag([1e-3, 1e-4]), np.diag([1.0, 0.01]))
MICROGRID = Process(np.eye(2), 1e-5 * np.eye(2), 1e-5 * np.eye(2))


def keys(seed: int) -> dict[str, bytes]:
    """Of all streams."""
    return {name: stream_key(root_of_seed(seed), name) for name in ("process", "schedule", "noise", "coin", "link")}


class Slot(NamedTuple):
    """What happens in a slot, for R trials."""

    k: int
    x: Floats
    z: Floats
    nu: Flags
    gamma: Flags


def slots(process: Process, mu_d: float, mu_e: float, batch: Batch, seed: int = 1) -> Iterator[Slot]:
    """All slots of a batch, with losses common to all who listen."""
    own = keys(seed)
    trajectory = Trajectory(process, own["process"], batch)
    encoder = Innovation(process, mu_d).encoder(own, batch)
    link = Stream(own["link"], batch.trial_range, 1)
    for k in range(batch.slots):
        x = trajectory.advance()
        packet = encoder.encode(k, x, trajectory.predicted)
        yield Slot(k, x, packet.z, packet.nu, uniforms(link.words(range(k, k + 1)))[0, :, 0] < mu_e)


def followed(receivers: Mapping[str, Receiver], heard: Iterator[Slot]) -> Iterator[tuple[Slot, dict[str, Belief]]]:
    """Every slot with every receiver's belief after it."""
    beliefs = {name: receiver.prior() for name, receiver in receivers.items()}
    for slot in heard:
        for name, receiver in receivers.items():
            beliefs[name] = receiver.step(slot.k, beliefs[name], Reception(slot.gamma, slot.z))
        yield slot, dict(beliefs)
