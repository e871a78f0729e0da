"""Expectations for a link with fading and shadowing: theory, which enters no digest and may therefore use numpy's functions.

A slot that needs power c is delivered where g · e^{sZ} ≥ c, with fading g ~ Exp(1) and shadowing Z ~ N(0, 1).

Source: docs/mathematics.md, path loss.
"""

from __future__ import annotations

import math

import numpy as np

from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.process import Floats

_AT_ONCE = 1 << 20  # numbers


def shadowing_rule(standard_deviation: float) -> tuple[Floats, Floats]:
    """Nodes e^{−sz} and weights of the mean over the shadowing; s is the standard deviation in nepers of power, both (nodes,).

    The trapezoidal rule: its error is about exp(−π²/(sh)) for a step h, because exp(−c e^{−sz}) is bounded for |Im z| <
    π/(2s). With the step used here it is below 1e-11, while a Gauss–Hermite rule of 128 nodes is off by 1e-3 at 30 dB.
    """
    if standard_deviation == 0.0:
        return np.ones(1), np.ones(1)
    step = min(0.5, 0.357 / standard_deviation)
    ahead = math.ceil(9.0 / step)
    z = np.arange(-ahead, ahead + 1) * step
    weights = np.exp(-0.5 * z * z)
    return np.exp(-standard_deviation * z), weights / weights.sum()


def delivery_probability(needed: Floats, standard_deviation: float) -> Floats:
    """E exp(−c e^{−sZ}) for each needed power c, (slots,)."""
    nodes, weights = shadowing_rule(standard_deviation)
    step = max(1, _AT_ONCE // len(nodes))
    parts = [np.exp(-needed[i : i + step, None] * nodes) @ weights for i in range(0, len(needed), step)]
    return np.concatenate(parts)


def count_variance(needed: Floats, first: int, outer: int, inner: int, standard_deviation: float) -> float:
    """Variance of the number of delivered slots among consecutive slots from `first` on that need these powers, (slots,).

    outer: slots for which the shadowing is held; inner: slots for which the fading is held, a divisor of outer.

    Given the shadowing of a block, the fading of its parts is independent, and two slots j, i of one part are both delivered
    with the smaller of their probabilities, exp(−max(c_j, c_i) e^{−sZ}).
    """
    if first % outer + len(needed) <= outer:
        outer = inner if first % inner + len(needed) <= inner else -(-(first % inner + len(needed)) // inner) * inner
        first %= inner
        if outer == inner:
            outer = inner = len(needed)
            first = 0
    lead = first % outer
    blocks = -(-(lead + len(needed)) // outer)
    padded = np.full(blocks * outer, np.inf)  # never delivered
    padded[lead : lead + len(needed)] = needed
    parts = np.sort(padded.reshape(blocks, outer // inner, inner), axis=2)
    step = max(1, _AT_ONCE // outer)
    return sum_in_order(_variance_of(parts[i : i + step], standard_deviation) for i in range(0, blocks, step))


def _variance_of(parts: Floats, standard_deviation: float) -> float:
    """The same for whole blocks, (blocks, parts, slots), the powers of each part in ascending order."""
    pairs = 2.0 * np.arange(parts.shape[2]) + 1.0  # the number of pairs in a part in which a slot needs the most
    second, mean = 0.0, np.zeros(len(parts))
    for node, weight in zip(*shadowing_rule(standard_deviation), strict=True):
        delivered = np.exp(-parts * node)
        part = delivered.sum(axis=2)
        block = part.sum(axis=1)
        second += weight * float((delivered @ pairs - part * part).sum() + (block * block).sum())
        mean += weight * block
    return second - float((mean * mean).sum())
