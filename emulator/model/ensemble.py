"""Actual error covariances given the events of a slot: what a study needs that simulates covariances alone.

Given the events, the covariance is the mean of e eᵀ over all states and noises, not over events: its mean over trials
estimates `theory.expected_covariances`. Trials are the last axis, elementwise as in process.py.

Source: docs/mathematics.md, eavesdroppers.
"""

from __future__ import annotations

import numpy as np

from emulator.model.process import Floats, Process
from emulator.model.receiver import Flags


def initial_covariance(process: Process, used: Flags) -> Floats:
    """P_0 of any receiver, (n, n, R): 0 where the packet of slot 0 was used, else Σ0.

    used (R,): received and used; that packet always holds the state.

    Source: docs/mathematics.md, legitimate estimator.
    """
    return np.where(used, 0.0, process.initial_covariance[:, :, None])


def legitimate_step(process: Process, P: Floats, gamma: Flags, nu: Flags) -> Floats:
    """P_k of the estimator that holds the secret, k ≥ 1, (n, n, R), from P_{k−1}; it is also what it believes.

    gamma (R,): received; nu (R,): the packet holds an innovation.

    Source: Theorem IV.1.
    """
    carried = process.carry(P)
    return np.where(gamma, np.where(nu, carried, 0.0), process.diffuse(carried))


def packet_user_step(process: Process, P: Floats, used: Flags, nu: Flags, misled_covariance: Floats) -> Floats:
    """Actual P_k of an eavesdropper that uses packets as states, k ≥ 1, (n, n, R), from P_{k−1}.

    used (R,): received and used; nu (R,): the packet holds an innovation; misled_covariance (n, n): f_k of
    `theory.misled_covariances`.

    Source: Lemma V.1.
    """
    wrong = np.where(nu, misled_covariance[:, :, None], 0.0)
    return np.where(used, wrong, process.diffuse(process.carry(P)))
