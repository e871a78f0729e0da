"""Scores a run, live or in memory: compares every slot with theory, keeps a tally per receiver, and makes the summary.

The summary is described in docs/results.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, final

import numpy as np

from evedrop.expected.expectations import expectations_of
from evedrop.model.digest import Digests, RunDigest, block_starts
from evedrop.model.process import Floats
from evedrop.names import CONTROLLER, LEGITIMATE
from evedrop.scenario import Scenario
from evedrop.score.channel import channel_of
from evedrop.score.closed_loop_tally import Acted
from evedrop.score.expectations_held import Evidence
from evedrop.score.filtering import true_errors
from evedrop.score.histogram import LEVELS
from evedrop.score.slots import Slots
from evedrop.score.sums import SlotSums, Tally, slot_sums, squared_errors, trial_means
from evedrop.score.totals import Totals
from evedrop.score.verdict import Secrecy, secrecy
from evedrop.score.verified import verification_of

_ENOUGH_TO_SURPRISE = 10  # trials


class Scored(NamedTuple):
    """One receiver over c slots, scored."""

    squared_error: Floats
    """(c, R)."""
    sums: SlotSums
    expected: Floats
    """Theory: trace of the expected actual error covariance, (c,)."""


@final
class Scorekeeper:
    """Scores the slots of a batch of trials, in order."""

    def __init__(self, scenario: Scenario, trials: int) -> None:
        self._theory = {name: one.stream() for name, one in expectations_of(scenario).items()}
        self.totals = Totals.of(scenario, trials)

    def add(self, slots: Slots) -> dict[str, Scored]:
        """Score the next slots: receiver → its errors, sums and theory."""
        scored = {}
        self._add_plant(slots)
        for name, receiver in slots.receivers.items():
            errors = squared_errors(slots.x, receiver.x_hat)
            one = Scored(
                errors, slot_sums(errors, receiver.action, receiver.trace), self._theory[name].next_traces(slots.count)
            )
            tally = self.totals.tallies[name]
            tally.add(slots.first, *one)
            tally.account(receiver.delivered, receiver.action, receiver.lost, receiver.unsent)
            if slots.sent is not None:
                tally.account_sent(slots.sent, receiver.delivered, receiver.unsent)
            late = None
            if receiver.late is not None and receiver.late_used is not None and receiver.late_delivered is not None:
                late = (receiver.late, receiver.late_used)
                tally.account_late(receiver.late_delivered, *late)
            tally.watched.add(slots.first, errors, receiver.action, one.sums.trace, late)
            scored[name] = one
        return scored

    def _add_plant(self, slots: Slots) -> None:
        """Add the slots' alarms, the controller's decisions, and the true errors of a sensor that filters."""
        totals, estimates = self.totals, {name: one.x_hat for name, one in slots.receivers.items()}
        if slots.alarms is not None and totals.detection is not None:
            totals.detection.add(slots.first, slots.alarms)
        if slots.true is not None and totals.filter is not None:
            totals.filter.add(true_errors(slots.true, slots.x, estimates))
        if slots.inputs is not None and totals.loop is not None:
            true = slots.x if slots.true is None else slots.true
            totals.loop.add(Acted(slots.inputs, slots.x, estimates, slots.receivers[LEGITIMATE].action, true))


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    wall_seconds: float
    """From the start command to the last row on disk."""
    how: str = "complete"
    """`complete`, `interrupted`, or why it failed."""
    replay: str | None = None
    """The command that runs it again, shown when an expectation fails."""
    mode: str = "live"
    """`live`, or the mode of a run in memory."""
    events: Sequence[Mapping[str, Any]] = ()
    """As in the summary."""
    outages: Sequence[Mapping[str, Any]] = ()
    """As in the summary."""
    accused: tuple[str, ...] = ()
    """The processes whose behaviour made the run end."""
    misdelivered: Mapping[str, int] = field(default_factory=dict)
    """Process → messages with other processes' keys, which it dropped."""


def verdicts(scenario: Scenario, tallies: Mapping[str, Tally]) -> list[Secrecy]:
    """The verdict on every eavesdropper."""
    expected = expectations_of(scenario)
    user = (tallies[LEGITIMATE], expected[LEGITIMATE])
    return [secrecy(user, (name, tallies[name], expected[name])) for name in scenario.eavesdroppers]


def summary_of(scenario: Scenario, totals: Totals, digests: Mapping[str, str | None], ending: Ending) -> dict[str, Any]:
    """The summary of docs/results.md; a digest is None if there is none, or if the run was cut short.

    An accused process has no digest either: what it reported is contradicted.
    """
    tallies, detection, loop = totals.tallies, totals.detection, totals.loop
    digests = {name: None if name in ending.accused else one for name, one in digests.items()}
    expected = expectations_of(scenario)
    peers: dict[str, dict[str, Any]] = {
        name: {
            **(_figures(tally) if tally.offered else dict.fromkeys(tally.figures)),
            "error_quantiles": _quantiles(tally),
            "infinite_variance": expected[name].infinite_variance,
            "digest": digests[name],
        }
        for name, tally in tallies.items()
    }
    if ending.mode == "covariance-only":
        for peer in peers.values():
            peer["mean_actual_trace_covariance"], peer["mean_squared_error"] = peer["mean_squared_error"], None
    applications = {} if loop is None else {name: one.summary() for name, one in loop.applications.items()}
    user = tallies[LEGITIMATE]
    links = {name: {**tally.link, **channel_of(scenario, name, tally)} for name, tally in tallies.items()}
    secret = {one.eavesdropper: one for one in verdicts(scenario, tallies)}
    evidence = Evidence(scenario, peers, links, tallies, expected, secret, applications)
    return {
        "scenario": scenario.title,
        "mode": ending.mode,
        "seed": scenario.seed,
        "slots": user.done,
        "trials": user.trials,
        "first_trial": scenario.first_trial,
        "wall_seconds": ending.wall_seconds,
        "slots_per_second": user.offered / user.trials / ending.wall_seconds if ending.wall_seconds else 0.0,
        "ended": ending.how,
        "peers": peers,
        "links": links,
        "events": list(ending.events),
        "outages": list(ending.outages),
        "verification": verification_of(scenario, ending.accused) if ending.mode == "live" else None,
        "misdelivered": dict(ending.misdelivered),
        "secrecy": {name: one.as_dict() for name, one in secret.items()},
        "detection": None if detection is None else detection.summary(scenario),
        "controller": None
        if loop is None
        else loop.summary(scenario, peers[LEGITIMATE], totals.solve_times, digests[CONTROLLER]),
        "filter": None if totals.filter is None else totals.filter.summary(scenario),
        **applications,
        "surprising": _surprising(scenario, tallies),
        "expectations": evidence.judged(ending.replay),
    }


def _figures(tally: Tally) -> dict[str, float | None]:
    """A receiver's figures; None where there is no theory."""
    return {name: None if math.isnan(value) else value for name, value in tally.figures.items()}


def _quantiles(tally: Tally) -> dict[str, float] | None:
    """Quantiles over trials of a trial's mean error; None if the run was cut short."""
    if tally.done != tally.slots:
        return None
    return {f"{level:g}": float(np.quantile(trial_means(tally), level)) for level in LEVELS}


def _surprising(scenario: Scenario, tallies: Mapping[str, Tally]) -> dict[str, Any] | None:
    """The trial whose mean error, for any receiver, lies furthest from the median, in logarithms and median deviations."""
    found: dict[str, Any] | None = None
    furthest = 0.0
    for name, tally in tallies.items():
        means = trial_means(tally)
        if tally.done != tally.slots or tally.trials < _ENOUGH_TO_SURPRISE or not np.all(means > 0.0):
            continue
        logarithms = np.log(means)
        median = float(np.median(logarithms))
        deviation = np.abs(logarithms - median)
        spread = float(np.median(deviation))
        worst = int(np.argmax(deviation))
        if spread > 0.0 and deviation[worst] / spread > furthest:
            furthest = float(deviation[worst] / spread)
            found = {
                "trial": scenario.first_trial + worst,
                "receiver": name,
                "mean_error": float(means[worst]),
                "median": float(np.exp(median)),
            }
    return found


def digest_of(scenario: Scenario, receiver: str, blocks: Mapping[int, Digests]) -> str | None:
    """A receiver's digest from all its blocks; None if the run was cut short."""
    if sorted(blocks) != block_starts(scenario.slots, scenario.cuts(receiver)):
        return None
    digest = RunDigest()
    digest.add(blocks)
    return digest.hexadecimal


def events_of(scenario: Scenario, done: int) -> list[dict[str, Any]]:
    """The scenario's events before slot `done`, as the summary lists them."""
    return [{"slot": act.at, "event": act.said, "by": "scenario"} for act in scenario.timeline.acts if act.at < done]


def event_line(event: Mapping[str, Any]) -> str:
    """An event of the summary as a line of the view."""
    return event["event"] if event["by"] == "scenario" else f"{event['event']} (by the {event['by']})"
