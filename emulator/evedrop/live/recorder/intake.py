"""Takes the reports of all processes and the router's journal, verifies them, and joins them into slots.

A message counts if it is the next one of its process: after losses, earlier and later ones arrive, too. On behalf of a receiver
that is away, the recorder reports by itself.

Source: docs/protocol.md, lost connections; docs/results.md, what is verified.
"""

from __future__ import annotations

from typing import final

from evedrop.live.network.process_session import GapDetector
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.telemetry import is_held, is_leaving, read_leaving
from evedrop.live.recorder.joiner import AbsenceReporter, Joiner
from evedrop.live.recorder.steering import Steering
from evedrop.live.recorder.verification import Verifier, extent_of
from evedrop.model.digest import Blocks
from evedrop.names import CONTROLLER, ROUTER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally
from evedrop.score.slots import Slots


@final
class Intake:
    """Takes messages one by one, and returns slots as soon as all processes have reported them."""

    def __init__(self, brief: Brief[RecorderPart], scenario: Scenario, run_tally: RunTally) -> None:
        """run_tally: counts the accounts of links, and the time of a controller's decisions."""
        self._brief, self._scenario, self._run_tally = brief, scenario, run_tally
        windows = {name: scenario.window(name) for name in scenario.receivers}
        blocks = {name: Blocks(scenario.slots, scenario.outage_bounds(name)) for name in scenario.digested}
        period = None if scenario.controller is None else scenario.controller.period
        self._extent = extent_of(scenario, brief.flow.batch)
        self._verifier = Verifier(blocks, scenario.record_trials, scenario.first_trial)
        self.joiner = Joiner(self._extent, windows, blocks, period, self._verifier.report)
        self._gaps: dict[str, GapDetector] = {}
        self._absent: dict[str, AbsenceReporter] = {}

    def take(self, source: str, message: Reader, steering: Steering) -> Slots | None:
        """Take a message; returns the slots that are complete with it, if any.

        steering: is told when the sensor holds and when a receiver leaves. Raises MalformedMessage, Gap or Contradiction.
        """
        if not self._is_due(source, message, steering):
            return None
        if source == ROUTER:
            self.joiner.add_journal(message)
        elif source == CONTROLLER:
            self.joiner.add_decisions(message)
        elif source != SENSOR and is_leaving(message):
            self._leave(source, message, steering)
        elif source != SENSOR:
            self.joiner.add_report(source, message)
        elif is_held(message):
            steering.held(message.slot(self.joiner.sent))
        else:
            self.joiner.add_truth(message)
        self._report_absences()
        slots = self.joiner.take_slots()
        if slots is not None:
            self._verifier.joined(slots)
        self._count()
        return slots

    def _count(self) -> None:
        """Count the links' accounts and the decisions of the slots that are complete: other processes may be ahead of them."""
        for accounts in self.joiner.take_accounts():
            for name, account in accounts.items():
                self._run_tally.tallies[name].count(account)
        self._run_tally.solve_times.add_seconds(self.joiner.take_seconds())

    def _is_due(self, source: str, message: Reader, steering: Steering) -> bool:
        slot = message.integer("k")
        if source not in (ROUTER, SENSOR) and is_leaving(message):  # comes before the reports of the slots before it
            return not steering.has_left(source, slot)
        due = self.joiner.reported(source)
        if slot != due:
            patience = self._brief.flow.longest_outage
            self._gaps.setdefault(source, GapDetector(message.key, patience)).missed(due, slot)
        return slot == due

    def _leave(self, name: str, message: Reader, steering: Steering) -> None:
        """Report on behalf of a receiver until it is back."""
        k, left = read_leaving(message, self._extent)
        away = next((outage for outage in self._scenario.timeline.outages[name] if outage.start == k), None)
        if away is None:
            raise message.malformed(
                f"a leave before slot {k}", "a leave at a slot where an event makes the receiver leave"
            )

        def put(payload: bytes) -> None:
            self.joiner.add_report(name, Reader(message.key, payload))

        self._verifier.left(name, k, left)
        steering.left(name, k)
        self._absent[name] = AbsenceReporter(self._brief, self._scenario, name, away, left, put)

    def _report_absences(self) -> None:
        for name, reporter in list(self._absent.items()):
            if self.joiner.reported(name) == reporter.next:
                reporter.follow(self.joiner.sent)
            if reporter.over:
                del self._absent[name]
