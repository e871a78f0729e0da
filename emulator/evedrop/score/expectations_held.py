"""Whether a run met its expectations: the value found, the value expected, and how to reproduce a failure.

Source: docs/scenario.md, expect; docs/results.md, expectations.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from evedrop.model.links.loss_model import REASONS
from evedrop.scenario.application import APPLICATIONS, Summary
from evedrop.scenario.expect import ExpectTable, direction_metric, link_metric
from evedrop.scenario.tables import Scenario
from evedrop.score.secrecy import Claim
from evedrop.score.summary import (
    MODES,
    DirectionSummary,
    Judged,
    JudgedValue,
    LinkSummary,
    PeerSummary,
    SecrecySummary,
)
from evedrop.score.sums import Tally, quantile_of
from evedrop.score.watched_tally import watch_of

_THEORY = {True: "theory promises it", False: "theory denies it", None: "no theory covers these links"}
_RUN = {Claim.HELD.value: "the run shows it", Claim.FAILED.value: "the run shows that it fails"}


def replay_of(folder: Path, scenario: Scenario, mode: str = "live") -> str:
    """The command that repeats the run in a results folder, to the same bits."""
    return repeating(folder.absolute(), scenario.trials, mode)


def repeating(source: Path, trials: int, mode: str) -> str:
    """The same for a scenario's file or folder; trials: of the run, mode: as in the summary."""
    where = shlex.quote(str(source))
    if mode == "live":
        return f"evedrop run {where}"
    return f"evedrop montecarlo {where} --trials {trials}{MODES[mode]}"


@dataclass(frozen=True)
class Evidence:
    """The results of a run by receiver."""

    scenario: Scenario
    peers: Mapping[str, PeerSummary]
    links: Mapping[str, LinkSummary]
    tallies: Mapping[str, Tally]
    secrecy: Mapping[str, SecrecySummary]
    applications: Mapping[str, Summary] = field(default_factory=dict)
    """Application → its entry of the summary."""
    directions: Mapping[str, Mapping[str, DirectionSummary]] = field(default_factory=dict)
    """As in the summary."""

    def judged(self, replay: str | None) -> list[Judged]:
        """Every expectation of the scenario; `replay` is the command that reproduces a failure."""
        return [self._judged(expect, replay) for expect in self.scenario.expect]

    def _judged(self, expect: ExpectTable, replay: str | None) -> Judged:
        judge = {
            "metric": self._metric,
            "link": self._link,
            "secrecy": self._secrecy,
            "synchronised": self._synchronised,
        }
        value, held = judge[expect.kind](expect)
        why = None if held is not None or self._complete else "the run was cut short"
        return Judged(expect.text, held, value, expect.wanted, replay if held is False else None, why)

    @property
    def _complete(self) -> bool:
        return all(tally.done == tally.slots for tally in self.tallies.values())

    def _metric(self, expect: ExpectTable) -> tuple[float | None, bool | None]:
        name = str(expect.metric)
        link = link_metric(name)
        application, *path = name.split(".")
        direction = direction_metric(name)
        if direction is not None:
            entry = self.directions.get(direction[0], {}).get(direction[1])
            value = None if entry is None else entry.mean_squared_error
        elif application in self.scenario.applications:
            summary = self.applications.get(application)
            value = None if summary is None else APPLICATIONS[application].metric(summary, path)
        else:
            value = self._of_link(*link) if link is not None else self._of_receiver(expect, *name.split("."))
        decided = self._complete or expect.slots is not None
        return value, expect.holds(value) if value is not None and decided else None

    def _of_link(self, receiver: str, path: tuple[str, ...]) -> float | None:
        """A metric of a link's account, or of its losses by reason: 0 for a reason that did not occur."""
        entries: Mapping[str, object] = vars(self.links[receiver])
        *place, metric = path
        for part in place:
            inner = entries.get(part)
            entries = inner if isinstance(inner, Mapping) else {}
        value = entries.get(metric, 0 if place == ["lost_by"] and metric in REASONS else None)
        return value if isinstance(value, (int, float)) else None

    def _of_receiver(self, expect: ExpectTable, receiver: str, metric: str) -> float | None:
        """A metric of the whole run or of some slots, or a quantile of it over trials."""
        whole = self.peers[receiver].metric(metric)
        wanted = watch_of(self.scenario, expect)
        if whole is None or wanted is None:
            return whole
        if self.tallies[receiver].done < wanted[1].end:
            return None
        tally = self.tallies[receiver].watched.tally(wanted[1])
        if expect.quantile is None:
            return tally.value
        values = tally.of_trials
        return None if values is None else quantile_of(values, expect.quantile)

    def _link(self, expect: ExpectTable) -> tuple[JudgedValue, bool | None]:
        account = self.links[str(expect.link)]
        return account.rate, account.within_interval

    def _secrecy(self, expect: ExpectTable) -> tuple[JudgedValue, bool | None]:
        """Held if theory promises secrecy and the run shows it, otherwise not; undecided in a run that was cut short.

        In one direction theory only promises perfect secrecy: relative secrecy is what the run shows.
        """
        against, relative = str(expect.against), expect.secrecy == "relative"
        entry: SecrecySummary | DirectionSummary | None
        of_direction = self.directions.get(against, {}).get(str(expect.direction))
        entry = self.secrecy[against] if expect.direction is None else of_direction
        if entry is None:
            return None, None
        shown = str(entry.relative if relative else entry.perfect)
        value = _RUN.get(shown, f"the run has {shown}")
        if not relative:
            promised = entry.perfect_by_theory
        elif isinstance(entry, SecrecySummary):
            promised = entry.relative_by_theory
        else:
            return value, shown == Claim.HELD.value if self._complete else None
        held = promised is True and shown == Claim.HELD.value
        return f"{_THEORY[promised]}, {value}", held if self._complete else None

    def _synchronised(self, expect: ExpectTable) -> tuple[JudgedValue, bool | None]:
        """The slot by which it was synchronised in all trials; undecided if the run was cut short before `by`."""
        wanted = watch_of(self.scenario, expect)
        assert wanted is not None  # noqa: S101 - every such expectation has one
        tally = self.tallies[wanted[0]]
        by = math.inf if expect.by is None else expect.by
        if tally.done <= by and tally.done < tally.slots:
            return None, None
        value = tally.watched.tally(wanted[1]).value
        return value, value is not None and value <= by
