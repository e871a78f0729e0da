"""Recovers from lost connections: notes which processes were cut off and for how long, and has lost messages sent again.

The run waits for a process that vanishes from the network. When all are back, the conductor begins a round: the sensor sends
its packets again from the first slot that is not joined, the router routes them again, and every process sends its reports
again; a process ignores messages that it already has. Rounds are repeated until slots are joined again.

Source: docs/protocol.md, lost connections.
"""

from __future__ import annotations

from typing import final

from evedrop.live.protocol.brief import Flow
from evedrop.live.protocol.commands import Again
from evedrop.live.recorder.conductor import Conductor
from evedrop.live.recorder.stall import patience_of
from evedrop.live.recorder.steering import Steering
from evedrop.names import RECORDER, RELAY, ROUTER
from evedrop.scenario.progress_events import ConnectionOutage, OnEvent
from evedrop.system.waiting import SYSTEM_CLOCK, Clock

_SOON_SECONDS = 0.5  # after which a round without effect is repeated; the wait doubles each time
_IDLE_SECONDS = 10.0  # for which a run may stand still without a known reason before a round is tried
_LONGEST_SECONDS = 30.0
_REACH_SECONDS = 2.0  # for which a round waits for processes that are back to subscribe to their commands again


@final
class Recovery:
    """Notices lost connections and begins rounds of resending. say: sends events to the launcher."""

    def __init__(
        self,
        conductor: Conductor,
        steering: Steering,
        flow: Flow,
        pace: float,
        say: OnEvent,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._clock = clock
        self._conductor, self._steering, self._flow, self._say = conductor, steering, flow, say
        self._batch_seconds = pace * flow.batch
        self._patience = patience_of(flow.longest_outage, pace, flow.batch)
        """Seconds for which the run may stand still; rounds come sooner."""
        self._returned: float | None = None
        """When the last missing process was back, if no round has begun since."""
        self._missing: dict[str, tuple[int, float]] = {}
        """Missing process → the first slot not joined when that was noticed, and the time from which its outage counts."""
        self._back: dict[str, tuple[int, float]] = {}
        """The same for processes that are back while the run has not gone on yet."""
        self._done = 0
        self._target = 0
        """Slots below this may have been under way when a connection was lost."""
        self._moved = self._joined = self._clock.monotonic()
        self._longest = 0.0
        self._wait = 0.0
        self._number = 0
        self.outages: list[ConnectionOutage] = []
        """All outages so far."""

    def poll(self, done: int) -> None:
        """Handle lost connections, given that all slots below `done` are joined.

        Raises RunError if a process has been missing for too long.
        """
        now = self._clock.monotonic()
        if done > self._done:
            self._go_on(done, now)
        if self._conductor.missing:
            self._miss(done, now)
        elif self._missing:
            self._returned = now if self._returned is None else self._returned
            if now - self._returned > _REACH_SECONDS or not self._conductor.unreached:
                self._all_back(now)
        elif self._steering.at is not None and done >= self._steering.at:
            self._moved = self._joined = now  # the run is held: no slots are expected
            self._close(done, now)
        elif now - self._moved > self._limit:
            self._round(now)

    @property
    def _limit(self) -> float:
        """Seconds that may pass without a slot before a round begins."""
        if self._wait:
            return self._wait
        usual = 3.0 * max(self._batch_seconds, self._longest)
        if self._done < self._target:
            return max(_SOON_SECONDS, min(usual, self._patience / 8.0))
        idle = min(_IDLE_SECONDS, max(1.0, self._flow.longest_outage / 3.0))
        return min(max(idle, usual), self._patience / 2.0)

    def _go_on(self, done: int, now: float) -> None:
        if not self._missing and not self._wait:
            self._longest = max(self._longest, now - self._moved)
        self._done, self._moved, self._joined, self._wait = done, now, now, 0.0
        self._close(done, now)

    def _close(self, done: int, now: float) -> None:
        """Record the outages that ended, now that the run continues."""
        for name, (slot, since) in self._back.items():
            outage = ConnectionOutage(name, slot, done, now - since)
            self.outages.append(outage)
            self._say(outage)
        self._back = {}

    def _miss(self, done: int, now: float) -> None:
        self._returned = None
        for name in self._conductor.missing:
            self._missing.setdefault(name, (done, min(self._joined, self._conductor.lost.get(name, now))))
        gone = [
            name
            for name in self._conductor.missing
            if now - self._conductor.lost.get(name, now) > self._flow.longest_outage
        ]
        if gone:
            # Without the router no other process can be seen.
            gone = next(([name] for name in (RELAY, ROUTER) if name in gone), gone)
            self.give_up(done)
            self._conductor.fail_cut_off(gone, self._flow.longest_outage)

    def _all_back(self, now: float) -> None:
        missing = self._missing
        # All processes vanish with the recorder's own router, or with the connection to it. Behind a relay, the sensor
        # vanishes with the router, and both with the link between the routers.
        own = RELAY if self._conductor.relayed else ROUTER
        if own in missing:
            missing = {own if self._conductor.router_changed() else RECORDER: missing[own]}
        elif ROUTER in missing:
            missing = {ROUTER: missing[ROUTER]}
        for name, beginning in missing.items():
            self._back.setdefault(name, beginning)
        self._missing, self._returned = {}, None
        self._target = self._done + self._flow.window + self._flow.batch
        self._wait = 0.0
        self._round(now)

    def _round(self, now: float) -> None:
        """Ask all processes to send the messages again that may have been lost."""
        self._wait = min(2.0 * self._limit, max(_LONGEST_SECONDS, self._limit))
        self._moved = now
        self._number += 1
        for name, there in self._conductor.processes.items():
            if there:
                links = self._steering.changes if name == ROUTER else None
                self._conductor.send_to(name, Again(self._number, self._done, links))
        if self._done == 0:
            self._conductor.start()
        self._steering.remind()
        self._conductor.report_progress(self._done)

    def give_up(self, done: int, complete: bool = False) -> None:
        """Record the outages that are open when the run ends; all slots below `done` are joined.

        complete: whether these are all slots, so that none was waited for: the outages lasted to the end.
        """
        now = self._clock.monotonic()
        self._close(done, now)
        missing = self._missing
        missing = next(({name: missing[name]} for name in (RELAY, ROUTER) if name in missing), missing)
        until = done if complete else None
        self.outages += [ConnectionOutage(name, slot, until, now - since) for name, (slot, since) in missing.items()]
        self._missing = {}
