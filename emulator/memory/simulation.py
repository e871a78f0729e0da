"""A batch of trials in memory, slot by slot, over the model's own code, in three modes.

| mode | simulates | error |
|---|---|---|
| `exact` | states, packets and estimates: the bits of a live run | |x − x̂|² |
| `error-coordinates` | the errors themselves, so that nothing cancels where the state has grown beyond precision | |e|² |
| `covariance-only` | covariances given the events; draws no noise | tr of the actual covariance |
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import pairwise
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.memory.attendance import IntermittentReceiver
from evedrop.memory.closed_loop import Loop, Source, informed
from evedrop.memory.guarded_classes import Guard
from evedrop.model import update
from evedrop.model.digest import BeliefLog, Digests, block_starts
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.outcomes import eavesdropper_outcomes
from evedrop.model.process import Floats, ProcessNoise, Trajectory
from evedrop.model.receiver import Belief, Codes, Flags, Receiver, trace_of
from evedrop.model.schemes import scheme_of
from evedrop.model.schemes.scheme import Encoder, Packet
from evedrop.model.slot.link import Fates, Link
from evedrop.model.theory.covariances import misled_covariances
from evedrop.names import CONTROLLER, LEGITIMATE
from evedrop.plugins import look_in
from evedrop.scenario import Scenario
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.score.acknowledging import Acknowledging
from evedrop.score.closed_loop_tally import Acted, SolveTimes
from evedrop.score.filtering import true_errors
from evedrop.score.slots import ReceiverSlots, Slots
from evedrop.score.sums import squared_errors
from evedrop.streams import Batch

_CHUNK_NUMBERS = 64  # slots of a chunk times states: with 2000 trials side by side, a megabyte for each array


class Mode(StrEnum):
    """The quantities to simulate."""

    EXACT = "exact"
    ERROR_COORDINATES = "error-coordinates"
    COVARIANCE_ONLY = "covariance-only"


@dataclass(frozen=True)
class ReceiverChunk:
    """One receiver over c slots of R trials."""

    error: Floats
    """The error of the mode, (c, R)."""
    trace: Floats
    """Believed tr P, (c, R)."""
    action: Codes
    """(c, R)."""
    fates: Fates
    """Fates of the packets sent in these slots, (c, R)."""
    late: NDArray[np.uint16] | None = None
    """Counts of late packets that arrived, and that were used, (2, c, R); None if the receiver cannot use late packets."""
    x_hat: Floats | None = None
    """Estimates in exact mode, (c, n, R)."""


@dataclass(frozen=True)
class Chunk:
    """The measurements of some slots; the arrays are overwritten when the next chunk is made."""

    first: int
    receivers: Mapping[str, ReceiverChunk]
    recorded: Slots | None
    """The recorded trials in full; exact mode only."""
    alarms: Flags | None = None
    """Where the sensor raised an alarm that its acknowledgements are attacked, (c, R); None if it does not watch them."""
    acted: Acted | None = None
    """The closed loop's actions, in exact mode."""
    x: Floats | None = None
    """True states in exact mode, (c, n, R)."""
    true_errors: Mapping[str, Floats] | None = None
    """If the sensor filters: squared errors against the true state, of `sensor` and of receivers, (c, R)."""


@final
class Simulation:
    """Simulates all slots of a range of trials, the first `recorded` of them in full; `chunks` can be read only once."""

    def __init__(self, scenario: Scenario, trials: range, recorded: int = 0, mode: Mode = Mode.EXACT) -> None:
        self._scenario = scenario
        self._recorded = recorded
        self._mode = mode
        self._batch = Batch(scenario.slots, len(trials), trials.start)
        self._process = scenario.process.process
        self._keys = StreamKeys.of(scenario)
        if scenario.modules is not None:
            look_in(scenario.modules)
        self._scheme = scheme_of(self._process, scenario.encoding.spec)
        self._guard = guard = Guard(scenario, self._scheme, self._batch)
        secret = self._keys.secret(self._scheme.secret_streams)
        with guard.asking(LEGITIMATE, range(1)):
            self._shared = self._scheme.shared(secret, self._batch)
            self._initial = self._scheme.initial_state(secret, self._batch)
            self._receivers: dict[str, Receiver] = {LEGITIMATE: informed(scenario, self._shared.estimator())}
        for name in scenario.eavesdroppers:
            with guard.asking(name, range(1)):
                self._receivers[name] = self._eavesdropper(name)
        self._betrayed = {
            name: STRATEGIES[table.strategy].betrayed(table.parameters)
            for name, table in scenario.eavesdroppers.items()
        }
        self.digests: dict[str, dict[int, Digests]] = {name: {} for name in scenario.digested}
        """Receiver, or controller → block number → digests, (R, 32); filled in exact mode only."""
        self.solve_times = SolveTimes()

    def _eavesdropper(self, name: str) -> Receiver:
        table = self._scenario.eavesdroppers[name]
        keys = self._keys.eavesdropper(name, table.strategy, table.parameters)
        knowledge = Knowledge(self._process, self._scenario.encoding.mu_d, table.parameters, keys)
        return STRATEGIES.imported(table.strategy)(knowledge, self._batch)

    def chunks(self) -> Iterator[Chunk]:
        """Simulate all slots, some tens or hundreds at a time."""
        slots = self._batch.slots
        names = self._scenario.receivers
        courses = {name: self._scenario.course(name) for name in names}
        links = {name: Link(one, name, self._keys.link(name, one), self._batch) for name, one in courses.items()}
        play = {
            Mode.EXACT: self._exact,
            Mode.ERROR_COORDINATES: self._error_coordinates,
            Mode.COVARIANCE_ONLY: self._covariances,
        }[self._mode]()
        # The same length for any number of trials, so that sums over slots are formed in the same order.
        length = max(1, min(slots, _CHUNK_NUMBERS // self._process.n))
        bounds = sorted({slots, *(start for name in names for start in block_starts(slots, self._scenario.cuts(name)))})
        for block, end in pairwise(bounds):
            for first in range(block, end, length):
                chunk = range(first, min(first + length, end))
                fates = {}
                for name in names:
                    with self._guard.asking_link(name, chunk):
                        fates[name] = links[name].fates(chunk)
                    self._guard.fates(name, chunk, fates[name])
                yield play(chunk, fates)

    def _exact(self) -> Callable[[range, Mapping[str, Fates]], Chunk]:
        n, trials, slots = self._process.n, self._batch.trials, self._batch.slots
        estimator, of_loop = self._receivers[LEGITIMATE], self.digests.get(CONTROLLER, {})
        source = Source(self._keys, self._initial, self._batch)
        loop = Loop(self._scenario, source, estimator, of_loop, self.solve_times)
        encoder = self._shared.encoder()
        back = Acknowledging.of(self._scenario, self._keys.way_back, self._batch)
        windows = {name: self._scenario.window(name) for name in self._receivers}
        present = {
            name: IntermittentReceiver(receiver, windows[name], self._scenario.timeline.outages[name])
            for name, receiver in self._receivers.items()
        }
        logs = {name: BeliefLog(n, trials, slots, self._scenario.cuts(name)) for name in self._receivers}

        def play(chunk: range, fates: Mapping[str, Fates]) -> Chunk:
            x = np.empty((len(chunk), n, trials))
            true = np.empty_like(x) if loop.filters else x
            nu = np.empty((len(chunk), trials), np.bool_)
            late = {
                name: np.zeros((2, len(chunk), trials), np.uint16) if window else None
                for name, window in windows.items()
            }
            alarms = np.zeros((len(chunk), trials), np.bool_) if back is not None and back.watches else None
            if self._scheme.may_be_silent:
                fates = {name: one.copied() for name, one in fates.items()}
            sent = np.ones((len(chunk), trials), np.bool_) if self._scheme.may_be_silent else None
            loop.begin(len(chunk))
            for row, k in enumerate(chunk):
                true[row], x[row], predicted = loop.advance(k)
                packet = self._packet(encoder, k, x[row], predicted)
                nu[row] = packet.nu
                if packet.sent is not None and sent is not None:
                    sent[row] = packet.sent
                    for of_link in fates.values():
                        of_link.silence(row, packet.sent)
                if back is not None:
                    arrived = back.take(k, packet.sent, {name: fate.in_time_of(row) for name, fate in fates.items()})
                    with self._guard.asking(LEGITIMATE, range(k, k + 1)):
                        encoder.acknowledged(k, arrived)
                    if alarms is not None:
                        alarms[row] = back.alarms
                for name, one in present.items():
                    truth = x[row] if self._betrayed.get(name) == k else None
                    belief = self._belief(
                        name, k, partial(one.take, k, fates[name], row, packet.z, packet.header, truth)
                    )
                    if (counts := late[name]) is not None:
                        counts[:, row] = one.late, one.late_used
                    digests = logs[name].add(k, belief)
                    if digests is not None:
                        self.digests[name].update([digests])
                    if name == LEGITIMATE:
                        loop.act(k, row, true[row], belief.x_hat)
            rows = {name: log.rows(chunk.start, chunk.stop) for name, log in logs.items()}
            measured = {
                name: ReceiverChunk(
                    squared_errors(x, one.x_hat),
                    trace_of(one.P.transpose(1, 2, 0, 3)),
                    one.action,
                    fates[name],
                    late[name],
                    one.x_hat,
                )
                for name, one in rows.items()
            }
            beside = None if not loop.filters else true_errors(true, x, {name: one.x_hat for name, one in rows.items()})
            inputs, user = loop.inputs, rows[LEGITIMATE]
            estimates = {name: one.x_hat for name, one in rows.items()}
            acted = None if inputs is None else Acted(inputs, x, estimates, user.action, true)
            if not self._recorded:
                return Chunk(chunk.start, measured, None, alarms, acted, x, beside)
            some = slice(0, self._recorded)
            receivers = {
                name: ReceiverSlots(
                    one.x_hat[..., some],
                    one.action[:, some],
                    one.P[..., some],
                    np.empty((len(chunk), 2)),
                    fates[name].in_time[:, some],
                    {},
                )
                for name, one in rows.items()
            }
            shown = Slots(
                chunk.start,
                x[..., some],
                nu[:, some],
                receivers,
                None if sent is None else sent[:, some],
                inputs=None if acted is None else acted.part(some).inputs,
            )
            return Chunk(chunk.start, measured, shown, alarms, acted, x, beside)

        return play

    def _error_coordinates(self) -> Callable[[range, Mapping[str, Fates]], Chunk]:
        n, trials = self._process.n, self._batch.trials
        noise = ProcessNoise(self._process, self._keys.process, self._batch, self._initial)
        # The state, which may grow beyond precision, is needed only if a receiver may take an innovation for a state.
        misleads = bool(self._misled())
        trajectory = Trajectory(self._process, self._keys.process, self._batch, self._initial) if misleads else None
        errors = {name: np.zeros((n, trials)) for name in self._receivers}
        covariances = {name: receiver.prior().P for name, receiver in self._receivers.items()}

        def play(chunk: range, fates: Mapping[str, Fates]) -> Chunk:
            measured = self._blank(chunk, fates)
            delivered = {name: one.in_time for name, one in fates.items()}
            for row, k in enumerate(chunk):
                nu, w = self._nu(k), noise.at(k)
                if trajectory is not None:
                    trajectory.advance()
                for name, action, one in self._acts(k, row, measured, delivered):
                    errors[name] = update.error(
                        self._process,
                        errors[name],
                        action,
                        nu,
                        w,
                        lambda k=k: trajectory.predicted - self._chi(k),  # type: ignore[misc, union-attr]
                    )
                    covariances[name] = update.believed_covariance(self._process, k, covariances[name], action)
                    one.error[row] = (errors[name] * errors[name]).sum(axis=0)
                    one.trace[row] = trace_of(covariances[name])
            return Chunk(chunk.start, measured, None)

        return play

    def _covariances(self) -> Callable[[range, Mapping[str, Fates]], Chunk]:
        misled = self._misled()
        f = misled_covariances(self._process, self._batch.slots if misled else 0)
        trials, count = self._batch.trials, len(self._receivers)
        priors = {name: receiver.prior().P for name, receiver in self._receivers.items()}
        # All receivers' beliefs side by side along the axis of trials: half of the time is the overhead of numpy calls.
        places = {name: slice(i * trials, (i + 1) * trials) for i, name in enumerate(self._receivers)}
        believed = np.concatenate(list(priors.values()), axis=2)
        actual = {name: priors[name] for name in misled}

        def play(chunk: range, fates: Mapping[str, Fates]) -> Chunk:
            nonlocal believed
            traces = np.empty((len(chunk), count * trials))
            actions = np.empty(traces.shape, np.uint8)
            errors = {name: np.empty((len(chunk), trials)) for name in misled}
            delivered = {name: one.in_time for name, one in fates.items()}
            for row, k in enumerate(chunk):
                for name, receiver in self._receivers.items():
                    actions[row, places[name]] = self._act(name, receiver, k, delivered[name][row])
                believed = update.believed_covariance(self._process, k, believed, actions[row])
                traces[row] = trace_of(believed)
                for name, error in errors.items():
                    action, nu = actions[row, places[name]], self._nu(k)
                    actual[name] = update.actual_covariance(self._process, k, actual[name], action, nu, f[k])
                    error[row] = trace_of(actual[name])
            measured = {}
            for name, place in places.items():
                trace = traces[:, place]
                measured[name] = ReceiverChunk(errors.get(name, trace), trace, actions[:, place], fates[name])
            return Chunk(chunk.start, measured, None)

        return play

    def _packet(self, encoder: Encoder, k: int, x: Floats, predicted: Floats) -> Packet:
        """Make the packet of slot k."""
        with self._guard.asking(LEGITIMATE, range(k, k + 1)):
            packet = encoder.encode(k, x, predicted)
        self._guard.packet(k, packet)
        return packet

    def _belief(self, name: str, k: int, take: Callable[[], Belief]) -> Belief:
        """A receiver's belief after slot k."""
        with self._guard.asking(name, range(k, k + 1)):
            belief = take()
        self._guard.belief(name, k, belief)
        return belief

    def _nu(self, k: int) -> Flags:
        """ν_k, (R,)."""
        with self._guard.asking(LEGITIMATE, range(k, k + 1)):
            nu = self._shared.nu(k)
        self._guard.shared(k, nu)
        return nu

    def _chi(self, k: int) -> Floats:
        """χ_k, (n, R)."""
        with self._guard.asking(LEGITIMATE, range(k, k + 1)):
            chi = self._shared.chi(k)
        self._guard.shared(k, self._shared.nu(k), chi)
        return chi

    def _act(self, name: str, receiver: Receiver, k: int, gamma: Flags) -> Codes:
        """A receiver's action in slot k, (R,)."""
        with self._guard.asking(name, range(k, k + 1)):
            action = receiver.act(k, gamma)
        self._guard.acted(name, k, action)
        return action

    def _misled(self) -> set[str]:
        """Receivers that may take an innovation for the state."""
        found = set()
        for name, table in self._scenario.eavesdroppers.items():
            outcomes = eavesdropper_outcomes(self._scheme, table.strategy, table.parameters)
            if outcomes is not None and outcomes(1.0).misled > 0.0:
                found.add(name)
        return found

    def _blank(self, chunk: range, fates: Mapping[str, Fates]) -> dict[str, ReceiverChunk]:
        shape = (len(chunk), self._batch.trials)
        return {
            name: ReceiverChunk(np.empty(shape), np.empty(shape), np.empty(shape, np.uint8), codes)
            for name, codes in fates.items()
        }

    def _acts(
        self, k: int, row: int, measured: Mapping[str, ReceiverChunk], delivered: Mapping[str, Flags]
    ) -> Iterator[tuple[str, Codes, ReceiverChunk]]:
        """Every receiver's action in slot k, from one row of `delivered` (c, R)."""
        for name, one in measured.items():
            action = self._act(name, self._receivers[name], k, delivered[name][row])
            one.action[row] = action
            yield name, action, one
