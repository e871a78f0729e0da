"""The innovation scheme as eavesdroppers hear it: states, packets, losses, drawn from the model's own streams."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Belief, Flags, Receiver, Reception
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.streams import Batch, Stream, uniforms
from tests.builders import UNSTABLE, stream_keys

EXAMPLE = Process(UNSTABLE.A, UNSTABLE.Q, UNSTABLE.Q)
"""The paper's numerical illustration with Σ0 = Q."""


def keys(seed: int) -> dict[str, bytes]:
    """Of all streams."""
    return stream_keys(seed, ("process", "schedule", "noise", "coin", "link"))


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
