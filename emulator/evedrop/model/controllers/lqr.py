"""The linear quadratic regulator with clipped inputs: it needs no solver, and gives the same bits on every machine.

It minimises Σ xᵀW_x x + uᵀW_u u + (u − u′)ᵀW_r (u − u′) over decisions, with u′ the previous inputs, ignoring limits
and disturbances: u = −K [x; u′]. The Riccati equation is solved by the structured doubling algorithm.

Source: Chu, Fan and Lin (2005), Linear Algebra and its Applications 396; docs/mathematics.md, regulator.
"""

from __future__ import annotations

from typing import final

import numpy as np

from evedrop.model.controllers.controller import Assignment, Controller
from evedrop.model.kernels.elementary import inverse
from evedrop.model.process import Floats, product

_DOUBLINGS = 60  # 2⁶⁰ decisions: an iteration that has not settled after them never will
_SETTLED = 1e-13


def gain(assignment: Assignment) -> Floats:
    """K (m, n + m) of u = −K [x; u′].

    Raises ValueError if no input keeps the weighted states from growing.
    """
    return riccati(assignment)[0]


def riccati(assignment: Assignment) -> tuple[Floats, Floats]:
    """K, as `gain`, and the solution Π of the Riccati equation, (n + m, n + m): [x; u′]ᵀ Π [x; u′] is the cost from there on.

    Raises ValueError as `gain`.
    """
    A, B = held(assignment)
    n, m = B.shape
    weight_u, weight_r = np.diag(assignment.input_weights), np.diag(assignment.rate_weights)
    both = weight_u + weight_r
    # With v = u − (W_u + W_r)⁻¹ W_r u′ instead of u the weights have no products of inputs and states.
    part = product(inverse(both), weight_r)
    F = np.zeros((n + m, n + m))
    F[:n, :n], F[:n, n:], F[n:, n:] = A, product(B, part), part
    G_u = np.vstack([B, np.eye(m)])
    H = np.zeros((n + m, n + m))
    H[:n, :n] = np.diag(assignment.state_weights)
    H[n:, n:] = weight_r - product(weight_r, part)
    P = _riccati(F, product(product(G_u, inverse(both)), _transposed(G_u)), H)
    carried = product(_transposed(G_u), P)
    K = product(inverse(both + product(carried, G_u)), product(carried, F))
    K[:, n:] -= part
    return K, P


def held(assignment: Assignment, entry: Floats | None = None) -> tuple[Floats, Floats]:
    """A and B from one decision to the next, (n, n) and (n, m), with the inputs held in between.

    entry: a matrix by which something else that is held enters the states, such as B_d, instead of B.
    """
    A, B = assignment.process.A, assignment.plant.input_matrix if entry is None else entry
    power, driven = np.eye(len(A)), np.zeros(B.shape)
    for _ in range(assignment.period):
        power, driven = product(A, power), product(A, driven) + B
    return power, driven


@np.errstate(over="ignore", invalid="ignore")
def _riccati(F: Floats, G: Floats, H: Floats) -> Floats:
    """The limit P of P = Fᵀ P (1 + G P)⁻¹ F + H."""
    identity = np.eye(len(F))
    for _ in range(_DOUBLINGS):
        try:
            W = inverse(identity + product(G, H))
        except ValueError as error:
            raise ValueError("the Riccati equation has no solution") from error
        FW = product(F, W)
        more = product(product(product(_transposed(F), H), W), F)
        G = G + product(product(FW, G), _transposed(F))
        H, F = H + more, product(FW, F)
        if not np.isfinite(H).all():
            break
        if np.abs(more).max() <= _SETTLED * np.abs(H).max():
            return 0.5 * (H + _transposed(H))
    raise ValueError("the Riccati equation has no solution")


def _transposed(M: Floats) -> Floats:
    return np.ascontiguousarray(M.T)


@final
class Lqr(Controller):
    """Clips inputs first to the limits of their change, then to their own limits."""

    def __init__(self, assignment: Assignment, trials: int) -> None:
        super().__init__(assignment, trials)
        self._gain = -gain(assignment)
        plant = assignment.plant
        self._lower, self._upper = plant.input_lower[:, None], plant.input_upper[:, None]
        self._rate = assignment.rate_limits[:, None]
        self._u = np.zeros((plant.inputs, trials))

    @classmethod
    def objections(cls, assignment: Assignment) -> list[tuple[str, str]]:
        """Weights that leave an input free, and states that no input can keep from growing."""
        both = assignment.input_weights + assignment.rate_weights
        if not np.all(both > 0.0):
            return [
                ("input_weights", "leave an input without weight; expected input_weights, or rate_weights, above 0")
            ]
        try:
            gain(assignment)
        except ValueError:
            return [
                (
                    "state_weights",
                    "weigh a state that no input can keep from growing: there is no such regulator; expected an "
                    "input_matrix that reaches it, or weights of 0 there and on every state that it moves",
                )
            ]
        return []

    def decide(self, k: int, x_hat: Floats, d: Floats) -> Floats:  # noqa: ARG002 - every decision alike
        """−K [x̂; u′], clipped."""
        u = product(self._gain, np.concatenate([x_hat, self._u]))
        u = np.minimum(np.maximum(u, self._u - self._rate), self._u + self._rate)
        self._u = np.minimum(np.maximum(u, self._lower), self._upper)
        return self._u
