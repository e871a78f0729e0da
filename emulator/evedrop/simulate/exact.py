"""Exact mode: the same cores as in a live run, without messages between them.

A receiver with its link does the work of a live run's router, receiver process and absence reporter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from evedrop.model.acknowledgements import AckChannel
from evedrop.model.detection import CusumBatch
from evedrop.model.digest import BlockDigests, Digests, InputLog
from evedrop.model.integrity.monitor import Monitor
from evedrop.model.kernels.current import kernels
from evedrop.model.plant import InputAwareEstimator
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Flags, Receiver, prior
from evedrop.model.schemes.scheme import Scheme, Shared
from evedrop.model.slot.cores import (
    Absence,
    ControllerCore,
    GivenStates,
    PlantCore,
    ReceiverCore,
    SensorCore,
    Sent,
    recorded,
)
from evedrop.model.slot.link import ReceiverOutage
from evedrop.model.slot.link_core import Arrivals, LinkCore
from evedrop.model.slot.records import ReceiverSlots
from evedrop.model.streams import Batch
from evedrop.names import CONTROLLER, LEGITIMATE
from evedrop.scenario.closed_loop import monitor_of
from evedrop.scenario.input_files import disturbances_of, states_of
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import Scenario
from evedrop.score.closed_loop_tally import SolveTimes
from evedrop.score.filtering import local_filter_of
from evedrop.score.links import ack_channel_of, chart_of
from evedrop.score.slots import Slots
from evedrop.score.sums import squared_errors
from evedrop.simulate.chunk import Chunk, PacketTally, ReceiverChunk
from evedrop.simulate.guarded_classes import Guard


@dataclass(frozen=True)
class Roles:
    """A scenario's sensor, scheme and receivers for a batch of trials."""

    scenario: Scenario
    batch: Batch
    keys: StreamKeys
    guard: Guard
    """Checks the results of classes that are not built in."""
    scheme: Scheme
    shared: Shared
    """The scheme's shared part of both sides."""
    initial: Floats | None
    """As for `Trajectory`."""
    receivers: Mapping[str, Receiver]
    betrayed: Mapping[str, int | None]
    """Eavesdropper → the slot whose state it learns."""


@final
class ExactSimulation:
    """Simulates all slots of a batch of trials.

    digests: filled with the digests of receivers and controller, block by its first slot → (R, bytes); times: filled with the
    times of decisions; packets: filled with the counts of packets.
    """

    def __init__(
        self, roles: Roles, digests: Mapping[str, dict[int, Digests]], times: SolveTimes, packets: PacketTally
    ) -> None:
        scenario, batch, keys = roles.scenario, roles.batch, roles.keys
        self._roles, self._digests, self._packets = roles, digests, packets
        self._guard = roles.guard
        disturbances = disturbances_of(scenario)
        process, chart, plan = scenario.process.process, chart_of(scenario), monitor_of(scenario)
        states = states_of(scenario)
        given = None if states is None else GivenStates(process, recorded(states), batch.trials)
        self._sensor = SensorCore(
            roles.guard.encoder(roles.shared.encoder()),
            PlantCore(process, keys.process, batch, roles.initial, scenario.driven, disturbances, given),
            local_filter_of(
                scenario, keys.measurement, batch, None if plan is None else plan.spoofing(keys.spoofing, batch)
            ),
            None if chart is None else CusumBatch(chart, batch.trials),
            None if plan is None else Monitor(plan, keys.watermark, batch),
        )
        ack_channel = ack_channel_of(scenario)
        self._jammer = None if ack_channel is None else ack_channel.jammer
        self._ack_channel = None if ack_channel is None else AckChannel(ack_channel, keys.acknowledgements, batch)
        self._control_loop = None
        if scenario.controller is not None and scenario.assignment is not None:
            controller = ControllerCore(scenario.controller.strategy, scenario.assignment, disturbances, batch.trials)
            self._control_loop = _ControlLoop(roles, controller, self._sensor, digests[CONTROLLER], times)
        self._receivers = {
            name: SimulatedReceiver(role, scenario.window(name), scenario.timeline.outages[name])
            for name, role in roles.receivers.items()
        }
        self._logs = {
            name: BlockDigests(batch.trials, scenario.slots, scenario.outage_bounds(name)) for name in roles.receivers
        }

    def belief(self, name: str) -> Belief:
        """A receiver's belief after the last chunk."""
        return self._receivers[name].belief

    def play(self, chunk: range, links: Mapping[str, LinkCore]) -> Chunk:
        """Simulate the next slots, which are those that the links have planned. No receiver leaves or returns among them."""
        answered = self._ack_channel is not None or self._control_loop is not None
        sent: list[Sent] = []
        alarms: list[Flags] = []
        followed: list[ReceiverSlots] = []
        inputs: list[tuple[Floats, Flags]] = []
        for slots in [range(k, k + 1) for k in chunk] if answered else [chunk]:
            with self._guard.asking(LEGITIMATE, slots):
                made = self._sensor.send(slots)
            sent.append(made)
            if made.packets.sent is not None:
                for link in links.values():
                    link.silence(slots, made.packets.sent)
            if self._ack_channel is not None:
                alarm = self._acknowledge(self._ack_channel, slots.start, made.packets.sent, links)
                alarms += [] if alarm is None else [alarm]
            if self._control_loop is not None:
                if self._control_loop.awaits_estimate:
                    followed.append(self._follow(LEGITIMATE, slots, links[LEGITIMATE], made))
                x_hat = followed[-1].x_hat[0] if followed else None
                inputs.append(self._control_loop.act(slots.start, made.slots.states[0], x_hat))
        whole = Sent.joined(sent)
        with self._guard.asking(LEGITIMATE, chunk):
            self._packets.add_slots(self._roles.scheme.encrypted(whole.packets), whole.packets.sent)
        receivers = {
            name: ReceiverSlots.joined(followed)
            if followed and name == LEGITIMATE
            else self._follow(name, chunk, link, whole)
            for name, link in links.items()
        }
        for name, receiver in receivers.items():
            self._digests[name].update(self._logs[name].add(chunk, receiver.beliefs))
        u, failed = map(np.array, zip(*inputs, strict=True)) if inputs else (None, None)
        sensor = replace(whole.slots, alarms=np.array(alarms) if alarms else None, u=u, failed=failed)
        measured = {
            name: ReceiverChunk(
                squared_errors(sensor.x, receiver.x_hat),
                kernels.traces(receiver.P),
                receiver.action,
                links[name].fates,
            )
            for name, receiver in receivers.items()
        }
        return Chunk(chunk.start, measured, Slots(sensor, receivers, {}))

    def _acknowledge(
        self, ack_channel: AckChannel, k: int, sent: Flags | None, links: Mapping[str, LinkCore]
    ) -> Flags | None:
        """Return the acknowledgements of slot k to the sensor; where they raise an alarm, (R,), or None."""
        gamma = links[LEGITIMATE].gamma(k)
        gamma_e = gamma if self._jammer is None else links[self._jammer].gamma(k)
        arrived = ack_channel.arrived(k, None if sent is None else sent[0], gamma, gamma_e)
        with self._guard.asking(LEGITIMATE, range(k, k + 1)):
            return self._sensor.acknowledged(k, arrived, None if sent is None else sent[0])

    def _follow(self, name: str, slots: range, link: LinkCore, made: Sent) -> ReceiverSlots:
        arrivals = link.arrivals(slots, made.packets.z, made.packets.header)
        betrayed = self._roles.betrayed.get(name)
        if betrayed is not None and betrayed in slots:
            row = betrayed - slots.start
            arrivals = arrivals._replace(truth={row: made.slots.x[row]})
        with self._guard.asking(name, slots):
            return self._receivers[name].take_slots(slots, arrivals)


@final
class _ControlLoop:
    """The controller of a scenario, and the way of its inputs to the sensor and to an estimator that knows them."""

    def __init__(
        self,
        roles: Roles,
        controller: ControllerCore,
        sensor: SensorCore,
        digests: dict[int, Digests],
        times: SolveTimes,
    ) -> None:
        scenario, trials = roles.scenario, roles.batch.trials
        table, plant, estimator = scenario.controller, scenario.driven, roles.receivers[LEGITIMATE]
        inputs = 0 if plant is None else plant.inputs
        self._controller, self._sensor, self._digests, self._times = controller, sensor, digests, times
        self._on_truth = table is not None and table.acts_on == "truth"
        self._estimator = estimator if isinstance(estimator, InputAwareEstimator) else None
        self._log = InputLog(inputs, trials, scenario.slots)
        self._u: Floats = np.zeros((inputs, trials))
        self._failed: Flags = np.zeros(trials, np.bool_)

    @property
    def awaits_estimate(self) -> bool:
        """Whether the legitimate estimator and the controller wait for each other in every slot."""
        return not self._on_truth or self._estimator is not None

    def act(self, k: int, true: Floats, x_hat: Floats | None) -> tuple[Floats, Flags]:
        """The inputs of slot k, (m, R), and where their decision failed, (R,), from its true state or the estimate, (n, R)."""
        if k % self._controller.period == 0:
            decision = self._controller.decide(k, true if self._on_truth or x_hat is None else x_hat)
            self._u, self._failed = decision.u, decision.failed
            self._times.add_seconds([decision.seconds])
            self._sensor.set_inputs(self._u)
        if self._estimator is not None:
            self._estimator.learn(k, self._u)
        digests = self._log.add(k, self._u, self._failed)
        if digests is not None:
            self._digests.update([digests])
        return self._u, self._failed


@final
class SimulatedReceiver:
    """A receiver that follows the slots from 0 on, and may be away in some of them."""

    def __init__(self, receiver: Receiver, window: int, outages: Sequence[ReceiverOutage]) -> None:
        self._receiver, self._window = receiver, window
        self._outages = {away.start: away for away in outages}
        self._away: ReceiverOutage | None = None
        self._absence: Absence
        self._core = ReceiverCore(receiver, window)

    @property
    def belief(self) -> Belief:
        """Its belief after the last slot in which it was present, or that it passed."""
        return self._core.belief

    def take_slots(self, slots: range, arrivals: Arrivals) -> ReceiverSlots:
        """The receiver after consecutive slots, at least one. The receiver is present in all of them, or away in all."""
        k = slots.start
        if k in self._outages:
            self._leave(self._outages[k])
        if self._away is not None and k < self._away.stop:
            if self._away.keeps_state:
                self._core.miss(slots)
            return self._absence.take_slots(slots)
        if self._away is not None and not self._away.keeps_state:
            self._core = ReceiverCore(self._receiver, self._window, k)
        self._away = None
        return self._core.take_slots(slots, arrivals)

    def _leave(self, away: ReceiverOutage) -> None:
        process, trials = self._receiver.process, self._receiver.trials
        left = self._core.belief if away.keeps_state else prior(process, trials, away.start)
        self._away, self._absence = away, Absence(process, left, self._window)
