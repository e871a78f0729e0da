"""Finite-k expectations of every receiver compared with simulation: the actual error, and the error it reports.

Source: Theorem IV.3 and Theorem V.2, corrected (docs/mathematics/model.md, expectations).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Receiver, Reception
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.slot.link import deliveries, link_of
from evedrop.model.streams import Batch, root_of_seed, stream_key
from evedrop.model.theory.covariances import Outcomes, theoretical_traces
from evedrop.show.view.figure_style import panels
from evedrop.show.view.palette import paper_inks

MU, MU_D, SLOTS = 0.9, 0.85, 26
_BATCH = 2000
_SUSPICIOUS = {"use_state": 0.8, "use_innovation": 0.3}
_LOOKS = {
    "legitimate": ("o", "-"),
    "smart": ("s", "--"),
    "suspicious": ("D", "-."),
    "naive": ("^", ":"),
}


def process() -> Process:
    """The paper's matrices with Σ0 = Q."""
    Q = 1e-3 * np.eye(2)
    return Process(np.array([[1.0, 0.3], [0.5, 1.001]]), Q, Q)


def outcomes() -> dict[str, Outcomes]:
    """Receiver → its outcomes in a slot."""
    by_name = {"legitimate": Outcomes.legitimate(MU, MU_D)}
    for name in ("smart", "suspicious", "naive"):
        outcomes_at = STRATEGIES[name].outcomes(_SUSPICIOUS, MU_D)
        if outcomes_at is not None:
            by_name[name] = outcomes_at(MU)
    return by_name


@dataclass(frozen=True)
class SimulatedRuns:
    """Means over trials and their standard errors, (slots,), by receiver: squared error, and trace of its own P."""

    squared_error: dict[str, tuple[Floats, Floats]]
    reported: dict[str, tuple[Floats, Floats]]
    trials: int


def simulate(trials: int, progress: Callable[[str], None]) -> SimulatedRuns:
    """Simulate the scheme, its links and its receivers as the emulator runs them, over many trials."""
    sums = {name: np.zeros((4, SLOTS)) for name in _LOOKS}
    for first in range(0, trials, _BATCH):
        progress(f"strategies: trial {first} of {trials}")
        _simulate_batch(Batch(SLOTS, min(_BATCH, trials - first), first), sums)
    return SimulatedRuns(
        {name: _mean_and_error(total[0], total[1], trials) for name, total in sums.items()},
        {name: _mean_and_error(total[2], total[3], trials) for name, total in sums.items()},
        trials,
    )


def draw(path: Path, runs: SimulatedRuns) -> str:
    """Draw the figure; returns its caption."""
    k, inks = np.arange(SLOTS), paper_inks(_LOOKS, {})
    with panels(path, 2, 9.6, 4.2) as (actual, reported):
        for name, (mark, line) in _LOOKS.items():
            colour = inks[name]
            theory = outcomes()[name]
            for axes, expected, (mean, error) in (
                (actual, theory, runs.squared_error[name]),
                (reported, theory.reported, runs.reported[name]),
            ):
                axes.plot(k, theoretical_traces(process(), expected, SLOTS), line, color=colour, label=name)
                axes.errorbar(
                    k, mean, 2.58 * error, fmt=mark, color=colour, markersize=4, capsize=2, elinewidth=0.9,
                    markerfacecolor="white",
                )  # fmt: skip
                axes.set_yscale("log")
                axes.set_xlabel("slot k")
        actual.set_title("(a) actual error")
        reported.set_title("(b) what each reports")
        actual.set_ylabel(r"E $\|x_k - \hat x_k\|^2$ (units of $x$, squared)")
        reported.set_ylabel(r"E tr $P_k$ of its own (units of $x$, squared)")
        reported.set_ylim(1.5e-4, 3e-3)
        actual.legend(loc="upper left", title="lines: theory; marks: simulated")
    return (
        f"Every receiver of the innovation scheme slot by slot: the paper's A and Q, Σ0 = Q, μ = μ_e = {MU}, "
        f"μ_d = {MU_D}, suspicious with μ_b = 0.8 and μ̄_b = 0.3; {runs.trials} trials of the real model (states, noises, "
        "packets); bars are 99 % intervals, lines the corrected finite-k theory. Naive and suspicious diverge and do not know."
    )


def _simulate_batch(batch: Batch, sums: dict[str, Floats]) -> None:
    model = process()
    root = root_of_seed(2024)
    keys = {name: stream_key(root, name) for name in ("process", "schedule", "noise", "coin", "link/l", "link/e")}
    scheme = Innovation(model, MU_D)
    encoder = scheme.encoder(keys, batch)
    receivers: dict[str, Receiver] = {"legitimate": scheme.estimator(keys, batch)}
    for name in ("smart", "suspicious", "naive"):
        receivers[name] = STRATEGIES[name](Knowledge(model, MU_D, _SUSPICIOUS, keys), batch)
    trajectory = Trajectory(model, keys["process"], batch)
    links = (link_of({"model": "bernoulli", "quality": MU}, keys[name], batch) for name in ("link/l", "link/e"))
    beliefs = {name: receiver.prior() for name, receiver in receivers.items()}
    for k, gammas in enumerate(zip(*(deliveries(link, batch.slots) for link in links), strict=True)):
        x = trajectory.advance()
        z = encoder.encode(k, x, trajectory.predicted).z
        for name, receiver in receivers.items():
            beliefs[name] = receiver.step(k, beliefs[name], Reception(gammas[name != "legitimate"], z))
            squared_error = np.sum((x - beliefs[name].x_hat) ** 2, axis=0)
            trace = np.trace(beliefs[name].P)
            for row, value in enumerate((squared_error, squared_error**2, trace, trace**2)):
                sums[name][row, k] += value.sum()


def _mean_and_error(total: Floats, square: Floats, trials: int) -> tuple[Floats, Floats]:
    mean = total / trials
    return mean, np.sqrt(np.maximum(square / trials - mean**2, 0.0) / trials)
