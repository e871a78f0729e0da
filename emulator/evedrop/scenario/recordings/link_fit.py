"""The fit of a link's recording: candidates, the chosen model, its goodness of fit, and the line for the scenario.

Candidates are the models that may have produced the recording, each fitted to it. A hidden chain with two states and two
outcomes is fitted by Baum and Welch's expectation-maximisation: the recording is cut into chunks, and each step of the recursion
is computed for all of them at once: first the effect of each chunk on any state before it, then from chunk to chunk, then inside
the chunks. The goodness of fit compares the lengths of bursts and gaps in the recording and under the model.

The fit of recorded messages is a link for a wire, whose delays are in seconds, and for a scenario, in slots.

Source: Baum, Petrie, Soules, Weiss (1970); Rabiner (1989) for the scaling;
docs/mathematics/links.md, estimating a link; docs/links.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.errors import TraceError
from evedrop.model.checks import toml_of
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.scenario.recordings.link_recording import DELAY, LinkRecording, Outcomes
from evedrop.scenario.recordings.message_recording import COUNTS, MessageRecording

_SCOUTED = 50_000  # outcomes on which starting points are compared
_SCOUTING, _MOST = 40, 400  # steps
_ENOUGH = 0.002  # remaining gain in log-likelihood at which to stop
_NOTHING = 2e-5  # gain in log-likelihood of a step that counts as none
_IN_A_ROW = 4  # such steps before stopping: while a fast gain gives way to a slow one, the estimate is too small
_LEAST = 1e-9
_NEWTON = 20  # steps of Newton's method, which doubles the digits in each of the last ones
_RESCALED = 8  # steps between rescalings of a product of probabilities


@dataclass(frozen=True)
class TwoStates:
    """The parameters of a Gilbert–Elliott link."""

    p: float
    r: float
    good: float
    bad: float

    @property
    def in_bad(self) -> float:
        """Stationary probability of the bad state."""
        return self.p / (self.p + self.r)

    @property
    def transitions(self) -> Floats:
        """From good and bad to good and bad, (2, 2)."""
        return np.array([[1.0 - self.p, self.p], [self.r, 1.0 - self.r]])

    @property
    def loss(self) -> Floats:
        """Probability of a loss in good and bad, (2,)."""
        return np.array([self.good, self.bad])

    def ordered(self) -> TwoStates:
        """The same model with the states named such that bad loses more."""
        return self if self.good <= self.bad else TwoStates(self.r, self.p, self.bad, self.good)

    def log_likelihood_of_states(self, bad: Flags) -> float:
        """The log-likelihood of a recording that shows the states themselves, (packets,)."""
        start = np.array([1.0 - self.in_bad, self.in_bad])
        at = bad.astype(np.intp)
        counts = np.bincount(2 * at[:-1] + at[1:], minlength=4).reshape(2, 2)
        seen = counts > 0
        return float((counts[seen] * np.log(self.transitions[seen])).sum() + np.log(start[at[0]]))


def most_likely(outcomes: Outcomes, starts: Iterable[TwoStates]) -> tuple[TwoStates, float]:
    """The best of the local maxima that expectation-maximisation reaches, and its log-likelihood.

    All starting points take some steps on the first part of the recording; the best two continue to the end on all of it.
    """
    some = ChunkedOutcomes(outcomes[:_SCOUTED])
    scouted = sorted((_climb(some, start, _SCOUTING) for start in starts), key=lambda climbed: -climbed[1])
    whole = ChunkedOutcomes(outcomes)
    model, likelihood = max((_climb(whole, start, _MOST) for start, _ in scouted[:2]), key=lambda climbed: climbed[1])
    return model.ordered(), likelihood


def log_likelihood(outcomes: Outcomes, model: TwoStates) -> float:
    """The log-likelihood of a recording under a model that starts in its stationary distribution."""
    return ChunkedOutcomes(outcomes).step(model)[1]


def _climb(chunks: ChunkedOutcomes, model: TwoStates, steps: int) -> tuple[TwoStates, float]:
    """Alternate expectation and maximisation until little can be gained; returns the best model and its log-likelihood.

    The gains of the steps decrease like a geometric series, whose remainder is estimated from two gains (Aitken).
    """
    best, reached, before, done = model, -np.inf, np.inf, 0
    for _ in range(steps):
        following, likelihood = chunks.step(model)
        gained = likelihood - reached
        if gained > 0.0:
            best, reached = model, likelihood
        done = done + 1 if before > gained and gained * gained / (before - gained) < _ENOUGH else 0
        if gained < _NOTHING or done == _IN_A_ROW:
            break
        model, before = following, gained
    return best, float(reached)


@final
class ChunkedOutcomes:
    """A recording divided into chunks: step t of all chunks is row t."""

    def __init__(self, outcomes: Outcomes) -> None:
        self._count = len(outcomes)
        self._length = max(8, int(0.16 * self._count**0.5))  # balances the time between chunks and inside them
        chunks = -(-self._count // self._length)
        padded = np.full(chunks * self._length, 2, np.uint8)  # 2: unknown
        padded[: self._count] = outcomes
        self._symbols = np.ascontiguousarray(padded.reshape(chunks, self._length).T)
        self._rest = self._count - (chunks - 1) * self._length  # known steps of the last chunk

    def step(self, model: TwoStates) -> tuple[TwoStates, float]:
        """The model after one step of expectation-maximisation, and the log-likelihood of the given model."""
        emission = np.array([model.loss, 1.0 - model.loss, np.ones(2)])[self._symbols]  # (steps, chunks, 2)
        in_good, in_bad = np.ascontiguousarray(emission[..., 0]), np.ascontiguousarray(emission[..., 1])
        starts, ends = self._between(model, in_good, in_bad)
        bad, scale = self._forward(model, in_good, in_bad, starts)
        counts = self._backward(model, in_good, in_bad, bad, scale, ends)
        return _maximised(counts), float(np.log(scale).sum())

    def _between(self, model: TwoStates, in_good: Floats, in_bad: Floats) -> tuple[Floats, Floats]:
        """P(bad) before each chunk, (chunks,), and the likelihood of the rest from good and bad, (2, chunks), up to scale."""
        T, steps, chunks = model.transitions, len(in_good), in_good.shape[1]
        product = np.tile(np.eye(2)[:, :, None], (1, 1, chunks))
        for t in range(steps):
            product = np.stack(
                (
                    (product[:, 0] * T[0, 0] + product[:, 1] * T[1, 0]) * in_good[t],
                    (product[:, 0] * T[0, 1] + product[:, 1] * T[1, 1]) * in_bad[t],
                ),
                axis=1,
            )
            if t % _RESCALED == _RESCALED - 1:
                product /= product.sum(axis=(0, 1))
        maps = product.transpose(2, 0, 1).tolist()
        starts, good, bad = [], 1.0 - model.in_bad, model.in_bad
        for (gg, gb), (bg, bb) in maps:
            starts.append(bad)
            good, bad = good * gg + bad * bg, good * gb + bad * bb
            good, bad = good / (good + bad), bad / (good + bad)
        ends, good, bad = [], 1.0, 1.0
        for (gg, gb), (bg, bb) in reversed(maps):
            ends.append((good, bad))
            good, bad = gg * good + gb * bad, bg * good + bb * bad
            good, bad = good / (good + bad), bad / (good + bad)
        return np.array(starts), np.array(ends[::-1]).T

    def _forward(
        self, model: TwoStates, in_good: Floats, in_bad: Floats, starts: Floats
    ) -> tuple[NDArray[np.float64], Floats]:
        """P(bad) given all up to each step, (steps + 1, chunks), and the probability of its outcome given those before."""
        bad, scale = np.empty((len(in_good) + 1, in_good.shape[1])), np.empty(in_good.shape)
        bad[0] = starts
        for t in range(len(in_good)):
            coming = bad[t] * (1.0 - model.r - model.p) + model.p
            is_bad = coming * in_bad[t]
            scale[t] = is_bad + (1.0 - coming) * in_good[t]
            bad[t + 1] = is_bad / scale[t]
        return bad, scale

    def _backward(
        self, model: TwoStates, in_good: Floats, in_bad: Floats, bad: Floats, scale: Floats, ends: Floats
    ) -> Floats:
        """Expected counts given all outcomes: transitions gg, gb, bg, bb, losses in good, losses in bad."""
        (p, r), steps, chunks = (model.p, model.r), len(in_good), in_good.shape[1]
        after_good, after_bad = ends / (ends[0] * (1.0 - bad[steps]) + ends[1] * bad[steps])
        counts = np.zeros((6, chunks))
        for t in reversed(range(steps)):
            to_good, to_bad = in_good[t] * after_good / scale[t], in_bad[t] * after_bad / scale[t]
            complete = chunks if t < self._rest else chunks - 1
            was_bad = bad[t]
            was_good = 1.0 - was_bad
            moves = (
                was_good * to_good * (1.0 - p),
                was_good * to_bad * p,
                was_bad * to_good * r,
                was_bad * to_bad * (1.0 - r),
            )
            for count, move in zip(counts, moves, strict=False):
                count[:complete] += move[:complete]
            lost = self._symbols[t] == 0
            counts[4] += (moves[0] + moves[2]) * lost
            counts[5] += (moves[1] + moves[3]) * lost
            after_good, after_bad = (1.0 - p) * to_good + p * to_bad, r * to_good + (1.0 - r) * to_bad
        total: Floats = counts.sum(axis=1)
        return total


def _maximised(counts: Floats) -> TwoStates:
    """The parameters that make the expected counts most likely."""
    gg, gb, bg, bb, good_lost, bad_lost = counts.tolist()
    fractions = (
        gb / max(_LEAST, gg + gb),
        bg / max(_LEAST, bg + bb),
        good_lost / max(_LEAST, gg + bg),
        bad_lost / max(_LEAST, gb + bb),
    )
    return TwoStates(*(min(1.0 - _LEAST, max(_LEAST, value)) for value in fractions))


Interval = tuple[float, float]
_NORMAL = 1.959963984540054  # for 95 %


@dataclass(frozen=True)
class Candidate:
    """One model with its most likely parameters."""

    name: str
    exact: Mapping[str, Any]
    """`model`, and the parameters, not rounded."""
    log_likelihood: float
    parameters: int
    """The number of parameters that were estimated."""
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    """95 % confidence intervals, for parameters that have a simple one."""

    @property
    def spec(self) -> dict[str, Any]:
        """The model as a scenario describes it: `model`, and the parameters, rounded."""
        return {name: value if name == "model" else _rounded(name, value) for name, value in self.exact.items()}

    def bic(self, count: int) -> float:
        """Schwarz's criterion for `count` observations; smaller is better."""
        return -2.0 * self.log_likelihood + self.parameters * math.log(count)

    def as_dict(self, count: int) -> dict[str, Any]:
        """The candidate as JSON values."""
        return {
            "name": self.name,
            "spec": self.spec,
            "log_likelihood": self.log_likelihood if math.isfinite(self.log_likelihood) else None,
            "bic": self.bic(count) if math.isfinite(self.log_likelihood) else None,
            "intervals": {name: list(interval) for name, interval in self.intervals.items()},
        }

    @property
    def text(self) -> str:
        """The parameters, with their intervals."""
        parts = []
        for name, value in self.spec.items():
            if name != "model":
                bounds = [f"{_rounded(name, bound):.10g}" for bound in self.intervals.get(name, ())]
                parts.append(f"{name} = {value:.10g}" + (f" ({' … '.join(bounds)})" if bounds else ""))
        return ", ".join(parts)


def wilson(hits: int, count: int) -> Interval:
    """The 95 % confidence interval of a probability, from the number of hits in `count` trials.

    Source: Wilson (1927).
    """
    square = _NORMAL * _NORMAL
    middle = (hits + 0.5 * square) / (count + square)
    half = _NORMAL / (count + square) * math.sqrt(hits * (count - hits) / count + 0.25 * square)
    return max(0.0, middle - half), min(1.0, middle + half)


def normal_interval(value: float, error: float) -> Interval:
    """The 95 % confidence interval of an estimate with this standard error."""
    return value - _NORMAL * error, value + _NORMAL * error


def rounded(value: float) -> float:
    """Rounded to four digits, which is the precision that recordings allow."""
    return float(f"{value:.4g}")


def _rounded(parameter: str, value: float) -> float:
    """The same for a parameter of a model; of a quality close to 1, the rest to 1, the loss, has four digits."""
    loss = 1.0 - value
    if parameter != "quality" or not 0.0 < loss < 0.1:
        return rounded(value)
    return round(value, 3 - math.floor(math.log10(loss)))


def delay_candidates(delays: Floats) -> list[Candidate]:
    """Models for delays in slots, (packets,): constant if all are equal, otherwise normal, or Pareto if none is 0."""
    count, least = len(delays), float(delays.min())
    if least == float(delays.max()):
        return [Candidate("constant", {"model": "constant", "value": least}, 0.0, 1)]
    candidates = [_normal(delays)]
    if least > 0.0:
        logs = float(np.log(delays / least).sum())
        shape = count / logs
        likelihood = count * (math.log(shape) - math.log(least)) - (shape + 1.0) * logs
        candidates.append(
            Candidate(
                "pareto",
                {"model": "pareto", "least": least, "shape": shape},
                likelihood,
                2,
                {"shape": normal_interval(shape, shape / math.sqrt(count))},
            )
        )
    return candidates


def _normal(delays: Floats) -> Candidate:
    """The most likely normal model, whose delays are 0 where the normal number is not above 0."""
    count, mean, standard_deviation = len(delays), float(delays.mean()), float(delays.std())
    likelihood = -0.5 * count * (math.log(2.0 * math.pi * standard_deviation * standard_deviation) + 1.0)
    errors = standard_deviation / math.sqrt(count), standard_deviation / math.sqrt(2.0 * count)
    above = delays[delays > 0.0]
    if len(above) < count:
        scaled, zeros = above / standard_deviation, count - len(above)
        (place, scale), covariance, likelihood = _cut_at_zero(scaled, zeros, mean / standard_deviation)
        likelihood -= len(above) * math.log(standard_deviation)
        mean, standard_deviation = place / scale * standard_deviation, standard_deviation / scale
        to_both = standard_deviation * np.array([[1.0, -place / scale], [0.0, -1.0 / scale]])
        errors = tuple(np.sqrt(np.diag(to_both @ covariance @ to_both.T)).tolist())
    intervals = [normal_interval(*pair) for pair in zip((mean, standard_deviation), errors, strict=True)]
    names = ("mean", "standard_deviation")
    return Candidate(
        "normal",
        {"model": "normal", "mean": mean, "standard_deviation": standard_deviation},
        likelihood,
        2,
        {name: (max(0.0, low), high) for name, (low, high) in zip(names, intervals, strict=True)},
    )


def _cut_at_zero(above: Floats, zeros: int, place: float) -> tuple[Floats, Floats, float]:
    """The most likely mean / sd, at least 0, and 1 / sd of normal numbers of which some are not above 0; the others are these.

    zeros: how many are not above 0; place: a guess of mean / sd, where the sd is about 1. By Newton's method, with steps that
    are halved until the log-likelihood grows, which is concave. Returns also the covariance of both, and the log-likelihood.

    Source: Olsen (1978).
    """
    from scipy.special import log_ndtr  # noqa: PLC0415 - 0.2 s that only this needs

    count, half = len(above), 0.5 * math.log(2.0 * math.pi)

    def likelihood(at: Floats) -> float:
        if at[1] <= 0.0:
            return -math.inf
        away = at[1] * above - at[0]
        return float(zeros * log_ndtr(-at[0]) + count * (math.log(at[1]) - half) - 0.5 * (away * away).sum())

    def derivatives(at: Floats) -> tuple[Floats, Floats]:
        away = at[1] * above - at[0]
        hazard = math.exp(-0.5 * at[0] * at[0] - half - float(log_ndtr(-at[0])))
        slope = np.array([away.sum() - zeros * hazard, count / at[1] - (above * away).sum()])
        mixed, own = -float(above.sum()), count / (at[1] * at[1]) + float((above * above).sum())
        return slope, np.array([[count + zeros * hazard * (hazard - at[0]), mixed], [mixed, own]])

    at = np.array([place, 1.0])
    for _ in range(_NEWTON):
        slope, bend = derivatives(at)
        step = np.linalg.solve(bend, slope)
        while likelihood(at + step) < likelihood(at):
            step *= 0.5
        at = at + step
    if at[0] < 0.0:  # the model has no mean below 0
        at = np.array([0.0, math.sqrt(count / float((above * above).sum()))])
    covariance = np.asarray(np.linalg.inv(derivatives(at)[1]), np.float64)
    return at, covariance, likelihood(at)


def bernoulli(outcomes: Outcomes) -> Candidate:
    """The same quality for every packet."""
    count, hits = len(outcomes), int(outcomes.sum())
    quality = hits / count
    likelihood = hits * math.log(quality) + (count - hits) * math.log1p(-quality)
    return Candidate(
        "bernoulli",
        {"model": "bernoulli", "quality": quality},
        likelihood,
        1,
        {"quality": wilson(hits, count)},
    )


def gilbert(outcomes: Outcomes) -> Candidate:
    """Gilbert's model: good loses nothing and bad everything, so outcomes are states, and their changes are counted."""
    before, after = outcomes[:-1] == 0, outcomes[1:] == 0
    from_bad = int(before.sum())
    from_good = len(before) - from_bad
    worse, better = int((~before & after).sum()), int((before & ~after).sum())
    # A recording that ends or begins in its only burst lacks one of the changes, which then counts as half a change.
    p, r = (worse or 0.5) / max(1, from_good), (better or 0.5) / max(1, from_bad)
    model = TwoStates(min(p, 1.0), min(r, 1.0), 0.0, 1.0)
    return Candidate(
        "gilbert",
        {"model": "gilbert-elliott", "p": model.p, "r": model.r},
        model.log_likelihood_of_states(outcomes == 0),
        2,
        {"p": wilson(worse, max(1, from_good)), "r": wilson(better, max(1, from_bad))},
    )


def gilbert_elliott(outcomes: Outcomes) -> Candidate:
    """Gilbert and Elliott's model with all four parameters, by expectation-maximisation."""
    model, likelihood = most_likely(outcomes, _starts(outcomes))
    return Candidate("gilbert-elliott", {"model": "gilbert-elliott", **vars(model)}, likelihood, 4)


def _starts(outcomes: Outcomes) -> list[TwoStates]:
    """Starting points: Gilbert's own solution, softened, and regimes of tens, hundreds and thousands of slots."""
    loss = 1.0 - float(outcomes.mean())
    own = gilbert(outcomes).spec
    mild, harsh = 0.5 * loss, min(0.95, 0.5 + 0.5 * loss)
    starts = [
        TwoStates(own["p"], own["r"], 0.1 * loss, 0.95),
        TwoStates(0.5 * own["p"], 0.5 * own["r"], mild, harsh),
    ]
    for slots in (20.0, 200.0, 2000.0):
        if slots * 4 < len(outcomes):
            starts.append(TwoStates(0.5 / slots, 1.0 / slots, 0.3 * loss, min(0.95, 2.5 * loss)))
    return [
        TwoStates(*(float(np.clip(value, 1e-4, 0.999)) for value in vars(two_states).values())) for two_states in starts
    ]


_BINS, _LEAST_EXPECTED, _FEWEST = 20, 5.0, 30


def lengths_of(within: Flags) -> NDArray[np.intp]:
    """Lengths of the runs that begin and end within the recording, (runs,)."""
    edges = np.flatnonzero(within[1:] != within[:-1]) + 1
    lengths = np.diff(edges)
    return lengths[within[edges[:-1]]]


@dataclass(frozen=True)
class RunLengthDistribution:
    """How long the runs of one outcome are: for a chain with transitions (states, states), stationary distribution (states,)."""

    transitions: Floats
    stationary: Floats
    chance: Floats
    """Probability of the outcome in each state, (states,)."""

    @classmethod
    def of(cls, spec: Mapping[str, Any], lost: bool) -> RunLengthDistribution:
        """The distribution of the bursts (lost) or gaps of a fitted loss model."""
        if spec["model"] == "bernoulli":
            T, stationary, loss = np.ones((1, 1)), np.ones(1), np.array([1.0 - spec["quality"]])
        else:
            p, r = spec["p"], spec["r"]
            T, stationary = np.array([[1.0 - p, p], [r, 1.0 - r]]), np.array([r, p]) / (p + r)
            loss = np.array([spec.get("good", 0.0), spec.get("bad", 1.0)])
        return cls(T, stationary, loss if lost else 1.0 - loss)

    @property
    def _opening(self) -> Floats:
        """The states in which a run begins, (states,)."""
        opening: Floats = ((self.stationary * (1.0 - self.chance)) @ self.transitions) * self.chance
        opening /= opening.sum()
        return opening

    @property
    def mean(self) -> float:
        """Mean length."""
        stay = self.transitions * self.chance
        return float(
            self._opening @ np.linalg.solve(np.eye(len(self.stationary)) - stay, np.ones(len(self.stationary)))
        )

    def longer(self, most: int) -> Floats:
        """P(length > l) for l = 0 … most, (most + 1,)."""
        stay, at = (self.transitions * self.chance).tolist(), self._opening.tolist()
        probabilities = []
        for _ in range(most + 1):
            probabilities.append(sum_in_order(at))
            at = [sum_in_order(a * row[j] for a, row in zip(at, stay, strict=True)) for j in range(len(at))]
        return np.array(probabilities)


def p_value(lengths: NDArray[np.intp], distribution: RunLengthDistribution, parameters: int) -> float | None:
    """Probability of runs at least as unlikely under the distribution, by Pearson's test. None for too few runs.

    parameters: the number of parameters of the distribution that were estimated from the recording.
    """
    if len(lengths) < _FEWEST:
        return None
    longer = distribution.longer(int(lengths.max()) + 1)
    least = max(_LEAST_EXPECTED, len(lengths) / _BINS)
    bounds, left = [0], float(longer[0])
    for length in range(1, len(longer)):
        if (left - longer[length]) * len(lengths) >= least and longer[length] * len(lengths) >= least:
            bounds.append(length)
            left = float(longer[length])
    if len(bounds) < 2:
        return None
    expected = -np.diff([*longer[bounds], 0.0]) * len(lengths)
    counts = np.bincount(np.searchsorted(bounds, lengths, side="left") - 1, minlength=len(bounds))
    statistic = float(((counts - expected) ** 2 / expected).sum())
    from scipy.stats import chi2  # noqa: PLC0415 - takes a second, which reading recordings does not need

    return float(chi2.sf(statistic, max(1, len(bounds) - 1 - parameters)))


FEWEST = 100
"""The fewest outcomes from which a model can be estimated."""
FEWEST_DELAYS = 10
"""The fewest delays from which a model can be estimated."""
_LEVEL = 0.01


@dataclass(frozen=True)
class RunLengths:
    """Bursts or gaps: runs of lost or delivered packets that begin and end within the recording."""

    count: int
    mean: float | None
    """Slots, observed; None if there are no runs."""
    fitted: float
    """Slots, under the chosen model."""
    p_value: float | None
    """None: too few runs for a test."""


@dataclass(frozen=True)
class Fit:
    """The result of fitting a recording."""

    trace: str
    count: int
    lost: int
    candidates: Sequence[Candidate]
    bursts: RunLengths
    gaps: RunLengths
    delays: int
    """Packets whose delay was measured."""
    delay_candidates: Sequence[Candidate]

    @property
    def chosen(self) -> Candidate:
        """The loss model with the least BIC."""
        return min(self.candidates, key=lambda candidate: candidate.bic(self.count))

    @property
    def chosen_delay(self) -> Candidate | None:
        """The delay model with the least BIC; None if no delays were measured."""
        return min(self.delay_candidates, key=lambda candidate: candidate.bic(self.delays), default=None)

    @property
    def link(self) -> dict[str, Any]:
        """The link as a scenario describes it."""
        delay = self.chosen_delay
        return {"loss": self.chosen.spec} | ({} if delay is None else {"delay": delay.spec})

    @property
    def toml(self) -> str:
        """The line for the scenario."""
        return f"link = {toml_of(self.link)}"

    @property
    def goodness(self) -> str:
        """How well the chosen model explains the lengths of bursts and gaps, in a sentence."""
        told = {"bursts": self.bursts.p_value, "gaps": self.gaps.p_value}
        judged = {name: value for name, value in told.items() if value is not None}
        shown = " and ".join(f"{value:.2g} for {name}" for name, value in judged.items())
        if not judged:
            return f"too few bursts ({self.bursts.count}) to tell how well it fits"
        # Each of two tests has half the level: together they reject a correct model in one of a hundred recordings.
        if min(judged.values()) < _LEVEL / 2.0:
            return (
                f"it does NOT explain how long bursts and gaps last (chi-square, p = {shown}): the link has habits that none "
                'of these models has; use the recording itself, model = "trace"'
            )
        return f"bursts and gaps last as long as the model predicts (chi-square, p = {shown})"

    def as_dict(self) -> dict[str, Any]:
        """The fit as JSON values."""
        delay = self.chosen_delay
        return {
            "trace": self.trace,
            "outcomes": self.count,
            "lost": self.lost,
            "candidates": [candidate.as_dict(self.count) for candidate in self.candidates],
            "chosen": self.chosen.name,
            "bursts": vars(self.bursts),
            "gaps": vars(self.gaps),
            "goodness": self.goodness,
            "delays": self.delays,
            "delay_candidates": [candidate.as_dict(self.delays) for candidate in self.delay_candidates],
            "chosen_delay": None if delay is None else delay.name,
            "link": self.link,
            "toml": self.toml,
        }


def fit(path: Path, column: str | None = None, delay_column: str | None = None, lost: str | None = None) -> Fit:
    """Find the models that may have produced a recording.

    column: that of the outcomes, in a file with several, by default `received`; delay_column: that of delays in slots, by default
    `delay` if present; lost: in place of column, one whose ones are losses.

    Raises TraceError if the file is not a recording, or if nothing can be estimated from it.
    """
    recording = LinkRecording(path)
    names = recording.columns()
    outcomes = recording.outcomes(column, lost)
    _check(str(path), outcomes)
    wanted = delay_column or (DELAY if DELAY in names and DELAY not in {column, lost} else None)
    delays = np.empty(0) if wanted is None else recording.delays(wanted)
    delays = delays[~np.isnan(delays)]
    if wanted is not None and len(delays) < FEWEST_DELAYS:
        problem = f"{wanted} has {len(delays)} delays; expected {FEWEST_DELAYS} or more, such as a longer recording"
        raise TraceError(str(path), "file", problem)
    return fit_outcomes(str(path), outcomes, delays)


def fit_outcomes(name: str, outcomes: Outcomes, delays: Floats) -> Fit:
    """Find the models that may have produced outcomes, (n,), and delays, (d,), which may be empty.

    name: what was recorded, for messages. Raises TraceError if nothing can be estimated.
    """
    _check(name, outcomes)
    candidates = [bernoulli(outcomes), gilbert(outcomes), gilbert_elliott(outcomes)]
    chosen = min(candidates, key=lambda candidate: candidate.bic(len(outcomes)))
    return Fit(
        name,
        len(outcomes),
        int((outcomes == 0).sum()),
        candidates,
        _runs(outcomes, chosen, True),
        _runs(outcomes, chosen, False),
        len(delays),
        delay_candidates(delays) if len(delays) else (),
    )


def _check(name: str, outcomes: Outcomes) -> None:
    """Raise TraceError for a recording from which nothing can be estimated."""
    count, delivered = len(outcomes), int(outcomes.sum())
    if count < FEWEST:
        raise TraceError(name, "file", f"has {count} outcomes; expected {FEWEST} or more, such as a longer recording")
    if delivered in {0, count}:
        low, high = wilson(delivered, count)
        all_or_none, bound = ("delivered", f"at least {low:.4g}") if delivered else ("lost", f"at most {high:.4g}")
        raise TraceError(
            name,
            "file",
            f"has {count} outcomes, all {all_or_none}: the quality is {bound} with 95 % confidence if losses are independent, "
            "and nothing can be said about bursts; expected a recording with both, such as a longer one",
        )


def _runs(outcomes: Outcomes, chosen: Candidate, lost: bool) -> RunLengths:
    lengths = lengths_of(outcomes == 0 if lost else outcomes == 1)
    distribution = RunLengthDistribution.of(chosen.exact, lost)
    # Four parameters come from the order of all outcomes, not from how long these runs are. They follow the runs much less than
    # parameters fitted to them (Chernoff and Lehmann, 1954): taken for such, they let a correct model be rejected too often.
    estimated = 0 if chosen.parameters == 4 else 1
    return RunLengths(
        len(lengths),
        float(lengths.mean()) if len(lengths) else None,
        distribution.mean,
        p_value(lengths, distribution, estimated),
    )


def lines(fitted: Fit) -> list[str]:
    """The fit as printed lines."""
    return [_headline(fitted, "outcomes", "slots"), *model_lines(fitted), fitted.toml]


def _headline(fitted: Fit, packets: str, unit: str) -> str:
    """How much was recorded and lost; packets, unit: what is counted, and what bursts are measured in."""
    fraction = 100.0 * fitted.lost / fitted.count
    mean = "none of them ended" if fitted.bursts.mean is None else f"{fitted.bursts.mean:.4g} {unit} on average"
    counted = f"{fitted.count} {packets}, {fitted.lost} lost ({fraction:.4g} %)"
    return f"{fitted.trace}: {counted}, {fitted.bursts.count} bursts, {mean}"


def model_lines(fitted: Fit) -> list[str]:
    """The candidates, the models that were taken, and how well they fit, as printed lines."""
    told = _table(fitted.candidates, fitted.chosen, fitted.count)
    told.append(f"taken: {fitted.chosen.name}, by BIC; its bursts last {fitted.bursts.fitted:.4g} slots on average")
    told.append(f"fit: {fitted.goodness}")
    if fitted.chosen_delay is not None:
        told.append(f"{fitted.delays} delays")
        told += _table(fitted.delay_candidates, fitted.chosen_delay, fitted.delays)
    return told


def _table(candidates: Sequence[Candidate], chosen: Candidate, count: int) -> list[str]:
    rows = [f"  {'model':<16} {'log-likelihood':>16} {'BIC':>14}  parameters"]
    for tried in candidates:
        mark = "*" if tried is chosen else " "
        rows.append(f"{mark} {tried.name:<16} {tried.log_likelihood:>16.2f} {tried.bic(count):>14.2f}  {tried.text}")
    return rows


@final
@dataclass(frozen=True)
class MessageFit:
    """The result of fitting recorded messages."""

    recording: MessageRecording
    fit: Fit
    """Of losses, and of delays in seconds."""
    slot: float | None
    """Seconds of a slot in a scenario; None: not known."""

    @property
    def settings(self) -> dict[str, Any]:
        """The entries of a link in a wire file, without its sides and keys."""
        return {**self.fit.link, **self._chances}

    @property
    def wire_toml(self) -> str:
        """The link for a wire file."""
        recording = self.recording
        entries = {"from": recording.source, "to": recording.target, "keys": recording.keys, **self.settings}
        return "\n".join(["[[link]]", *(f"{name} = {toml_of(value)}" for name, value in entries.items())])

    @property
    def scenario_link(self) -> dict[str, Any] | None:
        """The link of a scenario, where a message is a slot; None if there are delays, and no slot has a known length."""
        chosen = self.fit.chosen_delay
        if chosen is None:
            return {**self.fit.link, **self._chances}
        if self.slot is None:
            return None
        delay = {
            name: rounded(value / self.slot) if name in _IN_SECONDS else value for name, value in chosen.spec.items()
        }
        return {**self.fit.link, "delay": delay, **self._chances}

    @property
    def _chances(self) -> dict[str, float]:
        series, corrupt = self.recording.series, self.recording.corrupt or 0.0
        # A message that was damaged or dropped does not arrive twice.
        whole = float(series.outcomes.sum()) * (1.0 - corrupt) - self.recording.dropped
        chances = {"duplicate": series.repeated / whole if whole else 0.0, "corrupt": corrupt}
        return {name: rounded(value) for name, value in chances.items() if value}

    def as_dict(self) -> dict[str, Any]:
        """The fit as JSON values."""
        series, link = self.recording.series, self.scenario_link
        return {
            **self.fit.as_dict(),
            **{name: getattr(series, name) for name in COUNTS},
            "outages": list(series.outages),
            "notes": list(self.recording.notes),
            "settings": self.settings,
            "wire": self.wire_toml,
            "slot_seconds": self.slot,
            "link": link,
            "toml": None if link is None else f"link = {toml_of(link)}",
        }


_IN_SECONDS = frozenset({"value", "mean", "standard_deviation", "least"})
"""The parameters of delay models that are times."""


def fit_messages(recording: MessageRecording, slot: float | None = None) -> MessageFit:
    """Find the models that may have produced recorded messages.

    slot: seconds of a slot; None: the median time between two messages.

    Raises TraceError if nothing can be estimated.
    """
    delays = recording.delays if len(recording.delays) >= FEWEST_DELAYS and recording.delays.any() else np.empty(0)
    return MessageFit(
        recording, fit_outcomes(recording.name, recording.series.outcomes, delays), slot or recording.series.seconds
    )


def message_lines(fitted: MessageFit) -> list[str]:
    """The fit as printed lines."""
    fit = fitted.fit
    told = [_headline(fit, "messages", "messages")]
    told += [f"  {sentence}" for sentence in (*_counted(fitted), *fitted.recording.notes)]
    told += [*model_lines(fit), "# for a wire file:", fitted.wire_toml]
    link = fitted.scenario_link
    if link is None:
        return [*told, "# a scenario needs the length of a slot: give --slot SECONDS"]
    if fit.chosen_delay is None:
        return [*told, "# for a scenario in which a message is a slot:", f"link = {toml_of(link)}"]
    return [*told, f"# for a scenario with slots of {fitted.slot:.4g} s:", f"link = {toml_of(link)}"]


def _counted(fitted: MessageFit) -> list[str]:
    """What else happened to the messages, in sentences."""
    series = fitted.recording.series
    told = []
    if series.repeated:
        told.append(f"{series.repeated} arrived twice")
    if series.late:
        told.append(f"{series.late} arrived after a later one")
    if series.restarts:
        told.append(f"the numbers began again {_times(series.restarts)}: the sender was started again")
    if series.leaps:
        told.append(
            f"the numbers leapt ahead {_times(series.leaps)} faster than messages could be lost: not counted as losses"
        )
    if series.outages:
        told.append(
            f"{len(series.outages)} silences, the longest of {max(series.outages):.4g} s, were longer than --outage: "
            "not counted as losses; in a wire file they are an [[event]] with cut"
        )
    if series.parts > 1:
        told.append(f"{series.parts} parts, joined: losses between two parts are not known")
    return told


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
