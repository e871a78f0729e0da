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
    """The slot with the largest separation between the eavesdroppers that are overconfident and the legitimate estimator.

    errors, traces: receiver → its squared error, and the trace of the covariance that it reports, (slots,). noise: trace of Q.
    """
    legitimate = errors[LEGITIMATE]
    others = [name for name in errors if name != LEGITIMATE]
    if others:
        overconfident = {name: is_overconfident(errors[name], traces[name], noise) for name in others}
        some = any(flags[_candidates(len(flags))].any() for flags in overconfident.values())
        separation = sum(
            np.log10((errors[name] + noise) / (legitimate + noise)) * (overconfident[name] if some else 1.0)
            for name in others
        )
    else:
        separation = legitimate
    candidates = _candidates(len(legitimate))
    return int(candidates.start) + int(np.argmax(np.nan_to_num(separation, nan=-np.inf)[candidates]))


def _candidates(slots: int) -> slice:
    """The slots that may be chosen: not the first, in which receivers begin, nor the last, so that the panels are filled."""
    first = min(_BEFORE, slots - 1)
    return slice(first, max(first + 1, slots - _AFTER))
