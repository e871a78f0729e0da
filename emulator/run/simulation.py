"""A batch of trials in memory: sensor, links and receivers of a scenario, slot by slot, over the model's own code."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from emulator.model.digest import BLOCK_SLOTS, BlockDigester, Digests
from emulator.model.eavesdroppers import STRATEGIES
from emulator.model.eavesdroppers.eavesdropper import Knowledge
from emulator.model.links import link_of
from emulator.model.links.link import Fate, losses
from emulator.model.process import Trajectory
from emulator.model.receiver import Belief, Codes, Receiver, trace_of
from emulator.model.schemes import SCHEMES
from emulator.network.access import LEGITIMATE
from emulator.run.briefs import StreamKeys
from emulator.run.joined import ReceiverSlots, Slots
from emulator.scenario import Scenario
from emulator.streams import Batch

_CHUNK_NUMBERS = 131_072  # states of a chunk of slots: about a megabyte an array


class _Rows:
    """One receiver's columns of a chunk, filled slot by slot."""

    def __init__(self, count: int, n: int, trials: int, recorded: int) -> None:
        self._fates = np.empty((count, trials), np.uint8)
        self._x_hat = np.empty((count, n, trials))
        self._action = np.empty((count, trials), np.uint8)
        self._P = np.empty((count, n, n, recorded))
        self._trace = np.empty((count, 2))

    def fill(self, row: int, fates: Codes, belief: Belief) -> None:
        self._fates[row] = fates
        self._x_hat[row] = belief.x_hat
        self._action[row] = belief.action
        self._P[row] = belief.P[:, :, : self._P.shape[3]]
        trace = trace_of(belief.P)
        self._trace[row] = trace.sum(), (trace * trace).sum()

    def slots(self) -> ReceiverSlots:
        delivered = self._fates == Fate.DELIVERED
        return ReceiverSlots(self._x_hat, self._action, self._P, self._trace, delivered, losses(self._fates))


class Simulation:
    """The trials of a range, all slots. Final; `chunks` may be read once."""

    def __init__(self, scenario: Scenario, trials: range, recorded: int) -> None:
        self._scenario = scenario
        self._recorded = recorded
        self._batch = Batch(scenario.slots, len(trials), trials.start)
        self._process = scenario.process.process
        self._keys = StreamKeys.of(scenario)
        self._scheme = SCHEMES[scenario.encoding.scheme](self._process, scenario.encoding.mu_d)
        self._secret = self._keys.secret(self._scheme.secret_streams)
        self.digests: dict[str, dict[int, Digests]] = {name: {} for name in scenario.receivers}
        """Receiver → block number → digests, (R, 32)."""

    def _receiver(self, name: str) -> Receiver:
        if name == LEGITIMATE:
            return self._scheme.estimator(self._secret, self._batch)
        table = self._scenario.eavesdroppers[name]
        keys = self._keys.eavesdropper(name, table.strategy)
        knowledge = Knowledge(self._process, self._scenario.encoding.mu_d, table.parameters, keys)
        return STRATEGIES[table.strategy](knowledge, self._batch)

    def chunks(self) -> Iterator[Slots]:
        """All slots, some tens or hundreds at a time."""
        n, trials, slots = self._process.n, self._batch.trials, self._batch.slots
        names = self._scenario.receivers
        trajectory = Trajectory(self._process, self._keys.process, self._batch)
        encoder = self._scheme.encoder(self._secret, self._batch)
        receivers = {name: self._receiver(name) for name in names}
        links = {name: link_of(self._scenario.link(name).spec, self._keys.link(name), self._batch) for name in names}
        beliefs = {name: receivers[name].prior() for name in names}
        digesters = {name: BlockDigester(n, trials, slots) for name in names}
        length = max(1, min(slots, _CHUNK_NUMBERS // (n * trials)))
        for first in range(0, slots, length):
            count = min(length, slots - first)
            rows = {name: _Rows(count, n, trials, self._recorded) for name in names}
            x = np.empty((count, n, trials))
            nu = np.empty((count, trials), np.bool_)
            for row in range(count):
                k = first + row
                x[row] = trajectory.advance()
                packet = encoder.encode(k, x[row], trajectory.predicted)
                nu[row] = packet.nu
                for name in names:
                    fates = links[name].at(k)
                    delivered = fates == Fate.DELIVERED
                    beliefs[name] = receivers[name].step(k, beliefs[name], delivered, packet.z)
                    digests = digesters[name].add(k, beliefs[name])
                    if digests is not None:
                        self.digests[name][k // BLOCK_SLOTS] = digests
                    rows[name].fill(row, fates, beliefs[name])
            yield Slots(first, x, nu, {name: rows[name].slots() for name in names})
