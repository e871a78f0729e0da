"""A batch of trials in memory: sensor, links and receivers of a scenario, slot by slot, over the model's own code."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from emulator.model.digest import BLOCK_SLOTS, BeliefLog, Digests
from emulator.model.eavesdroppers import STRATEGIES
from emulator.model.eavesdroppers.eavesdropper import Knowledge
from emulator.model.links import link_of
from emulator.model.links.link import Fate, losses
from emulator.model.process import Trajectory
from emulator.model.receiver import Flags, Receiver, trace_of
from emulator.model.schemes import SCHEMES
from emulator.network.access import LEGITIMATE
from emulator.run.briefs import StreamKeys
from emulator.run.joined import ReceiverSlots, Slots
from emulator.scenario import Scenario
from emulator.streams import Batch

_CHUNK_NUMBERS = 131_072  # states of a chunk of slots: about a megabyte an array


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

    def _eavesdropper(self, name: str) -> Receiver:
        table = self._scenario.eavesdroppers[name]
        keys = self._keys.eavesdropper(name, table.strategy)
        knowledge = Knowledge(self._process, self._scenario.encoding.mu_d, table.parameters, keys)
        return STRATEGIES[table.strategy](knowledge, self._batch)

    def chunks(self) -> Iterator[Slots]:
        """All slots, some tens or hundreds at a time; a chunk's arrays are overwritten when the next one is made."""
        n, trials, slots = self._process.n, self._batch.trials, self._batch.slots
        names = self._scenario.receivers
        trajectory = Trajectory(self._process, self._keys.process, self._batch)
        encoder, estimator = self._scheme.pair(self._secret, self._batch)
        receivers = {LEGITIMATE: estimator}
        receivers.update({name: self._eavesdropper(name) for name in self._scenario.eavesdroppers})
        links = {name: link_of(self._scenario.link(name).spec, self._keys.link(name), self._batch) for name in names}
        beliefs = {name: receivers[name].prior() for name in names}
        logs = {name: BeliefLog(n, trials, slots) for name in names}
        length = max(1, min(slots, BLOCK_SLOTS, _CHUNK_NUMBERS // (n * trials)))
        for block in range(0, slots, BLOCK_SLOTS):
            end = min(block + BLOCK_SLOTS, slots)
            for first in range(block, end, length):
                chunk = range(first, min(first + length, end))
                x = np.empty((len(chunk), n, trials))
                nu = np.empty((len(chunk), trials), np.bool_)
                fates = {name: links[name].fates(chunk) for name in names}
                delivered = {name: fates[name] == Fate.DELIVERED for name in names}
                for row, k in enumerate(chunk):
                    x[row] = trajectory.advance()
                    packet = encoder.encode(k, x[row], trajectory.predicted)
                    nu[row] = packet.nu
                    for name in names:
                        beliefs[name] = receivers[name].step(k, beliefs[name], delivered[name][row], packet.z)
                        digests = logs[name].add(k, beliefs[name])
                        if digests is not None:
                            self.digests[name][k // BLOCK_SLOTS] = digests
                yield Slots(
                    chunk.start,
                    x,
                    nu,
                    {name: self._slots(logs[name], chunk, delivered[name], losses(fates[name])) for name in names},
                )

    def _slots(
        self, log: BeliefLog, slots: range, delivered: Flags, lost: Mapping[str, NDArray[np.uint32]]
    ) -> ReceiverSlots:
        rows = log.rows(slots.start, slots.stop)
        trace = trace_of(rows.P.transpose(1, 2, 0, 3))
        sums = np.stack([trace.sum(axis=1), (trace * trace).sum(axis=1)], axis=1)
        return ReceiverSlots(rows.x_hat, rows.action, rows.P[..., : self._recorded], sums, delivered, lost)
