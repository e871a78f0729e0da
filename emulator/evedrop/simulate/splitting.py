"""Estimates means that rare events dominate, by splitting: trials with large errors are copied, and copies weigh less.

A copy is a trial that reads the random numbers of its ancestor up to the slot of the split (`evedrop.model.streams.Lineage`), so
the simulation is that of all other trials, and nothing in it has to be copied. After a split the slots before it are simulated
again.

Source: docs/mathematics/verdicts.md, splitting; docs/montecarlo.md, rare events.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.metrics.standard_error import standard_error, z_of
from evedrop.model.process import Floats
from evedrop.model.streams import OWN, Batch, BlockReader, Lineage, root_of_seed, stream_key
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import Expectation, expectations_of
from evedrop.score.summary import RareEstimate
from evedrop.simulate.chunk import ReceiverChunk
from evedrop.simulate.simulation import Mode, Simulation

_KEPT = 0.99  # the fraction of trials below the value to which larger ones are cut in the floor of the importance
_LEAST = 1e-3


def importance_floor(errors: Floats, scale: float) -> Floats:
    """The amount c_k that the importance of a trial has in addition to its error, (slots,), from trials of their own (slots, R).

    It is the usual error: without it a trial whose error is 0 would be lost, and with it every later error that it has. The
    few largest errors are cut, so that one of them does not decide. scale: a size of errors, above 0, where all are 0.
    """
    usual = np.minimum(errors, np.quantile(errors, _KEPT, axis=1)[:, None]).mean(axis=1)
    return np.asarray(usual + _LEAST * scale, np.float64)


@final
class SplitPopulations:
    """P independent populations of N trials each, that read slots one by one and are split where they are told to.

    With G the importance of a trial and u its weight, the mean of u f over a population has the expectation E f of a single
    trial, for every quantity f of a trial and any number of splits. All arrays are (P, N).
    """

    def __init__(self, populations: int, size: int) -> None:
        self.weight: Floats = np.ones((populations, size))
        """u, which changes in splits only."""
        self._importance: Floats = self.weight

    def means(self, quantity: Floats) -> Floats:
        """The estimate of E f by each population, (P,)."""
        return np.asarray((quantity * self.weight).mean(axis=1), np.float64)

    def weigh(self, importance: Floats) -> Floats:
        """Take the importance G of the slot's trials; the fraction of them that would count in a split, 1/N … 1, (P,)."""
        self._importance = importance
        product = importance * self.weight
        fraction = product / product.max(axis=1, keepdims=True)
        effective: Floats = fraction.sum(axis=1) ** 2 / (fraction * fraction).sum(axis=1) / fraction.shape[1]
        return effective

    def split(self, uniforms: Floats) -> NDArray[np.intp]:
        """Copy each trial, on average, in proportion to u G within its population; the trials that are copied, (P N,).

        uniforms: one for each population, (P,). Each trial is copied as often as the average, rounded up or down.
        """
        populations, size = self.weight.shape
        product = self._importance * self.weight
        total = product.mean(axis=1)
        cumulated = np.cumsum(product, axis=1)
        marks = (np.arange(size) + uniforms[:, None]) / size * cumulated[:, -1:]
        copied = np.array([np.searchsorted(sums, at, side="right") for sums, at in zip(cumulated, marks, strict=True)])
        copied = np.minimum(copied, size - 1)
        self.weight = total[:, None] / np.take_along_axis(self._importance, copied, axis=1)
        return np.asarray((copied + size * np.arange(populations)[:, None]).reshape(-1), np.intp)


POPULATIONS = 32
LEAST_TRIALS = 100
"""The least number of trials of a population."""
_PILOTS = 8  # populations that decide in which slots all others are split
_SIDE_BY_SIDE = 2000  # trials
_FIRST_TRIAL = 2**47  # far from the trials of any study, so that both are independent
_SPLIT_BELOW = 0.5  # of the trials that count
_WIDEST = 0.1  # of the mean: with a larger standard error the populations are too skewed for it to be true


@final
@dataclass(frozen=True)
class SplitMeans:
    """What populations say about one receiver."""

    errors: Floats
    """The estimate of each slot's mean error by each population, (P, slots)."""
    splits: tuple[int, ...]
    """The slots after which trials were copied."""
    fractions: Floats
    """The fraction of trials of each population that counted in each slot, (slots, P)."""

    @classmethod
    def joined(cls, parts: Sequence[SplitMeans]) -> SplitMeans:
        """The means of several sets of populations that were split after the same slots, in their order."""
        errors = np.concatenate([part.errors for part in parts])
        return cls(errors, parts[0].splits, np.concatenate([part.fractions for part in parts], axis=1))

    @property
    def counting(self) -> float:
        """The least fraction of trials that counted in a slot, in the mean over populations."""
        return float(self.fractions.mean(axis=1).min())

    @property
    def of_populations(self) -> Floats:
        """The mean error of the run by each population, (P,)."""
        return np.asarray(self.errors.mean(axis=1), np.float64)

    def estimate(self, trials: int, expected: Expectation) -> RareEstimate:
        """The entry of the summary; trials: of each population; expected: what theory expects of the receiver."""
        means, count = self.of_populations, len(self.errors)
        about = (count, trials, len(self.splits), self.counting)
        mean, finite, doubt = float(means.mean()), bool(np.isfinite(means).all()), None
        error = standard_error(means) if finite else None
        if not finite:
            doubt = "an error leaves double precision; give fewer slots"
        elif error is not None and error > _WIDEST * mean > 0.0:
            doubt = (
                f"its standard error would be {100 * error / mean:.0f} % of the mean; give more trials or fewer slots"
            )
        if doubt is not None:
            return RareEstimate(None, None, None, *about, doubt, {})
        comparable = expected.known and not expected.of_model
        theory = float(expected.traces(self.errors.shape[1]).mean()) if comparable else None
        slots = {
            "mean_error": self.errors.mean(axis=0).tolist(),
            "standard_error": (self.errors.std(axis=0, ddof=1) / np.sqrt(count)).tolist(),
        }
        return RareEstimate(mean, error, z_of(means, theory), *about, None, slots)


@final
class Splitter:
    """Splits trials of a scenario by the error of one receiver.

    trials: of each population; stopped: asked between slots, ends the work; on_progress: gets the trial-slots done since its
    last call.
    """

    def __init__(
        self,
        scenario: Scenario,
        mode: Mode,
        receiver: str,
        trials: int = LEAST_TRIALS,
        stopped: Callable[[], bool] = lambda: False,
        on_progress: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._scenario, self._mode, self._receiver, self._trials = scenario, mode, receiver, trials
        self._stopped, self._on_progress = stopped, on_progress
        self._key = stream_key(root_of_seed(scenario.seed), f"splitting/{receiver}")
        jammer = None if scenario.acknowledgements is None else scenario.acknowledgements.jammer
        self._others = scenario.eavesdroppers.keys() - {receiver, jammer}
        scale = float(np.trace(scenario.process.process.Q))
        floor = []
        for _, _, sizes in self._chunks(range(_PILOTS), OWN):
            floor.append(importance_floor(sizes, scale))
            on_progress(sizes.size)
            if stopped():
                break
        self._floor = np.concatenate(floor)

    def estimated(self, populations: int = POPULATIONS) -> SplitMeans:
        """The estimates of some populations, split in the slots in which pilots with other trials had to be split."""
        pilots = self._simulated(range(_PILOTS), None)
        groups = self._groups(range(_PILOTS, _PILOTS + populations))
        return SplitMeans.joined([self._simulated(group, pilots.splits) for group in groups])

    def _groups(self, numbers: range) -> Iterator[range]:
        """Populations in groups that are simulated side by side, so that only the pilots need more memory for more trials."""
        count = max(1, _SIDE_BY_SIDE // self._trials)
        return (numbers[i : i + count] for i in range(0, len(numbers), count))

    def _size(self, chunk: ReceiverChunk) -> Floats:
        """What makes a trial important, (c, R): the error, and what the receiver reports of it where both scatter."""
        return chunk.error if self._mode is Mode.COVARIANCE_ONLY else 0.5 * (chunk.error + chunk.trace)

    def _simulated(self, numbers: range, splits: Collection[int] | None) -> SplitMeans:
        """The estimates of the populations with these numbers; splits: after which slots; None: wherever few trials count."""
        count, slots = len(numbers), self._scenario.slots
        size = self._trials
        uniforms = BlockReader(self._key, Batch(slots, count, numbers.start), 1)
        populations, lineage, start = SplitPopulations(count, size), OWN, 0
        errors, fractions, done = np.empty((count, slots)), np.ones((slots, count)), list[int]()
        while start < slots and not self._stopped():
            for k, error, important in self._slots(numbers, lineage, start):
                errors[:, k] = populations.means(error.reshape(count, size))
                fractions[k] = populations.weigh((important + self._floor[k]).reshape(count, size))
                fraction, start = fractions[k].mean(), k + 1
                self._on_progress(count * size)
                if self._stopped():
                    break
                if k + 1 < slots and (fraction < _SPLIT_BELOW if splits is None else k in splits):
                    ancestors = populations.split(uniforms.uniforms(range(k, k + 1))[0, 0])
                    lineage = lineage.split(k + 1, ancestors)
                    done.append(k)
                    break
        return SplitMeans(errors, tuple(done), fractions)

    def _chunks(self, numbers: range, lineage: Lineage) -> Iterator[tuple[int, Floats, Floats]]:
        """The first slot of each chunk, with the errors of the trials of these populations, and their sizes, (c, R)."""
        first = _FIRST_TRIAL + numbers.start * self._trials
        trials = range(first, first + len(numbers) * self._trials)
        simulation = Simulation(self._scenario, trials, self._mode, lineage=lineage, leaving_out=self._others)
        for chunk in simulation.chunks():
            receiver = chunk.receivers[self._receiver]
            yield chunk.first, receiver.error, self._size(receiver)

    def _slots(self, numbers: range, lineage: Lineage, start: int) -> Iterator[tuple[int, Floats, Floats]]:
        """Each slot from `start` on, with the errors of its trials, and what makes them important, (R,)."""
        for first, errors, sizes in self._chunks(numbers, lineage):
            for row in range(max(0, start - first), len(errors)):
                yield first + row, errors[row], sizes[row]


def rare_estimates(
    scenario: Scenario, mode: Mode, stopped: Callable[[], bool], on_progress: Callable[[int], None]
) -> dict[str, RareEstimate]:
    """Receiver → its estimate, by populations that together have at least the scenario's trials; empty once `stopped`."""
    estimates: dict[str, RareEstimate] = {}
    trials, expected = trials_of(scenario), expectations_of(scenario)
    if mode is Mode.COVARIANCE_ONLY:  # theory's own model is simulated, whatever moves the states
        expected = {name: replace(expectation, of_model=False) for name, expectation in expected.items()}
    for name in scenario.receivers:
        means = Splitter(scenario, mode, name, trials, stopped, on_progress).estimated()
        if stopped():
            return {}
        estimates[name] = means.estimate(trials, expected[name])
    return estimates


def trials_of(scenario: Scenario) -> int:
    """The trials of each population."""
    return max(LEAST_TRIALS, -(-scenario.trials // POPULATIONS))


def work_of(scenario: Scenario) -> int:
    """The trial-slots that the populations of all receivers have."""
    return len(scenario.receivers) * (2 * _PILOTS + POPULATIONS) * trials_of(scenario) * scenario.slots
