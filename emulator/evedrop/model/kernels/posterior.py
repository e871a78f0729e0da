"""A slot of the Bayesian eavesdropper in numpy: the components of its posterior, weighed by a packet.

Source: docs/mathematics.md, bayesian eavesdropper.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.elementary import Floats, exp, product
from evedrop.model.kernels.factored import Factor, grown, squared_length
from evedrop.model.kernels.leak import Leak
from evedrop.model.kernels.mixtures import Mixture, opened, pruned, summed

_Flags = NDArray[np.bool_]
_Kind = TypeVar("_Kind", bound=np.generic)

_CERTAIN = 300.0  # an exponent at which a packet is certainly the state, still far from overflow
_SURE = 1e300  # stands for all larger odds
_IMPOSSIBLE = -700.0  # an exponent at which it certainly is not, still far from underflow


class MixtureModel(NamedTuple):
    """What does not change from slot to slot."""

    A: Floats
    """(n, n)."""
    noise: Factor
    """Q, factored."""
    state_probability: float
    """μ_d."""
    capacity: int
    """The most components of a trial."""


def step(
    model: MixtureModel, of: Mixture, gamma: _Flags, z: Floats, leak: Leak | None, rounding: Floats
) -> tuple[Mixture, Floats]:
    """The mixture one slot later, and the probability that the packet is the state, (R,).

    gamma (R,); z (n, R), 0 where nothing was received; leak: None in slot 0, in which a packet is the state; rounding (n,): the
    least variance of packets about their prediction.
    """
    if leak is None:
        state = gamma.astype(np.float64)
        of = Mixture(np.where(gamma, 0.0, of.weight), *(part.copy() for part in of[1:]))
    else:
        of, state = _weighed(model, of, gamma, z, leak, rounding)
    return opened(pruned(of), state, z, model.capacity), state


def _weighed(
    model: MixtureModel, of: Mixture, gamma: _Flags, z: Floats, leak: Leak, rounding: Floats
) -> tuple[Mixture, Floats]:
    """The components one slot later, without the packet's own, and the probability that the packet is the state, (R,).

    The costly steps skip empty places, which usually are half of all.
    """
    there = np.flatnonzero(of.weight)
    trial = there % max(1, of.weight.shape[1])
    some = Mixture(*(_taken(part.reshape(*part.shape[:-2], of.weight.size), there) for part in of))
    white, heard = leak.white(z), _taken(gamma, trial)
    mean = product(model.A, some.mean)
    predicted, informed = grown(model.A, some.spread, model.noise, leak.remaining_factor)
    seen = predicted.rounded(rounding)
    squared = squared_length(seen, list(_taken(z, trial) - mean))
    alone = _taken(_squared(white), trial)
    ratios = np.zeros(of.weight.shape)
    ratios.reshape(-1)[there] = _weighed_ratios(
        heard, some.weight, squared, np.where(predicted.diagonal > 0.0, seen.diagonal, predicted.diagonal), alone, leak
    )
    state, other = _type_probabilities(model.state_probability, summed(ratios), gamma)
    mean += _taken(np.where(gamma, leak.innovation(white), 0.0), trial)
    for after, known in zip(predicted, informed, strict=True):
        np.copyto(after, known, where=heard)
    spread = [np.zeros(part.shape) for part in of[1:]]
    for whole, part in zip(spread, (mean, *predicted), strict=True):
        for row, values in zip(whole.reshape(len(whole), of.weight.size), part, strict=True):
            row[there] = values
    return Mixture(of.weight * other, *spread), state


def _type_probabilities(mu_d: float, ratio: Floats, gamma: _Flags) -> tuple[Floats, Floats]:
    """Probabilities that the packet is the state, and that it is not, (R,); 0 and 1 where nothing was received.

    ratio: of the packet's densities under the two types, (R,).
    """
    if mu_d == 1.0:
        state = gamma.astype(np.float64)
        return state, 1.0 - state
    odds = np.minimum(mu_d / (1.0 - mu_d) * ratio, _SURE)
    return np.where(gamma, odds / (1.0 + odds), 0.0), np.where(gamma, 1.0 / (1.0 + odds), 1.0)


def _taken(part: NDArray[_Kind], places: NDArray[np.intp]) -> NDArray[_Kind]:
    """Some places of the last axis, all of them valid."""
    return part.take(places, axis=-1, mode="clip") if len(places) else part[..., :0]


def _squared(white: Floats) -> Floats:
    """Squared lengths of (n, R), (R,)."""
    total: Floats = white[0] * white[0]
    for row in white[1:]:
        total += row * row
    return total


def _weighed_ratios(
    heard: _Flags, weight: Floats, squared: Floats, diagonal: Floats, alone: Floats, leak: Leak
) -> Floats:
    """π_j N(z; m_j, P_j) / N(z; 0, Σ_k) of components whose trial received z, (N,); 0 for all others.

    weight: π, (N,); squared: (z − m)ᵀ P⁻¹ (z − m), (N,); diagonal: D of P's factors, (n, N); alone: zᵀ Σ_k⁻¹ z, (N,). A packet in
    the range of a singular P has an infinite density, for which 1e300 stands.
    """
    exponent = 0.5 * (alone - squared)
    # Most packets are far from the threshold, and need no exponential.
    some = np.flatnonzero((exponent > _IMPOSSIBLE) & heard)
    determinant = np.ones(len(some))
    for D, state in zip(diagonal, leak.state_diagonal, strict=True):
        determinant *= D[some] / state
    likely = exp(np.minimum(exponent[some], _CERTAIN))
    ratios = np.zeros(weight.shape)
    with np.errstate(divide="ignore", over="ignore"):
        found = weight[some] * likely / np.sqrt(determinant)
    ratios[some] = np.where(found > _SURE, _SURE, found)
    return ratios
