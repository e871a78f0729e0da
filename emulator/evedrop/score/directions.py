"""Errors and verdicts by direction: of vᵀx for the scenario's directions v.

Source: docs/mathematics/verdicts.md, verdicts by direction; docs/metrics.md, directions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from evedrop.model.metrics.standard_error import standard_error
from evedrop.names import LEGITIMATE
from evedrop.scenario.theory import Expectation
from evedrop.score.rare_events import rare_events_of, z_of_error
from evedrop.score.secrecy import Claim, largest_means, perfect_verdict, relative_verdict, sign_of_mean, sign_of_median
from evedrop.score.summary import DirectionSummary, RareEvents
from evedrop.score.sums import DirectionTally, Tally, window_means


def directions_of(
    tallies: Mapping[str, Tally], expected: Mapping[str, Expectation]
) -> dict[str, dict[str, DirectionSummary]]:
    """Receiver → direction → its entry; empty without directions, and in a run without estimates."""
    summaries: dict[str, dict[str, DirectionSummary]] = {}
    legitimate = tallies[LEGITIMATE]
    for receiver, tally in tallies.items():
        for name, errors in tally.directions.items():
            if not errors.reached.any():
                continue
            summary = _measured(errors, expected[receiver], rare_events_of(expected[receiver], tally))
            if receiver != LEGITIMATE:
                pair = (expected[LEGITIMATE], expected[receiver])
                summary = _judged(summary, summaries[LEGITIMATE][name], (legitimate.directions[name], errors), pair)
            summaries.setdefault(receiver, {})[name] = summary
    return summaries


def _measured(errors: DirectionTally, expected: Expectation, rare: RareEvents | None) -> DirectionSummary:
    """The error, and what theory knows of it; rare: the receiver's rare events."""
    sums, offered = errors.window_errors.sum(axis=0), int(errors.reached.sum())
    # Trials that were cut short at different slots do not have the same expectation.
    means = sums / errors.done if errors.done * len(sums) == offered else None
    series = None if expected.of_model else expected.along(errors.v, int(errors.reached.max()))
    mean, begun = float(sums.sum()) / offered, errors.reached[errors.reached > 0]
    theory = None if series is None else float(np.cumsum(series, out=series)[begun - 1].sum()) / offered
    scatter = None if expected.infinite_variance else standard_error(means)
    growth = None if expected.of_model else expected.growth
    z = z_of_error(means, theory, expected, errors.done, rare)
    return DirectionSummary(mean, scatter, theory, z, None if growth is None else growth.along(errors.v))


def _judged(
    summary: DirectionSummary,
    legitimate: DirectionSummary,
    errors: tuple[DirectionTally, DirectionTally],
    expected: tuple[Expectation, Expectation],
) -> DirectionSummary:
    """The entry of an eavesdropper with its verdict; errors, expected: the legitimate estimator's and the eavesdropper's."""
    promised = None
    if legitimate.unbounded is not None and summary.unbounded is not None:
        promised = summary.unbounded and not legitimate.unbounded
    relative, perfect = Claim.UNDECIDED, Claim.FAILED if promised is False else Claim.UNDECIDED
    if all(each.done == each.slots for each in errors):
        heavy = any(each.infinite_variance for each in expected)
        test = sign_of_median if heavy else sign_of_mean
        means, other = (window_means(each) for each in errors)
        least = most = None
        if not heavy and means.shape[1] > 1:
            slots, v = errors[0].slots, errors[0].v
            ours, theirs = (largest_means(*each, slots, v) for each in zip(expected, (means, other), strict=True))
            least, most = other - ours, theirs - means
        relative, _ = relative_verdict(other - means, test, errors[0].slots, least, most)
        if promised is not False:
            series = None if expected[0].of_model else expected[0].along(errors[0].v, errors[0].slots)
            bound = math.inf if series is None or legitimate.unbounded else float(np.max(series))
            perfect = perfect_verdict(other, means, bound, test)
    return replace(summary, relative=relative.value, perfect=perfect.value, perfect_by_theory=promised)
