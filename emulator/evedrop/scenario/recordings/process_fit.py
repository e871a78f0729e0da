"""The process that explains a recording of states best: A and Q by least squares, with standard errors.

Source: docs/mathematics/plant.md, given states; docs/programs.md, a model of the states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evedrop.counting import counted
from evedrop.errors import UsageError
from evedrop.model.checks import toml_of
from evedrop.model.kernels.elementary import normal_quantile
from evedrop.model.process import Floats, mistakes_of
from evedrop.model.slot.cores import LARGEST, deviations
from evedrop.scenario.recordings.disturbance_file import StateRecording, recorded_states

FEWEST = 10
"""The fewest transitions for each state from which a process can be estimated."""
_EXACT = 1e-9  # of a state's size: smaller residuals are rounding
_LEVEL = 0.01


@dataclass(frozen=True)
class ProcessFit:
    """The fit of a recording."""

    recording: StateRecording
    reference: Floats
    """(n,)."""
    A: Floats
    """(n, n); its standard errors are in `A_error`, and so on."""
    A_error: Floats
    Q: Floats
    Q_error: Floats
    initial_covariance: Floats
    correlation: Floats
    """The correlation of each state's residuals with those of the slot before, (n,); NaN without residuals."""
    singular: bool
    """Whether Q has a direction without variance."""

    @property
    def transitions(self) -> int:
        """How many pairs of consecutive states there are."""
        return len(self.recording.rows) - 1

    @property
    def exact(self) -> list[str]:
        """The states that follow from those before without noise."""
        return [name for name, own in zip(self.recording.names, np.diag(self.Q), strict=True) if own == 0.0]

    @property
    def spectral_radius(self) -> float:
        """ρ(A)."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    @property
    def unexplained(self) -> list[str]:
        """The states whose residuals depend on those before, so that noise that is white does not explain them."""
        quantile = normal_quantile(np.array([1.0 - 0.5 * _LEVEL / len(self.A)])).item()
        limit = quantile / math.sqrt(self.transitions)
        correlations = zip(self.recording.names, np.abs(self.correlation), strict=True)
        return [name for name, size in correlations if size > limit]

    @property
    def table(self) -> dict[str, Any]:
        """The entries of `[process]`."""
        recording, entries = self.recording, {"states": list(self.recording.names)}
        entries_: dict[str, Any] = {**entries, **({} if recording.units is None else {"units": list(recording.units)})}
        entries_ |= {} if not self.reference.any() else {"reference": self.reference.tolist()}
        entries_ |= {name: getattr(self, name).tolist() for name in ("A", "Q", "initial_covariance")}
        return {**entries_, **({"singular_noise": True} if self.singular else {}), "theory": True}

    @property
    def toml(self) -> str:
        """The table for the scenario, which takes its states from the recording."""
        source = {"source": "file", "state_file": self.recording.path}
        lines = [f"{name} = {toml_of(value)}" for name, value in {**self.table, **source}.items()]
        head = [] if self.recording.seconds is None else [f"slot_seconds = {self.recording.seconds:.6g}", ""]
        return "\n".join([*head, "[process]", *lines])

    @property
    def remarks(self) -> list[str]:
        """The fit in sentences."""
        names = self.recording.names
        remarks = [f"{self.recording.path}: {self.transitions + 1} states of {', '.join(names)}"]
        for matrix, values, errors in (("A", self.A, self.A_error), ("Q", self.Q, self.Q_error)):
            rows = zip(values.tolist(), errors.tolist(), strict=True)
            shown = [", ".join(f"{v:.4g} ± {e:.2g}" for v, e in zip(*row, strict=True)) for row in rows]
            remarks += [f"{matrix}: {line}" for line in shown]
        remarks.append(f"spectral radius {self.spectral_radius:.6g}")
        if self.exact:
            remarks.append(f"{', '.join(self.exact)}: without noise, so Q is singular")
        elif self.singular:
            remarks.append(f"the noise of {', '.join(names)} has fewer sources than states, so Q is singular")
        if self.unexplained:
            remarks.append(
                f"{', '.join(self.unexplained)}: the residuals depend on those before, so no process with white noise explains "
                "them: theory describes these states only roughly; more states, or fewer slots a second, may help"
            )
        return remarks

    def as_dict(self) -> dict[str, Any]:
        """The fit as JSON values."""
        errors = {"A": self.A_error.tolist(), "Q": self.Q_error.tolist()}
        return {
            "transitions": self.transitions,
            "process": self.table,
            "standard_errors": errors,
            "slot_seconds": self.recording.seconds,
            "spectral_radius": self.spectral_radius,
            "residual_correlation": [
                None if math.isnan(correlation) else correlation for correlation in self.correlation.tolist()
            ],
            "unexplained": self.unexplained,
        }


def fit_process(path: Path, names: Sequence[str] | None = None, reference: Sequence[float] | None = None) -> ProcessFit:
    """Fit a process to a CSV file of states; names: its columns, by default all but the time; reference: (n,), by default 0.

    Raises UsageError if the file cannot be read, has too few states, or is not explained by one process.
    """
    recording = recorded_states(path, names)
    n, count = len(recording.names), len(recording.rows) - 1
    if reference is not None and len(reference) != n:
        raise UsageError(
            f"--reference has {counted(len(reference), 'number')}; expected {n}, one for each of {', '.join(recording.names)}"
        )
    if count < FEWEST * n:
        raise UsageError(
            f"{path} has {counted(count + 1, 'state')}; expected at least {FEWEST * n + 1}, for a process of {n} states"
        )
    around = np.zeros(n) if reference is None else np.array(reference, np.float64)
    x = deviations(np.array(recording.rows), around)
    if not np.all(np.abs(x) <= LARGEST):
        raise UsageError(f"{path} has {np.abs(x).max():g}; expected numbers of at most {LARGEST:g}")
    size = np.sqrt(np.mean(x * x, axis=0))
    scaled = x[:-1] / np.where(size > 0.0, size, 1.0)
    solution, _, rank, _ = np.linalg.lstsq(scaled, x[1:], rcond=None)
    if rank < n:
        raise UsageError(
            f"{path}: the states depend on each other, or do not move, so that A is not determined; leave some of "
            f"{', '.join(recording.names)} out, by --states"
        )
    A = (solution / size[:, None]).T
    with np.errstate(over="ignore", invalid="ignore"):  # of states that are tiny: then A is refused
        residuals = x[1:] - x[:-1] @ A.T
    noisy = np.sqrt(np.mean(residuals * residuals, axis=0)) > _EXACT * size
    if not noisy.any() and np.isfinite(residuals).all():
        raise UsageError(
            f"{path}: every state follows from those before without noise, so nothing about them is uncertain once one of them "
            "is received; expected states that noise moves"
        )
    residuals = residuals * noisy
    Q = residuals.T @ residuals / (count - n)
    Q = 0.5 * (Q + Q.T)
    spread = np.sum(np.linalg.inv(np.linalg.qr(scaled, mode="r")) ** 2, axis=1) / size**2  # the diagonal of (X Xᵀ)⁻¹
    own = np.diag(Q)
    singular = bool(mistakes_of(A, Q, np.eye(n)))  # or there is another mistake, which remains below
    initial = np.diag(np.where(x[0] == 0.0, size**2 * singular, x[0] ** 2)) + Q
    wrong = mistakes_of(A, Q, initial, singular)
    if wrong:
        raise UsageError(
            f"{path} is not explained by a process: " + "; ".join(f"{name} {problem}" for name, problem in wrong)
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.sum(residuals[1:] * residuals[:-1], axis=0) / np.sum(residuals * residuals, axis=0)
    return ProcessFit(
        recording,
        around,
        A,
        np.sqrt(np.outer(own, spread)),
        Q,
        np.sqrt((np.outer(own, own) + Q * Q) / (count - n)),
        initial,
        correlation,
        singular,
    )
