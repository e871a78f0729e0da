"""The tally of a set of trials, updated slot by slot, live or in memory; the summary is made from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from evedrop.scenario.tables import Scenario
from evedrop.score.after_start import DistanceTally, leading_states
from evedrop.score.closed_loop_tally import LoopTally, SolveTimes
from evedrop.score.conditional import conditional_error_of
from evedrop.score.filtering import FilterTally
from evedrop.score.leak import LeakTally, leak_is_known
from evedrop.score.links import Detection
from evedrop.score.sums import DirectionTally, Tally, merged
from evedrop.score.watched_tally import WatchedTally, watches_of


@dataclass(frozen=True)
class RunTally:
    """The tallies of some trials. Those that do not concern receivers are None if the run or its mode does not have them."""

    tallies: Mapping[str, Tally]
    """Receiver → its tally."""
    detection: Detection | None = None
    loop: LoopTally | None = None
    filter: FilterTally | None = None
    solve_times: SolveTimes = field(default_factory=SolveTimes)

    @classmethod
    def nothing(cls, scenario: Scenario, trials: int) -> RunTally:
        """The empty tallies of receivers only: of trials without slots, or in a mode without states."""
        watches, n = watches_of(scenario), len(scenario.process.A)
        leading: int | None = leading_states(scenario.process.units or (), n)
        leading = None if leading == n else leading
        tallies = {
            name: Tally(scenario.slots, trials, WatchedTally(watch, trials), cuts=scenario.outage_bounds(name))
            for name, watch in watches.items()
        }
        for name, tally in tallies.items():
            tally.conditional = conditional_error_of(scenario, name, trials)
            for direction, v in scenario.process.directions_as_arrays.items():
                tally.directions[direction] = DirectionTally(v, scenario.slots, trials)
            tally.distance = DistanceTally(leading, scenario.slots, trials)
            tally.leak = LeakTally(trials) if leak_is_known(scenario, name) else None
        return cls(tallies)

    @classmethod
    def from_scenario(cls, scenario: Scenario, trials: int) -> RunTally:
        """An empty tally of trials that are about to begin, in a mode with states."""
        return cls(
            cls.nothing(scenario, trials).tallies,
            Detection(trials),
            LoopTally.from_scenario(scenario, trials),
            FilterTally.from_scenario(scenario, trials),
        )

    def begin(self) -> None:
        """Make the tallies of packages' metrics now, not with the first slot: an example of all that a tally consists of."""
        for tally in self.tallies.values():
            tally.watched.begin()

    @property
    def failures(self) -> list[str]:
        """Why metrics and applications of packages failed, in words."""
        applications = {} if self.loop is None else self.loop.applications
        of_applications = [application.failure for application in applications.values() if application.failure]
        return [failure for tally in self.tallies.values() for failure in tally.watched.failures] + of_applications

    @classmethod
    def merged(cls, parts: Sequence[RunTally]) -> RunTally:
        """The tally of disjoint sets of trials, in their order."""
        times = SolveTimes()
        for part in parts:
            times.merge(part.solve_times)
        detections = [part.detection for part in parts if part.detection is not None]
        return cls(
            {name: merged([part.tallies[name] for part in parts]) for name in parts[0].tallies},
            Detection.merged(detections) if detections else None,
            LoopTally.merged([part.loop for part in parts]),
            FilterTally.merged([part.filter for part in parts]),
            times,
        )
