"""The paper that this project starts from: every number that it prints, its figures, and a table of its numbers with ours.

Source: docs/errata.md for differences; docs/papers/kennedy2022.md; docs/mathematics.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.theory.covariances import Outcomes, stability_bound, theoretical_traces
from evedrop.model.theory.design import Against
from evedrop.model.theory.ratio import Adversary, adversary_bound
from evedrop.studies.papers import chain, microgrid, numerical, strategies
from evedrop.studies.papers.reproduction import NumberVerdict, Paper, Progress, PublishedNumber, markdown_table, silent


@final
class Kennedy2022(Paper):
    """Innovation-based secrecy without acknowledgements; all numbers come from theory, so `quick` changes nothing."""

    title = "Innovation-Based Remote State Estimation Secrecy with no Acknowledgments"
    authors = "J. M. Kennedy, J. J. Ford, D. E. Quevedo, F. Dressler"
    published = "arXiv 2212.08234, 2022"
    text_read = True

    def rows(self, quick: bool, progress: Progress) -> Iterator[PublishedNumber]:  # noqa: ARG002 - there is nothing to shorten
        """The numbers of the numerical illustration and of the microgrid; `evedrop figures` draws their figures."""
        progress("numerical illustration")
        yield from numerical_illustration(numerical.designs())
        progress("microgrid")
        yield from microgrid_application(microgrid.theory(microgrid.DAY))


_INTERCHANGED = "the paper gives the other eavesdropper's value: the values for 0.95 and 0.99 are interchanged"
_LOWER_END = "0.5342 is the legitimate stability bound; just above it J → ∞ while J_e stays finite, so J_r < 0"


def formulas() -> str:
    """The finite-k expectations at k = 1, as corrected and as printed, as a Markdown table.

    Source: docs/errata.md (items 1 and 2).
    """
    process = numerical.process()
    carried = float(np.trace(process.A @ process.initial_covariance @ process.A.T))
    noise = float(np.trace(process.Q))
    start = float(np.trace(process.initial_covariance))
    mu, mu_d = 0.9, 0.6
    lines = ["| receiver | as printed | corrected | recursion |", "|---|---|---|---|"]
    for name, outcomes in (
        ("legitimate", Outcomes.legitimate(mu, mu_d)),
        ("smart", Outcomes.eavesdropper(mu, mu_d, 1.0, 0.0)),
        ("naive", Outcomes.eavesdropper(mu, mu_d, 1.0, 1.0)),
    ):
        rest = outcomes.predicted * noise + outcomes.misled * 2.0 * carried
        printed = outcomes.propagated * (carried if name == "legitimate" else start) + rest
        corrected = outcomes.initial * outcomes.propagated * carried + rest
        recursion = theoretical_traces(process, outcomes, 2)[1]
        lines.append(f"| {name} | {printed:.4f} | {corrected:.4f} | {recursion:.4f} |")
    return "\n".join(lines)


def numerical_illustration(designs: dict[float, Against]) -> list[PublishedNumber]:
    """The numbers of the numerical illustration."""
    where = "numerical illustration"
    process = numerical.process()
    bound = stability_bound(process, numerical.MU)
    worse = adversary_bound(process, Adversary("worse", 0.85, 1.0, 0.0))
    numbers = [
        _compared(where, "ρ(A)", "1.3878", process.spectral_radius),
        _compared(where, "legitimate stability bound", "0.5342", bound),
        _compared(where, "upper end of perfect secrecy, μ_e = 0.85", "0.5656", worse),
    ]
    for mu_e, best, upper in ((0.95, "0.5745", "0.8931"), (0.99, "0.5571", "0.9384")):
        against = designs[mu_e]
        low, high = against.relative[0]
        optimum = float("nan") if against.best_difference is None else against.best_difference
        numbers += [
            _compared(where, f"μ_d that maximises J_r, μ_e = {mu_e}", best, optimum, _INTERCHANGED),
            _compared(where, f"lower end of J_r > 0, μ_e = {mu_e}", "0.5342", low, _LOWER_END),
            _compared(
                where, f"upper end of J_r > 0, μ_e = {mu_e}", upper, high, f"{_INTERCHANGED}, and off in the last digit"
            ),
        ]
    peak = designs[0.99].best_ratio
    numbers.append(
        PublishedNumber.stated(
            where, "J_r > 0 for μ_e = 0.99", '"not apparent" in the figure',
            f"J_r/J up to {numerical.gain(0.99, peak):.3f}" if peak is not None else "none", NumberVerdict.NOT_COMPARABLE,
            "the paper's axis is not known; of the J_r/J that the text names it would be plain to see",
        )
    )  # fmt: skip
    return numbers


def microgrid_application(day: Floats) -> list[PublishedNumber]:
    """The numbers of the microgrid application."""
    where = "microgrid"
    legitimate, smart, naive = day
    ratio = float((smart / legitimate).max())
    return [
        _compared(where, "slots in a day of one-second slots", "86400", 24 * 3600),
        PublishedNumber.stated(
            where, "legitimate day mean", "less than 10⁰", f"{legitimate.max():.3e} … {legitimate.min():.3e}",
            NumberVerdict.AGREES,
        ),
        PublishedNumber.stated(
            where, "eavesdropper day mean, smart as the text says", "greater than 10³",
            f"{smart.max():.3e} … {smart.min():.3e}", NumberVerdict.ERRATUM,
            f"impossible for smart: its ratio to the legitimate one is at most {ratio:.2f}; the naive one with "
            f"Σ0 = 2500 I gives {naive.max():.1e} … {naive.min():.1e}, which may be what was plotted (an inference)",
        ),
        PublishedNumber.stated(
            where, "change of grid power flow at μ_d = 0.1", "below 1.58 %", "not computed", NumberVerdict.NOT_COMPARABLE,
            "the day of solar and load data is no longer published; for a day of our own see docs/microgrid.md",
        ),
    ]  # fmt: skip


def _compared(where: str, quantity: str, paper: str, ours: float, erratum: str = "") -> PublishedNumber:
    """Ours, rounded to our six decimals, within half a unit of the last digit that the paper prints."""
    digits = len(paper.partition(".")[2])
    half = 0.5 * 10.0**-digits
    return PublishedNumber.compared(where, quantity, float(paper), round(ours, 6), absolute=half, erratum=erratum)


@dataclass(frozen=True)
class Size:
    """The amount of simulation. The paper's study of the microgrid has 1000 trials of 86 400 slots."""

    microgrid_trials: int = 200
    microgrid_slots: int = microgrid.DAY
    strategy_trials: int = 100_000
    chain_trials: int = 1000
    chain_slots: int = 6000


DEFAULT_SIZE = Size()


def figures(directory: Path, progress: Callable[[str], None] = silent, size: Size = DEFAULT_SIZE) -> Path:
    """Draw every figure into `directory`, created if necessary, as PNG and PDF, and write `figures.md` there.

    progress receives a line for each step. Takes less than a minute on two cores at the default size.
    """
    directory.mkdir(parents=True, exist_ok=True)
    progress("numerical illustration")
    designs = numerical.designs()
    captions = {"numerical": numerical.draw(directory / "numerical", designs)}
    day = microgrid.simulate(size.microgrid_trials, size.microgrid_slots, progress)
    captions["microgrid"] = microgrid.draw(directory / "microgrid", day)
    runs = strategies.simulate(size.strategy_trials, progress)
    captions["strategies"] = strategies.draw(directory / "strategies", runs)
    occupations = [chain.simulate(*case, size.chain_trials, size.chain_slots, progress) for case in chain.CASES]
    captions["chain"] = chain.draw(directory / "chain", occupations)
    report = directory / "figures.md"
    progress("numbers")
    day_means = day.theory if day.slots == microgrid.DAY else microgrid.theory(microgrid.DAY)
    rows = (*numerical_illustration(designs), *microgrid_application(day_means))
    report.write_text(_report(captions, markdown_table(rows), formulas()), encoding="utf-8")
    return report


_TITLES = {
    "numerical": "Numerical illustration",
    "microgrid": "Microgrid",
    "strategies": "Finite-k expectations of every receiver",
    "chain": "Markov chain of the legitimate estimator",
}


def _report(captions: dict[str, str], table: str, formulas: str) -> str:
    parts = [
        "# The paper's figures and numbers, and ours",
        'The paper is "Innovation-Based Remote State Estimation Secrecy with no Acknowledgments" (Kennedy, Ford, Quevedo, '
        "Dressler). Every figure is also there as PDF. docs/errata.md explains the differences.",
    ]
    for name, caption in captions.items():
        parts += [f"## {_TITLES[name]}", f"![{_TITLES[name]}]({name}.png)", caption]
    parts += [
        "## Every number the paper prints",
        table,
        "## The finite-k formulas at k = 1",
        "tr E P_1 for the example's A and Q, Σ0 = I, μ = μ_e = 0.9, μ_d = 0.6: the paper prints formulas, not these values.",
        formulas,
    ]
    return "\n\n".join(parts) + "\n"
