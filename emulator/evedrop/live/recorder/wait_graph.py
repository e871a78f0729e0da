"""Finds the processes that hold up a run that stands still, from what each process says it waits for.

    recorder ── waits for reports of the process furthest behind ── waits for a message of … ── waits for no process

The run waits for the process at the end of such a chain. Without an end, some processes wait for each other in a circle.

Source: docs/protocol.md, lost connections and silence.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import final

from evedrop.live.protocol.commands import ProcessStatus
from evedrop.live.protocol.keys import writer_of
from evedrop.names import RECORDER, ROUTER, SENSOR


@final
class WaitGraph:
    """Who waits for whom in a run that stands still, by what the processes answer."""

    def __init__(
        self,
        places: Mapping[str, int],
        answers: Mapping[str, ProcessStatus],
        batch: int,
        unneeded: Collection[str] = (),
        late: Collection[str] = (),
    ) -> None:
        """places: process → the first slot that it has not reported; answers: of the processes that have answered.

        batch: slots of a report; unneeded: processes whose reports are not needed to join slots; late: those that hold up a held
        run, if it is held.
        """
        self._places, self._answers, self._batch = places, answers, batch
        needed = {name: k for name, k in places.items() if name not in unneeded}
        self._behind = [name for name, k in needed.items() if (name in late if late else k == min(needed.values()))]
        self._some_are_further = len(self._behind) < len(needed)
        self._chain = list(self._behind)
        for name in self._chain:  # grows
            self._chain += [writer for writer in self._writers(name) if writer in places and writer not in self._chain]

    def silent(self) -> list[str]:
        """The processes at fault: those that wait for no process or, without any, those that do not answer.

        If all wait for others: those between which a message is missing.
        """
        idle = [name for name in self._chain if name in self._answers and not self._answers[name].waits]
        mute = [name for name in self._chain if name not in self._answers]
        if idle or mute:
            return idle or mute
        return self._unreported() or self._owing() or (self._behind if self._some_are_further else self._circle())

    def _writers(self, name: str) -> dict[str, None]:
        """Whose messages a process waits for; several keys may have one writer."""
        return dict.fromkeys(map(writer_of, self._answers[name].waits)) if name in self._answers else {}

    def _unreported(self) -> list[str]:
        """Processes that have done more slots than a report has, and did not report them, while others did."""
        behind = self._behind if self._some_are_further else ()
        return [name for name in behind if self._answers[name].slot >= self._places[name] + self._batch]

    def _owing(self) -> list[str]:
        """The processes of the circle between which a message is missing: not sent by the one, or not taken by the other."""
        waits = [*self._waits_in_circle()]
        unsent = [(writer, name) for writer, name, _ in waits if self._unsent(writer) > self._answers[name].slot]
        # How far the progress must be for which a sensor waits, its answer does not say.
        unsent = unsent or [(writer, name) for writer, name, key in waits if "/progress/" in key]
        owing = {name for pair in unsent for name in pair}
        return [name for name in self._places if name in owing]

    def _circle(self) -> list[str]:
        """The processes that wait for each other; all others wait for these. The recorder waits for those behind."""
        direct = {name: self._writers(name).keys() & {RECORDER, *self._chain} for name in self._chain}
        direct[RECORDER] = set(self._behind)
        awaited = {name: _reached(name, direct) for name in direct}
        return [name for name in self._chain if all(name in awaited[other] for other in awaited[name])]

    def _waits_in_circle(self) -> Iterator[tuple[str, str, str]]:
        """Writer, reader and key of each message for which a process of the circle waits, from another one there."""
        circle = self._circle()
        for name in circle:
            for key in self._answers[name].waits:
                if (writer := writer_of(key)) in circle:
                    yield writer, name, key

    def _unsent(self, process: str) -> int:
        """The first slot of which a process has not sent its messages, by its answer.

        Who waits for a command has sent all, also the barrier of a hold. Sensor and router wait for the acknowledgement or the
        input of a slot after they have sent its packet or its deliveries.
        """
        status = self._answers[process]
        after = ("control", "ack", "input") if process in (SENSOR, ROUTER) else ("control",)
        return status.slot + any(key.split("/")[2] in after for key in status.waits)


def _reached(name: str, direct: Mapping[str, Collection[str]]) -> set[str]:
    """The processes that a process waits for, directly or not; direct: process → those that it waits for directly."""
    reached: set[str] = set()
    chain = [name]
    for process in chain:  # grows
        chain += sorted(set(direct[process]) - reached)
        reached |= set(direct[process])
    return reached
