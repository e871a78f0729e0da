"""The words of a comparison: the cost and secrecy of each scheme, then every pair.

Source: docs/compare.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import TYPE_CHECKING

from evedrop.counting import counted
from evedrop.model.metrics.text import ShownNumber, estimate, fraction_text, number_text
from evedrop.scenario.words import listed
from evedrop.score.summary import RARE_FRACTION
from evedrop.score.verdict import SecrecyOutcome
from evedrop.show.report.closing import rare_events_words
from evedrop.show.report.text_table import TextTable

if TYPE_CHECKING:
    from evedrop.results.comparison import Cell, Comparison, SimulatedError


def comparison_heading(comparison: Comparison) -> str:
    """What was compared, and how much of it."""
    against = " · errors against the sensor's estimate" if comparison.of_estimate else ""
    return f"{comparison.title} · {counted(comparison.slots, 'slot')} · {counted(comparison.trials, 'trial')}{against}"


def schemes_done(comparison: Comparison) -> str:
    """How many schemes were simulated before the comparison was interrupted; empty if it was not."""
    done, left = len(comparison.schemes), len(comparison.not_done)
    return f"{done:,} of {done + left:,} schemes were done" if left else ""


def conclusion(comparison: Comparison) -> str:
    """Which schemes dominate, how many pairs are undecided, and how many schemes were done if not all, in a sentence."""
    verdicts = [
        cell.verdict for scheme in comparison.schemes.values() for cell in scheme.cells.values() if cell.verdict
    ]
    undecided = verdicts.count(SecrecyOutcome.OPEN)
    doubts = [
        f"undecided: {undecided:,} of {len(verdicts):,} pairs" if undecided else "",
        schemes_done(comparison),
    ]
    more = "".join(f"; {doubt}" for doubt in doubts if doubt)
    if comparison.dominant:
        alone = "each of them dominates" if len(comparison.dominant) > 1 else "dominates"
        return (
            f"{', '.join(comparison.dominant)}: {alone}: no other scheme costs the legitimate estimator less in the long run, "
            f"and no other scheme gives the closest adversary a larger error{more}"
        )
    if all(map(comparison.is_beaten, comparison.schemes.values())):
        return (
            "no scheme dominates: each one costs the legitimate estimator more in the long run than another scheme, or gives "
            f"the closest adversary a smaller error{more}"
        )
    if len(comparison.schemes) == 1:
        return f"no scheme dominates: only {next(iter(comparison.schemes))} was compared{more}"
    if comparison.without_limit:
        why = f"theory does not give the legitimate error of {listed(comparison.without_limit)} in the long run, and"
    elif comparison.without_protection:
        return (
            f"no scheme is known to dominate: no adversary counts against {listed(comparison.without_protection)}{more}"
        )
    else:
        why = "theory does not give the errors of all closest adversaries, and"
    return f"no scheme is known to dominate: {why} errors of trials are too inexact to rank schemes{more}"


def comparison_lines(comparison: Comparison) -> Iterator[str]:
    """Notes to the tables: what was left out or is not defined, and what their words mean."""
    yield from left_out_schemes(comparison)
    yield from _undefined(comparison)
    yield from _remarks(comparison)


def schemes_table(comparison: Comparison) -> TextTable:
    """A row for each scheme: its error, its cost, and its closest adversary."""
    numbers = ("legitimate", "theory", "ACKs", "sent", "bits", "energy", "secret", "clear", "leak")
    least = ("theory", "leak", "clear", "sent", "secret", "ACKs", "bits", "energy", "legitimate", "closest adversary")
    table = TextTable.headed(["scheme"], numbers, ["closest adversary", "verdict"], least=least)
    for name, scheme in comparison.schemes.items():
        cell, needs = scheme.closest, scheme.needs
        once = f" + {needs.initial_secret_bits}" if needs.initial_secret_bits else ""
        table.add(
            name,
            simulated(scheme.legitimate),
            theory(scheme.legitimate),
            "yes" if needs.acknowledgements else "–",
            number_text(needs.sent_fraction, ".3g"),
            number_text(needs.bits_per_slot),
            estimate(needs.energy_per_slot, needs.standard_errors["energy_per_slot"] or None, ".3g"),
            f"{needs.secret_bits_per_slot}{once}" if needs.secret_bits_per_slot else "–",
            *(
                ("–", "–")
                if scheme.leak is None
                else (number_text(scheme.leak.clear_fraction, ".3g"), number_text(scheme.leak.bits, ".3g"))
            ),
            *(("–", "–") if cell is None else (cell.match.adversary, verdict(cell))),
        )
    return table


def pairs_table(comparison: Comparison) -> TextTable:
    """A row for each pair of scheme and adversary that is defined."""
    numbers = ("its error", "theory", "z", "legitimate", "theory", "ratio")
    least = ("theory", "legitimate", "z", "its error", "ratio")
    table = TextTable.headed(["scheme", "adversary"], numbers, ["verdict"], least=least)
    for name, scheme in comparison.schemes.items():
        shown = name
        for adversary, cell in scheme.cells.items():
            if cell.eavesdropper is None or cell.legitimate is None:
                continue
            table.add(
                shown,
                adversary if cell.match.attack == "none" else f"{adversary} ({cell.match.strategy})",
                simulated(cell.eavesdropper),
                theory(cell.eavesdropper),
                number_text(cell.eavesdropper.z, "+.1f"),
                simulated(cell.legitimate),
                theory(cell.legitimate),
                estimate(cell.ratio, cell.ratio_error, ".3g"),
                verdict(cell),
            )
            shown = ""
    return table


def simulated(of: SimulatedError) -> str:
    """The mean over trials with its standard error, or the median if the variance is infinite."""
    if of.infinite_variance:
        return number_text(of.typical, ".3g") + " med"
    return estimate(of.mean, of.standard_error, ".3g")


def theory(of: SimulatedError) -> str:
    """The mean that theory expects over the same slots; with ≥ if it is only a bound."""
    if of.theory is None:
        return number_text(None)
    mean = of.theory.mean
    return ShownNumber(f"≥ {mean:.3g}", mean, after="at least") if of.theory.bound else number_text(mean, ".3g")


def verdict(cell: Cell) -> str:
    """The mark and the word of a cell's verdict."""
    return "–" if cell.verdict is None else f"{cell.verdict.glyph} {cell.verdict.value}"


def _rare_fraction(of: SimulatedError | None) -> float:
    return 0.0 if of is None or of.rare_events is None or of.infinite_variance else of.rare_events.fraction


def left_out_schemes(comparison: Comparison) -> Iterator[str]:
    """A line for each scheme that cannot be used with the process."""
    for scheme, why in comparison.left_out.items():
        yield f"left out: {scheme}: {'; '.join(why)}"


def _undefined(comparison: Comparison) -> Iterator[str]:
    """A line for each adversary and reason that a pair is not defined, with its schemes."""
    cells = [cell.match for match in comparison.schemes.values() for cell in match.cells.values()]
    why = sorted((match.adversary, match.not_defined, match.scheme) for match in cells if match.not_defined is not None)
    for (adversary, reason), some in groupby(why, lambda match: match[:2]):
        yield f"not defined: {adversary} {reason} ({', '.join(scheme for _, _, scheme in some)})"


def _remarks(comparison: Comparison) -> Iterator[str]:
    yield (
        "sent: the fraction of slots with a packet; bits, energy: what the sensor sends, headers included, and spends in a "
        "slot on average; secret: the most bits that a slot uses, + bits that a trial uses once; "
        "clear: the fraction of slots whose packet is the state itself; leak: the bits about the path of states that another "
        "packet reveals without the secret"
    )
    schemes = comparison.schemes.values()
    measured = [cell.eavesdropper for scheme in schemes for cell in scheme.cells.values()]
    if any(scheme is not None and scheme.infinite_variance for scheme in measured):
        yield (
            "med: the variance over trials is infinite, so the mean says nothing; this is the median trial, which lies far "
            "below the expectation of theory"
        )
    fractions = {
        name: max(
            map(_rare_fraction, (*scheme.legitimate_errors, *(cell.eavesdropper for cell in scheme.cells.values())))
        )
        for name, scheme in comparison.schemes.items()
    }
    rare = [
        f"{name} up to {fraction_text(fraction)}" for name, fraction in fractions.items() if fraction > RARE_FRACTION
    ]
    if rare and comparison.trials > 1:
        yield (
            f"{rare_events_words(comparison.trials)} carry a part of expected errors, whose means and standard errors are then "
            f"probably too small: {', '.join(rare)}"
        )
    every = [*measured, *(error for scheme in schemes for error in scheme.legitimate_errors)]
    if any(error is not None and error.theory is not None and error.theory.bound for error in every):
        yield (
            "≥: no closed form is known; a lower bound on the expected error, that of an adversary for any receiver without "
            "the secret"
        )
