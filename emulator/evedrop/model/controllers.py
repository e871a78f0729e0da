"""The base class of controllers, and the control strategies by their name in a scenario.

Both minimise Σ xᵀW_x x + uᵀW_u u + (u − u′)ᵀW_r (u − u′) over decisions, with u′ the previous inputs.

The linear quadratic regulator ignores limits and disturbances and clips its inputs: u = −K [x; u′]. It needs no solver and gives
the same bits on every machine; the Riccati equation is solved by the structured doubling algorithm (Chu, Fan and Lin 2005, Linear
Algebra and its Applications 396; docs/mathematics/plant.md, regulator).

In model predictive control, every decision finds the best inputs over a horizon of decisions and applies the first. It minimises
the sum with soft·‖s‖² added over `horizon` decisions of a period each, with disturbances constant at their current values, within
the limits of inputs and of their change; s is the amount by which states exceed their limits, which inputs may be unable to
prevent. OSQP, of the extra `microgrid`, solves it. A solver's arithmetic is like LAPACK's, so its last bits may, unlike those of
everything else that enters a digest, differ between processors: a live run and the same run in memory agree on one machine.

Source: docs/microgrid.md, controllers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any, ClassVar, final

import numpy as np

from evedrop.model.checks import Parametrised, expect_shapes
from evedrop.model.kernels.elementary import has_settled, inverse
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Limits, Process, product
from evedrop.model.receiver import Flags

LONGEST_PERIOD = 1_000_000
"""The most slots between two decisions: a controller multiplies matrices for each of them when it begins."""


@dataclass(frozen=True)
class Assignment:
    """All that a controller knows. States are deviations from the public reference, to which it steers."""

    process: Process
    """Its A is the plant's A."""
    plant: Plant
    period: int
    """Slots between decisions; the inputs are held between them."""
    slot_seconds: float
    """The duration of a slot."""
    state_weights: Floats
    """Diagonal of the weight of the states, (n,)."""
    input_weights: Floats
    """Diagonal of the weight of the inputs, (m,)."""
    rate_weights: Floats
    """Diagonal of the weight of the inputs' change between decisions, (m,)."""
    rate_limits: Limits
    """The largest change of each input between decisions, (m,); inf where there is no limit."""
    parameters: Mapping[str, Any]
    """The strategy's own parameters."""

    def __post_init__(self) -> None:
        n, m = self.plant.input_matrix.shape
        expect_shapes(
            self, {"state_weights": (n,), **dict.fromkeys(("input_weights", "rate_weights", "rate_limits"), (m,))}
        )
        if not 1 <= self.period <= LONGEST_PERIOD:
            raise ValueError(f"period is {self.period}, expected 1 to {LONGEST_PERIOD}")
        if self.slot_seconds < 0.0:
            raise ValueError(f"slot_seconds is {self.slot_seconds}, expected 0 or more")


class Controller(Parametrised, ABC):
    """A control strategy.

    `parameters` are the entries of the scenario's `[controller]` for this strategy, each with an example.
    """

    optional: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Defaults of the `parameters` that may be left out."""

    def __init__(self, assignment: Assignment, trials: int) -> None:
        self.assignment = assignment
        self.trials = trials
        self.failed: Flags = np.zeros(trials, np.bool_)
        """Whether the last decision failed, (R,), so that the previous inputs were held."""

    @classmethod
    @abstractmethod
    def objections(cls, assignment: Assignment) -> list[tuple[str, str]]:
        """Reasons why it cannot do what is asked: (entry of `[controller]`, value found and expected)."""

    @abstractmethod
    def decide(self, k: int, x_hat: Floats, d: Floats) -> Floats:
        """The inputs (m, R) from slot k on, a multiple of the period; slots come in order.

        x_hat: estimate of the state of slot k, (n, R); d: the disturbances of slot k, (q,), or (q, R) where trials differ.
        Sets `failed`. A trial's inputs must not depend on the other trials.
        """


_DOUBLINGS = 60  # 2⁶⁰ decisions: an iteration that has not settled after them never will
_SETTLED = 1e-13


def gain(assignment: Assignment) -> Floats:
    """K (m, n + m) of u = −K [x; u′].

    Raises ValueError if no input keeps the weighted states from growing, or numbers leave double precision.
    """
    return riccati(assignment)[0]


@np.errstate(over="ignore", invalid="ignore")  # of weights that leave double precision, which are refused
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
    P = _riccati(F, product(product(G_u, inverse(both)), G_u.T), H)
    carried = product(G_u.T, P)
    K = product(inverse(both + product(carried, G_u)), product(carried, F))
    K[:, n:] -= part
    if not np.isfinite(K).all():
        raise ValueError("the weights leave double precision")
    return K, P


@np.errstate(over="ignore", invalid="ignore")  # of an input matrix that leaves double precision, which is refused
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
        more = product(product(product(F.T, H), W), F)
        G = G + product(product(FW, G), F.T)
        H, F = H + more, product(FW, F)
        if not np.isfinite(H).all():
            break
        if has_settled(more, np.diag(H), _SETTLED):
            return 0.5 * (H + H.T)
    raise ValueError("the Riccati equation has no solution")


def _free_inputs(assignment: Assignment) -> list[tuple[str, str]]:
    """An objection to weights that leave an input free, so that there are no best inputs."""
    if np.all(assignment.input_weights + assignment.rate_weights > 0.0):
        return []
    return [("input_weights", "leave an input without weight; expected input_weights, or rate_weights, above 0")]


@final
class Lqr(Controller):
    """Clips inputs first to the limits of their change, then to their own limits."""

    def __init__(self, assignment: Assignment, trials: int) -> None:
        super().__init__(assignment, trials)
        self._gain = -gain(assignment)
        self._plant, self._rate = assignment.plant, assignment.rate_limits[:, None]
        self._u = np.zeros((assignment.plant.inputs, trials))

    @classmethod
    def objections(cls, assignment: Assignment) -> list[tuple[str, str]]:
        """Weights that leave an input free, and states that no input can keep from growing."""
        if free := _free_inputs(assignment):
            return free
        try:
            gain(assignment)
        except ValueError:
            why = "weigh a state that no input can keep from growing: there is no such regulator; expected an "
            why += "input_matrix that reaches it, or weights of 0 there and on every state that it moves"
            return [("state_weights", why)]
        return []

    def decide(self, k: int, x_hat: Floats, d: Floats) -> Floats:  # noqa: ARG002 - every decision alike
        """−K [x̂; u′], clipped."""
        u = product(self._gain, np.concatenate([x_hat, self._u]))
        u = np.minimum(np.maximum(u, self._u - self._rate), self._u + self._rate)
        self._u = self._plant.limited(u)
        return self._u


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
            remedy = "expected pip install '.[microgrid]' in the checkout first"
            return [("strategy", f"is mpc, whose solver is not installed; {remedy}")]
        why = _broken()
        if why is not None:
            remedy = "expected pip install --force-reinstall osqp first, or the strategy lqr"
            return [("strategy", f"is mpc, whose solver is broken ({why}); {remedy}")]
        return _free_inputs(assignment)

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


CONTROLLERS: Mapping[str, type[Controller]] = {"lqr": Lqr, "mpc": Mpc}
