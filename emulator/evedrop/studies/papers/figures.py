"""The paper's figures, and a table of its numbers with ours.

Source: docs/mathematics.md; docs/errata.md for differences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from evedrop.studies.papers import chain, microgrid, numbers, numerical, strategies
from evedrop.studies.papers.paper import silent
from evedrop.studies.papers.reproduction import markdown_table


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
    rows = (*numbers.numerical_illustration(designs), *numbers.microgrid_application(day_means))
    report.write_text(_report(captions, markdown_table(rows), numbers.formulas()), encoding="utf-8")
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
