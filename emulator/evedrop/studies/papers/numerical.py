"""The paper's numerical illustration: relative gain J_r / J of the secrecy scheme against μ_d, four eavesdroppers.

Source: the paper, section "Numerical Illustration".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evedrop.model.process import Process
from evedrop.model.theory.covariances import Outcomes, limit_trace, stability_bound
from evedrop.model.theory.design import Against, design
from evedrop.model.theory.ratio import Adversary
from evedrop.show.view.figure_style import GREY, panels
from evedrop.show.view.palette import paper_inks

MU = 0.9
QUALITIES = (0.85, 0.90, 0.95, 0.99)
_LOOKS = {
    0.85: (":", "worse"),
    0.90: ("--", "equal"),
    0.95: ("-", "better"),
    0.99: ("-.", "much better"),
}


def process() -> Process:
    """The paper's matrices, with Σ0 = I."""
    return Process(np.array([[1.0, 0.3], [0.5, 1.001]]), 1e-3 * np.eye(2), np.eye(2))


def designs() -> dict[float, Against]:
    """The designs by the eavesdropper's link quality."""
    smart = [Adversary(f"{mu_e:g}", mu_e, 1.0, 0.0) for mu_e in QUALITIES]
    designed = design(process(), MU, 0.6, smart, slots=80)
    return {mu_e: designed.eavesdroppers[f"{mu_e:g}"] for mu_e in QUALITIES}


def gain(mu_e: float, mu_d: float) -> float:
    """J_r / J at μ_d; inf where the eavesdropper alone is unbounded."""
    ours = limit_trace(process(), Outcomes.legitimate(MU, mu_d))
    return limit_trace(process(), Outcomes.eavesdropper(mu_e, mu_d, 1.0, 0.0)) / ours - 1.0


def draw(path: Path, result: dict[float, Against]) -> str:
    """Draw the figure; returns its caption."""
    low = stability_bound(process(), MU)
    curves = {}
    for mu_e, against in result.items():
        start = max(low, against.bound)
        mu_d = start + (1.0 - start) * np.geomspace(1e-4, 1.0, 240)
        curves[mu_e] = mu_d, [gain(mu_e, value) for value in mu_d]
    names = [f"{mu_e:g}" for mu_e in result]
    inks = paper_inks(names, dict.fromkeys(names, "smart"))
    with panels(path, 2, 9.6, 4.1) as (whole, close):
        for axes in (whole, close):
            axes.axhline(0.0, color="#888888", linewidth=0.8)
            axes.axvline(low, color="#888888", linewidth=0.8)
            for mu_e, against in result.items():
                colour, (line, word) = inks[f"{mu_e:g}"], _LOOKS[mu_e]
                label = f"$\\mu_e = {mu_e:.2f}$ ({word})"
                axes.plot(*curves[mu_e], line, color=colour, label=label)
                if against.best_ratio is not None:
                    axes.plot(against.best_ratio, gain(mu_e, against.best_ratio), "o", color=colour, markersize=5)
                if against.best_difference is not None:
                    axes.plot(
                        against.best_difference, gain(mu_e, against.best_difference), "s", color=colour,
                        markersize=5, markerfacecolor="white",
                    )  # fmt: skip
            axes.set_xlabel(r"probability of sending the state, $\mu_d$")
        perfect = result[0.85].perfect
        if perfect is not None:
            whole.axvspan(*perfect, color=GREY, alpha=0.2, linewidth=0)
            whole.text(
                0.5 * sum(perfect), 7.2, "perfect secrecy vs 0.85", rotation=90, ha="center", va="center", color="#555555",
            )  # fmt: skip
        whole.set_ylabel(r"relative gain $J_r / J$ (dimensionless)")
        whole.set_title("(a) all admissible $\\mu_d$")
        whole.set_xlim(0.5, 1.0)
        whole.set_ylim(-1.2, 10.0)
        whole.text(
            low - 0.004, 5.0, f"stability bound {low:.4f}", rotation=90, ha="right", va="center", color="#666666"
        )
        whole.legend(loc="upper right", title="eavesdropper's link")
        close.set_title("(b) better eavesdroppers, near zero")
        close.set_xlim(0.53, 1.0)
        close.set_ylim(-1.0, 2.6)
        close.plot([], [], "o", color="#555555", markersize=5, label="largest $J_r/J$")
        close.plot([], [], "s", color="#555555", markersize=5, markerfacecolor="white", label="largest $J_r$")
        handles, labels = close.get_legend_handles_labels()
        close.legend(handles[-2:], labels[-2:], loc="lower center")
    return (
        f"Relative gain of the smart eavesdropper's limiting error over the legitimate one, J_r/J, for the paper's A and "
        f"Q and μ = {MU}. Above zero the scheme is secret in the limit. Closed form (Lyapunov equations), no simulation."
    )
