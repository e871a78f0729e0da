"""Model predictive control: every decision finds the best inputs over a horizon of decisions and applies the first.

It minimises Σ xᵀW_x x + uᵀW_u u + (u − u′)ᵀW_r (u − u′) + soft·‖s‖² over `horizon` decisions of a period each, with
disturbances constant at their current values, within the limits of inputs and of their change; s is the amount by which
states exceed their limits, which inputs may be unable to prevent.

OSQP, of the extra `microgrid`, solves it. A solver's arithmetic is like LAPACK's, so its last bits may, unlike those of
everything else that enters a digest, differ between processors: a live run and the same run in memory agree on
one machine.
Source: docs/microgrid.md, controllers.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any, ClassVar, final

import numpy as np

from evedrop.model.controllers.controller import Assignment, Controller
from evedrop.model.controllers.lqr import held
from evedrop.model.process import Floats

_UNBOUNDED = 1e30
_SETTINGS: Mapping[str, Any] = MappingProxyType(
    {
        "verbose": False,
        "warm_starting": True,
        "polishing": False,
        "eps_abs": 1e-4,
        "eps_rel": 1e-4,
        "max_iter": 4000,
        # Adapted by iterations, not by the clock: the same numbers give the same decision.
        "adaptive_rho": True,
        "adaptive_rho_interval": 50,
        "check_termination": 10,
        "rho": 10.0,  # found by trial: the fewest iterations on the microgrid's day
    }
)


@final
class Mpc(Controller):
    """A solver for every trial, each started from its solution of the previous decision.

    Where a solver finds no solution, the previous inputs are held and `failed` is set.
    """

    parameters = MappingProxyType({"horizon": 60, "soft": 1000.0})
    optional: ClassVar[Mapping[str, Any]] = parameters

    def __init__(self, assignment: Assignment, trials: int) -> None:
        super().__init__(assignment, trials)
        import osqp  # noqa: PLC0415 - an optional dependency, and a tenth of a second for those that do not need it

        self._programme = programme = _Programme(assignment)
        self.solvers: list[osqp.OSQP] = []
        """One per trial."""
        for _ in range(trials):
            solver = osqp.OSQP()
            solver.setup(
                programme.weights, programme.linear, programme.rows, programme.lower, programme.upper, **_SETTINGS
            )
            self.solvers.append(solver)
        self._solved = int(osqp.SolverStatus.OSQP_SOLVED)
        self._u = np.zeros((assignment.plant.inputs, trials))

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A horizon that is not a number of decisions, or a weight that is not positive."""
        mistakes = []
        horizon, soft = given.get("horizon", 1), given.get("soft", 1.0)
        if type(horizon) is not int or not 1 <= horizon <= 1000:
            mistakes.append(
                ("horizon", f"is {horizon!r}; expected a whole number from 1 to 1000, such as horizon = 60")
            )
        if type(soft) not in (int, float) or not 0.0 < soft < 1e12:
            mistakes.append(("soft", f"is {soft!r}; expected a number above 0, such as soft = 1000.0"))
        return mistakes

    @classmethod
    def objections(cls, assignment: Assignment) -> list[tuple[str, str]]:
        """A missing or broken solver, and inputs without weight, for which no best inputs exist."""
        if find_spec("osqp") is None:
            return [
                (
                    "strategy",
                    "is mpc, whose solver is not installed; expected pip install '.[microgrid]' in the checkout first",
                )
            ]
        why = _broken()
        if why is not None:
            remedy = "expected pip install --force-reinstall osqp first, or the strategy lqr"
            return [("strategy", f"is mpc, whose solver is broken ({why}); {remedy}")]
        if not np.all(assignment.input_weights + assignment.rate_weights > 0.0):
            return [
                ("input_weights", "leave an input without weight; expected input_weights, or rate_weights, above 0")
            ]
        return []

    def decide(self, k: int, x_hat: Floats, d: Floats) -> Floats:  # noqa: ARG002 - every decision alike
        """The first of the best inputs of the horizon, for each trial by its own solver."""
        programme = self._programme
        decided = self._u.copy()
        for r, solver in enumerate(self.solvers):
            linear, lower, upper = programme.at(x_hat[:, r], d if d.ndim == 1 else d[:, r], self._u[:, r])
            solver.update(q=linear, l=lower, u=upper)
            solution = solver.solve(raise_error=False)
            self.failed[r] = solution.info.status_val != self._solved
            if not self.failed[r]:
                decided[:, r] = programme.first(solution.x, self._u[:, r])
        self._u = decided
        return decided


def _broken() -> str | None:
    """Why the installed solver cannot be used; None if it can."""
    try:
        osqp = import_module("osqp")
        _ = osqp.OSQP, int(osqp.SolverStatus.OSQP_SOLVED)
    except Exception as error:  # importing a broken extension module may raise anything
        return f"importing osqp raised {type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
    return None


class _Programme:
    """The quadratic programme: variables are the states x_1 … x_N, the inputs u_0 … u_{N−1}, and the excesses s_1 … s_N.

    Rows: the plant, the states' limits, the inputs' limits, the limits of their change.
    """

    def __init__(self, assignment: Assignment) -> None:
        sparse: Any = import_module("scipy.sparse")  # imported only where there is such a controller

        plant, N = assignment.plant, int(assignment.parameters["horizon"])
        A, B = held(assignment)
        n, m = B.shape
        self._A, self._n, self._m, self._N = A, n, m, N
        self._disturbed = held(assignment, plant.disturbance_matrix)[1]
        self._rate = assignment.rate_limits
        self._rate_weights = assignment.rate_weights
        self._input_lower, self._input_upper = plant.input_lower, plant.input_upper
        states, inputs = n * N, m * N
        identity, before = sparse.eye(N), sparse.eye(N, k=-1)
        change = identity - before
        weight_u = sparse.kron(identity, sparse.diags(assignment.input_weights))
        weight_r = sparse.kron(change.T @ change, sparse.diags(assignment.rate_weights))
        weights = sparse.block_diag(
            [
                sparse.kron(identity, sparse.diags(assignment.state_weights)),
                weight_u + weight_r,
                float(assignment.parameters["soft"]) * sparse.eye(states),
            ]
        )
        self.weights = sparse.triu(2.0 * weights, format="csc")
        self.linear = np.zeros(2 * states + inputs)
        no = sparse.csc_matrix
        dynamics = [sparse.eye(states) - sparse.kron(before, A), -sparse.kron(identity, B), no((states, states))]
        limits = [sparse.eye(states), no((states, inputs)), sparse.eye(states)]
        own = [no((inputs, states)), sparse.eye(inputs), no((inputs, states))]
        changes = [no((inputs, states)), sparse.kron(change, sparse.eye(m)), no((inputs, states))]
        self.rows = sparse.bmat([dynamics, limits, own, changes], format="csc")
        nothing = np.zeros(states)
        self.lower = np.concatenate(
            [nothing, np.tile(plant.state_lower, N), np.tile(plant.input_lower, N), np.tile(-self._rate, N)]
        ).clip(-_UNBOUNDED, _UNBOUNDED)
        self.upper = np.concatenate(
            [nothing, np.tile(plant.state_upper, N), np.tile(plant.input_upper, N), np.tile(self._rate, N)]
        ).clip(-_UNBOUNDED, _UNBOUNDED)

    def at(self, x: Floats, d: Floats, before: Floats) -> tuple[Floats, Floats, Floats]:
        """Linear term and limits of the rows, for a state x (n,), disturbances d (q,) and the previous inputs (m,)."""
        n, m, N = self._n, self._m, self._N
        moved = np.tile(self._disturbed @ d, N)
        moved[:n] += self._A @ x
        self.lower[: n * N] = self.upper[: n * N] = moved
        first = slice(2 * n * N + m * N, 2 * n * N + m * N + m)
        self.lower[first] = np.clip(before - self._rate, -_UNBOUNDED, _UNBOUNDED)
        self.upper[first] = np.clip(before + self._rate, -_UNBOUNDED, _UNBOUNDED)
        self.linear[n * N : n * N + m] = -2.0 * self._rate_weights * before
        return self.linear, self.lower, self.upper

    def first(self, solution: Floats, before: Floats) -> Floats:
        """The first inputs of a solution, (m,), exactly within their limits, which a solver keeps only to its tolerance."""
        u = solution[self._n * self._N : self._n * self._N + self._m]
        u = np.clip(u, before - self._rate, before + self._rate)
        return np.clip(u, self._input_lower, self._input_upper)
