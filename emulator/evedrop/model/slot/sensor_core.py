"""The sensor from slot to slot: states, the filter of its measurements, packets, and the monitoring of acknowledgements.

The true states of a batch are those of a process alone, of a plant that inputs and disturbances move, or given ones, from a
recording or a program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, final

import numpy as np

from evedrop.model.detection import CusumBatch
from evedrop.model.integrity.monitor import Monitor, MonitoredSlots
from evedrop.model.local_filter import LocalFilter
from evedrop.model.plant import Drive, Plant
from evedrop.model.process import Floats, Process, Trajectory, product
from evedrop.model.receiver import Flags
from evedrop.model.schemes.scheme import Encoder, PacketBlock
from evedrop.model.streams import Batch

LARGEST = 1e100
"""The largest given state, as a deviation from the reference: the square, summed over trials, stays within double precision."""


def deviations(levels: Floats, reference: Floats) -> Floats:
    """The deviations x (…, n) of levels (…, n) from the public reference (n,).

    They are rounded so that the levels x + reference have exactly these deviations again: tables hold such levels.
    """
    return ((levels - reference) + reference) - reference


def recorded(states: Floats) -> Callable[[range], Floats]:
    """Returns the rows of some slots of states that were recorded, (slots, n)."""
    return lambda slots: states[slots.start : slots.stop]


@final
class GivenStates:
    """The given states of a batch, and the predictions A x_{k−1} that innovations refer to. Must be read in order.

    take: returns the deviations of the next slots, (c, n).
    """

    def __init__(self, process: Process, take: Callable[[range], Floats], trials: int) -> None:
        self._A, self._take, self._trials = process.A, take, trials
        self._last = np.zeros((process.n, 1))

    def advance(self, slots: range) -> tuple[Floats, Floats]:
        """The states of the next slots and the predictions A x_{k−1} of each, (c, n, R); the prediction of slot 0 is 0."""
        x = self._take(slots)[:, :, None]
        predicted = product(self._A, np.concatenate([self._last[None], x[:-1]]))
        self._last = x[-1]
        return np.repeat(x, self._trials, axis=2), np.repeat(predicted, self._trials, axis=2)


class States(NamedTuple):
    """The states of c consecutive slots."""

    x: Floats
    """True states, (c, n, R)."""
    predicted: Floats
    """A x of the slots before, (c, n, R)."""
    pushed: list[Floats] | None = None
    """The effect of inputs and disturbances on each slot's state, (n, R) or (n, 1); None without a plant."""


@final
class PlantCore:
    """Computes the states, in order.

    key: of the stream `process`; initial: as for `Trajectory`; disturbances (slots, q): needed with a plant; given: the states
    themselves, in place of all of these.
    """

    def __init__(
        self,
        process: Process,
        key: bytes,
        batch: Batch,
        initial: Floats | None = None,
        plant: Plant | None = None,
        disturbances: Floats | None = None,
        given: GivenStates | None = None,
    ) -> None:
        self._given = given
        self._trajectory = Trajectory(process, key, batch, initial, None if plant is None else plant.noise)
        self._drive = None if plant is None or disturbances is None else Drive(plant, disturbances)

    def advance(self, slots: range) -> States:
        """The states of the next slots."""
        if self._given is not None:
            return States(*self._given.advance(slots))
        if self._drive is None:
            return States(*self._trajectory.advance_block(len(slots)))
        pushed, x, predicted = [], [], []
        for k in slots:
            pushed.append(self._drive.pushed(k))
            x.append(self._trajectory.advance(pushed[-1]))
            predicted.append(self._trajectory.predicted)
        return States(np.array(x), np.array(predicted), pushed)

    def set_inputs(self, u: Floats) -> None:
        """Apply the inputs u (m, R) from the next slot on, until others come."""
        if self._drive is not None:
            self._drive.set_inputs(u)

    def add_watermark(self, e: Floats) -> None:
        """Add the watermark e, (m, R), to the inputs from the next slot on, until there is another one."""
        if self._drive is not None:
            self._drive.add_watermark(e)

    @property
    def entered(self) -> Floats | None:
        """What the watermark added to the inputs that led into the last slot, (m, R); None if there was none."""
        return None if self._drive is None else self._drive.entered


class Sent(NamedTuple):
    """The sensor in c consecutive slots."""

    true: Floats
    """True states, (c, n, R)."""
    x: Floats
    """The states that packets are made from, (c, n, R): the true ones, or the estimates of the sensor's filter."""
    packets: PacketBlock
    monitored: MonitoredSlots | None = None
    """The detector for the filter; None without one."""

    @classmethod
    def joined(cls, parts: Sequence[Sent]) -> Sent:
        """Consecutive slots, at least one, as one."""
        if len(parts) == 1:
            return parts[0]
        packets = PacketBlock.joined([part.packets for part in parts])
        true, x = (np.concatenate(arrays) for arrays in zip(*((part.true, part.x) for part in parts), strict=True))
        monitored = [part.monitored for part in parts if part.monitored is not None]
        return cls(true, x, packets, MonitoredSlots.joined(monitored) if monitored else None)

    def rows(self, some: slice) -> Sent:
        """Some of the slots."""
        monitored = None if self.monitored is None else self.monitored.rows(some)
        return Sent(self.true[some], self.x[some], self.packets.rows(some), monitored)


@final
class SensorCore:
    """Makes the packets of many slots at once; or of one slot at a time, if the next packet depends on feedback.

    watch: over the acknowledgements, None if it does not watch them. monitor: of the filter's innovations; it needs inputs in
    every slot, so slots are made one at a time.
    """

    def __init__(
        self,
        encoder: Encoder,
        plant: PlantCore,
        local: LocalFilter | None = None,
        watch: CusumBatch | None = None,
        monitor: Monitor | None = None,
    ) -> None:
        self._encoder, self._plant = encoder, plant
        self._local, self._watch, self._monitor = local, watch, monitor

    @property
    def watches(self) -> bool:
        """Whether the sensor watches the acknowledgements."""
        return self._watch is not None

    @property
    def filters(self) -> bool:
        """Whether the sensor filters its measurements, so that it does not transmit the true state."""
        return self._local is not None

    @property
    def monitors(self) -> bool:
        """Whether the sensor's filter has a detector."""
        return self._monitor is not None

    def send(self, slots: range) -> Sent:
        """The next slots, at least one."""
        states = self._plant.advance(slots)
        x, predicted = self._filtered(slots, states)
        monitored = None if self._monitor is None else self._monitored(slots.start, self._monitor)
        return Sent(states.x, x, self._encoder.encode_block(slots, x, predicted), monitored)

    def _monitored(self, k: int, monitor: Monitor) -> MonitoredSlots:
        """Test the filter's innovation of slot k, and add the watermark to the input of this slot."""
        assert self._local is not None  # noqa: S101 - a monitor is there only with a filter
        monitor.take(k, self._local.normalised, self._plant.entered)
        self._plant.add_watermark(monitor.watermark)
        return MonitoredSlots(monitor.statistic[None], monitor.watermark[None])

    def _filtered(self, slots: range, states: States) -> tuple[Floats, Floats]:
        """The states to transmit, and the predictions that their innovations refer to."""
        if self._local is None or states.pushed is None:
            return states.x, states.predicted
        x, predicted = np.empty_like(states.x), np.empty_like(states.x)
        for row, (k, pushed) in enumerate(zip(slots, states.pushed, strict=True)):
            x[row] = self._local.take(k, states.x[row], pushed)
            predicted[row] = self._local.predicted
        return x, predicted

    def acknowledged(self, k: int, acknowledged: Flags, sent: Flags | None) -> Flags | None:
        """Take the acknowledgements of slot k that reached the sensor, before the next slot is sent; sent: as in `Packet`.

        Returns where they raise an alarm, (R,); None if the sensor does not watch them.
        """
        self._encoder.acknowledged(k, acknowledged)
        return None if self._watch is None else self._watch.take(acknowledged, sent)

    def set_inputs(self, u: Floats) -> None:
        """Apply the inputs u (m, R) from the next slot on, until others come."""
        self._plant.set_inputs(u)
