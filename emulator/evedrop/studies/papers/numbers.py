"""Every number that the founding paper prints, with ours: agreement, erratum, or the reason why it cannot be compared.

Source: docs/errata.md.
"""

from __future__ import annotations

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.theory.covariances import Outcomes, expected_traces, stability_bound
from evedrop.model.theory.design import Against
from evedrop.model.theory.ratio import Adversary, adversary_bound
from evedrop.studies.papers import numerical
from evedrop.studies.papers.reproduction import NumberVerdict, PublishedNumber

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
        printed = outcomes.kept * (carried if name == "legitimate" else start) + rest
        corrected = outcomes.initial * outcomes.kept * carried + rest
        recursion = expected_traces(process, outcomes, 2)[1]
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
