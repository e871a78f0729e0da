"""Finds the process at fault when a run stands still although all processes are on the network.

    recorder ── waits for reports of the process furthest behind ── waits for a message of … ── waits for no process

Every process is asked what it waits for. The run waits for the process at the end of such a chain. Work that no other
process waits for does not count as progress.

Source: docs/protocol.md, silence.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import final

from evedrop.errors import Silence
from evedrop.live.protocol.commands import ProcessStatus
from evedrop.live.protocol.keys import writer_of
from evedrop.names import RECORDER
from evedrop.system.waiting import SYSTEM_CLOCK, Clock

LEAST_SECONDS = 5.0
"""The least of these: a busy machine may not let a process work for some seconds."""
_POLL_SECONDS = 0.25
_STEP_SECONDS = (
    1.0  # the most that counts between two polls: time in which the recorder itself did not run does not count
)


def patience_of(longest_outage: float, pace: float, batch: int, program: bool = False) -> float:
    """Seconds for which a process may do nothing while the run waits for it; longer with a pace, when it may have no work.

    program: whether one gives the states; if it falls silent, the sensor has time to say so itself.
    """
    return max(LEAST_SECONDS, longest_outage) + 2.0 * pace * batch + (LEAST_SECONDS if program else 0.0)


@final
class Stall:
    """Notices that a run stands still, and ends it when the process that it waits for has done nothing for too long."""

    def __init__(self, patience: float, batch: int, ask: Callable[[], None], clock: Clock = SYSTEM_CLOCK) -> None:
        """patience: as in `patience_of`; batch: slots of a report; ask: requests the status of every process."""
        self._patience, self._batch, self._ask = patience, batch, ask
        self._clock = clock
        self._polled = self._clock.monotonic()
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
    ) -> None:
        """Check whether the run makes progress. Raises Silence if a process has held it up too long.

        All slots below `done` are joined. reported: process → the first slot that it has not reported; unneeded: processes
        whose reports are not needed to join slots. held: the run is held, and no process has anything to do; missing: some
        process is not on the network, which is handled elsewhere.
        """
        now = self._clock.monotonic()
        if done > self._done or held:
            self._done, self._polled, self._stalled, self._asked = done, now, 0.0, 0.0
            self._answers, self._moved = {}, {}
            return
        if now - self._polled < _POLL_SECONDS:
            return
        step, self._polled = min(now - self._polled, _STEP_SECONDS), now
        if missing:
            return
        self._stalled += step
        if self._stalled < self._patience / 2.0:
            return
        places = reported()
        for process, k in places.items():
            # It reports at least once in every batch of slots: do not believe that it is further without a report.
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
        if self._stalled > self._patience + 2.0 * self._patience / 10.0:
            self._judge(places, unneeded)

    def _judge(self, places: Mapping[str, int], unneeded: Collection[str]) -> None:
        silent = tuple(silent_of(places, self._answers, unneeded))
        still = self._stalled - max(self._moved[name][1] for name in silent)
        if still > self._patience:
            described = " and ".join(_described(name, self._answers.get(name)) for name in silent)
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


def silent_of(
    places: Mapping[str, int], answers: Mapping[str, ProcessStatus], unneeded: Collection[str] = ()
) -> list[str]:
    """The processes that a run waits for when it stands still.

    places: process → the first slot that it has not reported; answers: of the processes that have answered; unneeded:
    processes whose reports are not needed to join slots.
    """
    joined = {name: k for name, k in places.items() if name not in unneeded}
    behind = [name for name, k in joined.items() if k == min(joined.values())]
    seen, chain = set(behind), list(behind)
    idle, mute = [], []
    for name in chain:  # grows
        status = answers.get(name)
        if status is None:
            mute.append(name)
        elif not status.waits:
            idle.append(name)
        for key in () if status is None else status.waits:
            writer = writer_of(key)
            if writer in places and writer not in seen:
                seen.add(writer)
                chain.append(writer)
    if idle or mute:
        return idle or mute
    if len(behind) < len(joined):
        return behind
    # Every process claims to wait for another: some process has not sent a message that it claims to have sent.
    owing = {
        writer
        for name in chain
        for key in answers[name].waits
        if (writer := writer_of(key)) in answers
        and writer != RECORDER
        and ("/progress/" in key or answers[writer].slot > answers[name].slot)
    }
    return [name for name in places if name in owing] or behind
