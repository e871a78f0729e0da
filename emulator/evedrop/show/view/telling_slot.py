"""Chooses the slot of a run that a picture shows.

Source: docs/view.md, pictures.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow.compute as pc

from evedrop.model.process import Floats
from evedrop.names import LEGITIMATE
from evedrop.results.reading import Results
from evedrop.scenario.recorded import recorded
from evedrop.score.synchronisation import is_overconfident

_BEFORE, _AFTER = 105, 25  # slots that the panels show on either side, so that the picture is filled
_ABOUT = 0.9  # of the largest mean
_MOST = 1e3  # powers of ten: a separation that is not a number counts as such


def telling_slot(results: Results) -> int | None:
    """The slot of a run whose picture is the most telling; None for the last one.

    Raises UsageError if the folder's tables cannot be read.
    """
    record = recorded(results.folder)
    scenario = record.scenario
    if scenario.controller is not None:  # its panels show the whole run, up to the slot
        return None
    trials = results.trials
    if not trials.num_rows:
        return None
    first = trials.filter(pc.equal(trials["trial"], pc.min(trials["trial"])))
    errors, traces = {}, {}
    for name in scenario.receivers:
        rows = first.filter(pc.equal(first["peer"], name)).sort_by("slot")
        errors[name], traces[name] = rows["squared_error"].to_numpy(), rows["trace_covariance"].to_numpy()
    return most_telling(errors, traces, record.noise)


def most_telling(errors: Mapping[str, Floats], traces: Mapping[str, Floats], noise: float) -> int:
    """The slot with the largest separation of the eavesdroppers that are overconfident from the legitimate estimator.

    It is one of those with the slots before them, which the panels show, in which the mean separation is about the largest.

    errors, traces: receiver → its squared error, and the trace of the covariance that it reports, (slots,). noise: trace of Q.
    """
    legitimate = errors[LEGITIMATE]
    others = [name for name in errors if name != LEGITIMATE]
    candidates = _candidates(len(legitimate))
    separation = legitimate
    if others:
        overconfident = {name: is_overconfident(errors[name], traces[name], noise) for name in others}
        some = any(flags[candidates].any() for flags in overconfident.values())
        with np.errstate(all="ignore"):
            separation = np.sum(
                [
                    np.log10((errors[name] + noise) / (legitimate + noise)) * (overconfident[name] if some else 1.0)
                    for name in others
                ],
                axis=0,
            )
    separation = np.nan_to_num(separation, nan=-_MOST, posinf=_MOST, neginf=-_MOST)
    sums = np.concatenate([[0.0], np.cumsum(np.where(np.arange(len(separation)) < candidates.start, 0.0, separation))])
    ends = np.arange(len(separation)) + 1
    means = ((sums[ends] - sums[np.maximum(ends - _BEFORE, 0)]) / _BEFORE)[candidates]
    about_largest = means >= means.max() - (1.0 - _ABOUT) * abs(means.max())
    chosen = np.where(about_largest, separation[candidates], -np.inf)
    return int(candidates.start) + int(np.flatnonzero(chosen == chosen.max())[-1])


def _candidates(slots: int) -> slice:
    """The slots that may be chosen: not the first, in which receivers begin, nor the last, so that the panels are filled.

    Of a run that cannot fill them, the last quarter: in its very last slot, each eavesdropper may have just heard the state.
    """
    if slots <= _BEFORE + _AFTER:
        return slice(3 * slots // 4, slots)
    first = _BEFORE
    return slice(first, max(first + 1, slots - _AFTER))
