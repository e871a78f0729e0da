"""Sensor, receiver and controller from slot to slot, the same live and in memory.

The sensor has the states, the filter of its measurements, its packets, and the monitoring of acknowledgements. After late
packets, a receiver repeats its recursion from their slots on. The controller decides in some slots, and its inputs hold until
the next decision.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np

from evedrop.model import update
from evedrop.model.controllers import CONTROLLERS, Assignment
from evedrop.model.detection import CusumBatch
from evedrop.model.integrity.monitor import Monitor
from evedrop.model.local_filter import LocalFilter
from evedrop.model.plant import Drive, Plant
from evedrop.model.process import Floats, Process, Trajectory, product
from evedrop.model.receiver import Action, Belief, Beliefs, Flags, Receiver, Reception
from evedrop.model.schemes.scheme import Encoder, PacketBlock
from evedrop.model.slot.link_core import Arrival, Arrivals, Late
from evedrop.model.slot.records import ReceiverSlots, SensorSlots
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

    slots: SensorSlots
    packets: PacketBlock

    @classmethod
    def joined(cls, parts: Sequence[Sent]) -> Sent:
        """Consecutive slots, at least one, as one."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            SensorSlots.joined([part.slots for part in parts]), PacketBlock.joined([part.packets for part in parts])
        )


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

    def send(self, slots: range) -> Sent:
        """The next slots, at least one."""
        states = self._plant.advance(slots)
        x, predicted = self._filtered(slots, states)
        statistic, watermark = None, None
        if self._monitor is not None:
            statistic, watermark = self._monitored(slots.start, self._monitor)
        packets = self._encoder.encode_block(slots, x, predicted)
        true = None if self._local is None else states.x
        sensor = SensorSlots(
            slots.start, x, packets.nu, packets.sent, true=true, statistic=statistic, watermark=watermark
        )
        return Sent(sensor, packets)

    def _monitored(self, k: int, monitor: Monitor) -> tuple[Floats, Floats]:
        """Test the filter's innovation of slot k, and add the watermark to the input of this slot.

        Returns the detector's statistic, (1, R), and the watermark, (1, m, R).
        """
        assert self._local is not None  # noqa: S101 - a monitor is there only with a filter
        monitor.take(k, self._local.normalised, self._plant.entered)
        self._plant.add_watermark(monitor.watermark)
        return monitor.statistic[None], monitor.watermark[None]

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


@dataclass
class _Slot:
    """One of the window's slots, with everything that has arrived of it."""

    k: int
    heard: Reception
    before: Belief
    fresh: Flags
    """Trials whose packet has just arrived."""


@final
class ReceiverCore:
    """A receiver with its belief, which takes the arrivals of many slots at once, or of one.

    first: the first slot; window: slots by which a packet may be late and still be used.
    """

    def __init__(self, receiver: Receiver, window: int = 0, first: int = 0) -> None:
        self._receiver = receiver
        self._history: deque[_Slot] = deque(maxlen=window)
        self.belief = receiver.prior(first)
        self._late = np.zeros((2, receiver.trials), np.uint16)

    def take_slots(self, slots: range, arrivals: Arrivals) -> ReceiverSlots:
        """The receiver after consecutive slots, at least one, with the covariances of all trials."""
        if arrivals.plain and not self._history.maxlen:
            beliefs, self.belief = self._receiver.follow(slots, self.belief, arrivals.gamma, arrivals.z)
            return ReceiverSlots(slots.start, beliefs.x_hat, beliefs.action, beliefs.P)
        beliefs = Beliefs.empty(arrivals.z.shape)
        late = np.zeros((2, len(slots), self._receiver.trials), np.uint16) if self._history.maxlen else None
        for row, k in enumerate(slots):
            self._step(k, arrivals.at(row))
            beliefs.put(row, self.belief)
            if late is not None:
                late[:, row] = self._late
        return ReceiverSlots(
            slots.start, beliefs.x_hat, beliefs.action, beliefs.P, None, *((None, None) if late is None else late)
        )

    def _step(self, k: int, arrival: Arrival) -> None:
        changed = k
        self._late[:] = 0
        for late in arrival.late:
            if late.k < k and self._merge(late):
                changed = min(changed, late.k)
        if changed < k:
            self._again(changed)
        if self._history.maxlen:
            self._history.append(_Slot(k, arrival.heard, self.belief, np.zeros_like(arrival.heard.gamma)))
        self.belief = self._receiver.step(k, self.belief, arrival.heard)

    def miss(self, slots: range) -> None:
        """Pass slots in which nothing was received because the receiver was away; the window is cleared."""
        trials = self.belief.x_hat.shape[1]
        nothing = Reception(np.zeros(trials, np.bool_), np.zeros_like(self.belief.x_hat))
        for k in slots:
            self.belief = self._receiver.step(k, self.belief, nothing)
        self._history.clear()

    def _merge(self, late: Late) -> bool:
        """Store late packets in their slots; returns whether any of them is new. A second copy is not."""
        slot = next((slot for slot in self._history if slot.k == late.k), None)
        if slot is None:
            return False
        new = late.heard.gamma & ~slot.heard.gamma
        if not new.any():
            return False
        self._late[0] += new
        z = np.where(new, late.heard.z, slot.heard.z)
        header = slot.heard.header
        if late.heard.header is not None:
            header = late.heard.header if header is None else np.where(new, late.heard.header, header)
        slot.heard = Reception(slot.heard.gamma | new, z, header, slot.heard.truth)
        slot.fresh = slot.fresh | new
        return True

    def _again(self, first: int) -> None:
        """Compute the beliefs from slot `first` of the window again."""
        slots = [slot for slot in self._history if slot.k >= first]
        belief = slots[0].before
        for slot in slots:
            slot.before = belief
            belief = self._receiver.step(slot.k, belief, slot.heard)
            self._late[1] += slot.fresh & (belief.action != int(Action.DISCARDED))
            slot.fresh = np.zeros_like(slot.fresh)
        self.belief = belief


@final
class Absence:
    """The estimate of a receiver that is away: it is predicted from slot to slot.

    A receiver that is away reports nothing; these are its beliefs for these slots once it is back.
    """

    def __init__(self, process: Process, belief: Belief, window: int = 0) -> None:
        """window: slots by which a packet may be late for the receiver."""
        self._process, self._belief, self._window = process, belief, window

    def take_slots(self, slots: range) -> ReceiverSlots:
        """The receiver after consecutive slots, at least one, in which nothing was received."""
        n, trials = self._belief.x_hat.shape
        nothing = np.zeros((len(slots), trials), np.uint8)
        beliefs = update.beliefs(self._process, slots.start, self._belief, nothing, np.zeros((len(slots), n, trials)))
        self._belief = beliefs.last
        late = np.zeros((len(slots), trials), np.uint16) if self._window else None
        return ReceiverSlots(slots.start, beliefs.x_hat, beliefs.action, beliefs.P, None, late, late)


class Decision(NamedTuple):
    """The inputs from a slot on."""

    u: Floats
    """(m, R)."""
    failed: Flags
    """Whether the decision failed, so that the previous inputs stay, (R,)."""
    seconds: float
    """The time that it took."""


@final
class ControllerCore:
    """Decides the inputs of a batch of trials.

    strategy: the controller's name; disturbances (slots, q).
    """

    def __init__(self, strategy: str, assignment: Assignment, disturbances: Floats, trials: int) -> None:
        self._controller = CONTROLLERS[strategy](assignment, trials)
        self._disturbances = disturbances
        self.period = assignment.period
        """It decides in every slot that this number divides."""

    def decide(self, k: int, x: Floats) -> Decision:
        """The decision of slot k, from its state or an estimate of it, (n, R)."""
        began = time.perf_counter()
        u = self._controller.decide(k, x, self._disturbances[k])
        return Decision(u, self._controller.failed, time.perf_counter() - began)
