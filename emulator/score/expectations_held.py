"""Whether a run met its expectations: the value found, the value expected, and how to reproduce a failure.

Source: docs/scenario.md, expect; docs/results.md, expectations.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from evedrop.expected.expectations import Expectation
from evedrop.scenario import ExpectTable, Scenario, link_figure
from evedrop.scenario.application import APPLICATIONS
from evedrop.score.sums import Tally
from evedrop.score.verdict import Secrecy, Verdict
from evedrop.score.watched import watch_of

Found = float | str | None
"""None: the run does not tell, or a receiver that must be in step never was."""

_MODES = {"exact": "", "covariance-only": " --covariance-only", "error-coordinates": " --error-coordinates"}


def replay_of(folder: Path, scenario: Scenario, mode: str = "live") -> str:
    """The command that runs the contents of a results folder again, to the same bits."""
    where = shlex.quote(str(folder.absolute()))
    if mode == "live":
        return f"evedrop run {where}"
    return f"evedrop montecarlo {where} --trials {scenario.trials}{_MODES[mode]}"


def format_expectation(expectation: Mapping[str, Any]) -> str:
    """An expectation from a summary as a sentence."""
    found, held = expectation["found"], expectation["held"]
    word = {True: "held", False: "FAILED", None: "this run does not tell"}[held]
    if found is None:
        return f"expected {expectation['text']}: {word}" + (", found none" if held is False else "")
    if isinstance(found, str) and found not in {"inf", "-inf", "nan"}:
        return f"expected {expectation['text']}: {word}, found {found}"
    number = str(found) if isinstance(found, int) else f"{float(found):.6g}"
    return f"expected {expectation['text']}: {word}, found {number}"


@dataclass(frozen=True)
class Evidence:
    """The results of a run by receiver."""

    scenario: Scenario
    peers: Mapping[str, Mapping[str, Any]]
    """As in the summary."""
    links: Mapping[str, Mapping[str, Any]]
    """As in the summary."""
    tallies: Mapping[str, Tally]
    theory: Mapping[str, Expectation]
    secrecy: Mapping[str, Secrecy]
    applications: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Application → its entry of the summary."""

    def judged(self, replay: str | None) -> list[dict[str, Any]]:
        """Every expectation of the scenario as in the summary; `replay` is the command that reproduces a failure."""
        return [self._judged(expect, replay) for expect in self.scenario.expect]

    def _judged(self, expect: ExpectTable, replay: str | None) -> dict[str, Any]:
        judge = {"figure": self._figure, "link": self._link, "secrecy": self._secrecy, "in_step": self._in_step}
        found, held = judge[expect.kind](expect)
        one = {"text": expect.text, "held": held, "found": found, "wanted": expect.wanted}
        return {**one, "replay": replay} if held is False and replay is not None else one

    def _figure(self, expect: ExpectTable) -> tuple[Found, bool | None]:
        name = str(expect.figure)
        link = link_figure(name)
        application, *path = name.split(".")
        if application in self.scenario.applications:
            summary = self.applications.get(application)
            found = None if summary is None else APPLICATIONS[application].figure(summary, path)
        else:
            found = self._of_link(*link) if link is not None else self._of_receiver(expect, *name.split("."))
        return found, None if found is None else expect.holds(found)

    def _of_link(self, receiver: str, path: tuple[str, ...]) -> float | None:
        inner: Any = self.links[receiver]
        for part in path:
            inner = inner.get(part) if isinstance(inner, Mapping) else None
        return inner if isinstance(inner, (int, float)) else None

    def _of_receiver(self, expect: ExpectTable, receiver: str, figure: str) -> float | None:
        """A figure of the whole run or of some slots, or a quantile of it over trials."""
        whole: float | None = self.peers[receiver][figure]
        first, end = expect.slots or (0, self.scenario.slots)
        if whole is None or (expect.slots is None and expect.quantile is None):
            return whole
        if self.tallies[receiver].done < end:
            return None
        wanted = watch_of(self.scenario, expect)
        if wanted is None:
            return float(np.mean(self.theory[receiver].traces(end)[first:]))
        watched, watch = self.tallies[receiver].watched, wanted[1]
        return watched.mean(watch) if expect.quantile is None else watched.quantile(watch, expect.quantile)

    def _link(self, expect: ExpectTable) -> tuple[Found, bool | None]:
        account = self.links[str(expect.link)]
        return account.get("rate"), account.get("within_interval")

    def _secrecy(self, expect: ExpectTable) -> tuple[Found, bool | None]:
        """Held if theory promises secrecy and the run shows it; in all other cases it is not held."""
        verdict = self.secrecy[str(expect.against)]
        relative = expect.secrecy == "relative"
        shown = verdict.relative if relative else verdict.perfect
        promised = verdict.relative_by_theory if relative else verdict.perfect_by_theory
        theory = {True: "theory promises it", False: "theory denies it", None: "there is no theory for these links"}
        run = {Verdict.HELD: "the run shows it", Verdict.FAILED: "the run shows that it fails"}
        found = f"{theory[promised]}, {run.get(shown, f'the run has {shown.value}')}"
        complete = all(tally.done == tally.slots for tally in self.tallies.values())
        return found, promised is True and shown is Verdict.HELD if complete else None

    def _in_step(self, expect: ExpectTable) -> tuple[Found, bool | None]:
        """The largest slot over trials; undecided if the run was cut short before that slot."""
        wanted = watch_of(self.scenario, expect)
        assert wanted is not None  # noqa: S101 - every such expectation has one
        tally = self.tallies[wanted[0]]
        by = math.inf if expect.by is None else expect.by
        if tally.done <= by and tally.done < tally.slots:
            return None, None
        found = tally.watched.in_step(wanted[1])
        return found, found is not None and found <= by
