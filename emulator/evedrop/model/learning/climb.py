"""Expectation-maximisation over all slots that an eavesdropper has kept, from several starts at once.

The starts are columns next to those of the trials: a trial has one for each start, and in the end keeps the most likely one.

Source: docs/mathematics.md, eavesdroppers that learn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evedrop.model.kernels.elementary import Floats
from evedrop.model.learning.known import Known
from evedrop.model.learning.learner_posterior import LearnerPosterior, advanced, scale_of, unheard
from evedrop.model.learning.moments import Moments
from evedrop.model.learning.posterior import Parameters
from evedrop.model.receiver import Flags

PASSES = 8
"""Passes over the slots that were kept, whenever they are gone through."""
NARROW = (0.1, 0.01, 1e-4)
"""The starts' Q, over the variance of the first packets, each with A = I."""


class Learned(NamedTuple):
    """The result of a climb."""

    posterior: LearnerPosterior
    theta: Parameters
    moments: Moments
    scale: Floats
    """(R,)."""


def climbed(known: Known, first: int, gamma: Flags, z: Floats, so_far: Parameters | None) -> Learned:
    """The most likely parameters for slots from `first` on, gamma (c, R) and z (c, n, R), 0 where nothing was received.

    so_far: the parameters that were found from fewer slots, which are one more start.
    """
    scale = scale_of(gamma, z)
    # The regression that takes every packet for the state: its A has the right direction, and is too small.
    start = known.start(scale)
    every = start._replace(mu_d=np.ones_like(scale))
    _, moments, _ = _passed(known, every, first, gamma, z, scale)
    regression = moments.most_likely(every, scale, known.names)[1]._replace(mu_d=start.mu_d)
    starts = [regression, *(known.start(fraction * scale) for fraction in NARROW), *([so_far] if so_far else [])]
    several, trials = len(starts), len(scale)
    theta = Parameters(*(np.concatenate(parts, axis=-1) for parts in zip(*starts, strict=True)))
    gamma, z, scales = (np.concatenate([part] * several, axis=-1) for part in (gamma, z, scale))
    for _ in range(PASSES):
        posterior, moments, evidence = _passed(known, theta, first, gamma, z, scales)
        moments, theta = moments.most_likely(theta, scales, known.names)
    best = np.argmax(evidence.reshape(several, trials), axis=0) * trials + np.arange(trials)
    return Learned(
        LearnerPosterior(*(part[..., best] for part in posterior)),
        Parameters(*(part[..., best] for part in theta)),
        Moments(*(part[..., best] for part in moments)),
        scale,
    )


def _passed(
    known: Known, theta: Parameters, first: int, gamma: Flags, z: Floats, scale: Floats
) -> tuple[LearnerPosterior, Moments, Floats]:
    """The posterior after the slots from `first` on, the moments of their transitions, and the logarithm of their density."""
    posterior, moments = unheard(known, scale), Moments.imagined(theta.A, scale)
    evidence = np.zeros(len(scale))
    for k, (heard, packet) in enumerate(zip(gamma, z, strict=True), first):
        posterior, _, density, last = advanced(k, known, theta, posterior, heard, packet)
        evidence = evidence + density
        if k:
            moments = moments.added(theta.A, packet, heard.astype(np.float64), last)
    return posterior, moments, evidence
