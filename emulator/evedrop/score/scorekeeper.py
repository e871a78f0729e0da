"""Scores a run, live or in memory: compares every slot with theory, keeps a tally per receiver, and makes the summary.

The summary is described in docs/results.md.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import NamedTuple, final

import numpy as np

from evedrop.model.digest import Digests, RunDigest, block_starts
from evedrop.model.metrics import metrics_of
from evedrop.model.metrics.metric import COVARIANCE_ONLY, ScoredSlots
from evedrop.model.process import Floats
from evedrop.names import CONTROLLER, LEGITIMATE
from evedrop.scenario.dry_run import has_foreign
from evedrop.scenario.progress_events import ConnectionOutage, RunEvent
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import (
    Expectation,
    TheoreticalTraceStream,
    error_floor_of,
    expectations_of,
    replays_a_recording,
)
from evedrop.score.after_start import AfterStart
from evedrop.score.directions import directions_of
from evedrop.score.expectations_held import Evidence
from evedrop.score.filtering import true_errors
from evedrop.score.leak import HeardBitsStream
from evedrop.score.links import link_summary_of
from evedrop.score.rare_events import rare_events_of, z_of_error
from evedrop.score.run_tally import RunTally
from evedrop.score.secrecy import secrecy
from evedrop.score.slots import Slots
from evedrop.score.summary import PeerSummary, SecrecySummary, Summary, SurprisingTrial, Verification
from evedrop.score.sums import LEVELS, SlotSums, Tally, quantile_of, slot_sums, squared_errors, trial_means
from evedrop.score.verdict import Compared, Verdict, verdict_of
from evedrop.score.watched_tally import watches_of

_ENOUGH_TO_SURPRISE = 10  # trials


class Scored(NamedTuple):
    """One receiver over c slots, scored."""

    squared_error: Floats
    """(c, R)."""
    sums: SlotSums
    expected: Floats
    """Trace of the theoretical error covariance, (c,)."""


@final
class Scorekeeper:
    """Scores the slots of a batch of trials, in order.

    theory: receiver → its theoretical traces; revealed: what packets reveal; both are computed if they are not given.
    """

    def __init__(
        self,
        scenario: Scenario,
        trials: int,
        theory: Mapping[str, TheoreticalTraceStream] | None = None,
        revealed: HeardBitsStream | None = None,
    ) -> None:
        self._theory = _theory_of(scenario) if theory is None else theory
        self._slots = 0
        """How many are scored."""
        self._revealed = HeardBitsStream(scenario) if revealed is None else revealed
        self._built_in = not has_foreign(scenario)
        self.run_tally = RunTally.from_scenario(scenario, trials)

    def amend(self, scenario: Scenario) -> None:
        """Expect what another scenario lets expect, which is the same for the slots so far. Raises NoAnswer."""
        for name, watches in watches_of(scenario).items():  # an event restarts the wait for a synchronised receiver
            tally = self.run_tally.tallies[name]
            tally.watched.watch(watches, tally.trials)
        theory = _theory_of(scenario)
        for stream in theory.values():
            stream.next_traces(self._slots)
        revealed = HeardBitsStream(scenario)
        revealed.of(range(self._slots))
        self._theory, self._revealed = theory, revealed

    def add_slots(
        self, slots: Slots, errors_and_traces: Mapping[str, tuple[Floats, Floats]] | None = None
    ) -> dict[str, Scored]:
        """Score the next slots: receiver → its errors, sums and theory.

        errors_and_traces: receiver → its squared errors, and tr P of every trial, (c, R) each, if they have been computed.
        """
        scored = {}
        self._slots += slots.count
        self._add_plant(slots)
        revealed = self._revealed.of(range(slots.first, slots.first + slots.count))
        sensor = slots.sensor
        for name, receiver in slots.receivers.items():
            link = slots.links[name]
            if errors_and_traces is None:
                errors, traces = squared_errors(sensor.x, receiver.x_hat), receiver.traces_of_trials
            else:
                errors, traces = errors_and_traces[name]
            values = Scored(
                errors, slot_sums(errors, receiver.action, receiver.trace), self._theory[name].next_traces(slots.count)
            )
            tally = self.run_tally.tallies[name]
            tally.add_slots(slots.first, *values)
            if tally.distance is not None:
                tally.distance.add_slots(slots.first, errors, values.sums.error, sensor.x, receiver.x_hat)
            if tally.conditional is not None:
                # In memory, a receiver that is built in computes the covariances that its actions imply.
                implied = errors_and_traces is not None and self._built_in
                tally.conditional.add_actions(receiver.action, traces if implied else None)
            if tally.leak is not None:
                tally.leak.add_slots(receiver.action, sensor.nu, revealed[name])
            for direction in tally.directions.values():
                direction.add_slots(slots.first, sensor.x, receiver.x_hat)
            tally.add_traces(slots.first, traces)
            tally.account(link, receiver.action)
            if sensor.sent is not None:
                tally.account_sent(sensor.sent, link)
            if receiver.late is not None and receiver.late_used is not None and link.late is not None:
                tally.account_late(link.late, receiver.late, receiver.late_used)
            tally.watched.add_slots(
                ScoredSlots(
                    slots.first,
                    errors,
                    receiver.action,
                    values.sums.trace,
                    values.expected,
                    receiver.late,
                    receiver.late_used,
                    sensor.x,
                    receiver.x_hat,
                )
            )
            if receiver.late is not None and receiver.late_used is not None:  # the tally has counted them by itself
                values = values._replace(sums=values.sums.with_late(receiver.late, receiver.late_used))
            scored[name] = values
        return scored

    def _add_plant(self, slots: Slots) -> None:
        """Add the slots' alarms, the controller's decisions, and the true errors of a sensor that filters."""
        run_tally, sensor = self.run_tally, slots.sensor
        estimates = {name: receiver.x_hat for name, receiver in slots.receivers.items()}
        if sensor.alarms is not None and run_tally.detection is not None:
            run_tally.detection.add_alarms(slots.first, sensor.alarms)
        if sensor.true is not None and run_tally.filter is not None:
            run_tally.filter.add_errors(true_errors(sensor.true, sensor.x, estimates))
        if run_tally.loop is not None:
            run_tally.loop.add_slots(sensor, estimates, slots.receivers[LEGITIMATE].action)


def _theory_of(scenario: Scenario) -> Mapping[str, TheoreticalTraceStream]:
    return {name: expectation.stream() for name, expectation in expectations_of(scenario).items()}


@dataclass(frozen=True)
class RunOutcome:
    """How a run went and ended, apart from its numbers."""

    wall_seconds: float
    """From the start command to the last row on disk."""
    how: str = "complete"
    """`complete`, `interrupted`, or why it failed."""
    replay: str | None = None
    """The command that runs it again, shown when an expectation fails."""
    mode: str = "live"
    """`live`, or the mode of a run in memory."""
    events: Sequence[RunEvent] = ()
    outages: Sequence[ConnectionOutage] = ()
    accused: tuple[str, ...] = ()
    """The processes whose misbehaviour ended the run."""
    misdelivered: Mapping[str, int] = field(default_factory=dict)
    """Process → messages with other processes' keys, which it dropped."""


def verdicts(
    scenario: Scenario,
    tallies: Mapping[str, Tally],
    expected: Mapping[str, Expectation],
    true: Mapping[str, AfterStart] | None = None,
) -> tuple[dict[str, SecrecySummary], list[Compared], Verdict | None]:
    """Secrecy against every eavesdropper, from all receivers' tallies and what theory expects of them.

    Returns eavesdropper → its entry, the comparisons on which the verdicts rest, and the verdict on all.

    true: eavesdropper → the comparison of errors against the true state, for a sensor that sends an estimate.
    """
    legitimate, unit = (tallies[LEGITIMATE], expected[LEGITIMATE]), unit_of(scenario)
    true = true or {}
    unmeasured = AfterStart(math.nan) if scenario.measures else None
    replaying = {name for name in tallies if replays_a_recording(scenario, name)}
    entries, each = {}, []
    for name, tally in tallies.items():
        if name != LEGITIMATE:
            entries[name], compared = secrecy(
                legitimate,
                (name, tally, expected[name]),
                unit,
                partial(_floor_grows, scenario, name),
                true.get(name, unmeasured),
                not replaying.isdisjoint({LEGITIMATE, name}),
            )
            each.append(compared)
    return entries, each, verdict_of(each, unit)


def summary_of(
    scenario: Scenario, run_tally: RunTally, digests: Mapping[str, str | None], ending: RunOutcome
) -> Summary:
    """The summary of a run; digests: process → its digest, None if it has none or the run was cut short.

    An accused process has no digest either, because its reports were contradicted. A run to the end in which a package's
    metric or application failed is not `complete`: it ended with that failure.
    """
    tallies, detection, loop = run_tally.tallies, run_tally.detection, run_tally.loop
    # If the run was cut short, some processes were ahead of the others.
    whole = tallies[LEGITIMATE].done == scenario.slots
    digests = {name: entry if whole and name not in ending.accused else None for name, entry in digests.items()}
    expected = expectations_of(scenario)
    peers = {name: _peer(name, tally, expected[name], digests[name], ending.mode) for name, tally in tallies.items()}
    heavy = {name for name, peer in peers.items() if peer.infinite_variance}
    legitimate = tallies[LEGITIMATE]
    applications = {} if loop is None else loop.entries(legitimate.trials)
    links = {name: link_summary_of(scenario, name, tally) for name, tally in tallies.items()}
    true = true_ratios(run_tally, expected)
    secret, _, verdict = verdicts(scenario, tallies, expected, true)
    directions = directions_of(tallies, expected)
    expectations = Evidence(scenario, peers, links, tallies, secret, applications, directions).judged(ending.replay)
    # Known only now that every metric has been computed.
    failures = run_tally.failures if ending.how == RunOutcome.how else []
    return Summary(
        scenario=scenario.title,
        mode=ending.mode,
        seed=scenario.seed,
        slots=legitimate.done,
        trials=legitimate.trials,
        first_trial=scenario.first_trial,
        wall_seconds=ending.wall_seconds,
        slots_per_second=legitimate.offered / legitimate.trials / ending.wall_seconds if ending.wall_seconds else 0.0,
        ended=failures[0] if failures else ending.how,
        peers=peers,
        links=links,
        events=ending.events,
        outages=ending.outages,
        verification=verification_of(scenario, ending.accused) if ending.mode == "live" else None,
        misdelivered=ending.misdelivered,
        secrecy=secret,
        detection=None if detection is None else detection.summary(scenario),
        controller=None
        if loop is None
        else loop.summary(scenario, peers[LEGITIMATE], run_tally.solve_times, digests[CONTROLLER]),
        filter=None if run_tally.filter is None else run_tally.filter.summary(scenario, true, heavy),
        applications=applications,
        surprising=_surprising(scenario, tallies),
        expectations=expectations,
        directions=directions,
        verdict=verdict,
    )


def true_ratios(run_tally: RunTally, expected: Mapping[str, Expectation]) -> dict[str, AfterStart]:
    """Eavesdropper → its error against the true state, compared with the legitimate one; empty for a sensor that knows it."""
    tally = run_tally.filter
    if tally is None:
        return {}
    heavy = {name for name, expectation in expected.items() if expectation.infinite_variance}
    return {
        name: tally.compared(name, not heavy.isdisjoint({name, LEGITIMATE})) for name in expected if name != LEGITIMATE
    }


def _floor_grows(scenario: Scenario, receiver: str) -> bool:
    """Whether the scheme's lower bound on an eavesdropper's error grows without bound."""
    bound = error_floor_of(scenario, receiver)
    return bound is not None and bound[1]


def unit_of(scenario: Scenario) -> str:
    """The unit of the first states, in which distances are given; empty without units."""
    return (scenario.process.units or ("",))[0]


def _peer(name: str, tally: Tally, expected: Expectation, digest: str | None, mode: str) -> PeerSummary:
    """A receiver's entry of the summary."""
    infinite_variance = expected.infinite_variance
    metrics: dict[str, float | None] = {}
    of_mode: dict[str, float | None] = {}
    errors: dict[str, float | None] = {}
    for metric, kind in metrics_of(name).items():
        if kind.only_in_mode not in {None, mode}:
            continue
        value = None if kind.not_in_mode == mode else tally.metric(metric)
        (metrics if kind.only_in_mode is None else of_mode)[metric] = value
        if kind.rests_on != "theory":
            meaningless = value is None or (kind.of_error and infinite_variance)
            errors[metric] = None if meaningless else tally.standard_error(metric)
    values, comparable = {**metrics, **of_mode}, not expected.of_model or mode == COVARIANCE_ONLY
    rare = rare_events_of(expected, tally) if comparable else None
    z = {
        metric: z_of_error(tally.of_trials(metric), values[kind.expected], expected, tally.done, rare)
        if comparable and values[metric] is not None
        else None
        for metric, kind in metrics_of(name).items()
        if kind.expected is not None and metric in errors
    }
    return PeerSummary(metrics, _quantiles(tally), infinite_variance, digest, of_mode, errors, z, rare)


def _quantiles(tally: Tally) -> dict[str, float] | None:
    """Quantiles over trials of a trial's mean error; None if the run was cut short."""
    if tally.done != tally.slots:
        return None
    return {f"{level:g}": quantile_of(trial_means(tally), level) for level in LEVELS}


def _surprising(scenario: Scenario, tallies: Mapping[str, Tally]) -> SurprisingTrial | None:
    """The trial whose mean error, for any receiver, is least probable, given what happened to its own packets.

    None without such a trial: the run was cut short, has too few trials, or no receiver with such expectations.
    """
    surprising: SurprisingTrial | None = None
    for name, tally in tallies.items():
        own = tally.conditional
        if own is None or not own.slots or tally.done != tally.slots or tally.trials < _ENOUGH_TO_SURPRISE:
            continue
        means, expected = trial_means(tally), own.expected / tally.slots
        probability = own.probability(means * tally.slots)
        # Where probabilities are too small for a float, the error decides.
        least = int(np.lexsort((-means, np.nan_to_num(probability, nan=1.0)))[0])
        if expected[least] > 0.0 and (surprising is None or probability[least] < surprising.probability):
            trial = scenario.first_trial + least
            surprising = SurprisingTrial(
                trial, name, *(float(values[least]) for values in (means, expected, probability))
            )
    return surprising


def digest_of(scenario: Scenario, receiver: str, blocks: Mapping[int, Digests]) -> str | None:
    """A receiver's digest from all its blocks; None if the run was cut short."""
    if sorted(blocks) != block_starts(scenario.slots, scenario.outage_bounds(receiver)):
        return None
    digest = RunDigest()
    digest.add(blocks)
    return digest.hexadecimal


def events_of(scenario: Scenario, done: int) -> list[RunEvent]:
    """The scenario's events before slot `done`."""
    return [RunEvent(act.at, act.text, "scenario") for act in scenario.timeline.acts if act.at < done]


def verification_of(scenario: Scenario, accused: Collection[str] = ()) -> dict[str, Verification]:
    """The entry `verification` of a live run's summary: receiver → the verified metrics, and those that rest on its word.

    accused: processes whose misbehaviour ended the run.
    """
    recorded = _recorded_of(scenario)
    verifications = {}
    for name in scenario.receivers:
        metrics = {who: _resting_on(who, name) for who in ("recorder", "receiver", "recorded trials")}
        checked, of_recorded = metrics["recorder"], [*metrics["recorded trials"], "digest"]
        verified = [] if name in accused else checked + (of_recorded if recorded == scenario.trials else [])
        own_word = [metric for metric in (*checked, *metrics["receiver"], *of_recorded) if metric not in verified]
        verifications[name] = Verification(0 if name in accused else recorded, verified, own_word)
    return verifications


def _resting_on(who: str, receiver: str) -> list[str]:
    """The metrics of a receiver of a live run with this value of `rests_on`."""
    metrics = metrics_of(receiver).items()
    return [name for name, kind in metrics if kind.rests_on == who and kind.only_in_mode is None]


def _recorded_of(scenario: Scenario) -> int:
    """The number of recorded trials; each shard records at least its first."""
    bounds = [scenario.trials * i // scenario.shards for i in range(scenario.shards + 1)]
    return sum(max(1, min(scenario.record_trials, stop) - start) for start, stop in pairwise(bounds))
