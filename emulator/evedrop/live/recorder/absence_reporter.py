"""Reports on behalf of an absent receiver, so that every slot of every receiver is accounted for.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import final

from evedrop.live.network.reporting import BeliefReporter
from evedrop.live.protocol.brief import AnyBrief
from evedrop.model.receiver import Belief, prior
from evedrop.model.slot.receiver import Absence
from evedrop.scenario.tables import Scenario
from evedrop.scenario.timeline import Away


@final
class AbsenceReporter:
    """Reports the beliefs of a receiver that is away, computed from its belief when it left.

    brief: of the recorder; put: takes the reports as if they were the receiver's own.
    """

    def __init__(
        self, brief: AnyBrief, scenario: Scenario, receiver: str, away: Away, left: Belief, put: Callable[[bytes], None]
    ) -> None:
        process = scenario.process.process
        fresh = prior(process, scenario.trials, away.start)
        self._absence = Absence(process, left if away.keeps_state else fresh)
        cuts, late = scenario.outage_bounds(receiver), scenario.window(receiver) > 0
        self._reporter = BeliefReporter(brief, lambda _, payload: put(payload), lambda *_: None, cuts, away.start, late)
        self.next = away.start
        """The first slot that has not been reported."""
        self._stop = min(away.stop, scenario.slots)

    @property
    def over(self) -> bool:
        """Whether all slots of the outage are reported."""
        return self.next == self._stop

    def follow(self, end: int) -> None:
        """Report the slots of the outage below `end`."""
        slots = range(self.next, min(end, self._stop))
        if slots:
            self._reporter.add_slots(slots, self._absence.take_slots(slots))
            self.next = slots.stop
        self._reporter.flush(self.next)
