"""The variance, over trials, of the number of packets delivered by a link with a memory.

Source: docs/mathematics.md, losses in bursts (rate of one trial).
"""

from __future__ import annotations

import numpy as np

from evedrop.model.process import Floats


def count_variance(transitions: Floats, law: Floats, quality: Floats, slots: int) -> float:
    """Variance of the number of packets that a chain in its stationary law delivers in `slots` slots.

    transitions (states, states), law (states,), quality (states,): as in `Chain`; slots ≥ 1. Exact, by doubling: the number
    of matrix products grows with the logarithm of the slots.
    """
    mean = float(law @ quality)
    centred = quality - mean
    # Without the stationary part the chain's powers decay, and no large numbers are subtracted from each other.
    fading = transitions - law
    own = np.eye(len(law))
    power, partial, total = own - np.outer(np.ones(len(law)), law), np.zeros_like(own), np.zeros_like(own)
    count = 0
    for bit in f"{slots:b}":
        # power = Tⁿ, partial = Σ_{j<n} T^j, total = Σ_{j<n} (n−j) T^j, of the chain without its stationary part
        total = total + count * partial + power @ total
        partial = partial + power @ partial
        power = power @ power
        count *= 2
        if bit == "1":
            partial = partial + power
            total = total + partial
            power = power @ fading
            count += 1
    together = float((law * centred) @ (2.0 * total @ centred)) - slots * float(law @ (centred * centred))
    return max(0.0, together) + slots * float(law @ (quality * (1.0 - quality)))
