"""A batch of trials in memory, slot by slot, over the model's own code, in three modes.

| mode | simulates | error |
|---|---|---|
| `exact` | states, packets and estimates: the bits of a live run | |x − x̂|² |
| `error-coordinates` | the errors themselves, so that nothing cancels where the state has grown beyond precision | |e|² |
| `covariance-only` | covariances given the events; draws no noise | tr of the actual covariance |
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from enum import StrEnum
from itertools import pairwise
from typing import final

import numpy as np

from evedrop.model import update
from evedrop.model.digest import Digests, block_starts
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge
from evedrop.model.outcomes import eavesdropper_outcomes
from evedrop.model.plant import InputAwareEstimator
from evedrop.model.process import Floats, ProcessNoise, Trajectory
from evedrop.model.receiver import Codes, Flags, Receiver, trace_of
from evedrop.model.slot.link_core import LinkCore
from evedrop.model.streams import OWN, Batch, Lineage
from evedrop.model.theory.covariances import misled_covariances
from evedrop.names import LEGITIMATE
from evedrop.scenario.conformance.checked import CheckedLink
from evedrop.scenario.plugins import look_in
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import Scenario
from evedrop.score.closed_loop_tally import SolveTimes
from evedrop.simulate.chunk import Chunk, PacketTally, ReceiverChunk
from evedrop.simulate.exact import ExactSimulation, Roles
from evedrop.simulate.guarded_classes import Guard

_CHUNK_NUMBERS = 64  # slots of a chunk times states: with 2000 trials side by side, a megabyte for each array


class Mode(StrEnum):
    """The quantities to simulate."""

    EXACT = "exact"
    ERROR_COORDINATES = "error-coordinates"
    COVARIANCE_ONLY = "covariance-only"


@final
class Simulation:
    """Simulates all slots of a range of trials; `chunks` can be read only once.

    lineage: whose random numbers they read; leaving out: eavesdroppers that are not simulated, which changes nothing else; stops:
    slots before which a chunk ends.
    """

    def __init__(
        self,
        scenario: Scenario,
        trials: range,
        mode: Mode = Mode.EXACT,
        *,
        lineage: Lineage = OWN,
        leaving_out: Collection[str] = (),
        stops: Collection[int] = (),
    ) -> None:
        self._scenario = scenario
        self._mode = mode
        self._batch = Batch(scenario.slots, len(trials), trials.start, lineage)
        self._process = scenario.process.process
        self._keys = StreamKeys.from_scenario(scenario)
        if scenario.modules is not None:
            look_in(scenario.modules)
        self._scheme = scenario.make_scheme()
        self._guard = guard = Guard(scenario, self._scheme, self._batch)
        secret = self._keys.secret(self._scheme.secret_streams)
        with guard.asking(LEGITIMATE, range(1)):
            self._shared = self._scheme.shared(secret, self._batch)
            self._initial = self._scheme.initial_state(secret, self._batch)
            self._receivers: dict[str, Receiver] = {
                LEGITIMATE: self._informed(guard.estimator(self._shared.estimator()))
            }
        self._strategies: dict[str, Eavesdropper] = {}
        self._stops = frozenset(stops)
        for name in scenario.eavesdroppers:
            if name in leaving_out:
                continue
            with guard.asking(name, range(1)):
                self._strategies[name] = self._eavesdropper(name)
                self._receivers[name] = guard.eavesdropper(name, self._strategies[name])
        self._betrayed = {
            name: STRATEGIES[table.strategy].betrayed(table.parameters)
            for name, table in scenario.eavesdroppers.items()
        }
        self.digests: dict[str, dict[int, Digests]] = {name: {} for name in scenario.digested}
        """Receiver, or controller → block number → digests, (R, 16); filled in exact mode only."""
        self.solve_times = SolveTimes()
        self.packets = PacketTally.zero(len(trials))
        """Counted in exact mode only."""

    def _informed(self, estimator: Receiver) -> Receiver:
        """The legitimate estimator, input-aware if the scenario says so."""
        scenario = self._scenario
        if scenario.driven is None or not scenario.legitimate.knows_input:
            return estimator
        return InputAwareEstimator(estimator, scenario.driven, scenario.window(LEGITIMATE))

    def _eavesdropper(self, name: str) -> Eavesdropper:
        table = self._scenario.eavesdroppers[name]
        keys = self._keys.eavesdropper(name, table.strategy, table.parameters)
        encoding, distribution = self._scenario.encoding, self._scheme.noise_distribution
        knowledge = Knowledge(
            self._process, encoding.mu_d, table.parameters, keys, encoding.state_probabilities, distribution
        )
        return STRATEGIES.imported(table.strategy)(knowledge, self._batch)

    def chunks(self) -> Iterator[Chunk]:
        """Simulate all slots, up to 64 at a time."""
        slots = self._batch.slots
        names = tuple(self._receivers)
        schedules = {name: self._scenario.schedule(name) for name in names}
        links = {
            name: LinkCore(schedule, name, self._keys.link(name, schedule), self._batch)
            for name, schedule in schedules.items()
        }
        checked_links = [CheckedLink(name, link, schedules[name], self._batch) for name, link in links.items()]
        play = {
            Mode.EXACT: self._exact,
            Mode.ERROR_COORDINATES: self._error_coordinates,
            Mode.COVARIANCE_ONLY: self._covariances,
        }[self._mode]()
        # The same length for any number of trials, so that sums over slots are formed in the same order.
        length = max(1, min(slots, _CHUNK_NUMBERS // self._process.n))
        starts = (start for name in names for start in block_starts(slots, self._scenario.outage_bounds(name)))
        bounds = sorted({slots, *starts, *(stop for stop in self._stops if 0 < stop < slots)})
        for block, end in pairwise(bounds):
            for first in range(block, end, length):
                chunk = range(first, min(first + length, end))
                for link in checked_links:
                    link.plan(chunk)
                yield play(chunk, links)

    def _exact(self) -> Callable[[range, Mapping[str, LinkCore]], Chunk]:
        roles = Roles(
            self._scenario,
            self._batch,
            self._keys,
            self._guard,
            self._scheme,
            self._shared,
            self._initial,
            self._receivers,
            self._betrayed,
        )
        self._exact_simulation = ExactSimulation(roles, self.digests, self.solve_times, self.packets)
        return self._exact_simulation.play

    def learned(self) -> dict[str, Mapping[str, Floats]]:
        """Eavesdropper → what it has learned of the process after the last chunk, as `Eavesdropper.learned`; in exact mode."""
        learned = {
            name: values.learned(self._exact_simulation.belief(name)) for name, values in self._strategies.items()
        }
        return {name: values for name, values in learned.items() if values}

    def _error_coordinates(self) -> Callable[[range, Mapping[str, LinkCore]], Chunk]:
        n, trials = self._process.n, self._batch.trials
        noise = ProcessNoise(self._process, self._keys.process, self._batch, self._initial)
        # The state, which may grow beyond precision, is needed only if a receiver may take an innovation for a state.
        misleads = bool(self._misled())
        trajectory = Trajectory(self._process, self._keys.process, self._batch, self._initial) if misleads else None
        errors = {name: np.zeros((n, trials)) for name in self._receivers}
        priors = {name: receiver.prior() for name, receiver in self._receivers.items()}
        covariances = {name: belief.P for name, belief in priors.items()}

        # The square of an error may leave double precision; then it is inf, as it should be.
        @np.errstate(over="ignore")
        def play(chunk: range, links: Mapping[str, LinkCore]) -> Chunk:
            shape = len(chunk), trials
            measured = {
                name: ReceiverChunk(np.empty(shape), np.empty(shape), np.empty(shape, np.uint8), link.fates)
                for name, link in links.items()
            }
            delivered = {name: link.in_time for name, link in links.items()}
            for row, k in enumerate(chunk):
                nu, w = self._nu(k), noise.block(range(k, k + 1))[0]
                if trajectory is not None:
                    trajectory.advance()
                for name, values in measured.items():
                    action = values.action[row] = self._act(name, self._receivers[name], k, delivered[name][row])
                    errors[name] = update.error(
                        self._process,
                        errors[name],
                        action,
                        nu,
                        w if k else w - priors[name].x_hat,
                        lambda k=k: trajectory.predicted - self._chi(k),  # type: ignore[misc, union-attr]
                    )
                    covariances[name] = update.reported_covariance(self._process, k, covariances[name], action)
                    values.error[row] = (errors[name] * errors[name]).sum(axis=0)
                    values.trace[row] = trace_of(covariances[name])
            return Chunk(chunk.start, measured)

        return play

    def _covariances(self) -> Callable[[range, Mapping[str, LinkCore]], Chunk]:
        misled = self._misled()
        f = misled_covariances(self._process, self._batch.slots if misled else 0)
        trials, count = self._batch.trials, len(self._receivers)
        priors = {name: receiver.prior().P for name, receiver in self._receivers.items()}
        # All receivers' beliefs side by side along the axis of trials: half of the time is the overhead of numpy calls.
        places = {name: slice(i * trials, (i + 1) * trials) for i, name in enumerate(self._receivers)}
        reported = np.concatenate(list(priors.values()), axis=2)
        actual = {name: priors[name] for name in misled}

        def play(chunk: range, links: Mapping[str, LinkCore]) -> Chunk:
            nonlocal reported
            traces = np.empty((len(chunk), count * trials))
            actions = np.empty(traces.shape, np.uint8)
            errors = {name: np.empty((len(chunk), trials)) for name in misled}
            delivered = {name: link.in_time for name, link in links.items()}
            for row, k in enumerate(chunk):
                for name, receiver in self._receivers.items():
                    actions[row, places[name]] = self._act(name, receiver, k, delivered[name][row])
                reported = update.reported_covariance(self._process, k, reported, actions[row])
                traces[row] = trace_of(reported)
                for name, error in errors.items():
                    action, nu = actions[row, places[name]], self._nu(k)
                    actual[name] = update.actual_covariance(self._process, k, actual[name], action, nu, f[k])
                    error[row] = trace_of(actual[name])
            measured = {}
            for name, place in places.items():
                trace = traces[:, place]
                measured[name] = ReceiverChunk(errors.get(name, trace), trace, actions[:, place], links[name].fates)
            return Chunk(chunk.start, measured)

        return play

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
        self._guard.acted(name, k, action, gamma)
        return action

    def _misled(self) -> set[str]:
        """Receivers that may take an innovation for the state."""
        misled = set()
        for name in self._receivers.keys() & self._scenario.eavesdroppers.keys():
            table = self._scenario.eavesdroppers[name]
            outcomes = eavesdropper_outcomes(self._scheme, table.strategy, table.parameters)
            if outcomes is not None and outcomes(1.0).misled > 0.0:
                misled.add(name)
        return misled
