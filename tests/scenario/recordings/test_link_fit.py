"""Fitting a recorded link: the estimates against textbook code and against what the recording was made of."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from evedrop.errors import TraceError
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Fate
from evedrop.model.process import Floats
from evedrop.scenario.loading import load
from evedrop.scenario.recordings import link_candidates, link_fit
from evedrop.scenario.recordings.delay_candidates import delay_candidates
from evedrop.scenario.recordings.link_candidates import wilson
from evedrop.scenario.recordings.link_fit import fit
from evedrop.scenario.recordings.link_recording import Outcomes
from evedrop.scenario.recordings.run_lengths import RunLengthDistribution, lengths_of, p_value
from evedrop.scenario.recordings.two_states import ChunkedOutcomes, TwoStates, log_likelihood
from tests.builders import scalar_tables
from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.golden.pages import Golden

BERNOULLI = {"model": "bernoulli", "quality": 0.9}
GILBERT = {"model": "gilbert-elliott", "p": 0.01, "r": 0.1}
SOFT = {"model": "gilbert-elliott", "p": 0.02, "r": 0.1, "good": 0.01, "bad": 0.7}
SLOW = {"model": "gilbert-elliott", "p": 0.002, "r": 0.004, "good": 0.05, "bad": 0.4}


def recorded(spec: dict[str, Any], count: int, seed: int = 0) -> Outcomes:
    """A recording of a link, (count,)."""
    loss = loss_of(spec)
    u = np.random.default_rng(seed).random((count, loss.uniforms_per_slot, 1))
    delivered: NDArray[np.uint8] = (loss.fates(0, u)[:, 0] == Fate.DELIVERED).astype(np.uint8)
    return delivered


def save(folder: Path, outcomes: Outcomes, **more: Any) -> Path:
    """A recording as a file."""
    path = folder / "walk.csv"
    columns = {"received": outcomes, **more}
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join("" if value != value else str(value) for value in row) for row in rows)]  # noqa: PLR0124 - NaN
    path.write_text("\n".join(lines) + "\n")
    return path


def textbook(outcomes: Outcomes, model: TwoStates) -> tuple[float, Any, Any]:
    """Log-likelihood, expected transitions and expected losses by state, from unscaled forward and backward probabilities.

    With one transition into the first slot, from the stationary distribution before it.
    """
    T, loss = model.transitions, model.loss
    distribution = np.array([1.0 - model.in_bad, model.in_bad])
    emission = [loss if outcome == 0 else 1.0 - loss for outcome in outcomes]
    forward, backward = [distribution], [np.ones(2)]
    for e in emission:
        forward.append((forward[-1] @ T) * e)
    for e in reversed(emission):
        backward.append(T @ (e * backward[-1]))
    backward = backward[::-1]
    total = forward[-1].sum()
    moves = sum(np.outer(forward[k], e * backward[k + 1]) * T / total for k, e in enumerate(emission))
    lost = sum(
        (forward[k + 1] * backward[k + 1] / total for k, outcome in enumerate(outcomes) if outcome == 0), np.zeros(2)
    )
    return math.log(total), moves, lost


chances = st.floats(0.01, 0.99)


@settings(deadline=None)
@given(chances, chances, chances, chances, st.lists(st.integers(0, 1), min_size=1, max_size=120))
def test_a_step_is_the_textbooks(p: float, r: float, good: float, bad: float, outcomes: list[int]) -> None:
    """Likelihood and all four parameters after a step, for recordings that fill their chunks and such that do not."""
    model, word = TwoStates(p, r, good, bad), np.array(outcomes, np.uint8)
    likelihood, moves, lost = textbook(word, model)
    following, likelihood_of_word = ChunkedOutcomes(word).step(model)
    assert likelihood_of_word == pytest.approx(likelihood, rel=1e-9)
    assert log_likelihood(word, model) == likelihood_of_word
    expected = (
        moves[0, 1] / moves[0].sum(), moves[1, 0] / moves[1].sum(),
        lost[0] / moves[:, 0].sum(), lost[1] / moves[:, 1].sum(),
    )  # fmt: skip
    assert list(vars(following).values()) == pytest.approx(list(expected), abs=2e-9)


def test_steps_climb() -> None:
    """The likelihood never falls by more than the first outcome's fraction, which the step neglects."""
    chunks, model, before = ChunkedOutcomes(recorded(SOFT, 5000)), TwoStates(0.3, 0.4, 0.2, 0.5), -math.inf
    for _ in range(60):
        model, likelihood = chunks.step(model)
        assert likelihood > before - 0.01
        before = likelihood


@pytest.mark.parametrize("seed", mostly_long([1, 2, 3], [1]))
@pytest.mark.parametrize(
    ("spec", "name", "bounds"),
    [
        pytest.param(BERNOULLI, "bernoulli", {"quality": 0.006}, marks=pytest.mark.long),
        pytest.param(GILBERT, "gilbert", {"p": 0.0015, "r": 0.015}, marks=pytest.mark.long),
        (SOFT, "gilbert-elliott", {"p": 0.0035, "r": 0.017, "good": 0.0035, "bad": 0.04}),
        pytest.param(
            SLOW, "gilbert-elliott", {"p": 0.0012, "r": 0.0024, "good": 0.008, "bad": 0.035}, marks=pytest.mark.long
        ),
    ],
)
def test_the_model_is_found_again(
    spec: dict[str, Any], name: str, bounds: dict[str, float], seed: int, tmp_path: Path
) -> None:
    """From 40 000 outcomes: the right model by BIC, every parameter within about four of its standard errors, good fit."""
    result = fit(save(tmp_path, recorded(spec, 40_000, seed)))
    assert result.chosen.name == name
    for parameter, bound in bounds.items():
        assert result.chosen.spec[parameter] == pytest.approx(spec[parameter], abs=bound)
    assert "as long as the model predicts" in result.goodness
    assert result.bursts.mean == pytest.approx(result.bursts.fitted, rel=0.15)


@pytest.mark.parametrize("spec", mostly_long([GILBERT, SOFT], [SOFT]))
def test_no_parameters_are_more_likely(spec: dict[str, Any]) -> None:
    """Around the maximum that is found the likelihood is less, by more than where the search stopped short of it."""
    outcomes = recorded(spec, 20_000, 4)
    gilbert_elliott = link_candidates.gilbert_elliott(outcomes)
    assert gilbert_elliott.log_likelihood > log_likelihood(
        outcomes, TwoStates(spec["p"], spec["r"], spec.get("good", 1e-9), spec.get("bad", 1 - 1e-9))
    )
    best = [gilbert_elliott.spec[name] for name in ("p", "r", "good", "bad")]
    for place in range(4):
        for factor in (0.8, 1.25):
            other = [
                min(1.0 - 1e-9, max(1e-9, value * (factor if i == place else 1.0))) for i, value in enumerate(best)
            ]
            assert log_likelihood(outcomes, TwoStates(*other)) < gilbert_elliott.log_likelihood + 0.05


def test_gilbert_counts_transitions() -> None:
    """Estimates and likelihood of a recording that can be done by hand."""
    outcomes = np.array([1, 1, 1, 0, 0, 1, 1, 0, 1, 1], np.uint8)  # from good: 4 stay, 2 go; from bad: 1 stays, 2 go
    gilbert = link_candidates.gilbert(outcomes)
    p, r = 2 / 6, 2 / 3
    assert gilbert.spec["p"] == pytest.approx(p, abs=1e-4)
    assert gilbert.spec["r"] == pytest.approx(r, abs=1e-4)
    by_hand = math.log(r / (p + r)) + 4 * math.log(1 - p) + 2 * math.log(p) + math.log(1 - r) + 2 * math.log(r)
    assert gilbert.log_likelihood == pytest.approx(by_hand, rel=1e-12)


@pytest.mark.parametrize("word", ["1" * 60 + "0" * 60, "0" * 60 + "1" * 60, "10" * 60])
def test_extreme_recordings_have_estimates(word: str) -> None:
    """A change that was never seen, and no two alike: parameters are probabilities, likelihoods finite."""
    outcomes = np.array([int(c) for c in word], np.uint8)
    for find in (link_candidates.bernoulli, link_candidates.gilbert, link_candidates.gilbert_elliott):
        result = find(outcomes)
        assert math.isfinite(result.log_likelihood)
        assert all(0.0 <= value <= 1.0 for name, value in result.spec.items() if name != "model")
        loss_of(dict(result.spec))


@pytest.mark.parametrize(("hits", "count"), [(0, 50), (3, 50), (25, 50), (50, 50)])
def test_intervals_are_wilsons(hits: int, count: int) -> None:
    """As SciPy has them."""
    expected = stats.binomtest(hits, count).proportion_ci(method="wilson")
    assert wilson(hits, count) == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.mark.parametrize("spec", [BERNOULLI, GILBERT, SOFT])
def test_the_distribution_of_runs(spec: dict[str, Any]) -> None:
    """Bursts and gaps of half a million outcomes have the expected mean at 1e-6 confidence, and the p-value is not small."""
    outcomes = recorded(spec, 500_000, 7)
    for lost in (True, False):
        lengths, distribution = lengths_of(outcomes == (0 if lost else 1)), RunLengthDistribution.of(spec, lost)
        assert abs(lengths.mean() - distribution.mean) < 4.9 * lengths.std() / math.sqrt(len(lengths))
        assert distribution.mean == pytest.approx(float(distribution.longer(5000)[:-1].sum()), rel=1e-3)
        chance = p_value(lengths, distribution, 0)
        assert chance is not None
        assert chance > 1e-4
        if spec is SOFT:
            other = p_value(
                lengths, RunLengthDistribution.of({"model": "bernoulli", "quality": float(outcomes.mean())}, lost), 1
            )
            assert other is not None
            assert other < 1e-9


def test_a_correct_hidden_chain_is_seldom_doubted() -> None:
    """The p-values of its bursts and gaps are below 0.05 in at most as many recordings as they say, not in two of ten."""
    loss = {"model": "gilbert-elliott", "p": 0.02, "r": 0.1, "good": 0.01, "bad": 0.7}
    low = {"bursts": 0, "gaps": 0}
    for seed in range(40):
        lost = loss_of(loss).fates(0, np.random.default_rng(seed).random((1500, 2, 1)))[:, 0]
        fitted = link_fit.fit_outcomes("walk", (lost == 0).astype(np.uint8), np.empty(0))
        assert fitted.chosen.name == "gilbert-elliott"
        for name in low:
            chance = getattr(fitted, name).p_value
            low[name] += chance is not None and chance < 0.05
    assert max(low.values()) <= 4, low


def test_runs_at_the_ends_do_not_count() -> None:
    """Their lengths are unknown."""
    word = np.array([int(c) for c in "0011101000110"], np.uint8)
    assert lengths_of(word == 0).tolist() == [1, 3]
    assert lengths_of(word == 1).tolist() == [3, 1, 2]
    assert lengths_of(np.ones(5, np.bool_)).tolist() == []


def test_a_link_that_no_model_explains_is_said(tmp_path: Path) -> None:
    """Bursts of exactly seven slots, at random times: the sentence says so, and names the remedy."""
    outcomes, rng = np.ones(20_000, np.uint8), np.random.default_rng(2)
    for start in rng.integers(0, 19_990, 300):
        outcomes[start : start + 7] = 0
    result = fit(save(tmp_path, outcomes))
    assert "does NOT explain" in result.goodness
    assert 'model = "trace"' in result.goodness


def test_few_bursts_tell_nothing_of_the_fit(tmp_path: Path) -> None:
    """Said as such."""
    outcomes = np.ones(200, np.uint8)
    outcomes[[40, 90, 91]] = 0
    assert fit(save(tmp_path, outcomes)).goodness == "too few bursts (2) to tell how well it fits"


def test_bursts_and_gaps_of_one_length_tell_nothing_of_the_fit(tmp_path: Path) -> None:
    """There are enough of them, and a test needs two lengths; a mean length of one is one slot."""
    fitted = fit(save(tmp_path, np.tile(np.array([1, 0], np.uint8), 100)))
    assert fitted.goodness == "the lengths of bursts and gaps differ too little to tell how well it fits"
    assert link_fit.headline(fitted, "outcomes", "slot").endswith("99 bursts, 1 slot on average")


def test_the_goodness_of_fit_names_what_was_judged(tmp_path: Path) -> None:
    """Bursts of one slot leave nothing to test; the gaps between them do."""
    outcomes, rng = np.ones(4000, np.uint8), np.random.default_rng(4)
    outcomes[np.cumsum(1 + rng.geometric(0.2, 600))] = 0
    fitted = fit(save(tmp_path, outcomes))
    assert fitted.bursts.p_value is None
    assert fitted.goodness.startswith("gaps last as long as the model predicts (chi-square, p = ")


def test_a_link_that_is_mostly_bad_is_found() -> None:
    """Long good regimes are rare: the fit is no worse than the model that has produced the recording."""
    loss = {"model": "gilbert-elliott", "p": 0.05, "r": 0.0006, "good": 0.0, "bad": 0.35}
    outcomes = recorded(loss, 20_000, 0)
    actual = log_likelihood(outcomes, TwoStates(0.05, 0.0006, 1e-9, 0.35))
    fitted = link_fit.fit_outcomes("walk", outcomes, np.empty(0))
    assert fitted.chosen.name == "gilbert-elliott"
    assert fitted.chosen.log_likelihood > actual


@pytest.mark.parametrize(
    ("name", "delays", "spec", "bound"),
    [
        ("constant", np.full(500, 3.0), {"value": 3.0}, 0.0),
        ("constant", np.zeros(500), {"value": 0.0}, 0.0),
        (
            "normal",
            8.0 + 1.5 * np.random.default_rng(1).standard_normal(2000),
            {"mean": 8.0, "standard_deviation": 1.5},
            0.15,
        ),
        ("pareto", 2.0 * np.random.default_rng(1).random(2000) ** (-1 / 2.5), {"least": 2.0, "shape": 2.5}, 0.25),
    ],
)
def test_delays_are_found_again(name: str, delays: Any, spec: dict[str, float], bound: float) -> None:
    """The right model by BIC, the parameters within four standard errors."""
    best = min(delay_candidates(delays), key=lambda candidate: candidate.bic(len(delays)))
    assert best.name == name
    assert {entry: best.spec[entry] for entry in spec} == pytest.approx(spec, abs=bound + 1e-12)


@pytest.mark.parametrize(
    "delays",
    [
        0.1 + np.random.default_rng(1).exponential(5e-5, 500),
        10.0 ** np.random.default_rng(1).uniform(-6.0, 6.0, 500),
    ],
)
def test_no_delay_is_proposed_that_a_link_cannot_have(delays: Floats) -> None:
    """Waits that are very short beside the least delay, or very long, are Pareto's with a shape that is refused."""
    for candidate in delay_candidates(delays):
        spec = dict(candidate.spec)
        assert not DELAY_MODELS[spec.pop("model")].mistakes(spec)


@pytest.mark.parametrize(
    ("model", "truth"),
    [
        ("normal", {"mean": 3.3, "standard_deviation": 0.9}),
        ("normal", {"mean": 1.1, "standard_deviation": 1.2}),
        ("normal", {"mean": 40.0, "standard_deviation": 7.0}),
        ("pareto", {"least": 2.6, "shape": 3.0}),
        ("pareto", {"least": 0.4, "shape": 1.2}),
    ],
)
def test_whole_delays_count_slots(model: str, truth: dict[str, float]) -> None:
    """A link delays by 2.7 slots what arrives two slots late: 95 % of the intervals hold the truth; of 200, 86 % by chance."""
    held = dict.fromkeys(truth, 0)
    means = dict.fromkeys(truth, 0.0)
    for seed in range(200):
        rng = np.random.default_rng(seed)
        numbers = rng.standard_normal((400, 1)) if model == "normal" else rng.random((400, 1))
        delays = np.floor(DELAY_MODELS[model](**truth).delays(0, numbers)[:, 0])
        fitted = min(delay_candidates(delays), key=lambda candidate: candidate.bic(len(delays)))
        if fitted.name != model:  # the other one explains a few of the recordings as well
            continue
        for name, value in truth.items():
            means[name] += fitted.exact[name] / 200
            low, high = fitted.intervals.get(name, (value, value))
            held[name] += low <= value <= high
    assert min(held.values()) > 0.86 * 200
    assert means == pytest.approx(truth, rel=0.05)


@pytest.mark.parametrize("delays", [[3.0, 4.0] * 50, [0.0] * 99 + [1.0], [2.0] * 50 + [90.0], [0.0, 10.0] * 9])
def test_few_different_whole_delays_have_models_that_a_link_can_have(delays: list[float]) -> None:
    """Each model gives the observed delays about their fractions."""
    values, counts = np.unique(delays, return_counts=True)
    for candidate in delay_candidates(np.array(delays)):
        spec = dict(candidate.spec)
        model = DELAY_MODELS[spec.pop("model")]
        assert not model.mistakes(spec)
        assert math.isfinite(candidate.log_likelihood)
        if len(values) == 2 and values[1] == values[0] + 1.0:
            arrived = model(**spec).arrived(int(values[0]))
            assert arrived == pytest.approx(counts[0] / counts.sum(), abs=0.02)


def test_intervals_from_few_delays_are_as_wide_as_they_must_be() -> None:
    """Of 2000 recordings of ten delays, 95 % of the intervals hold the truth; by chance, 92.9 % in one of 100 000 tests."""
    held = {"mean": 0, "standard_deviation": 0}
    for delays in 8.0 + 1.5 * np.random.default_rng(3).standard_normal((2000, 10)):
        normal = delay_candidates(delays)[0]
        for name, truth in (("mean", 8.0), ("standard_deviation", 1.5)):
            low, high = normal.intervals[name]
            held[name] += low <= truth <= high
    assert min(held.values()) > 0.929 * 2000


def test_delays_that_are_cut_at_zero_are_found_again() -> None:
    """A normal delay is 0 where the number is below 0: mean and standard deviation are in 95 of 100 intervals, not in none."""
    held = {"mean": 0, "standard_deviation": 0}
    for seed in range(100):
        delays = np.maximum(0.0, 0.5 + np.random.default_rng(seed).standard_normal(400))
        (normal,) = delay_candidates(delays)
        for name, truth in (("mean", 0.5), ("standard_deviation", 1.0)):
            low, high = normal.intervals[name]
            held[name] += low <= truth <= high
    assert min(held.values()) > 85


@pytest.mark.parametrize("late", [[1.5], [3e-3, 4e-3], (10.0 * np.random.default_rng(1).pareto(1.1, 100)).tolist()])
def test_delays_that_are_nearly_all_zero_have_no_mean_below_zero(late: list[float]) -> None:
    """Which no link may have: then half of them are 0, and the others as large as these."""
    (normal,) = delay_candidates(np.array([0.0] * 900 + late))
    assert normal.exact["mean"] == 0.0
    assert normal.exact["standard_deviation"] == pytest.approx(np.sqrt(np.mean(np.square(late))))
    assert normal.intervals["mean"][0] == 0.0 < normal.intervals["mean"][1]
    density = -0.5 * math.log(2.0 * math.pi) - math.log(normal.exact["standard_deviation"]) - 0.5
    assert normal.log_likelihood == pytest.approx(900 * math.log(0.5) + len(late) * density)


@pytest.mark.parametrize(("count", "lost"), [(60_000, 1), (60_000, 2), (20_000, 1)])
def test_a_link_that_loses_almost_nothing_keeps_its_losses(tmp_path: Path, count: int, lost: int) -> None:
    """With four digits, in the link as in the table; gaps are as long as they were."""
    outcomes = np.ones(count, np.uint8)
    outcomes[np.linspace(1000, count - 1000, lost).astype(int)] = 0
    fitted = fit(save(tmp_path, outcomes))
    quality = fitted.link["loss"]["quality"]
    assert 1.0 - quality == pytest.approx(lost / count, rel=1e-3)
    assert fitted.gaps.fitted == pytest.approx(count / lost)
    assert f"quality = {quality:.10g} (" in fitted.chosen.text


def test_delays_beside_outcomes(tmp_path: Path) -> None:
    """A column `delay` is taken by itself, another one by its name; lost packets have none; the line has both models."""
    outcomes = recorded(BERNOULLI, 1000)
    delays = np.where(outcomes == 1, np.round(4.0 + np.random.default_rng(5).random(1000), 3), np.nan)
    path = save(tmp_path, outcomes, delay=delays)
    result = fit(path)
    assert result.delays == int(outcomes.sum())
    assert result.chosen_delay is not None
    link = tomllib.loads(result.toml)["link"]
    assert link["loss"] == result.chosen.spec
    assert link["delay"] == result.chosen_delay.spec
    path.write_text(path.read_text().replace("received,delay", "received,lag"))
    assert fit(path, "received").chosen_delay is None
    assert fit(path, "received", "lag").chosen_delay == result.chosen_delay


@pytest.mark.parametrize(
    "text",
    [
        "1\n0\n" * 49,
        "1\n" * 1000,
        "0\n" * 1000,
        "1\nx\n" * 1000,
        "a,b\n" + "1,0\n" * 200,
        "t,received_ok\n" + "2.5,1\n3.5,0\n" * 200,
        "t,x\n" + "2.5,7\n" * 200,
        "lost\n" + "0\n1\n" * 200,
        "packet_loss,delay\n" + "0,1\n1,\n" * 200,
        "received,delay\n" + "1,\n0,\n" * 100 + "1,2\n" * 5,
        None,
    ],
    ids=[
        "short", "all delivered", "all lost", "another word", "two columns", "a column for outcomes", "no column of outcomes",
        "a column of losses", "another column of losses", "few delays", "no file",
    ],
)  # fmt: skip
def test_what_cannot_be_fitted_is_said(evedrop: Evedrop, text: str | None, golden: Golden) -> None:
    """One line, exit 2: what was found, what can be concluded, what to do."""
    if text is not None:
        (evedrop.folder / "walk.csv").write_text(text)
    done = evedrop("links", "fit", "walk.csv")
    assert (done.status, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert line.startswith("evedrop: walk.csv: ")
    golden("links", line)


def test_the_command_prints_what_can_be_pasted(evedrop: Evedrop) -> None:
    """Every candidate, the one taken, the fit, and last the line; the same for programs; the line is a scenario's."""
    save(evedrop.folder, recorded(GILBERT, 5000, 1))
    done = evedrop("links", "fit", "walk.csv", "--column", "received")
    assert (done.status, done.err) == (0, "")
    lines = done.out.splitlines()
    assert [line.split()[0] for line in lines[2:5]] == ["bernoulli", "*", "gilbert-elliott"]
    assert lines[5].startswith("taken: gilbert, by BIC; its bursts last ")
    fit_ = evedrop("links", "fit", "walk.csv", "--json").summary
    assert fit_["toml"] == lines[-1]
    assert fit_["chosen"] == "gilbert"
    assert [candidate["name"] for candidate in fit_["candidates"]] == ["bernoulli", "gilbert", "gilbert-elliott"]
    assert set(fit_["candidates"][1]["intervals"]) == {"p", "r"}
    assert fit_["outcomes"] == 5000
    scenario = scalar_tables(1.0, 0.01, slots=10, legitimate=tomllib.loads(lines[-1]))
    (evedrop.folder / "mine.toml").write_text(tomli_w.dumps(scenario))
    assert load(evedrop.folder / "mine.toml").legitimate.link.model.chain is not None


def test_json_has_no_infinities(tmp_path: Path) -> None:
    """NaN and infinities are null, so that every program can read the file."""
    outcomes = np.array([1, 0] * 60, np.uint8)
    path = save(tmp_path, outcomes, delay=np.ones(120))
    json.dumps(fit(path).as_dict(), allow_nan=False)


def test_a_directory_is_no_recording(tmp_path: Path) -> None:
    """Said as what it is."""
    with pytest.raises(TraceError, match="it is a folder"):
        fit(tmp_path)


def test_ones_are_losses_only_if_told(evedrop: Evedrop) -> None:
    """A column named lost is read as the command line says; --lost and --column of it are each other's opposites."""
    (evedrop.folder / "walk.csv").write_text("t,lost\n" + "".join(f"{t}.5,{int(t % 10 == 0)}\n" for t in range(200)))
    told = {option: evedrop("links", "fit", "walk.csv", option, "lost", "--json") for option in ("--lost", "--column")}
    assert {option: json.loads(done.out)["lost"] for option, done in told.items()} == {"--lost": 20, "--column": 180}
    both = evedrop("links", "fit", "walk.csv", "--lost", "lost", "--column", "lost")
    assert (both.status, both.out) == (2, "")
    assert "--lost: leave out --column" in both.err
