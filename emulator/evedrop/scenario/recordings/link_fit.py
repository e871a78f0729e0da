"""The fit of a link's recording: candidates, the chosen model, its goodness of fit, and the line for the scenario.

Source: docs/mathematics/links.md, estimating a link; docs/links.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evedrop.errors import TraceError
from evedrop.model.checks import toml_of
from evedrop.model.process import Floats
from evedrop.scenario.recordings.delay_candidates import delay_candidates
from evedrop.scenario.recordings.link_candidates import Candidate, bernoulli, gilbert, gilbert_elliott, wilson
from evedrop.scenario.recordings.link_recording import DELAY, LinkRecording, Outcomes
from evedrop.scenario.recordings.run_lengths import FEWEST_RUNS, RunLengthDistribution, RunLengths, lengths_of, p_value

FEWEST = 100
"""The fewest outcomes from which a model can be estimated."""
FEWEST_DELAYS = 10
"""The fewest delays from which a model can be estimated."""
_LEVEL = 0.01


@dataclass(frozen=True)
class Fit:
    """The result of fitting a recording."""

    trace: str
    count: int
    lost: int
    candidates: Sequence[Candidate]
    bursts: RunLengths
    gaps: RunLengths
    delays: int
    """Packets whose delay was measured."""
    delay_candidates: Sequence[Candidate]

    @property
    def chosen(self) -> Candidate:
        """The loss model with the least BIC."""
        return min(self.candidates, key=lambda candidate: candidate.bic(self.count))

    @property
    def chosen_delay(self) -> Candidate | None:
        """The delay model with the least BIC; None if no delays were measured."""
        return min(self.delay_candidates, key=lambda candidate: candidate.bic(self.delays), default=None)

    @property
    def link(self) -> dict[str, Any]:
        """The link as a scenario describes it."""
        delay = self.chosen_delay
        return {"loss": self.chosen.spec} | ({} if delay is None else {"delay": delay.spec})

    @property
    def toml(self) -> str:
        """The line for the scenario."""
        return f"link = {toml_of(self.link)}"

    @property
    def goodness(self) -> str:
        """How well the chosen model explains the lengths of bursts and gaps, in a sentence."""
        both = {"bursts": self.bursts, "gaps": self.gaps}
        judged = {name: runs.p_value for name, runs in both.items() if runs.p_value is not None}
        shown = " and ".join(f"{value:.2g} for {name}" for name, value in judged.items())
        if not judged:
            few = self.bursts.count < FEWEST_RUNS
            why = f"too few bursts ({self.bursts.count})" if few else "the lengths of bursts and gaps differ too little"
            return f"{why} to tell how well it fits"
        names = " and ".join(judged)
        # Each of two tests has half the level: together they reject a correct model in one of a hundred recordings.
        if min(judged.values()) < _LEVEL / 2.0:
            return (
                f"it does NOT explain how long {names} last (chi-square, p = {shown}): the link has habits that none "
                'of these models has; use the recording itself, model = "trace"'
            )
        return f"{names} last as long as the model predicts (chi-square, p = {shown})"

    def as_dict(self) -> dict[str, Any]:
        """The fit as JSON values."""
        delay = self.chosen_delay
        return {
            "trace": self.trace,
            "outcomes": self.count,
            "lost": self.lost,
            "candidates": [candidate.as_dict(self.count) for candidate in self.candidates],
            "chosen": self.chosen.name,
            "bursts": vars(self.bursts),
            "gaps": vars(self.gaps),
            "goodness": self.goodness,
            "delays": self.delays,
            "delay_candidates": [candidate.as_dict(self.delays) for candidate in self.delay_candidates],
            "chosen_delay": None if delay is None else delay.name,
            "link": self.link,
            "toml": self.toml,
        }


def fit(path: Path, column: str | None = None, delay_column: str | None = None, lost: str | None = None) -> Fit:
    """Find the models that may have produced a recording.

    column: that of the outcomes, in a file with several, by default `received`; delay_column: that of delays in slots, by default
    `delay` if present; lost: in place of column, one whose ones are losses.

    Raises TraceError if the file is not a recording, or if nothing can be estimated from it.
    """
    recording = LinkRecording(path)
    names = recording.columns()
    outcomes = recording.outcomes(column, lost)
    _check(str(path), outcomes)
    wanted = delay_column or (DELAY if DELAY in names and DELAY not in {column, lost} else None)
    delays = np.empty(0) if wanted is None else recording.delays(wanted)
    delays = delays[~np.isnan(delays)]
    if wanted is not None and len(delays) < FEWEST_DELAYS:
        problem = f"{wanted} has {len(delays)} delays; expected {FEWEST_DELAYS} or more, such as a longer recording"
        raise TraceError(str(path), "file", problem)
    return fit_outcomes(str(path), outcomes, delays)


def fit_outcomes(name: str, outcomes: Outcomes, delays: Floats) -> Fit:
    """Find the models that may have produced outcomes, (n,), and delays, (d,), which may be empty.

    name: what was recorded, for messages. Raises TraceError if nothing can be estimated.
    """
    _check(name, outcomes)
    candidates = [bernoulli(outcomes), gilbert(outcomes), gilbert_elliott(outcomes)]
    chosen = min(candidates, key=lambda candidate: candidate.bic(len(outcomes)))
    return Fit(
        name,
        len(outcomes),
        int((outcomes == 0).sum()),
        candidates,
        _runs(outcomes, chosen, True),
        _runs(outcomes, chosen, False),
        len(delays),
        delay_candidates(delays) if len(delays) else (),
    )


def _check(name: str, outcomes: Outcomes) -> None:
    """Raise TraceError for a recording from which nothing can be estimated."""
    count, delivered = len(outcomes), int(outcomes.sum())
    if count < FEWEST:
        raise TraceError(name, "file", f"has {count} outcomes; expected {FEWEST} or more, such as a longer recording")
    if delivered in {0, count}:
        low, high = wilson(delivered, count)
        all_or_none, bound = ("delivered", f"at least {low:.4g}") if delivered else ("lost", f"at most {high:.4g}")
        raise TraceError(
            name,
            "file",
            f"has {count} outcomes, all {all_or_none}: the quality is {bound} with 95 % confidence if losses are independent, "
            "and nothing can be said about bursts; expected a recording with both, such as a longer one",
        )


def _runs(outcomes: Outcomes, chosen: Candidate, lost: bool) -> RunLengths:
    lengths = lengths_of(outcomes == 0 if lost else outcomes == 1)
    distribution = RunLengthDistribution.of(chosen.exact, lost)
    # Four parameters come from the order of all outcomes, not from how long these runs are. They follow the runs much less than
    # parameters fitted to them (Chernoff and Lehmann, 1954): taken for such, they let a correct model be rejected too often.
    estimated = 0 if chosen.parameters == 4 else 1
    return RunLengths(
        len(lengths),
        float(lengths.mean()) if len(lengths) else None,
        distribution.mean,
        p_value(lengths, distribution, estimated),
    )


def lines(fitted: Fit) -> list[str]:
    """The fit as printed lines."""
    return [headline(fitted, "outcomes", "slot"), *model_lines(fitted, "slot"), fitted.toml]


def headline(fitted: Fit, packets: str, unit: str) -> str:
    """How much was recorded and lost; packets, unit: what is counted, and what bursts are measured in, such as "slot"."""
    fraction = 100.0 * fitted.lost / fitted.count
    mean = "none of them ended" if fitted.bursts.mean is None else _average(fitted.bursts.mean, unit)
    lost = f"{fitted.count} {packets}, {fitted.lost} lost ({fraction:.4g} %)"
    return f"{fitted.trace}: {lost}, {fitted.bursts.count} burst{'' if fitted.bursts.count == 1 else 's'}, {mean}"


def _average(length: float, unit: str) -> str:
    shown = f"{length:.4g}"
    return f"{shown} {unit if shown == '1' else f'{unit}s'} on average"


def model_lines(fitted: Fit, unit: str) -> list[str]:
    """The candidates, the models that were taken, and how well they fit, as printed lines; unit: as for `headline`."""
    told = _table(fitted.candidates, fitted.chosen, fitted.count)
    told.append(f"taken: {fitted.chosen.name}, by BIC; its bursts last {_average(fitted.bursts.fitted, unit)}")
    told.append(f"fit: {fitted.goodness}")
    if fitted.chosen_delay is not None:
        told.append(f"{fitted.delays} delays")
        told += _table(fitted.delay_candidates, fitted.chosen_delay, fitted.delays)
    return told


def _table(candidates: Sequence[Candidate], chosen: Candidate, count: int) -> list[str]:
    rows = [f"  {'model':<16} {'log-likelihood':>16} {'BIC':>14}  parameters"]
    for tried in candidates:
        mark = "*" if tried is chosen else " "
        rows.append(f"{mark} {tried.name:<16} {tried.log_likelihood:>16.2f} {tried.bic(count):>14.2f}  {tried.text}")
    return rows
