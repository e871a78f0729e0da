"""Compares every scheme against every adversary, on one process and its links: the secrecy of each scheme, and its cost.

Each scheme is a Monte Carlo study of its own, with another for every attack on acknowledgements; all of them have the same
trials, and an adversary has the same losses in each.

Source: docs/compare.md.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from evedrop.errors import Interrupted, RunError
from evedrop.expected.expectations import Expectation, expectations_of
from evedrop.memory.montecarlo import Merger, News, Plan, disk_errors, results_of, teller
from evedrop.memory.trials import BatchResult, tasks_of
from evedrop.memory.workers import connected
from evedrop.model.schemes import scheme_of
from evedrop.names import LEGITIMATE
from evedrop.results.folder import make_private, new_folder, private_pictures, write_private
from evedrop.results.resolved_scenario import resolved
from evedrop.results.writer import plain
from evedrop.scenario import Scenario
from evedrop.score.histogram import LEVELS
from evedrop.score.kept import SecrecyKept
from evedrop.score.scorekeeper import verdicts
from evedrop.score.sums import Tally, trial_means
from evedrop.score.verdict import Secrecy, Verdict
from evedrop.signals import stop_on_signals
from evedrop.studies.matchups import Group, Match, Matchups

_WRITE_SECONDS, _WRITE_SHARE = (
    3.0,
    50.0,
)  # from one compare.json to the next, and as a multiple of the time to write one
_ALIKE = 1e-6  # relative difference of two errors of theory that count as equal: allows for rounding only


@dataclass(frozen=True)
class Theory:
    """The trace of a receiver's expected error covariance."""

    mean: float
    """Mean over the slots of the run."""
    last: float
    """In the last slot of the run."""
    limit: float | None
    """In the long run; inf if it is unbounded; None if a bound is known only for the run."""
    bound: bool
    """Whether these are only lower bounds of its error."""


@dataclass(frozen=True)
class SimulatedError:
    """A receiver's squared error in simulation, over all slots, with the theory for it."""

    mean: float
    """Mean over trials."""
    standard_error: float | None
    """Standard error of the mean; None for one trial, and if the variance is infinite, so that it would mean nothing."""
    quantiles: Mapping[str, float]
    """Level → quantile over trials of a trial's mean error."""
    infinite_variance: bool
    theory: Theory | None

    @property
    def typical(self) -> float:
        """The figure to compare by: the mean over trials, or the median if the variance is infinite."""
        return self.quantiles["0.5"] if self.infinite_variance else self.mean


@dataclass(frozen=True)
class Cell:
    """One adversary against one scheme."""

    match: Match
    legitimate: SimulatedError | None = None
    """The legitimate estimator in the same simulation: an attack may affect it, too."""
    eavesdropper: SimulatedError | None = None
    secrecy: Secrecy | None = None

    @property
    def betrayed(self) -> bool:
        """Whether the adversary learns a true state, against which no scheme can protect."""
        return self.match.strategy == "replay-informed"

    @property
    def ratio(self) -> float | None:
        """Eavesdropper's over legitimate error; of medians if either variance is infinite. None if the pair is not defined."""
        if self.legitimate is None or self.eavesdropper is None:
            return None
        one, two = self.legitimate, self.eavesdropper
        medians = one.infinite_variance or two.infinite_variance
        user, other = (each.quantiles["0.5"] if medians else each.mean for each in (one, two))
        return other / user if user else math.inf

    @property
    def verdict(self) -> SecrecyKept | None:
        """The verdict of the run; theory also decides whether an error is unbounded, and whether two are equal."""
        secrecy, other, user = self.secrecy, self.eavesdropper, self.legitimate
        if secrecy is None or other is None or user is None:
            return None
        if secrecy.relative is Verdict.FAILED:
            return SecrecyKept.BROKEN
        unbounded = _limit(other) == math.inf and _limit(user) < math.inf
        if secrecy.perfect is Verdict.HELD and unbounded:
            return SecrecyKept.PERFECT
        if secrecy.relative is Verdict.HELD:
            return SecrecyKept.RELATIVE
        denied = secrecy.relative_by_theory is False and secrecy.relative_from is None and not unbounded
        return SecrecyKept.BROKEN if denied else SecrecyKept.UNDECIDED

    def as_dict(self) -> dict[str, Any]:
        """The cell in the form of compare.json."""
        verdict = self.verdict
        if verdict is None or self.secrecy is None or self.legitimate is None or self.eavesdropper is None:
            return {"not_defined": self.match.not_defined}
        return {
            "reads_as": self.match.strategy,
            "attack": self.match.attack,
            "eavesdropper": asdict(self.eavesdropper),
            "legitimate": asdict(self.legitimate),
            "ratio": self.ratio,
            "verdict": verdict.value,
            "secrecy": self.secrecy.as_dict(),
        }


@dataclass(frozen=True)
class Needs:
    """The cost of a scheme."""

    acknowledgements: bool
    payload_bits: int
    """Bits of a packet's payload on the wire: float64 numbers."""
    header_bits: int
    """Bits of a packet's header on the wire: int64 numbers."""
    sent_fraction: float
    """Fraction of slots with a packet, measured without an attack."""
    secret_bits_per_slot: int
    """The most bits in a slot from the streams that both sides draw."""
    initial_secret_bits: int
    """Bits that a trial uses once."""

    @property
    def packet_bits(self) -> int:
        """Bits of payload and header."""
        return self.payload_bits + self.header_bits


@dataclass(frozen=True)
class SchemeResult:
    """One scheme against all adversaries."""

    name: str
    parameters: Mapping[str, Any]
    needs: Needs
    legitimate: SimulatedError
    """The legitimate estimator without an attack."""
    cells: Mapping[str, Cell]
    """Adversary → its cell, for all adversaries."""

    @property
    def closest(self) -> Cell | None:
        """The adversary with the least error, except those that learn a true state; None if there is none."""
        played = [cell for cell in self.cells.values() if cell.eavesdropper is not None and not cell.betrayed]
        return min(played, key=lambda cell: _error(cell.eavesdropper), default=None)

    @property
    def kept(self) -> float:
        """The error of the closest adversary, by theory if it is known."""
        return math.nan if self.closest is None else _error(self.closest.eavesdropper)

    @property
    def price(self) -> float:
        """The largest error of the legitimate estimator under any attack: the limit of theory, if it is known."""
        users = [self.legitimate, *(cell.legitimate for cell in self.cells.values() if cell.legitimate is not None)]
        return max(_lasting(one) for one in users)


def _limit(of: SimulatedError) -> float:
    known = None if of.theory is None else of.theory.limit
    return math.nan if known is None else known


def _error(of: SimulatedError | None) -> float:
    assert of is not None  # noqa: S101 - the caller has checked it
    return of.typical if of.theory is None or of.theory.bound else of.theory.mean


def _lasting(of: SimulatedError) -> float:
    known = _limit(of)
    return of.typical if math.isnan(known) else known


@dataclass(frozen=True)
class Comparison:
    """The result of `evedrop compare`; `table` has a row for each pair, for pandas or polars."""

    title: str
    slots: int
    trials: int
    seed: int
    first_trial: int
    adversaries: tuple[str, ...]
    schemes: Mapping[str, SchemeResult] = field(default_factory=dict)

    @property
    def dominant(self) -> tuple[str, ...]:
        """Schemes that no other beats: none has a smaller legitimate error, or a larger error of the closest adversary."""
        known = [one for one in self.schemes.values() if not math.isnan(one.kept)]
        return tuple(
            one.name
            for one in known
            if all(
                one.price <= other.price * (1.0 + _ALIKE) and one.kept >= other.kept * (1.0 - _ALIKE) for other in known
            )
        )

    def cell(self, scheme: str, adversary: str) -> Cell:
        """The cell of one pair."""
        return self.schemes[scheme].cells[adversary]

    def as_dict(self) -> dict[str, Any]:
        """The comparison in the form of compare.json, except for infinite numbers."""
        return {
            "scenario": self.title,
            "slots": self.slots,
            "trials": self.trials,
            "seed": self.seed,
            "first_trial": self.first_trial,
            "adversaries": list(self.adversaries),
            "dominant": list(self.dominant),
            "schemes": {
                name: {
                    "parameters": dict(one.parameters),
                    "needs": {**asdict(one.needs), "packet_bits": one.needs.packet_bits},
                    "legitimate": asdict(one.legitimate),
                    "closest": None if one.closest is None else one.closest.match.adversary,
                    "against": {adversary: cell.as_dict() for adversary, cell in one.cells.items()},
                }
                for name, one in self.schemes.items()
            },
        }

    def as_json(self, indent: int | None = 1) -> str:
        """Strict JSON; infinite and undefined numbers as strings."""
        return json.dumps(plain(self.as_dict()), indent=indent, ensure_ascii=False)

    @property
    def table(self) -> pa.Table:
        """A row for each pair of scheme and adversary."""
        return pa.Table.from_pylist([row for one in self.schemes.values() for row in _rows(one)])


def _rows(one: SchemeResult) -> Iterator[dict[str, Any]]:
    for adversary, cell in one.cells.items():
        user, other = cell.legitimate, cell.eavesdropper
        yield {
            "scheme": one.name,
            "adversary": adversary,
            "not_defined": cell.match.not_defined,
            "eavesdropper_error": None if other is None else other.mean,
            "eavesdropper_median": None if other is None else other.quantiles["0.5"],
            "eavesdropper_theory": None if other is None or other.theory is None else other.theory.mean,
            "legitimate_error": None if user is None else user.mean,
            "legitimate_median": None if user is None else user.quantiles["0.5"],
            "legitimate_theory": None if user is None or user.theory is None else user.theory.mean,
            "ratio": cell.ratio,
            "verdict": None if cell.verdict is None else cell.verdict.value,
            "packet_bits": one.needs.packet_bits,
            "secret_bits_per_slot": one.needs.secret_bits_per_slot,
            "acknowledgements": one.needs.acknowledgements,
        }


def compare_all(matchups: Matchups, folder: Path, tell: Callable[[News], None], plan: Plan) -> Comparison:
    """Simulate all matches into a results folder: compare.json, compare.png and .pdf, and the simulated scenarios.

    Raises UsageError for an unusable folder or plan; Interrupted on Ctrl-C and RunError if a worker fails, with the completed
    schemes in the folder.
    """
    groups = matchups.groups
    workers = max(plan.workers_for(group.scenario) for group in groups)
    tasks = [tasks_of(group.scenario, plan.mode, 1) for group in groups]
    told = teller(tell, sum(group.scenario.trials * group.scenario.slots for group in groups))
    played: list[tuple[Group, Merger]] = []
    failure: RunError | None = None
    with stop_on_signals() as stop, connected(plan.scheduler) as client:
        new_folder(folder)
        everything = list(itertools.chain(*tasks))
        with (
            disk_errors(folder),
            contextlib.closing(results_of(everything, workers, client, told, stop.is_set)) as results,
        ):
            written, took = time.monotonic(), 0.0
            try:
                for group, its_tasks in zip(groups, tasks, strict=True):
                    merger = _merged(group, plan, itertools.islice(results, len(its_tasks)))
                    if not merger.complete:
                        break
                    played.append((group, merger))
                    began = time.monotonic()
                    if began - written > max(_WRITE_SECONDS, _WRITE_SHARE * took):
                        _write_found(folder, _comparison(matchups, played))
                        written = time.monotonic()
                        took = written - began
            except RunError as error:
                failure = error
        found = _comparison(matchups, played)
        if not found.schemes:
            shutil.rmtree(folder)
            raise failure or Interrupted("interrupted before a scheme was done; nothing was kept")
        _write(folder, found, played)
    if failure is not None:
        raise failure
    if len(played) < len(groups):
        raise Interrupted(f"interrupted; {len(found.schemes)} of {len(matchups.schemes)} schemes are in {folder}")
    return found


def _merged(group: Group, plan: Plan, results: Iterator[BatchResult]) -> Merger:
    merger = Merger(group.scenario, plan.mode)
    for result in results:
        merger.add(result)
    return merger


def _comparison(matchups: Matchups, played: Sequence[tuple[Group, Merger]]) -> Comparison:
    """The comparison of the schemes whose matches are all done."""
    some = matchups.groups[0].scenario
    wanted = [group.scheme for group in matchups.groups]
    done = [group.scheme for group, _ in played]
    whole = [scheme for scheme in matchups.schemes if done.count(scheme) == wanted.count(scheme)]
    title = some.title.rpartition(" (")[0]
    schemes = {}
    for scheme in whole:
        groups = [(group, merger.totals.tallies) for group, merger in played if group.scheme == scheme]
        cells = {one.adversary: Cell(one) for one in matchups.undefined if one.scheme == scheme}
        for group, totals in groups:
            cells |= _cells(group, totals)
        scenario, totals = groups[0][0].scenario, groups[0][1]
        schemes[scheme] = SchemeResult(
            scheme,
            scenario.encoding.parameters,
            _needs(scenario, totals[LEGITIMATE]),
            _measured(scenario, LEGITIMATE, totals[LEGITIMATE], expectations_of(scenario)[LEGITIMATE]),
            {adversary: cells[adversary] for adversary in matchups.adversaries},
        )
    return Comparison(title, some.slots, some.trials, some.seed, some.first_trial, matchups.adversaries, schemes)


def _cells(group: Group, totals: Mapping[str, Tally]) -> dict[str, Cell]:
    expected = expectations_of(group.scenario)
    measured = {name: _measured(group.scenario, name, tally, expected[name]) for name, tally in totals.items()}
    secrecy = {one.eavesdropper: one for one in verdicts(group.scenario, totals)}
    return {
        one.adversary: Cell(one, measured[LEGITIMATE], measured[one.receiver], secrecy[one.receiver])
        for one in group.matches
    }


def _needs(scenario: Scenario, user: Tally) -> Needs:
    scheme = scheme_of(scenario.process.process, scenario.encoding.spec)
    header = scheme.packet_bits * len(scheme.header) // (scheme.process.n + len(scheme.header))
    return Needs(
        scheme.needs_acknowledgements,
        scheme.packet_bits - header,
        header,
        1.0 - user.unsent / user.offered,
        scheme.secret_bits,
        scheme.initial_secret_bits,
    )


def _measured(scenario: Scenario, receiver: str, tally: Tally, expected: Expectation) -> SimulatedError:
    means = trial_means(tally)
    heavy = expected.infinite_variance
    spread = None if heavy or len(means) < 2 else float(np.std(means, ddof=1)) / math.sqrt(len(means))
    return SimulatedError(
        tally.figures["mean_squared_error"],
        spread,
        {f"{level:g}": float(np.quantile(means, level)) for level in LEVELS},
        heavy,
        _theory(scenario, receiver, expected),
    )


def _theory(scenario: Scenario, receiver: str, expected: Expectation) -> Theory | None:
    """The theory of a receiver: its error, or a lower bound for receivers of its kind; None if neither is known."""
    known = expected if expected.known else expected.bound
    if known is not None:
        traces = known.traces(scenario.slots)
        return Theory(float(np.mean(traces)), float(traces[-1]), known.limit, known is not expected)
    if receiver == LEGITIMATE or receiver in scenario.leaks:
        return None
    found = scheme_of(scenario.process.process, scenario.encoding.spec).error_floor(scenario.slots)
    if found is None:
        return None
    floor, grows = found
    return Theory(float(np.mean(floor)), float(floor[-1]), math.inf if grows else None, True)


def _write(folder: Path, found: Comparison, played: Sequence[tuple[Group, Merger]]) -> None:
    from evedrop.view.comparison_picture import draw  # noqa: PLC0415 - matplotlib takes half a second

    with disk_errors(folder):
        _write_found(folder, found)
        scenarios = folder / "scenarios"
        make_private(scenarios)
        for group, _ in played:
            write_private(scenarios / f"{group.name}.toml", resolved(group.scenario))
        draw(private_pictures(folder / "compare"), found)


def _write_found(folder: Path, found: Comparison) -> None:
    """Write compare.json with the schemes so far, if there are any; replaces the file atomically."""
    if found.schemes:
        unfinished = folder / "compare.json.new"
        write_private(unfinished, found.as_json() + "\n")
        os.replace(unfinished, folder / "compare.json")
