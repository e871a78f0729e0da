"""The sensor's filter: from noisy measurements y = C x + v it computes the estimate x̂ˢ that is transmitted instead of x.

It knows the plant, its inputs and its disturbances, so its innovations are white, with covariance S_k, and the transmitted
estimate follows x̂ˢ_{k+1} = A x̂ˢ_k + B u_k + B_d d_k + K_{k+1} ν_{k+1}: for the network, process noise of covariance K S Kᵀ.

Source: docs/mathematics/plant.md, a filter at the sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, final

import numpy as np

from evedrop.model.kernels.elementary import cholesky, has_settled, inverse, semidefinite_factor
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process, product
from evedrop.model.streams import Ahead, Batch, BlockReader

_SETTLED = 1e-14  # relative to the largest entry
_SETTLED_EACH = 1e-12  # relative to the states' own variances, at the start or now: states may have units of any size
_LONGEST = 200_000  # slots after which a filter is regarded as not settling
_LONGEST_OF_MANY = 4_000  # the same for a filter with many states or measurements, whose slots take longer
_SOME = 4
MOST_STATES = 16
"""The most states, and measurements, of a filter: it is computed in plain arithmetic, in a time that grows with their cube."""
_JUDGED = 32_768  # slots after which a filter that does not even converge slowly is regarded as not settling
# The change over the last doubling of slots, relative to the one before: ½ if it decays as 1/k, at most ⅓ if it decays as a
# useful exponential, 2 if it grows as k.
_NEARER = 0.45


class FilterStep(NamedTuple):
    """The filter in one slot."""

    gain: Floats
    """K, (n, p)."""
    covariance: Floats
    """Covariance of x − x̂ˢ, (n, n)."""
    innovation: Floats
    """K S Kᵀ, (n, n): the covariance of the measurement's contribution to x̂ˢ."""
    expected: Floats
    """S, (p, p): the covariance of the innovation y − C x̂ˢ⁻ itself."""
    predicted: Floats
    """Covariance of x − x̂ˢ before the next measurement, (n, n)."""


@final
class Steps:
    """The filter slot by slot from 0 on, until it has settled; the arithmetic is the same on every machine."""

    def __init__(self, process: Process, plant: Plant) -> None:
        self._A, self._W = process.A, plant.noise
        self._C, self._V = _measured(plant)
        self._predicted, self._initial = process.initial_covariance, np.diag(process.initial_covariance)
        self._last: FilterStep | None = None
        self.settled = False

    def next(self) -> FilterStep:
        """The filter in the next slot. Raises ValueError if measurements have no noise and contain nothing new."""
        if self.settled and self._last is not None:
            return self._last
        C, P = self._C, self._predicted
        PCt = product(P, C.T)
        S = product(C, PCt) + self._V
        K = product(PCt, inverse(S))
        rest = np.eye(len(P)) - product(K, C)
        # Joseph's form remains a covariance however small it gets.
        after = product(product(rest, P), rest.T) + product(product(K, self._V), K.T)
        after = 0.5 * (after + after.T)
        predicted = product(product(self._A, after), self._A.T) + self._W
        innovation = product(product(K, S), K.T)
        step = FilterStep(
            K,
            after,
            0.5 * (innovation + innovation.T),
            0.5 * (S + S.T),
            0.5 * (predicted + predicted.T),
        )
        change, variances = predicted - P, np.maximum(np.diag(predicted), self._initial)
        as_a_whole = bool(np.abs(change).max() <= _SETTLED * np.abs(predicted).max())
        self.settled = as_a_whole and has_settled(change, variances, _SETTLED_EACH)
        self._predicted, self._last = predicted, step
        return step


@np.errstate(over="ignore", invalid="ignore")
def settled(process: Process, plant: Plant) -> FilterStep:
    """The filter's steady state. Raises ValueError if it never settles or ends up ignoring all measurements."""
    steps = Steps(process, plant)
    marks = []
    longest = _LONGEST if max(process.n, len(_measured(plant)[0])) <= _SOME else _LONGEST_OF_MANY
    for k in range(1, longest + 1):
        step = steps.next()
        if not np.isfinite(step.covariance).all():
            break
        if k in {_JUDGED // 4, _JUDGED // 2, _JUDGED}:
            marks.append(step.covariance)
            if k == _JUDGED and np.abs(marks[2] - marks[1]).max() > _NEARER * np.abs(marks[1] - marks[0]).max():
                break
        if steps.settled:
            if not step.innovation.any():
                break
            return step
    raise ValueError("the filter does not settle")


@final
class LocalFilter:
    """The estimates of a batch, slot by slot.

    key: the key of the stream `measurement`; spoofing: changes the measurements of a slot, (p, R), before the filter gets them.
    """

    def __init__(
        self,
        process: Process,
        plant: Plant,
        key: bytes,
        batch: Batch,
        spoofing: Callable[[int, Floats], Floats] | None = None,
    ) -> None:
        self._process = process
        self._steps = Steps(process, plant)
        self._C, V = _measured(plant)
        factor = semidefinite_factor(V)
        reader = BlockReader(key, batch, len(self._C))
        self._noise = Ahead(reader.ahead, lambda slots: product(factor, reader.normals(slots)))
        self._spoofing = spoofing
        self._step: FilterStep
        self._whitening: tuple[FilterStep, Floats] | None = None
        self._innovation: Floats
        self.x: Floats = np.zeros((process.n, batch.trials))
        """x̂ˢ of the last slot, (n, R)."""
        self.predicted: Floats = self.x
        """A x̂ˢ of the slot before, (n, R): the transmitted innovation is measured against it."""

    def take(self, k: int, x: Floats, pushed: Floats) -> Floats:
        """x̂ˢ of slot k, (n, R), from its state x (n, R) and the effect of inputs and disturbances on it, (n, R) or (n, 1)."""
        self.predicted = self._process.predict(self.x) if k else self.x
        before = self.predicted + pushed
        y = product(self._C, x) + self._noise.at(k)
        if self._spoofing is not None:
            y = self._spoofing(k, y)
        self._step, self._innovation = self._steps.next(), y - product(self._C, before)
        self.x = before + product(self._step.gain, self._innovation)
        return self.x

    @property
    def normalised(self) -> Floats:
        """The innovation of the last slot divided by the lower triangular factor of its covariance S, (p, R)."""
        if self._whitening is None or self._whitening[0] is not self._step:
            self._whitening = self._step, inverse(cholesky(self._step.expected))
        return product(self._whitening[1], self._innovation)


def _measured(plant: Plant) -> tuple[Floats, Floats]:
    """C (p, n) and the covariance V (p, p) of the noise. Raises ValueError if nothing is measured."""
    if plant.output_matrix is None or plant.measurement_noise is None:
        raise ValueError("the plant's states are not measured")
    return plant.output_matrix, plant.measurement_noise
