"""Comparisons: which schemes meet which adversaries, with which losses and verdicts, and the numbers of the literature."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evedrop import compare, montecarlo
from evedrop.cli.api.results import ComparisonResults
from evedrop.errors import UsageError
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.schemes import SCHEMES
from evedrop.model.theory.closed_forms import encrypted_fraction
from evedrop.results.comparison import Cell, Comparison, SimulatedError, Theory, read_comparison
from evedrop.results.summary_file import plain
from evedrop.scenario.loading import load
from evedrop.score.summary import RareEvents
from evedrop.score.verdict import SecrecyOutcome
from evedrop.show.report.comparison import comparison_lines, conclusion, verdict
from evedrop.show.report.comparison_sections import COMPARISON_SECTIONS, ComparisonSource
from evedrop.show.report.writing import write_report
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from evedrop.studies.matchups import ATTACKERS, usual_adversaries
from tests.pages import Checked, checked

pytestmark = pytest.mark.thorough

MARGINAL: dict[str, Any] = {"slots": 60, "trials": 30, "process__initial_covariance": [[1e-3, 0.0], [0.0, 1e-4]]}
"""Changes of `bayesian`: long enough for verdicts, and trials that lose the first slot do not dominate the mean."""

VERDICTS = {
    ("plain", "naive"): SecrecyOutcome.BROKEN,
    ("cipher", "naive"): SecrecyOutcome.PERFECT,
    ("innovation", "naive"): SecrecyOutcome.PERFECT,
    ("acknowledged", "reference"): SecrecyOutcome.PERFECT,
    ("acknowledged", "blocks-critical"): SecrecyOutcome.BROKEN,
    ("acknowledged", "blocks-all"): SecrecyOutcome.BROKEN,
    ("acknowledged", "hijacks"): SecrecyOutcome.PERFECT,  # no acknowledgement is lost
    ("open-loop", "reference"): SecrecyOutcome.PERFECT,
    ("open-loop", "forges"): SecrecyOutcome.BROKEN,
    ("twin-track", "naive"): SecrecyOutcome.PERFECT,
    ("twin-track", "tracker"): SecrecyOutcome.PERFECT,
    ("twin-track", "replay-informed"): SecrecyOutcome.RELATIVE,
    ("innovation", "genie"): SecrecyOutcome.RELATIVE,
}

Everything = tuple[Comparison, Path]


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Everything:
    """All schemes against all adversaries with a marginally stable process, by two workers, and the folder."""
    folder = tmp_path_factory.mktemp("compare") / "run"
    return compare("bayesian", out=folder, plan=Plan(workers=2), **MARGINAL), folder


@pytest.fixture(scope="module")
def literature(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """The scenario `acknowledged`, whose last slot is k = 40, with the schemes of its paper and of ours, and their bounds."""
    schemes = ["acknowledged", "open-loop", "innovation", "plain", "cipher"]
    return compare("acknowledged", schemes=schemes, trials=100, out=tmp_path_factory.mktemp("compare") / "run")


def last(comparison: Comparison, scheme: str, adversary: str) -> tuple[float, float]:
    """Theory of the last slot: the adversary's, and the legitimate estimator's meanwhile."""
    cell = comparison.cell(scheme, adversary)
    assert cell.eavesdropper is not None
    assert cell.eavesdropper.theory is not None
    assert cell.legitimate is not None
    assert cell.legitimate.theory is not None
    return cell.eavesdropper.theory.last, cell.legitimate.theory.last


def test_every_pair_is_there_or_says_why_not(everything: Everything) -> None:
    """Every scheme has a cell for every adversary: two errors and a verdict, or a reason."""
    comparison, _ = everything
    assert set(comparison.schemes) == set(SCHEMES)
    assert set(STRATEGIES) | set(ATTACKERS) == {*comparison.adversaries, "learning-em", "learning-particle"}
    assert set(usual_adversaries(load("learning"))) == {*comparison.adversaries, "learning-em"}
    for scheme in comparison.schemes.values():
        assert tuple(scheme.cells) == comparison.adversaries
        for cell in scheme.cells.values():
            played = [cell.eavesdropper, cell.legitimate, cell.secrecy, cell.ratio]
            assert [cell_ is None for cell_ in played] == [cell.match.not_defined is not None] * 4


@pytest.mark.thorough
def test_a_comparison_is_read_back_and_has_its_page(everything: Everything) -> None:
    """compare.json has the results; every pair has its cell on the page."""
    comparison, folder = everything
    again = read_comparison(folder)
    assert str(plain(again.as_dict())) == str(plain(comparison.as_dict()))
    write_report(folder)
    page = checked(folder)
    assert page.values("class").count("verdict") == len(comparison.schemes) * len(comparison.adversaries)
    for scheme in comparison.schemes.values():
        assert {verdict(cell) for cell in scheme.cells.values() if cell.verdict is not None} <= set(page.texts)


@pytest.mark.parametrize(
    ("entry", "value"), [("relative", "nonsense"), ("perfect", "nonsense"), ("ratio_from", None), ("verdict", None)]
)
def test_a_comparison_with_an_entry_that_means_nothing_is_refused(
    everything: Everything, tmp_path: Path, entry: str, value: str | None
) -> None:
    """Words that are no verdict, and entries that an older version did not write."""
    data = json.loads((everything[1] / "compare.json").read_text())
    cells = (cell for scheme in data["schemes"].values() for cell in scheme["against"].values())
    secrecy = next(cell["secrecy"] for cell in cells if "secrecy" in cell)
    if value is None:
        del secrecy[entry]
    else:
        secrecy[entry] = value
    (tmp_path / "compare.json").write_text(json.dumps(data))
    with pytest.raises(UsageError, match=value or entry):
        read_comparison(tmp_path)


def test_the_matrix_leaves_out_adversaries_that_no_scheme_defines(everything: Everything) -> None:
    """Their columns would be empty; the caption names them."""
    comparison, folder = everything
    alone = replace(comparison, schemes={"cipher": comparison.schemes["cipher"]})
    (matrix,) = COMPARISON_SECTIONS["Verdicts"](ComparisonSource(folder, alone))
    page = Checked(matrix)
    assert {"scheme", "naive", "cipher"} <= set(page.texts)
    assert "smart" not in page.texts
    assert any("smart" in text and "for every scheme" in text for text in page.texts)


@pytest.mark.parametrize(
    ("scheme", "adversary", "why"),
    [
        ("cipher", "smart", "schedule"),
        ("twin-track", "suspicious", "schedule"),
        ("plain", "bayesian", "innovations"),
        ("innovation", "reference", "references"),
        ("acknowledged", "selective", "header"),
        ("innovation", "tracker", "two tracks"),
        ("innovation", "blocks-critical", "acknowledgements"),
    ],
)
def test_pairs_that_mean_nothing_say_why(everything: Everything, scheme: str, adversary: str, why: str) -> None:
    """By what is lacking."""
    reason = everything[0].cell(scheme, adversary).match.not_defined
    assert reason is not None
    assert why in reason


def test_an_adversary_that_learns_a_state_is_not_the_closest(literature: Comparison) -> None:
    """Of two adversaries, the one with the larger error is the closest if the other is given a true state."""
    innovation = literature.schemes["innovation"]
    first = innovation.closest
    assert first is not None
    betrayed = replace(first, match=replace(first.match, betrayed=True))
    then = replace(innovation, cells={**innovation.cells, first.match.adversary: betrayed})
    assert then.closest is not None
    assert then.closest.match.adversary != first.match.adversary
    assert then.protection > innovation.protection


def test_every_adversary_is_played_somewhere(everything: Everything) -> None:
    """None is there to be refused alone, and each scheme that needs acknowledgements meets all attacks on them."""
    comparison, _ = everything
    for adversary in comparison.adversaries:
        assert any(comparison.cell(scheme, adversary).eavesdropper for scheme in comparison.schemes)
    for name, scheme in SCHEMES.items():
        for attacker in ATTACKERS:
            assert (comparison.cell(name, attacker).eavesdropper is not None) == scheme.needs_acknowledgements


def test_a_cell_is_a_study_of_its_own(everything: Everything, tmp_path: Path) -> None:
    """The scenario that the folder has of a scheme gives the metrics of its cells, by `montecarlo`, to the bit."""
    comparison, folder = everything
    for file, scheme in (("innovation", "innovation"), ("acknowledged-blocks-critical", "acknowledged")):
        alone = montecarlo(folder / "scenarios" / f"{file}.toml", trials=comparison.trials, out=tmp_path / file).summary
        matched = [cell for cell in comparison.schemes[scheme].cells.values() if cell.match.strategy in alone["peers"]]
        attack = "none" if file == scheme else "critical"
        matched = [cell for cell in matched if cell.match.attack == attack]
        assert matched
        for cell in matched:
            peer = alone["peers"][cell.match.receiver]
            assert cell.eavesdropper is not None
            assert cell.legitimate is not None
            assert cell.secrecy is not None
            assert cell.eavesdropper.mean == peer["mean_squared_error"]
            assert cell.eavesdropper.quantiles == peer["error_quantiles"]
            assert cell.eavesdropper.standard_error == peer["standard_errors"]["mean_squared_error"]
            assert cell.eavesdropper.z == pytest.approx(peer["z"]["mean_squared_error"])
            rare = cell.eavesdropper.rare_events
            assert (None if rare is None else asdict(rare)) == peer["rare_events"]
            medians = cell.eavesdropper.infinite_variance or cell.legitimate.infinite_variance
            assert (cell.ratio_error is None) is medians
            assert cell.legitimate.mean == alone["peers"]["legitimate"]["mean_squared_error"]
            assert asdict(cell.secrecy) == alone["secrecy"][cell.match.receiver]


def test_all_schemes_have_the_same_trials_and_losses(everything: Everything) -> None:
    """An eavesdropper that reads what any scheme sends unencrypted has the error that it has against `plain`."""
    comparison, _ = everything
    legitimate = comparison.schemes["plain"].legitimate.mean
    assert comparison.schemes["cipher"].legitimate.mean == pytest.approx(legitimate, rel=1e-9)
    assert comparison.schemes["acknowledged"].legitimate.mean == pytest.approx(legitimate, rel=1e-6)
    constant = {scheme: comparison.cell(scheme, "constant").eavesdropper for scheme in SCHEMES}
    assert len({mean.mean for scheme, mean in constant.items() if mean is not None and scheme != "twin-track"}) == 1
    blocked = comparison.cell("scheduled", "blocks-all").eavesdropper
    clear = comparison.cell("plain", "naive").eavesdropper
    assert blocked is not None
    assert clear is not None
    assert blocked.mean == clear.mean


def test_simulation_agrees_with_theory(everything: Everything) -> None:
    """No mean over trials has a z-score beyond 4.5, legitimate estimator and adversary of every pair that has one."""
    judged = 0
    for scheme in everything[0].schemes.values():
        for cell in scheme.cells.values():
            for peer in (cell.eavesdropper, cell.legitimate):
                if peer is None or peer.z is None:
                    continue
                assert abs(peer.z) < 4.5, cell.match
                judged += 1
    assert judged > 40


def test_trials_alone_do_not_rank_schemes(tmp_path: Path) -> None:
    """Without a closed form for the link, as with a recording, it is not said that no scheme dominates."""
    trace = {"model": "pattern", "outcomes": "1101110111"}
    result = compare(
        "bayesian",
        schemes=["cipher", "plain"],
        adversaries=["smart"],
        out=tmp_path,
        expect=[],
        legitimate__link={"loss": trace},
        **MARGINAL,
    )
    assert not result.dominant
    assert result.without_limit == ("cipher", "plain")
    assert conclusion(result).startswith("no scheme is known to dominate: theory does not give")


def test_a_mean_over_a_run_is_no_price(tmp_path: Path) -> None:
    """A scheme without a limit in theory has the mean of the run, start included; it is not compared with limits of others.

    From a large start the mean of `random-code` over the run is above the limit of `innovation`, and its long run is below.
    """
    start: dict[str, Any] = {
        "process__initial_covariance": [[1.0, 0.0], [0.0, 0.1]],
        "process__A": [[0.95, 0.1], [0.0, 0.9]],
    }
    result = compare(
        "bayesian",
        schemes=["innovation", "random-code"],
        adversaries=["naive", "constant"],
        out=tmp_path,
        expect=[],
        slots=200,
        trials=10,
        **start,
    )
    innovation, code = result.schemes.values()
    assert innovation.price < code.price
    assert innovation.protection > code.protection
    assert code.price_range[0] < innovation.price < code.price_range[1]
    assert code.legitimate.theory is not None
    assert code.legitimate.theory.bound
    assert (result.dominant, result.without_limit) == ((), ("random-code",))
    assert conclusion(result).startswith(
        "no scheme is known to dominate: theory does not give the legitimate error of rand"
    )


def test_trials_bound_an_error_unless_rare_events_matter() -> None:
    """Within three standard errors of many trials, and not below what theory allows; a lower bound of theory is no limit."""
    error = SimulatedError(4.0, 0.1, {"0.5": 3.9}, infinite_variance=False, theory=None)
    above = replace(error, theory=Theory(3.9, 3.9, 5.0, bound=True))
    assert error.expected(10**6) == pytest.approx((3.7, 4.3), rel=1e-5)
    assert above.expected(10**6) == pytest.approx((3.9, 4.3), rel=1e-5)
    assert above.lasting == (5.0, math.inf)
    assert replace(error, theory=Theory(3.9, 3.9, 5.0, bound=False)).expected(10**6) == (3.9, 3.9)
    assert replace(error, theory=Theory(3.9, 3.9, 5.0, bound=False)).lasting == (5.0, 5.0)
    assert replace(error, rare_events=RareEvents(0.2, 1e4)).expected(10**6) == (0.0, math.inf)
    assert replace(error, standard_error=None).expected(10**6) == (0.0, math.inf)
    assert error.expected(2) == pytest.approx((0.0, 27.58), abs=0.01)
    assert error.lasting == (0.0, math.inf)


def test_pairs_that_a_short_run_leaves_open_are_not_said_to_need_trials(tmp_path: Path) -> None:
    """No number of trials of five slots decides them."""
    result = compare("vehicle", schemes=["plain"], adversaries=["naive"], out=tmp_path, slots=5, trials=4, expect=[])
    verdict = result.cell("plain", "naive").secrecy
    assert verdict is not None
    assert verdict.verdict is not None
    assert verdict.verdict.reason.startswith("the run has too few slots")
    assert conclusion(result).endswith("; undecided: 1 of 1 pairs")


def test_rare_events_that_carry_the_legitimate_error_are_said(tmp_path: Path) -> None:
    """A lost first packet, which ten trials lack; the adversary is as far off with it as without."""
    result = compare(
        "vehicle", schemes=["innovation"], adversaries=["naive"], out=tmp_path, slots=60, trials=10, expect=[]
    )
    legitimate, naive = result.schemes["innovation"].legitimate, result.cell("innovation", "naive").eavesdropper
    assert legitimate.theory is not None
    assert legitimate.theory.mean > 50.0 * legitimate.mean
    assert naive is not None
    assert naive.rare_events is not None
    assert naive.rare_events.fraction < 0.1
    assert any(line.endswith(": innovation up to more than 99 %") for line in comparison_lines(result))


def test_the_picture_says_which_error_is_a_median(literature: Comparison) -> None:
    """As the table does."""

    def texts(heavy: str) -> list[str]:
        schemes = {
            name: replace(scheme, legitimate=replace(scheme.legitimate, infinite_variance=name == heavy))
            for name, scheme in literature.schemes.items()
        }
        shown = replace(literature, schemes=schemes)
        assert isinstance(shown, ComparisonResults)
        axes = shown.plot().axes[0]
        return [text.get_text() for text in axes.texts]

    means, medians = texts("none"), texts("plain")
    assert not any(text.endswith("\nmed") or "med:" in text for text in means)
    assert sum(text.endswith("\nmed") for text in medians) == 1
    assert medians[-1].endswith("med: the median trial, since the variance over trials is infinite.")


def test_a_scheme_alone_does_not_dominate(literature: Comparison) -> None:
    """Nor does one if no adversary counts against it."""
    alone = replace(literature, schemes={"cipher": literature.schemes["cipher"]})
    assert alone.dominant == ()
    assert conclusion(alone).startswith("no scheme dominates: only cipher was compared")
    plain_, cipher = (literature.schemes[name] for name in ("plain", "cipher"))
    untouched = replace(literature, schemes={"plain": replace(plain_, cells={}), "cipher": cipher})
    assert untouched.dominant == ()
    assert conclusion(untouched).startswith("no scheme is known to dominate: no adversary counts against plain")


@pytest.mark.long
def test_the_cipher_dominates(everything: Everything, literature: Comparison) -> None:
    """Nothing is cheaper for the legitimate estimator in the long run, and nothing keeps every adversary further off."""
    assert everything[0].dominant == literature.dominant == ("cipher",)


def test_verdicts(everything: Everything) -> None:
    """Plain packets are an open book; an error that grows without bound is perfect secrecy; equal errors are none."""
    comparison, _ = everything
    assert {pair: comparison.cell(*pair).verdict for pair in VERDICTS} == VERDICTS


def test_one_trial_decides_nothing(tmp_path: Path) -> None:
    """But what theory alone decides: too few trials to tell is the verdict, and no standard error is given."""
    result = compare(
        "bayesian", schemes=["innovation"], adversaries=["naive", "smart"], trials=1, slots=40, out=tmp_path
    )
    for adversary in ("naive", "smart"):
        cell = result.cell("innovation", adversary)
        assert cell.eavesdropper is not None
        assert cell.verdict is SecrecyOutcome.OPEN
        assert cell.eavesdropper.standard_error is None


def test_what_each_scheme_needs(everything: Everything) -> None:
    """Two states: payload and header of 64-bit numbers, and the secret of docs/schemes.md."""
    needs = {name: scheme.needs for name, scheme in everything[0].schemes.items()}
    assert {name: (need.payload_bits, need.header_bits) for name, need in needs.items()} == {
        **dict.fromkeys(SCHEMES, (128, 0)),
        "acknowledged": (128, 64),
        **dict.fromkeys(("open-loop", "random-code", "threshold-code"), (128, 128)),
        **dict.fromkeys(("encrypted-schedule", "partial-encryption"), (128, 64)),
        "quantised-schedule": (16, 1),
    }
    secret = {name: (need.secret_bits_per_slot, need.initial_secret_bits) for name, need in needs.items()}
    assert secret == {
        **dict.fromkeys(SCHEMES, (0, 0)),
        "cipher": (128, 0),
        **dict.fromkeys(("encrypted-schedule", "quantised-schedule"), (128, 0)),
        "innovation": (192, 0),
        "noise": (64, 0),
        "partial-encryption": (64, 0),
        "twin-track": (64, 256),
    }
    assert {name for name, need in needs.items() if need.acknowledgements} == {
        "acknowledged",
        "encrypted-schedule",
        "open-loop",
        "quantised-schedule",
        "random-code",
        "scheduled",
        "threshold-code",
    }
    assert needs["plain"].sent_fraction == 1.0
    assert needs["withholding"].sent_fraction == pytest.approx(0.3, abs=0.03)


def test_bits_and_energy_are_those_of_the_packets(everything: Everything) -> None:
    """By default a packet costs 1 and its encryption 1 more; fractions agree with theory within five standard errors."""
    needs = {name: scheme.needs for name, scheme in everything[0].schemes.items()}
    for need in needs.values():
        assert need.energy_per_slot == pytest.approx(need.sent_fraction + need.encrypted_fraction)
        assert need.bits_per_slot == pytest.approx(need.packet_bits * need.sent_fraction)
        assert (need.standard_errors["bits_per_slot"] == 0.0) is (need.sent_fraction == 1.0)
    encrypted = {name: need.encrypted_fraction for name, need in needs.items()}
    assert {name for name, fraction in encrypted.items() if fraction} == {
        *("cipher", "encrypted-schedule", "partial-encryption", "quantised-schedule"),
    }
    assert encrypted["cipher"] == 1.0
    mu = load("bayesian").quality["legitimate"]
    # Slot 0 is encrypted; from then on, with θ ≤ 2, the chain is stationary. θ = 4 sends in 1/μ of every 3 + 1/μ slots.
    slots = MARGINAL["slots"]
    for name, threshold in (("encrypted-schedule", 2.0), ("quantised-schedule", 1.5)):
        expected = (1.0 + (slots - 1) * encrypted_fraction(threshold, mu)) / slots
        error = needs[name].standard_errors["encrypted_fraction"]
        assert error is not None
        assert abs(needs[name].encrypted_fraction - expected) < 5.0 * error
    assert needs["scheduled"].sent_fraction == pytest.approx((1.0 / mu) / (3.0 + 1.0 / mu), rel=0.03)


def test_the_energy_is_that_of_the_scenario(tmp_path: Path) -> None:
    """Per packet, per bit and per encrypted packet; one trial has no standard error."""
    result = compare(
        "bayesian",
        schemes=["cipher", "plain"],
        adversaries=["naive"],
        trials=1,
        slots=5,
        out=tmp_path,
        energy={"packet": 3.0, "bit": 0.5, "encryption": 7.0},
    )
    assert result.schemes["plain"].needs.energy_per_slot == 3.0 + 0.5 * 128
    assert result.schemes["cipher"].needs.energy_per_slot == 3.0 + 0.5 * 128 + 7.0
    assert set(result.schemes["plain"].needs.standard_errors.values()) == {None}


def test_a_comparison_follows_packets(tmp_path: Path) -> None:
    """A mode that does not is refused."""
    with pytest.raises(UsageError, match="follows packets"):
        compare("bayesian", trials=1, slots=5, out=tmp_path, plan=Plan(Mode.COVARIANCE_ONLY))


def test_blocking_critical_acknowledgements_undoes_the_state_secrecy_code(literature: Comparison) -> None:
    """At k = 40 an attacker that blocks them has the estimator's own 2.284e-4, and 4.91e7 with honest acknowledgements."""
    for attacker in ("blocks-critical", "blocks-all"):
        jammer, legitimate = last(literature, "acknowledged", attacker)
        assert jammer == pytest.approx(legitimate, rel=1e-9)
        assert legitimate == pytest.approx(2.284e-4, rel=3e-4)
    assert last(literature, "open-loop", "reference")[0] == pytest.approx(4.91e7, rel=1e-3)
    kept = literature.cell("acknowledged", "reference").eavesdropper
    assert kept is not None
    assert kept.theory is not None
    assert kept.theory.bound
    assert kept.theory.last == pytest.approx(7.846e7, rel=1e-3)


def test_innovations_have_no_acknowledgements_to_block(literature: Comparison) -> None:
    """Under the paper's scheme every adversary of the same link stays above the estimator, in theory and in simulation."""
    for adversary in ("naive", "suspicious", "smart", "genie", "bayesian"):
        other, legitimate = last(literature, "innovation", adversary)
        assert other > legitimate
        cell = literature.cell("innovation", adversary)
        assert cell.ratio is not None
        assert cell.ratio > 1.0
        assert cell.verdict in {SecrecyOutcome.RELATIVE, SecrecyOutcome.PERFECT}


def test_a_forged_acknowledgement_is_the_users_loss(literature: Comparison) -> None:
    """Its error is without bound, in theory as in simulation, and as large as the eavesdropper's."""
    assert literature.cell("acknowledged", "forges").legitimate.theory.bound  # type: ignore[union-attr]
    cell = literature.cell("open-loop", "forges")
    assert cell.legitimate is not None
    assert cell.legitimate.theory is not None
    assert cell.legitimate.theory.limit == math.inf
    assert cell.legitimate.typical > 1e3


@pytest.mark.parametrize(
    ("mu_d", "legitimate", "genie", "smart"), [(0.9, 2.672e-4, 4.462e-4, 5.077e-4), (0.7, 4.756e-4, 1.545e-3, 1.760e-3)]
)
def test_the_numerical_example_at_slot_sixty(
    mu_d: float, legitimate: float, genie: float, smart: float, tmp_path: Path
) -> None:
    """Exact values for μ = μ_e = 0.9, Σ0 = Q, k = 60, of a scheme that is not the scenario's own."""
    result = compare(
        "acknowledged",
        schemes=["innovation"],
        adversaries=["smart", "genie"],
        parameters={"innovation.state_probability": mu_d},
        trials=2,
        slots=61,
        out=tmp_path,
    )
    assert last(result, "innovation", "smart") == pytest.approx((smart, legitimate), rel=5e-4)
    assert last(result, "innovation", "genie") == pytest.approx((genie, legitimate), rel=5e-4)


def test_parameters_may_be_of_numpy() -> None:
    """As entries of a scenario may be: matrices, numbers and tuples mean what lists and numbers mean."""
    parameters = {
        "noise.noise_covariance": np.eye(2),
        "quantised-schedule.bits": np.int64(4),
        "innovation.state_probability": np.float32(0.5),
    }
    schemes = [key.partition(".")[0] for key in parameters]
    result = compare(
        "eavesdroppers", schemes=schemes, adversaries=["naive"], parameters=parameters, trials=2, slots=3, expect=None
    )
    given = {scheme: found.parameters for scheme, found in result.schemes.items()}
    assert given["noise"]["noise_covariance"] == [[1.0, 0.0], [0.0, 1.0]]
    assert (given["quantised-schedule"]["bits"], given["innovation"]["state_probability"]) == (4, 0.5)


def test_the_table_is_a_row_for_each_pair(everything: Everything) -> None:
    """In the order of schemes and adversaries."""
    comparison, _ = everything
    rows = comparison.table.to_pylist()
    assert [(row["scheme"], row["adversary"]) for row in rows] == [
        (scheme, adversary) for scheme in comparison.schemes for adversary in comparison.adversaries
    ]


def test_workers_change_nothing(everything: Everything, tmp_path: Path) -> None:
    """One worker finds what two found."""
    some: dict[str, Any] = {"schemes": ["scheduled", "cipher"], "adversaries": ["naive", "blocks-all"]}
    alone = compare("bayesian", out=tmp_path, plan=Plan(workers=1), **some, **MARGINAL)
    for scheme in some["schemes"]:
        for adversary in some["adversaries"]:
            assert alone.cell(scheme, adversary) == everything[0].cell(scheme, adversary)


@pytest.mark.parametrize(("ours", "theirs", "ratio"), [(0.0, 0.0, 1.0), (0.0, 2.0, math.inf), (4.0, 2.0, 0.5)])
def test_medians_that_are_both_0_are_equal(ours: float, theirs: float, ratio: float) -> None:
    """The ratio of medians is that of equal errors then, as the verdict says."""
    errors: list[Any] = [
        SimpleNamespace(infinite_variance=True, quantiles={"0.5": median}) for median in (ours, theirs)
    ]
    anything: Any = SimpleNamespace()
    assert Cell(anything, errors[0], errors[1], anything).ratio == ratio
