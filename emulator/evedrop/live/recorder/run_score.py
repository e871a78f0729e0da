"""What a live run has come to: its tallies, how it goes, and the summary that is made from both.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import final

from evedrop.live.recorder.joiner import Joiner
from evedrop.scenario.progress_events import ConnectionOutage, RunEvent
from evedrop.scenario.tables import Scenario
from evedrop.score.expectations_held import replay_of
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, digest_of, summary_of
from evedrop.score.summary import Summary
from evedrop.system.world import world


@final
class RunScore:
    """The score of a run so far, and its summary."""

    def __init__(self, scenario: Scenario, run_tally: RunTally, joiner: Joiner) -> None:
        self.scenario = scenario
        """With the operator's changes; it is the same for the slots so far."""
        self.started = self.ended = world().monotonic()
        """When all processes were there, or at first the recorder's beginning; and when the run was as the summary says."""
        self.events: Sequence[RunEvent] = ()
        self.outages: Sequence[ConnectionOutage] = ()
        self.misdelivered: Callable[[], Mapping[str, int]] = dict
        """Process → messages with other processes' keys, which it dropped so far."""
        self.run_tally = run_tally
        """The tallies of the slots so far."""
        self.joiner = joiner

    def start(self) -> None:
        """Note that all processes are there."""
        self.started = self.ended = world().monotonic()

    def end(self) -> None:
        """Note that this is the end of the run so far."""
        self.ended = world().monotonic()

    @property
    def all_joined(self) -> bool:
        """Whether all slots are joined."""
        return self.joiner.done == self.scenario.slots

    def summary(self, folder: Path, how: str, accused: tuple[str, ...] = ()) -> Summary:
        """The summary of the slots so far.

        folder: the results folder; how: how the run ended; accused: the processes whose misbehaviour ended it. Raises NoAnswer.
        """
        if self.all_joined:
            for name, sums in self.joiner.trace_sums.items():
                self.run_tally.tallies[name].know_traces(sums)
        digests = {name: digest_of(self.scenario, name, blocks) for name, blocks in self.joiner.digests.items()}
        outcome = RunOutcome(
            self.ended - self.started,
            how,
            replay_of(folder, self.scenario),
            events=self.events,
            outages=self.outages,
            accused=accused,
            misdelivered=self.misdelivered(),
        )
        return summary_of(self.scenario, self.run_tally, digests, outcome)
