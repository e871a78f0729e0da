"""Carries out the events of a wire while it runs: those of its file when their time comes, and those of an operator at once.

Source: docs/wire.md, events.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self, final

from evedrop.live.network.clock import SYSTEM_CLOCK, Clock
from evedrop.system.threads import wait_for_thread
from evedrop.wire.plan import WirePlan
from evedrop.wire.relay import WireRelay
from evedrop.wire.timeline import moment_at, times, with_change, with_cut_ended, with_partition_ended


@final
class WireConductor:
    """The time of a wire; use it as a context manager. Its methods may be called by any thread."""

    def __init__(
        self, plan: WirePlan, relay: WireRelay, say: Callable[[str], None], clock: Clock = SYSTEM_CLOCK
    ) -> None:
        """say: for a line about each event."""
        self._clock = clock
        self._plan, self._relay, self._say = plan, relay, say
        self._changed = threading.Condition(threading.RLock())
        self._ended = False
        self._done = -1.0  # the time up to which all events are carried out
        self._begun = self._clock.monotonic()
        self._relay.apply(moment_at(plan, 0.0))
        self._thread = threading.Thread(target=self._run, name="events", daemon=True)

    def __enter__(self) -> Self:
        self._begun = self._clock.monotonic()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        wait_for_thread(self._thread)

    @property
    def seconds(self) -> float:
        """How long the wire has been running."""
        return self._clock.monotonic() - self._begun

    @property
    def plan(self) -> WirePlan:
        """The plan, with the events of operators."""
        return self._plan

    def change(self, table: Mapping[str, Any]) -> str:
        """Carry out an event at once; returns what it does. table: as `[[event]]` without a time. Raises ScenarioError."""
        return self._now(lambda plan, now: with_change(plan, table, now))

    def end_cut(self, link: str) -> str:
        """End a cut at once; returns the line that says so. Raises ScenarioError if the link is not cut."""
        return self._now(lambda plan, now: with_cut_ended(plan, link, now))

    def end_partition(self, one: str, other: str) -> str:
        """End a partition at once; returns the line that says so. Raises ScenarioError if the sides are not partitioned."""
        return self._now(lambda plan, now: with_partition_ended(plan, one, other, now))

    def _now(self, change: Callable[[WirePlan, float], tuple[WirePlan, str]]) -> str:
        with self._changed:
            now = self.seconds
            self._carry_out(now)
            self._plan, said = change(self._plan, now)
            self._relay.apply(moment_at(self._plan, now))
            self._done = now
            self._say(f"{now:.1f} s: {said}")
            self._changed.notify()
            return said

    def _carry_out(self, now: float) -> None:
        """Carry out the events that are due."""
        for due in times(self._plan):
            if self._done < due <= now:
                moment = moment_at(self._plan, due)
                self._done = due
                self._relay.apply(moment)
                for line in moment.said:
                    self._say(f"{due:.1f} s: {line}")

    def _run(self) -> None:
        with self._changed:
            while not self._ended:
                self._carry_out(self.seconds)
                following = [one for one in times(self._plan) if one > self._done]
                self._clock.wait(self._changed, max(0.0, following[0] - self.seconds) if following else None)
