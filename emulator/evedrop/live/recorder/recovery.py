"""Recovers from lost connections, and finds the process at fault when a run stands still although all are on the network.

The run waits for a process that vanishes from the network; which processes were cut off and for how long is noted. When all are
back, the conductor begins a round: the sensor sends its packets again from the first slot that is not joined, the router routes
them again, and every process sends its reports again; a process ignores messages that it already has. Rounds are repeated until
slots are joined again.

When a run stands still, every process is asked what it waits for, and `wait_graph` tells for which one the run waits. Work that
no other process waits for does not count as progress.

Source: docs/protocol.md, lost connections and silence.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import final

from evedrop.errors import Silence
from evedrop.live.network.process_session import LEAST_SECONDS
from evedrop.live.network.session import READY_SECONDS
from evedrop.live.protocol.brief import Flow
from evedrop.live.protocol.commands import Again, ProcessStatus
from evedrop.live.recorder.conductor import Conductor
from evedrop.live.recorder.steering import STEP_SECONDS, Steering
from evedrop.live.recorder.wait_graph import WaitGraph
from evedrop.names import RECORDER, RELAY, ROUTER
from evedrop.scenario.progress_events import ConnectionOutage, OnEvent
from evedrop.system.world import world

_POLL_SECONDS = 0.25
_LEAST_ASKING = 3.0
"""Seconds for which all are asked: a process that misses a message says so before, if it was sent again twice."""


def patience_of(longest_outage: float, pace: float, batch: int, program: bool = False) -> float:
    """Seconds for which a process may do nothing while the run waits for it; longer with a pace, when it may have no work.

    program: whether one gives the states; if it falls silent, the sensor has time to say so itself.
    """
    return max(LEAST_SECONDS, longest_outage) + 2.0 * pace * batch + (LEAST_SECONDS if program else 0.0)


@final
class Stall:
    """Notices that a run stands still, and ends it when the process that it waits for has done nothing for too long."""

    def __init__(self, patience: float, batch: int, ask: Callable[[], None], router: str) -> None:
        """patience: as in `patience_of`; batch: slots of a report; ask: requests the status of every process.

        router: the router or relay through which all answers come.
        """
        self._patience, self._batch, self._ask, self._router = patience, batch, ask, router
        self._polled = world().monotonic()
        self._done = 0
        self._stalled = self._asked = 0.0
        """Seconds since slots were last joined, and the value of that count when the processes were last asked."""
        self._answers: dict[str, ProcessStatus] = {}
        self._moved: dict[str, tuple[tuple[int, int], float]] = {}
        """Process → the slot it is at by its answer and by its reports, and when in this stall that last changed."""

    def add_answer(self, process: str, status: ProcessStatus) -> None:
        """Take a process's answer."""
        self._answers[process] = status

    def poll(
        self,
        done: int,
        reported: Callable[[], Mapping[str, int]],
        unneeded: Collection[str] = (),
        *,
        held: bool,
        missing: bool,
        belief: bool = False,
    ) -> None:
        """Check whether the run makes progress. Raises Silence if a process has held it up too long.

        All slots below `done` are joined. reported: process → the first slot that it has not reported; unneeded: processes
        whose reports are not needed to join slots. held: the run is held, and no process has anything to do; missing: some
        process is not on the network, which is handled elsewhere; belief: the run is held until a receiver has sent its final
        belief, for which the time limit of the hold applies, but all are asked.
        """
        now = world().monotonic()
        if done > self._done or (held and not belief):
            self._done, self._polled, self._stalled, self._asked = done, now, 0.0, 0.0
            self._answers, self._moved = {}, {}
            return
        if now - self._polled < _POLL_SECONDS:
            return
        step, self._polled = min(now - self._polled, STEP_SECONDS), now
        if missing:
            return
        self._stalled += step
        if self._stalled < self._patience / 2.0:
            return
        places = reported()
        for process, k in places.items():
            # It reports at least once in every batch of slots: do not assume that it is further without a report.
            slot = min(self._answers[process].slot, k + self._batch) if process in self._answers else -1
            place = (slot, k)
            if process not in self._moved or self._moved[process][0] < place:
                # The first answer does not count as a move: it is unknown when the process reached that slot.
                moved = self._moved.get(process)
                first = moved is None or (moved[0][0] == -1 and moved[0][1] == k)
                self._moved[process] = (place, 0.0 if first else self._stalled)
        if self._stalled - self._asked > self._patience / 10.0:
            self._asked = self._stalled
            self._ask()
        if self._stalled > self._patience + max(_LEAST_ASKING, self._patience / 5.0) and not belief:
            self._judge(places, unneeded)

    def held_up_by(self, late: Sequence[str], places: Mapping[str, int]) -> tuple[tuple[str, ...], str]:
        """The processes for which a held run waits, and what they say; late: those that owe it a report or a final belief."""
        return self._silent(places, (), late) if self._asked else (tuple(late), "")

    def _silent(
        self, places: Mapping[str, int], unneeded: Collection[str], late: Collection[str] = ()
    ) -> tuple[tuple[str, ...], str]:
        # If nobody answers, no answer comes through.
        graph = WaitGraph(places, self._answers, self._batch, unneeded, late)
        silent = tuple(graph.silent()) if self._answers else (self._router,)
        return silent, " and ".join(_described(name, self._answers.get(name)) for name in silent)

    def _judge(self, places: Mapping[str, int], unneeded: Collection[str]) -> None:
        silent, described = self._silent(places, unneeded)
        still = self._stalled - max(self._moved[name][1] if name in self._moved else 0.0 for name in silent)
        if still > self._patience:
            raise Silence(
                silent,
                f"alive, and silent for {still:.0f} s while the run waits for slot {self._done} ({described}); look at "
                f"{' and '.join(f'logs/{name}.log' for name in silent)}, or raise longest_outage",
            )


def _described(name: str, status: ProcessStatus | None) -> str:
    if status is None:
        return f"{name} does not say where it is"
    if not status.waits:
        return f"{name} is at slot {status.slot} and waits for no process"
    return f"{name} says that it is at slot {status.slot} and waits on {', '.join(status.waits[:3])}"


_SOON_SECONDS = 0.5  # after which a round without effect is repeated; the wait doubles each time
_IDLE_SECONDS = 10.0  # for which a run may stand still without a known reason before a round is tried
_HELD_SECONDS = READY_SECONDS / 8.0  # the same while a run is held: there is time for three rounds, each twice as long
_LONGEST_SECONDS = 30.0
_REACH_SECONDS = 2.0  # for which a round waits for processes that are back to subscribe to their commands again


@final
class Recovery:
    """Notices lost connections and begins rounds of resending. say: sends events to the launcher."""

    def __init__(self, conductor: Conductor, steering: Steering, flow: Flow, pace: float, say: OnEvent) -> None:
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
        self._moved = self._joined = world().monotonic()
        self._longest = 0.0
        self._wait = 0.0
        self._number = 0
        self.outages: list[ConnectionOutage] = []
        """All outages so far."""
        self._polled = world().monotonic()

    def poll(self, done: int) -> None:
        """Handle lost connections, given that all slots below `done` are joined.

        Raises RunError if a process has been missing for too long. Time in which the recorder itself did not run does not count.
        """
        now = world().monotonic()
        self._conductor.wait_longer(max(0.0, now - self._polled - STEP_SECONDS))
        self._polled = now
        if done > self._done:
            self._go_on(done, now)
        if self._conductor.missing:
            self._miss(done, now)
        elif self._missing:
            self._returned = now if self._returned is None else self._returned
            if now - self._returned > _REACH_SECONDS or not self._conductor.unreached:
                self._all_back(now)
        elif self._steering.at is not None and done >= self._steering.at and not self._steering.awaits_belief:
            self._moved = self._joined = now  # the run is held: nothing is expected
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
        if self._steering.at is not None:
            idle = min(idle, _HELD_SECONDS)
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
        missing = self._conductor.missing
        # Without the router no other process can be seen: it may be back.
        judged = next(([name] for name in (RELAY, ROUTER) if name in missing), missing)
        gone = [name for name in judged if now - self._conductor.lost.get(name, now) > self._flow.longest_outage]
        if gone:
            self.give_up(done)
            self._conductor.fail_cut_off(gone, self._flow.longest_outage)

    def _all_back(self, now: float) -> None:
        missing = self._missing
        # All processes vanish with the recorder's own router, or with the connection to it. Behind a relay, the sensor
        # vanishes with the router, and both with the link between the routers.
        hub = self._conductor.hub
        if hub in missing:
            missing = {hub if self._conductor.router_changed() else RECORDER: missing[hub]}
        elif ROUTER in missing:
            missing = {ROUTER: missing[ROUTER]}
        for name, beginning in missing.items():
            self._back.setdefault(name, beginning)
        self._missing, self._returned = {}, None
        self._target = self._done + self._flow.window + self._flow.batch
        self._wait = 0.0
        self._steering.restart_limit()
        self._round(now)

    def _round(self, now: float) -> None:
        """Ask all processes to send the messages again that may have been lost."""
        self._wait = min(2.0 * self._limit, max(_LONGEST_SECONDS, self._limit))
        self._moved = now
        self._number += 1
        for name, there in self._conductor.present.items():
            if there:
                links = self._steering.changes if name == ROUTER else None
                self._conductor.send_to(name, Again(self._number, self._done, links))
        if self._done == 0:
            self._conductor.start()
        self._steering.remind()
        self._conductor.repeat_progress()

    def give_up(self, done: int, complete: bool = False) -> None:
        """Record the outages that are open when the run ends; all slots below `done` are joined.

        complete: whether these are all slots, so that none was waited for: the outages lasted to the end.
        """
        now, until = world().monotonic(), done if complete else None
        missing = {} if RECORDER in self._back else self._missing  # which nobody sees without its connection
        missing = next(({name: missing[name]} for name in (RELAY, ROUTER) if name in missing), missing)
        opened = {**missing, **self._back}  # one that was lost again before the run went on has been away since then
        self.outages += [ConnectionOutage(name, slot, until, now - since) for name, (slot, since) in opened.items()]
        self._missing, self._back = {}, {}
