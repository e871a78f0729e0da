"""Truth, estimates and fates of the same slots, joined to be scored, recorded and shown, both live and in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from evedrop.model.record import Record
from evedrop.model.slot.records import LinkSlots, ReceiverSlots, SensorSlots


@dataclass(frozen=True)
class Slots:
    """c consecutive slots of all trials, complete."""

    sensor: SensorSlots
    receivers: Mapping[str, ReceiverSlots]
    links: Mapping[str, LinkSlots]
    """Receiver → its link. In memory, links are known only once their packets are counted."""

    @classmethod
    def example(cls, receivers: Iterable[str]) -> Slots:
        """Slots without numbers, with an instance of every class that slots may have."""
        nothing: Any = np.zeros(0)
        names = tuple(receivers)
        return cls(
            SensorSlots(0, nothing, nothing),
            dict.fromkeys(names, ReceiverSlots(0, nothing, nothing, nothing)),
            dict.fromkeys(names, LinkSlots(0, nothing, nothing, nothing)),
        )

    @property
    def first(self) -> int:
        """The first slot."""
        return self.sensor.first

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.sensor.x)

    @property
    def trials(self) -> int:
        """Number of trials."""
        return int(self.sensor.x.shape[2])

    @property
    def recorded(self) -> int:
        """Number of recorded trials."""
        return int(next(iter(self.receivers.values())).P.shape[3])

    def mapped(self, change: Callable[[Any], Any]) -> Slots:
        """The slots with every record changed."""
        return Slots(
            change(self.sensor),
            {name: change(receiver) for name, receiver in self.receivers.items()},
            {name: change(link) for name, link in self.links.items()},
        )

    def part(self, trials: slice) -> Slots:
        """The same for some of the trials; counts over all trials stay as they are."""
        return self.mapped(lambda record: record.part(trials))

    def copied(self) -> Slots:
        """A copy whose arrays are its own, so that it does not keep larger ones in memory."""
        return self.mapped(lambda record: record.copied())


def concatenated(parts: Sequence[Slots]) -> Slots:
    """Consecutive slots as one. Raises ValueError if only some of the parts have a column."""

    def joined(name: str, table: str) -> Any:
        records: list[Record] = [getattr(part, table)[name] for part in parts]
        return type(records[0]).joined(records)

    first = parts[0]
    return Slots(
        SensorSlots.joined([part.sensor for part in parts]),
        {name: joined(name, "receivers") for name in first.receivers},
        {name: joined(name, "links") for name in first.links},
    )
