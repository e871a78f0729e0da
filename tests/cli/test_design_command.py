"""`evedrop design` and `evedrop figures` as they are typed: keys, numbers, edges, refusals."""

from __future__ import annotations

import json
import shlex
from typing import Any

import numpy as np
import pytest

from evedrop import design
from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.golden.pages import Golden

LOW = 0.534206


def designed(evedrop: Evedrop, scenario: str, *more: str) -> dict[str, Any]:
    """The JSON of a design, which must be strict."""
    done = evedrop("design", scenario, "--json", *more)
    assert (done.status, done.err) == (0, "")
    assert done.out.count("\n") == 1
    designed: dict[str, Any] = json.loads(done.out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    return designed


def changes(**entries: object) -> list[str]:
    """--set options, `__` for the dot."""
    return [word for key, value in entries.items() for word in ("--set", f"{key.replace('__', '.')}={value}")]


def test_the_numerical_illustration(evedrop: Evedrop) -> None:
    """Exactly the promised keys; bounds to 1e-6; intervals and optima for each μ_e to 1e-4."""
    result = designed(evedrop, "numerical")
    assert list(result) == ["rho", "legitimate", "eavesdroppers"]
    assert set(result["legitimate"]) == {"bound", "trace"}
    keys = {"bound", "perfect", "relative", "best_difference", "best_ratio", "ratio", "largest_ratio", "trace"}
    assert {frozenset(eavesdropper) for eavesdropper in result["eavesdroppers"].values()} == {frozenset(keys)}
    assert result["rho"] == pytest.approx(1.387799, abs=1e-6)
    assert result["legitimate"]["bound"] == pytest.approx(LOW, abs=1e-6)
    for name, bound, relative, difference, ratio in (
        ("smart", 0.565630, (LOW, 1.0), None, None),
        ("equal", 0.534206, (LOW, 1.0), None, None),
        ("better", 0.506090, (0.54153, 0.93882), 0.55709, 0.6297),
        ("much-better", 0.485642, (0.54790, 0.89331), 0.57447, 0.6445),
    ):
        eavesdropper = result["eavesdroppers"][name]
        assert eavesdropper["bound"] == pytest.approx(bound, abs=1e-6)
        (interval,) = eavesdropper["relative"]
        assert interval == pytest.approx(relative, abs=1e-4)
        assert eavesdropper["best_difference"] == (difference and pytest.approx(difference, abs=1e-4))
        assert eavesdropper["best_ratio"] == (ratio and pytest.approx(ratio, abs=1e-4))
        assert eavesdropper["perfect"] == (pytest.approx([LOW, 0.565630], abs=1e-6) if name == "smart" else None)
    assert result["eavesdroppers"]["smart"]["trace"] is None


@pytest.mark.parametrize(
    ("entries", "legitimate", "smart"),
    [
        ({"legitimate__link__quality": 1.0}, {"trace": 0.0}, {}),
        ({"eavesdroppers__smart__link__quality": 0.0}, {}, {"bound": None, "trace": None}),
        (
            {"process__A": [[1.0, 0.0], [0.0, 1.0]]},
            {"bound": 0.0},
            {"bound": 0.0, "perfect": None, "relative": [[0.0, 1.0]]},
        ),
        (
            {"legitimate__link__quality": 0.4},
            {"trace": None},
            {"perfect": None, "relative": [], "best_difference": None, "best_ratio": None},
        ),
    ],
    ids=["lossless", "deaf", "marginal", "hopeless"],
)
def test_edges(evedrop: Evedrop, entries: dict[str, Any], legitimate: dict[str, Any], smart: dict[str, Any]) -> None:
    """μ = 1, μ_e = 0, ρ = 1, and a link for which no μ_d is admissible: strict JSON with null for what is unbounded."""
    result = designed(evedrop, "numerical", *changes(**entries))
    assert result["legitimate"] == {**result["legitimate"], **legitimate}
    against = result["eavesdroppers"]["smart"]
    assert against == {**against, **smart}


def test_for_people(evedrop: Evedrop) -> None:
    """The text has a row for every eavesdropper, the admissible range, cost and bound."""
    done = evedrop("design", "numerical", "--max-trace", "0.01")
    assert (done.status, done.err) == (0, "")
    for words in (
        "smart",
        "equal",
        "better",
        "much-better",
        "naive",
        "0.534206 < μ_d ≤ 1",
        "least μ_d",
        "(0.53421, 0.56563]",
        "(0.53421, 1.00000)  ",  # perfect secrecy against naive: at 1 itself nothing misleads
    ):
        assert words in done.out
    assert "nan" not in done.out


def test_it_is_said_that_nothing_is_admissible(evedrop: Evedrop) -> None:
    """In words, with the number the link must exceed, and every eavesdropper still in the table."""
    done = evedrop("design", "numerical", *changes(legitimate__link__quality=0.4))
    assert (done.status, done.err) == (0, "")
    assert "no μ_d is admissible" in done.out
    assert "0.480785" in done.out
    assert "much-better" in done.out


def test_an_unbounded_choice_is_said(evedrop: Evedrop) -> None:
    """A μ_d below the bound: the range is there, and the error at the scenario's own μ_d is said to be unbounded."""
    done = evedrop("design", "numerical", *changes(encoding__state_probability=0.2))
    assert (done.status, done.err) == (0, "")
    assert "at this scenario's μ_d = 0.2 the legitimate error is unbounded" in done.out
    assert "inf" not in done.out
    assert "nan" not in done.out


@pytest.mark.parametrize("wanted", ["1e-9", "0", "-1", "nan"])
def test_a_trace_that_cannot_be_kept_is_refused(evedrop: Evedrop, wanted: str, golden: Golden) -> None:
    """Ω at or below J(1): one line with what is possible, exit 2."""
    done = evedrop("design", "numerical", "--max-trace", wanted)
    assert (done.status, done.out) == (2, "")
    assert "0.000228372" in done.err
    golden("design", done.err)


@pytest.mark.thorough
def test_the_least_choice_is_in_the_json_if_asked_for(evedrop: Evedrop) -> None:
    """`minimum` is given with bound and trace; at that μ_d the trace is Ω."""
    least = designed(evedrop, "numerical", "--max-trace", "0.01")["legitimate"]["minimum"]
    assert least == pytest.approx(0.540427, abs=1e-6)
    again = designed(evedrop, "numerical", *changes(encoding__state_probability=least))
    assert again["legitimate"]["trace"] == pytest.approx(0.01, rel=1e-5)


def test_a_run_of_any_length_can_be_designed(evedrop: Evedrop) -> None:
    """Theory is not limited by the number of slots that float64 can follow."""
    assert designed(evedrop, "numerical", *changes(slots=20000))["rho"] == pytest.approx(1.387799, abs=1e-6)


@pytest.mark.long
def test_who_has_no_closed_form_is_left_out_and_said(evedrop: Evedrop) -> None:
    """One line for people, an entry in the JSON; a genie, a pool of links and a constant one are designed against."""
    extra = changes(
        eavesdroppers__clever='{strategy = "bayesian", link = {quality = 0.9}}',
        eavesdroppers__genie='{strategy = "genie", link = {quality = 0.9}}',
        eavesdroppers__deaf='{strategy = "constant", link = {quality = 0.9}}',
        eavesdroppers__pool='{strategy = "colluding", links = [{quality = 0.5}, {quality = 0.8}], reads_as = "smart"}',
    )
    result = designed(evedrop, "numerical", *extra)
    assert result["left_out"] == {"clever": "bayesian"}
    equal, genie, pool = (result["eavesdroppers"][name] for name in ("equal", "genie", "pool"))
    assert pool == {key: pytest.approx(value) if key != "relative" else pool[key] for key, value in equal.items()}
    assert genie["bound"] == equal["bound"]
    assert result["legitimate"]["trace"] < genie["trace"] < equal["trace"]
    assert result["eavesdroppers"]["deaf"]["bound"] is None
    (line,) = [line for line in evedrop("design", "numerical", *extra).out.splitlines() if "left out" in line]
    assert line.startswith(
        "left out: clever (bayesian): no closed form of its error is known; a guarantee against a genie holds against every "
        "eavesdropper, and this measures it: evedrop sweep numerical --set "
    )


@pytest.mark.parametrize("scheme", ["twin-track", "cipher", "withholding"])
def test_a_scheme_without_such_a_choice_is_refused(evedrop: Evedrop, scheme: str) -> None:
    """In one line, with a change that helps, which does."""
    parameter = ", state_probability = 0.5" if scheme == "withholding" else ""
    done = evedrop("design", "twin-track", *changes(encoding=f'{{scheme = "{scheme}"{parameter}}}'))
    assert (done.status, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert f"for the scheme innovation or plain, and this scenario has {scheme}; give encoding={{" in line
    remedy = line.partition("give ")[2].partition(" to design")[0]
    assert designed(evedrop, "twin-track", "--set", remedy)["legitimate"]["bound"] == pytest.approx(LOW, abs=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("scheme", ["acknowledged", "scheduled", "encrypted-schedule"])
def test_a_scheme_that_needs_acknowledgements_is_refused(evedrop: Evedrop, scheme: str) -> None:
    """In one line, with a command that makes a scenario of it which can be designed."""
    encoding = f'{{scheme = "{scheme}"{"" if scheme == "acknowledged" else ", threshold = 3"}}}'
    done = evedrop("design", "acknowledged", *changes(encoding=encoding, expect=[]))
    assert (done.status, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert f"and this scenario has {scheme}; evedrop compare SCENARIO --schemes {scheme},innovation --out DIR" in line
    if scheme == "acknowledged":
        words = ("--schemes", f"{scheme},innovation", "--trials", "1", "--slots", "5", "--workers", "1")
        assert evedrop("compare", scheme, *words, "--out", "DIR").status == 0
        assert designed(evedrop, "DIR/scenarios/innovation.toml")["eavesdroppers"]["smart"]["bound"] == pytest.approx(
            LOW
        )


def test_sending_every_state_is_a_choice(evedrop: Evedrop) -> None:
    """The scheme plain is μ_d = 1: its trace is that of sending every state, and the range is the same."""
    naive = changes(encoding='{scheme = "plain"}', eavesdroppers='{eve = {strategy = "naive", link = {quality = 0.9}}}')
    result = designed(evedrop, "numerical", *naive)
    assert result["legitimate"]["trace"] == pytest.approx(0.000228372, rel=1e-5)
    assert result["legitimate"]["bound"] == pytest.approx(LOW, abs=1e-6)


def test_figures_that_cannot_be_written_are_refused(evedrop: Evedrop) -> None:
    """A file where the folder should be: one line, exit 2."""
    (evedrop.folder / "file").touch()
    done = evedrop("figures", "file")
    assert (done.status, done.out) == (2, "")
    assert done.err.splitlines()[-1].startswith("evedrop: file cannot be written (")


@pytest.mark.thorough
def test_the_choice_of_a_ratio(evedrop: Evedrop) -> None:
    """`--min-ratio R`: in words, as JSON, and the line it prints gives a scenario that has the ratio."""
    result = designed(evedrop, "numerical", "--min-ratio", "2")
    choice = result["choice"]
    assert min(ratio for ratio in choice["ratios"].values() if ratio is not None) == pytest.approx(2.0, rel=1e-9)
    assert choice["cost"] > 1.0
    again = designed(evedrop, "numerical", *changes(encoding__state_probability=choice["mu_d"]))
    ratios = {name: eavesdropper["ratio"] for name, eavesdropper in again["eavesdroppers"].items()}
    assert ratios == {name: value and pytest.approx(value) for name, value in choice["ratios"].items()}
    done = evedrop("design", "numerical", "--min-ratio", "2")
    assert f"state_probability = {choice['mu_d']!r}" in done.out.splitlines()
    assert "J_e/J ≥ 2 against every eavesdropper" in done.out
    assert "…  " not in done.out  # no column is cut


def test_a_ratio_that_is_impossible_is_refused(evedrop: Evedrop, golden: Golden) -> None:
    """With the largest there is, where it is, and its price."""
    done = evedrop("design", "numerical", "--min-ratio", "10")
    assert (done.status, done.out) == (2, "")
    golden("design", done.err)


@pytest.mark.parametrize("wanted", ["0", "-1", "inf", "nan"])
def test_a_ratio_that_is_no_ratio_is_refused(evedrop: Evedrop, wanted: str, golden: Golden) -> None:
    """In one line that says what is expected."""
    done = evedrop("design", "numerical", "--min-ratio", wanted)
    assert (done.status, done.out) == (2, "")
    golden("design", done.err)


@pytest.mark.parametrize(
    ("scenario", "entries"),
    [
        ("numerical", {"legitimate__link": '{loss = {model = "gilbert-elliott", p = 0.01, r = 0.3}}'}),
        pytest.param(
            "numerical",
            {"eavesdroppers": '{clever = {strategy = "bayesian", link = {quality = 0.9}}}'},
            marks=pytest.mark.long,
        ),
        ("twin-track", {}),
        pytest.param("noise", {}, marks=pytest.mark.long),
        ("acknowledged", {}),
        ("numerical", {"slots": 4, "encoding__state_probability": [1.0, 0.5, 0.5, 0.5]}),
        pytest.param(
            "numerical",
            {
                "title": '"it\'s  a \\"title\\""',
                "eavesdroppers__clever": '{strategy = "bayesian", link = {quality = 0.9}}',
            },
            marks=pytest.mark.long,
        ),
    ],
    ids=["bursts", "bayesian", "twin-track", "noise", "acknowledged", "list", "left out"],
)
def test_what_is_refused_can_be_measured(evedrop: Evedrop, scenario: str, entries: dict[str, Any]) -> None:
    """The refusal, or the line about who is left out, ends in a command that works as printed."""
    done = evedrop(
        "design", scenario, *([] if scenario != "numerical" else ["--min-ratio", "1.5"]), *changes(**entries)
    )
    line = done.err.splitlines()[-1] if done.err else done.out.splitlines()[-1]
    command = line[line.rindex("evedrop ") :].removesuffix(" measures this one")
    words = shlex.split(command)
    assert words[1] in {"sweep", "montecarlo"}
    assert evedrop(*words[1:], "--trials", "2", "--slots", "4", "--set", "expect=[]", "--out", "measured").status == 0


@pytest.mark.parametrize(
    ("options", "answer"),
    [
        (("--min-ratio", "2"), "choose μ_d = 0.76145: perfect secrecy against naive, and the error of much-better"),
        (
            changes(eavesdroppers="{smart={strategy='smart',link={quality=0.85}}}"),
            "choose μ_d = 0.56562: perfect secrecy",
        ),
        (
            changes(legitimate__link__quality=0.6),
            "no μ_d keeps the error of every eavesdropper above the legitimate one",
        ),
        (
            (
                *changes(legitimate__link__quality=0.8, eavesdroppers="{smart={strategy='smart',link={quality=0.85}}}"),
                "--max-trace",
                "6e-4",
            ),  # below 0.912, where smart's error is larger, the trace is not
            "no μ_d that keeps the wanted trace keeps the error of every eavesdropper above the legitimate one: ask for a larger "
            "trace, or improve",
        ),
        (
            changes(legitimate__link__quality=1.0),
            "choose μ_d = 0.48564: perfect secrecy against smart, equal, better, much-better, naive, and the legitimate",
        ),
    ],
)
def test_a_design_answers_first(evedrop: Evedrop, options: tuple[str, ...], answer: str) -> None:
    """Which μ_d to choose, what it gives and what it costs, in the first line."""
    done = evedrop("design", "numerical", *options)
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith(answer), done.out.splitlines()[0]


def test_the_suggestion_is_the_cheapest_with_nearly_the_largest_ratio() -> None:
    """90 % of it, as a search over a grid finds it too; the μ_d is in the intervals of perfect secrecy where that is possible."""
    made = design("numerical")
    assert made.suggestion is not None
    ratios = {}
    for mu_d in np.linspace(LOW + 1e-3, 1.0, 400):
        at = made.traces_at(float(mu_d))
        ratios[float(mu_d)] = min(trace for name, trace in at.items() if name != "legitimate") / at["legitimate"]
    wanted = 0.9 * max(ratios.values())
    assert made.suggestion.mu_d == pytest.approx(max(mu_d for mu_d in ratios if ratios[mu_d] >= wanted), abs=0.003)
    alone = design("numerical", changes={"eavesdroppers": {"smart": {"strategy": "smart", "link": {"quality": 0.85}}}})
    assert alone.suggestion is not None
    assert alone.eavesdroppers["smart"].perfect is not None
    assert alone.suggestion.mu_d == pytest.approx(alone.eavesdroppers["smart"].perfect[1])
    assert design("numerical", changes={"eavesdroppers": {}}).suggestion is None


@pytest.mark.thorough
@pytest.mark.parametrize("suffix", mostly_long(["pdf", "png", "svg"], ["svg"]))
def test_a_design_has_a_plot(evedrop: Evedrop, suffix: str) -> None:
    """As the kind of file that its name says."""
    path = evedrop.folder / f"plot.{suffix}"
    assert evedrop("design", "numerical", "--plot", path.name).status == 0
    begins = {"pdf": b"%PDF", "png": b"\x89PNG", "svg": b"<?xml"}
    assert path.read_bytes().startswith(begins[suffix])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--plot", "plot.gif"), "expected a name that ends in .pdf, .png or .svg"),
        (("--plot", "nowhere/plot.pdf"), "cannot be written"),
        (("--plot", "plot.pdf", "--schedule", "3"), "leave it out"),
        (("--plot", "plot.pdf", *changes(legitimate__link__quality=0.4)), "there is nothing to draw"),
    ],
)
def test_a_plot_that_cannot_be_drawn_is_refused(evedrop: Evedrop, options: tuple[str, ...], sentence: str) -> None:
    """With status 2 and what to do."""
    done = evedrop("design", "numerical", *options)
    assert done.status == 2
    assert sentence in done.err
