"""The reader of acknowledged references of a process whose Q is singular, against exact conditioning in fractions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from evedrop.model.receiver import Reception
from evedrop.model.reference_code import NONE, ReferenceReceiver
from tests.model.rationals import Matrix, combined, exact, inverted, times, transposed
from tests.model.singular_processes import PROCESSES, sigmas

SLOTS = 9
ACKNOWLEDGED = {0, 3, 4, 6}
HEARD = [True, True, False, False, True, True, False, True, True]
"""The reader misses slots 3 and 6, whose states are the references of later packets."""


def conditioned(shows: list[Matrix], values: list[Matrix], wanted: Matrix) -> tuple[list[float], list[list[float]]]:
    """Mean and covariance of `wanted`, given numbers `shows` of standard normal variables, one after the other."""
    rows = [row for matrix in (*shows, wanted) for row in matrix]
    joint = times(rows, transposed(rows))
    mean, seen = [Fraction(0)] * len(rows), [row[0] for value in values for row in value]
    for i, value in enumerate(seen):
        if joint[i][i] == 0:
            assert value == mean[i]
            continue
        gain, rest, own = [row[i] / joint[i][i] for row in joint], value - mean[i], joint[i]
        mean = [m + g * rest for m, g in zip(mean, gain, strict=True)]
        joint = [[a - g * b for a, b in zip(row, own, strict=True)] for row, g in zip(joint, gain, strict=True)]
    n = len(wanted)
    return [float(value) for value in mean[-n:]], [[float(value) for value in row[-n:]] for row in joint[-n:]]


@pytest.mark.parametrize("open_loop", [False, True])
@pytest.mark.parametrize("case", ["double integrator", "sampled force", "three integrators", "two of three"])
def test_the_reader_of_references_is_the_exact_posterior(case: str, open_loop: bool) -> None:
    """Mean and covariance after every slot, though packets show directions that noise has not reached yet."""
    process, random = PROCESSES[case], np.random.default_rng(3)
    n, A, G = process.n, exact(process.A), exact(process.noise_factor)
    reader, code = ReferenceReceiver(process, 1, open_loop), [A]
    for sigma in sigmas(process, SLOTS):
        noise = times(exact(process.Q), transposed(inverted(A)), inverted(sigma))
        code.append(A if open_loop else combined((1, A), (1, noise)))
    size = n * SLOTS
    drawn = [[Fraction(int(value), 64)] for value in random.integers(-96, 97, size)]
    states: list[Matrix] = []
    packets: list[Matrix] = []
    reference = NONE
    belief = reader.prior()
    for k in range(SLOTS):
        own = [[Fraction(int(c == n * k + i)) for c in range(size)] for i in range(n)]
        states.append(combined((1, times(A, states[-1])), (1, times(G, own))) if k else own)
        shown = states[k]
        if reference != NONE:
            carried = states[reference]
            for j in range(reference + 1, k + 1):
                carried = times(code[j], carried)
            shown = combined((1, shown), (-1, carried))
        if HEARD[k]:
            packets.append(shown)
        z = np.array(times(shown, drawn), np.float64)
        header = np.array([[reference]])
        belief = reader.step(k, belief, Reception(np.array([HEARD[k]]), z, header))
        mean, P = conditioned(packets, [times(factor, drawn) for factor in packets], states[k])
        assert np.allclose(belief.x_hat[:, 0], mean, rtol=0, atol=1e-6)
        assert np.allclose(belief.P[:, :, 0], P, rtol=0, atol=1e-6)
        if k in ACKNOWLEDGED:
            reference = k
    assert np.trace(belief.P[:, :, 0]) > 1e-3
