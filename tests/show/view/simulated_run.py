"""Runs to look at, simulated from the model in this process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Receiver, Reception
from evedrop.model.schemes import SCHEMES
from evedrop.model.streams import Batch
from evedrop.show.view.scene import PeerSlots, Scene, SceneSlots, Shown
from tests.builders import stream_keys

STATE_PROBABILITY = 0.35
USE_STATE, USE_INNOVATION = 0.8, 0.3
QUALITY = {"legitimate": 0.85, "naive": 0.9, "suspicious": 0.95, "smart": 0.6}


def orbit(n: int = 2, growth: float = 1.0) -> Process:
    """A marginally stable process: an ellipse once around in 140 slots, with n = 2; growth makes it unstable."""
    turn, size = 2 * np.pi / 140, np.array([1.35, 0.8])
    A = np.eye(n) * growth
    if n > 1:
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        A[:2, :2] = growth * rotation * size[:, None] / size
    return Process(A, np.eye(n) * 0.02, np.eye(n) * 30.0)


@dataclass(frozen=True)
class Simulated:
    """A run: its scene, and all its slots in one piece."""

    scene: Scene
    slots: SceneSlots

    def chunks(self, length: int) -> Iterator[SceneSlots]:
        """The slots, as the recorder hands them over: some at a time."""
        for first in range(0, self.scene.slots, length):
            part = slice(first, first + length)
            yield self.slots.rows(part).changed(peers={name: p.rows(part) for name, p in self.slots.peers.items()})


def simulate(
    process: Process, slots: int, *, trials: int = 1, pace: float = 0.0, copies: int = 1, seed: int = 7
) -> Simulated:
    """Sensor, legitimate estimator and `copies` of each strategy of eavesdropper, through lossy links."""
    batch, keys = Batch(slots, trials), stream_keys(seed, ("process", "schedule", "noise", "coin"))
    scheme = SCHEMES["innovation"](process, STATE_PROBABILITY)
    trajectory, encoder = Trajectory(process, keys["process"], batch), scheme.encoder(keys, batch)
    receivers: dict[str, tuple[str, Receiver]] = {"legitimate": ("innovation", scheme.estimator(keys, batch))}
    knowledge = Knowledge(process, STATE_PROBABILITY, {"use_state": USE_STATE, "use_innovation": USE_INNOVATION}, keys)
    for copy in range(copies):
        for name in ("naive", "suspicious", "smart"):
            receivers[f"{name}{copy + 1}" if copy else name] = (name, STRATEGIES[name](knowledge, batch))
    qualities = {
        name: max(0.1, QUALITY["legitimate" if name == "legitimate" else strategy] - 0.2 * name.endswith("2"))
        for name, (strategy, _) in receivers.items()
    }
    arrivals = np.random.default_rng(seed)
    beliefs = {name: receiver.prior() for name, (_, receiver) in receivers.items()}
    truth, nus = [], []
    seen: dict[str, list[tuple[Any, ...]]] = {name: [] for name in receivers}
    for k in range(slots):
        x = trajectory.advance()
        z, nu, *_ = encoder.encode(k, x, trajectory.predicted)
        truth.append(x[:, 0])
        nus.append(nu[0])
        for name, (_, receiver) in receivers.items():
            gamma = arrivals.random(trials) < qualities[name]
            beliefs[name] = b = receiver.step(k, beliefs[name], Reception(gamma, z))
            errors = np.sum((x - b.x_hat) ** 2, axis=0)
            spread = errors.std(ddof=1) / np.sqrt(trials) if trials > 1 else np.float64(np.nan)
            trace = np.trace(b.P).mean()
            seen[name].append((b.x_hat[:, 0], b.P[:, :, 0], b.action[0], errors.mean(), spread, trace))
    shown = tuple(
        Shown(name, "legitimate" if i == 0 else "eavesdropper", strategy, qualities[name])
        for i, (name, (strategy, _)) in enumerate(receivers.items())
    )
    peers = {}
    for s in shown:
        x_hat, P, action, error, spread, trace = (np.array(column) for column in zip(*seen[s.name], strict=True))
        theory = expected(process, s, qualities[s.name], slots)
        peers[s.name] = PeerSlots(0, x_hat, P, action.astype(np.uint8), error, spread, trace, theory)
    scene = Scene(
        "Simulated", f"simulated-{seed}-{slots}", slots, trials, process.n, pace, shown, float(np.trace(process.Q))
    )
    return Simulated(scene, SceneSlots(0, np.array(truth), np.array(nus), peers))


def expected(process: Process, shown: Shown, q: float, slots: int) -> Floats:
    """Trace of the actual mean error covariance, (slots,), by conditioning on what a slot may bring; q: its link's quality."""
    A, Q, d = process.A, process.Q, STATE_PROBABILITY
    use_state, misled = {"naive": (1.0, 1.0), "suspicious": (USE_STATE, USE_INNOVATION)}.get(shown.strategy, (1.0, 0.0))
    Sigma, M, traces = process.initial_covariance, (1 - q) * process.initial_covariance, []
    for k in range(slots):
        if k:
            carried = A @ M @ A.T
            if shown.role == "legitimate":
                M = (1 - q) * (carried + Q) + q * (1 - d) * carried
            else:
                used, taken = q * d * use_state, q * (1 - d) * misled
                M = (1 - used - taken) * (carried + Q) + taken * 2 * (A @ Sigma @ A.T)
            Sigma = A @ Sigma @ A.T + Q
        traces.append(np.trace(M))
    return np.array(traces)
