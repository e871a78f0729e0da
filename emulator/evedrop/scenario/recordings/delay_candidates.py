"""The models that may have produced the delays in a link's recording, each with its most likely parameters.

Source: docs/mathematics/links.md, estimating a link.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from evedrop.model.delays import Pareto
from evedrop.model.process import Floats
from evedrop.scenario.recordings.link_candidates import Candidate, normal_interval

_NEWTON = 20  # steps of Newton's method, which doubles the digits in each of the last ones
_TAIL = 0.025
_LEAST_SCALE = 0.1  # slots; whole slots do not show a lesser one


def delay_candidates(delays: Floats) -> list[Candidate]:
    """Models for delays in slots, (packets,): constant if all are equal, else normal, or Pareto if a link may have its shape.

    Delays that are all whole numbers count slots: 2 is a delay from 2 to below 3, since a packet that arrives between the ends of
    two slots is used at the later one.
    """
    count, least = len(delays), float(delays.min())
    if least == float(delays.max()):
        return [Candidate("constant", {"model": "constant", "value": least}, 0.0, 1)]
    if (delays == np.floor(delays)).all():
        slots, packets = np.unique(delays, return_counts=True)
        found = (_normal_of_slots(slots, packets), _pareto_of_slots(slots, packets))
        return [candidate for candidate in found if candidate is not None]
    candidates = [_normal(delays)]
    logs = float(np.log(delays / least).sum()) if least > 0.0 else math.inf
    shape = count / logs
    if not Pareto.mistakes({"shape": shape}):
        likelihood = count * (math.log(shape) - math.log(least)) - (shape + 1.0) * logs
        candidates.append(
            Candidate(
                "pareto",
                {"model": "pareto", "least": least, "shape": shape},
                likelihood,
                2,
                {"shape": normal_interval(shape, shape / math.sqrt(count))},
            )
        )
    return candidates


def _normal(delays: Floats) -> Candidate:
    """The most likely normal model, whose delays are 0 where the normal number is not above 0."""
    from scipy.special import chdtri, stdtrit  # noqa: PLC0415 - 0.2 s that only this needs

    count, mean, standard_deviation = len(delays), float(delays.mean()), float(delays.std())
    likelihood = -0.5 * count * (math.log(2.0 * math.pi * standard_deviation * standard_deviation) + 1.0)
    # Exact for a sample of any size: Student's for the mean, that of chi-square for the standard deviation.
    reach = float(stdtrit(count - 1, 1.0 - _TAIL)) * standard_deviation / math.sqrt(count - 1)
    least, most = (standard_deviation * math.sqrt(count / float(chdtri(count - 1, p))) for p in (_TAIL, 1.0 - _TAIL))
    intervals = [(mean - reach, mean + reach), (least, most)]
    above = delays[delays > 0.0]
    if len(above) < count:
        scaled, zeros = above / standard_deviation, count - len(above)
        (place, scale), covariance, likelihood = _cut_at_zero(scaled, zeros, mean / standard_deviation)
        likelihood -= len(above) * math.log(standard_deviation)
        mean, standard_deviation = place / scale * standard_deviation, standard_deviation / scale
        to_both = standard_deviation * np.array([[1.0, -place / scale], [0.0, -1.0 / scale]])
        errors = np.sqrt(np.diag(to_both @ covariance @ to_both.T)).tolist()
        intervals = [normal_interval(*pair) for pair in zip((mean, standard_deviation), errors, strict=True)]
    names = ("mean", "standard_deviation")
    return Candidate(
        "normal",
        {"model": "normal", "mean": mean, "standard_deviation": standard_deviation},
        likelihood,
        2,
        {name: (max(0.0, low), high) for name, (low, high) in zip(names, intervals, strict=True)},
    )


def _cut_at_zero(above: Floats, zeros: int, place: float) -> tuple[Floats, Floats, float]:
    """The most likely mean / sd, at least 0, and 1 / sd of normal numbers of which some are not above 0; the others are these.

    zeros: how many are not above 0; place: a guess of mean / sd, where the sd is about 1. By Newton's method, with steps that
    are halved until the log-likelihood grows, which is concave. Returns also the covariance of both, and the log-likelihood.

    Source: Olsen (1978).
    """
    from scipy.special import log_ndtr  # noqa: PLC0415 - 0.2 s that only this needs

    count, half = len(above), 0.5 * math.log(2.0 * math.pi)

    def likelihood(at: Floats) -> float:
        if at[1] <= 0.0:
            return -math.inf
        away = at[1] * above - at[0]
        return float(zeros * log_ndtr(-at[0]) + count * (math.log(at[1]) - half) - 0.5 * (away * away).sum())

    def derivatives(at: Floats) -> tuple[Floats, Floats]:
        away = at[1] * above - at[0]
        hazard = math.exp(-0.5 * at[0] * at[0] - half - float(log_ndtr(-at[0])))
        slope = np.array([away.sum() - zeros * hazard, count / at[1] - (above * away).sum()])
        mixed, own = -float(above.sum()), count / (at[1] * at[1]) + float((above * above).sum())
        return slope, np.array([[count + zeros * hazard * (hazard - at[0]), mixed], [mixed, own]])

    at = np.array([place, 1.0])
    for _ in range(_NEWTON):
        slope, bend = derivatives(at)
        step = np.linalg.solve(bend, slope)
        while likelihood(at + step) < likelihood(at):
            step *= 0.5
        at = at + step
    if at[0] < 0.0:  # the model has no mean below 0
        at = np.array([0.0, math.sqrt(count / float((above * above).sum()))])
    covariance = np.asarray(np.linalg.inv(derivatives(at)[1]), np.float64)
    return at, covariance, likelihood(at)


def _normal_of_slots(slots: Floats, packets: NDArray[np.int64]) -> Candidate:
    """The most likely normal model; slots: different whole delays, (d,), packets: how many have each, (d,)."""
    from scipy.optimize import minimize  # noqa: PLC0415 - 0.2 s that only this needs
    from scipy.special import log_ndtr  # noqa: PLC0415 - the same

    ends = np.stack([np.where(slots == 0.0, -math.inf, slots), slots + 1.0])  # delays below 0 are 0

    def likelihood(mean: float, scale: float) -> float:
        """The log-likelihood. Between two ends on the right of the mean lies as much as between their images on its left."""
        low, high = (ends - mean) / scale
        low, high = np.where(low > 0.0, -high, low), np.where(low > 0.0, -low, high)
        larger = log_ndtr(high)
        return float((packets * (larger + np.log(-np.expm1(log_ndtr(low) - larger)))).sum())

    middle, spread = slots + 0.5, max(_LEAST_SCALE, math.sqrt(float(np.cov(slots, fweights=packets))))
    start = np.array([np.average(middle, weights=packets), math.log(spread)])

    def improbability(at: Floats) -> float:
        return -likelihood(float(at[0]), math.exp(at[1]))

    bounds = ((0.0, math.inf), (math.log(_LEAST_SCALE), math.inf))
    done = minimize(improbability, start, method="Nelder-Mead", bounds=bounds, tol=1e-9)
    at = (float(done.x[0]), math.exp(done.x[1]))
    names = ("mean", "standard_deviation")
    inside = at[0] > 0.0 and at[1] > 1.001 * _LEAST_SCALE
    intervals = _intervals(lambda given: likelihood(*given), at) if inside else []
    return Candidate(
        "normal",
        {"model": "normal", **dict(zip(names, at, strict=True))},
        likelihood(*at),
        2,
        {name: (max(0.0, low), high) for name, (low, high) in zip(names, intervals, strict=False)},
    )


def _pareto_of_slots(slots: Floats, packets: NDArray[np.int64]) -> Candidate | None:
    """The most likely Pareto model, or None if a link cannot have its shape; slots, packets: as for `_normal_of_slots`."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - 0.2 s that only this needs

    first, later = float(slots[0]), slots[1:]
    beyond = float(packets[1:].sum() / packets.sum())

    def least(shape: float) -> float:
        """The most likely one: of (least / (first + 1))^shape of the packets the delay is longer than `first`."""
        return max(first, (first + 1.0) * float(beyond ** (1.0 / shape)))

    def likelihood(shape: float) -> float:
        low = least(shape)
        if low == 0.0:
            return -math.inf
        at_first = math.log(-math.expm1(shape * math.log(low / (first + 1.0))))
        at_later = shape * np.log(low / later) + np.log(-np.expm1(shape * np.log(later / (later + 1.0))))
        return float(packets[0] * at_first + (packets[1:] * at_later).sum())

    lowest, highest = Pareto.shapes
    done = minimize_scalar(
        lambda at: -likelihood(math.exp(at)),
        bounds=(math.log(lowest), math.log(highest)),
        method="bounded",
        options={"xatol": 1e-10},
    )
    shape = math.exp(done.x)
    if not 1.01 * lowest < shape < 0.99 * highest:  # the most likely one lies beyond
        return None
    found = {"least": least(shape), "shape": shape}
    intervals = _intervals(lambda given: likelihood(*given), (shape,))
    return Candidate(
        "pareto", {"model": "pareto", **found}, likelihood(shape), 2, dict(zip(("shape",), intervals, strict=False))
    )


def _intervals(likelihood: Callable[[Sequence[float]], float], at: Sequence[float]) -> list[tuple[float, float]]:
    """The 95 % intervals of positive parameters at the greatest log-likelihood; empty if it is flat there.

    From its second derivatives, by central differences.
    """
    steps = np.diag([1e-3 * value for value in at])
    bend = np.array(
        [
            [
                sum(
                    sign * other * likelihood((at + sign * row + other * column).tolist())
                    for sign in (1.0, -1.0)
                    for other in (1.0, -1.0)
                )
                / (4.0 * row.sum() * column.sum())
                for column in steps
            ]
            for row in steps
        ]
    )
    if not (np.isfinite(bend).all() and (np.linalg.eigvalsh(bend) < 0.0).all()):
        return []
    errors = np.sqrt(np.diag(np.linalg.inv(-bend)))
    return [normal_interval(*pair) for pair in zip(at, errors.tolist(), strict=True)]
