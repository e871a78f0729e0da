"""The Markov chain of the legitimate estimator: how long ago it fell out of sync, and the events since.

In sync (Δ = 0) its estimate is the state. A drop leads to Δ = 1; from there every drop or innovation adds one step,
and the next state packet leads back. A word is the order of drops and innovations since.

Source: the paper's appendix, Proposition (limiting distribution); docs/mathematics.md, Markov chain.
"""

from __future__ import annotations

import numpy as np

from evedrop.model.process import Floats


def in_sync_probability(mu: float, mu_d: float) -> float:
    """π_0 = μμ_d / (1 − μ(1−μ_d)): the fraction of time without error. 1 for μ = 1, whatever μ_d is.

    Source: Proposition (limiting distribution), first part.
    """
    return 1.0 if mu == 1.0 else mu * mu_d / (1.0 - mu * (1.0 - mu_d))


def word_probability(mu: float, mu_d: float, innovations: int, drops: int) -> float:
    """Limiting probability p_i^j p_d^{l+1} π_0 of one word: a drop, then j innovations and l drops in a given order.

    Source: Proposition (limiting distribution), second part.
    """
    lost = 1.0 - mu
    decoded = mu * (1.0 - mu_d)
    return float(decoded**innovations * lost ** (drops + 1) * in_sync_probability(mu, mu_d))


def step_probabilities(mu: float, mu_d: float, steps: int) -> Floats:
    """P(Δ = i) for i = 0 … steps−1, (steps,): π_0, then p_d π_0 (p_i + p_d)^{i−1}. All steps together sum to 1.

    Source: Proposition (limiting distribution), summed over the 2^{i−1} words of a step.
    """
    in_sync = in_sync_probability(mu, mu_d)
    probabilities = (1.0 - mu) * in_sync * (1.0 - mu * mu_d) ** (np.arange(steps, dtype=np.float64) - 1.0)
    probabilities[:1] = in_sync
    return probabilities
