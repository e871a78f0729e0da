"""Naha, Teixeira, Ahlén and Dey: a watermark for the quickest detection of false measurements.

Source: docs/papers/naha2021.md; docs/mathematics/attacks.md, integrity.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import final

import numpy as np

from evedrop.model.controllers import Assignment
from evedrop.model.integrity import SENSOR_ATTACKS
from evedrop.model.integrity.monitor import MonitorPlan
from evedrop.model.integrity.theory import WatermarkTheory, loop_of
from evedrop.model.metrics.standard_error import standard_error
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process
from evedrop.model.slot.monitored_loop import LoopRun, simulate
from evedrop.studies.papers.reproduction import NumberVerdict, Paper, Progress, PublishedNumber

_ONE, _INF = np.array([[1.0]]), np.array([np.inf])
EXAMPLE = Assignment(
    Process(1.05 * _ONE, 0.1 * _ONE, 0.17 * _ONE),
    Plant(_ONE, np.zeros((1, 0)), 0.1 * _ONE, np.zeros(1), -_INF, _INF, -_INF, _INF, _ONE, 0.1 * _ONE),
    1, 1.0, np.ones(1), np.array([0.1]), np.zeros(1), _INF, {},
)  # fmt: skip
"""A = 1.05, B = C = 1, all noises of variance 0.1, weights 1 of the state and 0.1 of the input: an example of this project."""
REPLACED = ("replace", {"matrix": [[0.8]]})
_LEVELS = (0.1, 0.3, 1.0)
_LOW, _MIDDLE, _HIGH = 8.0, 32.0, 64.0
_FALSE = 4.0
_UNREACHED = 1e300
_WORDS = "a = 1.05, z AR(1) 0.8, Σ_e = "
_ASYMPTOTIC = (
    "h/D is the leading term for large h; the statistic overshoots h, and the filter needs slots to follow false values"
)


@final
class Naha2021(Paper):
    """Their closed forms, evaluated for an example of ours, next to simulations; their own numbers are not public."""

    title = "Quickest Detection of Deception Attacks on Cyber-Physical Systems with a Parsimonious Watermarking Policy"
    authors = "A. Naha, A. Teixeira, A. Ahlén, S. Dey"
    published = "arXiv 2201.09389, 2022, and arXiv 2101.01466, 2021"

    def rows(self, quick: bool, progress: Progress) -> Iterator[PublishedNumber]:
        """Divergence, delay, false alarms and cost; then the numbers that are not public."""
        trials = 400 if quick else 4000
        for level in _LEVELS:
            progress(f"watermark of variance {level:g}")
            yield from _detection(level, trials)
        progress("no watermark")
        yield _without_watermark(trials)
        progress("false alarms")
        yield _false_alarms(trials)
        yield from _costs(trials)
        yield _parsimonious(trials)
        for quantity, reason in _NOT_PUBLIC.items():
            yield PublishedNumber.stated("2201.09389", quantity, None, None, NumberVerdict.NOT_PUBLIC, reason)


_NOT_PUBLIC: Mapping[str, str] = {
    "the numbers of their figures and tables": "the numbers were not available to us; the closed forms are compared above",
    "the CUSUM with the innovation's distribution given earlier measurements": "neither its program nor its numbers are public; "
    "the detector here has the stationary distribution",
    "the optimal thresholds of the parsimonious policy": "neither their values nor the program that found them are public",
}


def _run(
    level: float, slots: int, trials: int, attack_from: int | None, policy: tuple[str, Mapping[str, float]]
) -> LoopRun:
    attack, spans = (None, ()) if attack_from is None else (REPLACED, ((attack_from, slots),))
    plan = MonitorPlan.of(loop_of(EXAMPLE), level * _ONE, policy, attack, spans)
    return simulate(EXAMPLE, plan, slots, trials)


def _theory(level: float) -> WatermarkTheory:
    loop = loop_of(EXAMPLE)
    return WatermarkTheory.of(loop, SENSOR_ATTACKS[REPLACED[0]].of(REPLACED[1], loop, level * _ONE), level * _ONE)


def _always(threshold: float) -> tuple[str, Mapping[str, float]]:
    return "always", {"threshold": threshold}


def _mean(values: Floats) -> tuple[float, float | None]:
    return float(values.mean()), standard_error(values)


def _detection(level: float, trials: int) -> Iterator[PublishedNumber]:
    """D, the delay, and how it grows with h."""
    theory, words = _theory(level), f"{_WORDS}{level:g}"
    slots = 100 + math.ceil(3.0 * _HIGH / theory.divergence)
    plan = MonitorPlan.of(loop_of(EXAMPLE), level * _ONE, _always(_UNREACHED), REPLACED, ((1, slots),))
    run = simulate(EXAMPLE, plan, 60, trials)
    llr = plan.marked.llr(run.epsilon[-1], plan.shift[0, 0] * run.watermark[-2])
    ours, error = _mean(llr)
    yield PublishedNumber.compared(
        "D", f"{words}: D, and the mean of llr under attack", theory.divergence, ours, error, errors=4.0, printed=False
    )
    delays = {h: _run(level, slots, trials, 1, _always(h)).first_alarms(h) for h in (_LOW, _MIDDLE, _HIGH)}
    low, low_error = _mean(delays[_LOW])
    yield PublishedNumber.stated(
        "delay", f"{words}: h/D for h = 8, and the mean delay", _LOW / theory.divergence, low,
        NumberVerdict.NOT_COMPARABLE, _ASYMPTOTIC, low_error,
    )  # fmt: skip
    more, more_error = _mean(delays[_HIGH] - delays[_MIDDLE])
    yield PublishedNumber.compared(
        "delay", f"{words}: 32/D, and the delay for h = 64 without that for h = 32", (_HIGH - _MIDDLE) / theory.divergence,
        more, more_error, errors=4.0, relative=0.05, printed=False,
    )  # fmt: skip


def _without_watermark(trials: int) -> PublishedNumber:
    slots = 501
    fraction, error = _mean(np.isfinite(_run(0.0, slots, min(trials, 1000), 1, _always(_LOW)).first_alarms(_LOW)) * 1.0)
    theory = _theory(0.0)
    quantity = f"{_WORDS}0: h/D for h = 8 is {_LOW / theory.divergence:.0f} slots; the fraction detected within 500"
    return PublishedNumber.stated(
        "delay", quantity, None, fraction, NumberVerdict.NOT_COMPARABLE,
        "h/D is far beyond the 500 slots of the run, so the fraction that it predicts is too small to compare", error,
    )  # fmt: skip


def _false_alarms(trials: int) -> PublishedNumber:
    """With a small h, so that they occur: mean slots until the first, of trials that are all long enough."""
    slots, bound = 3000, math.exp(_FALSE)
    first = np.minimum(_run(0.3, slots, min(trials, 400), None, _always(_FALSE)).first_alarms(_FALSE), slots) + 1.0
    ours, error = _mean(first)
    far = ours > bound
    return PublishedNumber.stated(
        "false alarms", f"Σ_e = 0.3, h = 4, no attack: e^h = {bound:.1f} slots or more on average", f"≥ {bound:.1f}", ours,
        NumberVerdict.FORMULA if far else NumberVerdict.DIFFERS, "" if far else "the bound is violated", error, printed=False,
    )  # fmt: skip


def _costs(trials: int) -> Iterator[PublishedNumber]:
    """The regulator's cost with a watermark without that without one, from the same noise, after the start."""
    few, start = min(trials, 1000), 50
    plain = _run(0.0, 250, few, None, _always(_UNREACHED)).cost
    for level in _LEVELS:
        ours, error = _mean((_run(level, 250, few, None, _always(_UNREACHED)).cost - plain)[start:].mean(axis=0))
        quantity = f"Σ_e = {level:g}: tr[(BᵀΠB + U) Σ_e], and the measured increase of the cost per slot"
        yield PublishedNumber.compared("cost", quantity, _theory(level).cost, ours, error, errors=4.0, printed=False)


def _parsimonious(trials: int) -> PublishedNumber:
    """The slots with a watermark when nobody attacks."""
    policy = "parsimonious", {"watch_from": 0.05, "alarm_from": 0.999, "attack_rate": 1e-3}
    run = _run(0.3, 500, min(trials, 1000), None, policy)
    fraction, error = _mean((run.watermark[:, 0] != 0.0).mean(axis=0))
    return PublishedNumber.stated(
        "parsimonious", "θ₁ = 0.05, θ₂ = 0.999, an attack in 1000 slots, Σ_e = 0.3, none: slots with a watermark", None, fraction,
        NumberVerdict.NOT_COMPARABLE, "their thresholds are not public, and no closed form is known for this fraction", error,
    )  # fmt: skip
