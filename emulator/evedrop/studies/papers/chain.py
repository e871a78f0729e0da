"""The Markov chain of the legitimate estimator: its limiting distribution compared with simulation.

Source: the paper's appendix, Proposition (limiting distribution).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.schedule import Schedule
from evedrop.model.slot.link import deliveries, link_of
from evedrop.model.streams import Batch, root_of_seed, stream_key
from evedrop.model.theory.closed_forms import step_probabilities, word_probability
from evedrop.show.view.figure_style import OCHRE, SLATE, panels

CASES = ((0.9, 0.6), (0.6, 0.3))
WORDS = ("D", "DI", "DD", "DII", "DID", "DDI", "DDD")
STEPS = 13
_BURN_IN = 200
_LONGEST = 1 << 40  # longer words are not distinguished


@dataclass(frozen=True)
class Occupation:
    """Fractions of slots, mean over trials and its standard error: by step Δ, (2, STEPS), and by word, (2, words)."""

    steps: Floats
    words: Floats
    trials: int
    slots: int


def simulate(mu: float, mu_d: float, trials: int, slots: int, progress: Callable[[str], None]) -> Occupation:
    """Follow link and schedule, and count the estimator's states. A word is stored as bits: 1, then 1 for a drop, 0 otherwise."""
    batch = Batch(_BURN_IN + slots, trials)
    root = root_of_seed(2023)
    link = link_of({"model": "bernoulli", "quality": mu}, stream_key(root, "link/legitimate"), batch)
    schedule = Schedule(stream_key(root, "schedule"), mu_d, batch)
    codes = [int("1" + "".join("1" if event == "D" else "0" for event in word[1:]), 2) for word in WORDS]
    steps, words = np.zeros((STEPS, trials)), np.zeros((len(WORDS), trials))
    word = np.zeros(trials, np.int64)
    progress(f"Markov chain: μ = {mu}, μ_d = {mu_d}")
    for k, gamma in enumerate(deliveries(link, batch.slots)):
        lost = ~gamma
        nu = schedule.at(k)
        grown = np.minimum(2 * word + lost, _LONGEST)
        word = np.where(lost | (nu & (word > 0)), grown, 0)
        if k >= _BURN_IN:
            step = np.frexp(word.astype(np.float64))[1]
            for i in range(STEPS):
                steps[i] += step == i
            for i, code in enumerate(codes):
                words[i] += word == code
    return Occupation(_fractions(steps / slots), _fractions(words / slots), trials, slots)


def draw(path: Path, result: list[Occupation]) -> str:
    """Draw the figure; returns its caption."""
    with panels(path, 2, 9.6, 4.0) as (left, right):
        for index, ((mu, mu_d), occupation, colour, mark) in enumerate(
            zip(CASES, result, (SLATE, OCHRE), ("o", "s"), strict=True)
        ):
            label = rf"$\mu = {mu}$, $\mu_d = {mu_d}$"
            theory = step_probabilities(mu, mu_d, STEPS)
            left.plot(np.arange(STEPS), theory, "-", color=colour, label=label + ", theory")
            left.errorbar(
                np.arange(STEPS), occupation.steps[0], 2.58 * occupation.steps[1], fmt=mark, color=colour, capsize=2.5,
                markersize=4.5, markerfacecolor="white", elinewidth=1.0, label=label + ", simulated",
            )  # fmt: skip
            places = np.arange(len(WORDS)) + 0.4 * (index - 0.5)
            right.bar(places, words_by_theory(mu, mu_d), 0.38, color=colour, alpha=0.35, label=label + ", theory")
            right.errorbar(
                places, occupation.words[0], 2.58 * occupation.words[1], fmt=mark, color=colour, capsize=2.5,
                markersize=4.5, markerfacecolor="white", elinewidth=1.0, label=label + ", simulated",
            )  # fmt: skip
        left.set_yscale("log")
        left.set_ylim(3e-7, 1.5)
        left.set_xlabel(r"steps without synchronisation, $\Delta$")
        left.set_ylabel("fraction of slots")
        left.set_title(r"(a) steps; $\Delta = 0$ is synchronised")
        left.legend(loc="lower left")
        right.set_yscale("log")
        right.set_xticks(np.arange(len(WORDS)), WORDS)
        right.set_xlabel("word: D dropped, I innovation decoded")
        right.set_ylabel("fraction of slots")
        right.set_title("(b) words of up to three events")
    return (
        f"Limiting distribution of the legitimate estimator's Markov chain, {result[0].trials} trials × {result[0].slots} "
        f"slots after {_BURN_IN} slots of burn-in; bars are 99 % intervals over trials."
    )


def words_by_theory(mu: float, mu_d: float) -> Floats:
    """Limiting probability of each of WORDS."""
    return np.array([word_probability(mu, mu_d, word.count("I"), word.count("D") - 1) for word in WORDS])


def _fractions(per_trial: Floats) -> Floats:
    return np.stack([per_trial.mean(axis=1), per_trial.std(axis=1, ddof=1) / np.sqrt(per_trial.shape[1])])
