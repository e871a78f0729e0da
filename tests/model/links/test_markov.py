"""Links that remember: against a slot-by-slot reference, their marginal loss, their bursts, their stationary distribution."""

from __future__ import annotations

from itertools import accumulate
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.links import LOSS_MODELS, loss_of
from evedrop.model.links.loss_model import Fate
from evedrop.model.links.markov import stationary
from evedrop.model.process import Floats
from evedrop.model.slot.link import link_of
from evedrop.model.streams import Batch, Stream, root_of_seed, stream_key, uniforms

KEY = stream_key(root_of_seed(21), "link/eve")
BURSTS: dict[str, Any] = {"model": "gilbert-elliott", "p": 0.02, "r": 0.25}
SOFT = {"model": "gilbert-elliott", "p": 0.1, "r": 0.3, "good": 0.02, "bad": 0.7}
FOUR_STATES = {  # netem's: good, isolated loss, burst, gap within a burst
    "model": "markov",
    "transitions": [[0.9, 0.02, 0.08, 0.0], [1.0, 0.0, 0.0, 0.0], [0.3, 0.0, 0.5, 0.2], [0.0, 0.0, 0.4, 0.6]],
    "loss": [0.0, 1.0, 1.0, 0.0],
}
ROTE = {"model": "pattern", "outcomes": "1101001"}

probabilities = st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 0.5, 1.0]))


def drawn(slots: int, trials: range, per_slot: int) -> Floats:
    """The link's uniforms as the protocol has them, (slots, trials, per slot)."""
    return uniforms(Stream(KEY, trials, per_slot).words(range(slots)))


def two_states(spec: dict[str, Any], u: Floats) -> list[int]:
    """Gilbert–Elliott of one trial, slot by slot: 1 where lost."""
    p, r = spec["p"], spec["r"]
    bad, fates = False, []
    for k, (first, second) in enumerate(u.tolist()):
        if k == 0:
            bad = first < p / (p + r)
        elif bad:
            bad = not first < r
        else:
            bad = first < p
        fates.append(int(second < (spec.get("bad", 1.0) if bad else spec.get("good", 0.0))))
    return fates


def any_chain(spec: dict[str, Any], u: Floats) -> list[int]:
    """A Markov chain's losses in one trial, slot by slot: 1 where lost; what rounding leaves over is the last state's."""
    row, fates = stationary(np.array(spec["transitions"], float)).tolist(), []
    for first, second in u.tolist():
        state, bound = 0, row[0]
        last = max(i for i, chance in enumerate(row) if chance > 0.0)
        while first >= bound and state < last:
            state += 1
            bound += row[state]
        fates.append(int(second < spec["loss"][state]))
        row = spec["transitions"][state]
    return fates


def by_rote(spec: dict[str, Any], u: Floats) -> list[int]:
    """A pattern's losses."""
    return [int(spec["outcomes"][k % len(spec["outcomes"])] == "0") for k in range(len(u))]


REFERENCES = {"gilbert-elliott": two_states, "markov": any_chain, "pattern": by_rote}


@st.composite
def matrices(draw: st.DrawFn, most: int = 5) -> list[list[float]]:
    """Transitions with states that nothing enters or leaves among them, and one state that all can reach."""
    states = draw(st.integers(1, most))
    rows = []
    for i in range(states):
        weights = draw(st.lists(st.integers(0, 8), min_size=states, max_size=states))
        if sum(weights) == 0 or not any(weights[: max(i, 1)]):
            weights[max(i - 1, 0)] += 1  # downwards, to state 0 in the end
        rows.append([weight / sum(weights) for weight in weights])
    return rows


@st.composite
def specs(draw: st.DrawFn) -> dict[str, Any]:
    """Any link that remembers."""
    model = draw(st.sampled_from(sorted(REFERENCES)))
    if model == "gilbert-elliott":
        entries = {name: draw(probabilities) for name in ("p", "r", "good", "bad")}
        if entries["p"] == entries["r"] == 0.0:
            entries["r"] = 0.5
        return {"model": model, **entries}
    if model == "markov":
        rows = draw(matrices())
        return {"model": model, "transitions": rows, "loss": [draw(probabilities) for _ in rows]}
    return {"model": model, "outcomes": draw(st.text("01", min_size=1, max_size=12))}


@settings(deadline=None)
@given(spec=specs(), data=st.data(), slots=st.integers(1, 80), trials=st.integers(1, 5), first=st.integers(0, 2**40))
def test_fates_are_those_of_the_slot_by_slot_reference(
    spec: dict[str, Any], data: st.DataObject, slots: int, trials: int, first: int
) -> None:
    """However the slots are asked for, alone or in a batch, every packet has the fate the reference gives it."""
    parameters = {name: value for name, value in spec.items() if name != "model"}
    assert LOSS_MODELS[spec["model"]].mistakes(parameters) == []
    u = drawn(slots, range(first, first + trials), LOSS_MODELS[spec["model"]].uniforms_per_slot)
    expected = np.array([REFERENCES[spec["model"]](spec, u[:, r]) for r in range(trials)]).T
    link, start, parts = link_of(spec, KEY, Batch(slots, trials, first)), 0, []
    while start < slots:
        stop = data.draw(st.integers(start + 1, slots))
        parts.append(link.fates(range(start, stop)).codes.copy())
        start = stop
    assert np.array_equal(np.concatenate(parts), expected)
    r = data.draw(st.integers(0, trials - 1))
    alone = link_of(spec, KEY, Batch(slots, 1, first + r)).fates(range(slots)).codes
    assert np.array_equal(alone[:, 0], expected[:, r])


@pytest.mark.parametrize("spec", [BURSTS, SOFT, FOUR_STATES, ROTE], ids=["bursts", "soft", "four states", "pattern"])
def test_marginal_loss_of_a_million_packets(spec: dict[str, Any]) -> None:
    """Within the normal bounds of 10⁶ packets at 1e-6 confidence, their number divided by how long a fate is remembered.

    The variance of the mean of n slots is q(1−q)/n · (1 + 2 Σ c_j), with c_j the autocorrelation of the fates: from the
    chain's transitions, computed here by powers.
    """
    slots, trials = 1000, 1000
    lost = float((link_of(spec, KEY, Batch(slots, trials)).fates(range(slots)).codes == Fate.LOST).mean())
    loss, chain = 1.0 - loss_of(spec).quality, loss_of(spec).chain
    if chain is None:
        assert lost == pytest.approx(sum(by_rote(spec, np.empty(slots))) / slots, abs=1e-12)
        assert loss == pytest.approx(spec["outcomes"].count("0") / len(spec["outcomes"]), abs=1e-12)
        return
    memory, ahead, q = 1.0, np.eye(len(chain.stationary)), 1.0 - chain.quality
    for _ in range(400):
        ahead = ahead @ chain.transitions
        memory += 2.0 * float((chain.stationary * q) @ ahead @ q - loss**2) / (loss * (1.0 - loss))
    effective = slots * trials / memory
    assert abs(lost - loss) < 4.9 * np.sqrt(loss * (1.0 - loss) / effective)


@pytest.mark.parametrize("zeros", [0, 1, 3])
def test_rounding_leads_to_no_state_that_cannot_be(zeros: int) -> None:
    """Ten tenths add up to less than 1: the largest uniform number still leads to the tenth state, not to one behind it."""
    row = [0.1] * 10 + [0.0] * zeros
    assert [*accumulate(row)][-1] < 1.0 - 2.0**-54  # sum() compensates since Python 3.12
    chain = loss_of({"model": "markov", "transitions": [row] * len(row), "loss": [0.0] * 9 + [0.5] + [1.0] * zeros})
    u = np.full((3, 2, 1), 1.0 - 2.0**-53)
    u[:, 1] = 0.5
    assert (
        chain.fates(0, u) == Fate.DELIVERED
    ).all()  # 0.5 is not below the tenth state's loss, and is below the others'


def test_a_chain_of_many_states_is_searched_as_one_of_few() -> None:
    """With more bounds than are compared one by one, fates are those of the slot-by-slot reference."""
    weights = [[1 + (i * j) % 5 for j in range(30)] for i in range(30)]
    rows = [[weight / sum(row) for weight in row] for row in weights]
    spec = {"model": "markov", "transitions": rows, "loss": [i / 29 for i in range(30)]}
    u = drawn(200, range(6), 2)
    expected = np.array([any_chain(spec, u[:, r]) for r in range(6)]).T
    assert np.array_equal(link_of(spec, KEY, Batch(200, 6)).fates(range(200)).codes, expected)


def run_lengths(lost: np.ndarray[Any, Any]) -> list[int]:
    """Lengths of the bursts that begin and end within a trial."""
    edges = np.flatnonzero(np.diff(lost.astype(int)))
    starts, ends = edges[lost[edges + 1]], edges[~lost[edges + 1]]
    ends = ends[np.searchsorted(ends, starts[0], "right") :] if len(starts) else ends[:0]
    lengths: list[int] = (ends - starts[: len(ends)]).tolist()
    return lengths


def test_gilbert_elliott_bursts_are_geometric() -> None:
    """With good = 0 and bad = 1 a burst has length l with probability r(1−r)^(l−1): chi-square, at 1e-6 confidence."""
    r = BURSTS["r"]
    lost = link_of(BURSTS, KEY, Batch(200_000, 5)).fates(range(200_000)).codes == Fate.LOST
    lengths = np.array([length for trial in lost.T for length in run_lengths(trial)])
    assert len(lengths) > 10_000
    last = 20
    counts = np.bincount(np.minimum(lengths, last), minlength=last + 1)[1:]
    distribution = np.array([r * (1 - r) ** (length - 1) for length in range(1, last)] + [(1 - r) ** (last - 1)])
    assert stats.chisquare(counts, distribution * counts.sum()).pvalue > 1e-6
    assert lengths.mean() == pytest.approx(1 / r, rel=0.05)


def test_slot_zero_has_the_stationary_distribution() -> None:
    """The first packet is lost as often as any other, at 1e-6 confidence."""
    for spec in (BURSTS, SOFT, FOUR_STATES):
        fates = link_of(spec, KEY, Batch(1, 100_000)).fates(range(1)).codes
        assert stats.binomtest(int(fates.sum()), fates.size, 1.0 - loss_of(spec).quality).pvalue > 1e-6


def test_two_states_are_a_markov_chain() -> None:
    """Gilbert–Elliott and the Markov chain of its transitions have one chain and one quality."""
    spec = {"model": "markov", "transitions": [[0.9, 0.1], [0.3, 0.7]], "loss": [0.02, 0.7]}
    soft, other = loss_of(SOFT), loss_of(spec)
    assert soft.quality == pytest.approx(other.quality, abs=1e-15)
    assert soft.chain is not None
    assert other.chain is not None
    for name in ("transitions", "stationary", "quality"):
        np.testing.assert_allclose(getattr(soft.chain, name), getattr(other.chain, name), atol=1e-15)


@settings(deadline=None)
@given(matrices(7))
def test_the_stationary_distribution_is_the_eigenvector(rows: list[list[float]]) -> None:
    """Elimination finds the left eigenvector of 1 that numpy finds, transient and periodic states among them."""
    T = np.array(rows)
    values, vectors = np.linalg.eig(T.T)
    vector = np.real(vectors[:, np.argmin(np.abs(values - 1.0))])
    distribution = stationary(T)
    np.testing.assert_allclose(distribution, vector / vector.sum(), atol=1e-9)
    np.testing.assert_allclose(distribution @ T, distribution, atol=1e-14)
    assert (distribution >= 0.0).all()
    assert distribution.sum() == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize(
    ("rows", "distribution"),
    [
        ([[1.0]], [1.0]),
        ([[0.0, 1.0], [1.0, 0.0]], [0.5, 0.5]),
        ([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], [1 / 3, 1 / 3, 1 / 3]),
        ([[1.0, 0.0], [0.5, 0.5]], [1.0, 0.0]),
        ([[0.5, 0.5], [0.0, 1.0]], [0.0, 1.0]),
        ([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.0, 0.25, 0.75]], [0.0, 1 / 3, 2 / 3]),
        ([[0.5, 0.0, 0.5], [0.2, 0.6, 0.2], [0.25, 0.0, 0.75]], [1 / 3, 0.0, 2 / 3]),
    ],
    ids=["one state", "period 2", "period 3", "stays first", "stays last", "transient first", "transient between"],
)
def test_stationary_distributions_that_are_known(rows: list[list[float]], distribution: list[float]) -> None:
    """Periodic chains have one too, and a state that is never come back to has probability exactly 0."""
    result = stationary(np.array(rows))
    np.testing.assert_allclose(result, distribution, atol=1e-15)
    assert [value == 0.0 for value in result] == [value == 0.0 for value in distribution]


def test_the_stationary_distribution_is_summed_in_order() -> None:
    """Its bits are those of the protocol's recipe, in binary64: no compensated sum, whatever Python's version does."""
    rows = [[0.1, 0.2, 0.3, 0.4], [0.7, 0.1, 0.1, 0.1], [0.3, 0.3, 0.2, 0.2], [0.15, 0.25, 0.35, 0.25]]
    T, last = np.array(rows), 3
    while last:
        leaves = np.cumsum(T[last, :last])[-1]  # in order, unlike np.sum
        T[:last, last] /= leaves
        T[:last, :last] += T[:last, last, None] * T[last, :last]
        last -= 1
    distribution = np.ones(1)
    for state in range(1, 4):
        distribution = np.append(distribution, np.cumsum(distribution * T[:state, state])[-1])
    assert np.array_equal(stationary(np.array(rows)), distribution / np.cumsum(distribution)[-1])


def test_states_that_are_never_come_back_to_are_no_part_of_the_chain() -> None:
    """Theory is told of the recurrent states alone."""
    chain = loss_of({"model": "markov", "transitions": [[0.9, 0.1], [0.0, 1.0]], "loss": [0.3, 0.2]}).chain
    assert chain is not None
    assert chain.independent
    assert chain.quality.tolist() == [0.8]


@pytest.mark.parametrize("spec", [BURSTS, SOFT, FOUR_STATES])
def test_a_trial_alone(spec: dict[str, Any]) -> None:
    """A trial has the same losses alone, where a loop over numbers is quicker, as among others; also in pieces."""
    loss = loss_of(spec)
    u = drawn(700, range(5), loss.uniforms_per_slot).transpose(0, 2, 1)
    together = loss.fates(0, u)
    for trial in range(5):
        alone, own = loss_of(spec), u[:, :, trial : trial + 1]
        pieces = [alone.fates(start, own[start:stop]) for start, stop in ((0, 1), (1, 300), (300, 301), (301, 700))]
        assert np.array_equal(np.concatenate(pieces)[:, 0], together[:, trial])


@pytest.mark.parametrize(("p", "r", "quality"), [(0.0, 0.5, 0.9), (0.5, 0.0, 0.2)])
def test_a_state_that_is_never_met_does_not_count(p: float, r: float, quality: float) -> None:
    """A link of Gilbert and Elliott that stays in one state loses independently, and so has a limit of the error."""
    chain = loss_of({"model": "gilbert-elliott", "p": p, "r": r, "good": 0.1, "bad": 0.8}).chain
    assert chain is not None
    assert chain.independent
    assert chain.quality == pytest.approx([quality])
    np.testing.assert_array_equal(chain.transitions, [[1.0]])
