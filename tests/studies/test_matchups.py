"""The command that compares schemes: what it makes of a scenario, refuses, prints and writes."""

from __future__ import annotations

import json
from typing import Any

import pytest
from PIL import Image

from evedrop.errors import ScenarioError, UsageError
from evedrop.model.metrics.text import fraction_text
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.loading import load
from evedrop.studies.matchups import adversaries_of, matchups_of
from tests.conftest import Evedrop
from tests.examples import mostly_long


def test_the_scenario_says_what_it_says_and_the_rest_is_documented() -> None:
    """A strategy's first eavesdropper is taken as it is; others listen behind the link of the scenario's first."""
    matchups = matchups_of(load("numerical"))
    groups = {group.name: group.scenario for group in matchups.groups}
    innovation = groups["innovation"]
    assert innovation.encoding.parameters == groups["withholding"].encoding.parameters == {"state_probability": 0.56}
    assert {name: innovation.quality[name] for name in ("legitimate", "smart", "naive", "genie")} == {
        "legitimate": 0.9,
        "smart": 0.85,
        "naive": 0.85,
        "genie": 0.85,
    }
    suspicious = innovation.eavesdroppers["suspicious"]
    assert (suspicious.use_state, suspicious.use_innovation) == (0.8, 0.2)
    assert innovation.eavesdroppers["colluding"].reads_as == "bayesian"
    assert innovation.quality["colluding"] == pytest.approx(1.0 - 0.15**2)
    assert innovation.eavesdroppers["replay-informed"].learns_at == 40
    told = {match.adversary for group in matchups.groups for match in group.matches if match.betrayed}
    assert told == {"replay-informed"}
    assert groups["acknowledged"].acknowledgements is not None
    assert groups["acknowledged"].acknowledgements.link.quality == 1.0
    attacked = groups["acknowledged-blocks-critical"].acknowledgements
    assert attacked is not None
    assert (attacked.attack, attacked.jammer) == ("critical", "reference")


def test_flips_have_the_probability_of_the_scenario() -> None:
    """Its own if it flips acknowledgements, else one in ten; schemes without acknowledgements have nothing to flip."""
    for name, changes, flip in (("flipped", {"acknowledgements.flip": 0.2}, 0.2), ("acknowledged", {}, 0.1)):
        matchups = matchups_of(load(name, changes), ["threshold-code", "plain"], ["flips", "forges"])
        groups = {group.name: group.scenario.acknowledgements for group in matchups.groups}
        assert {file: table and (table.attack, table.flip) for file, table in groups.items()} == {
            "threshold-code": ("none", None),
            "threshold-code-forges": ("forge", None),
            "threshold-code-flips": ("flip", flip),
            "plain": None,
        }
        assert {match.adversary for match in matchups.undefined if match.scheme == "plain"} == {"flips", "forges"}


@pytest.mark.parametrize(
    "name",
    mostly_long(
        ["numerical", "vehicle", "fading", "colluding", "restart", "late", "driving-away"],
        ["colluding", "late", "restart"],
    ),
)
def test_shipped_scenarios_can_be_compared(name: str) -> None:
    """For any links, events and eavesdroppers."""
    assert len(matchups_of(load(name)).groups) >= len(SCHEMES)


def test_what_a_measuring_sensor_cannot_use_is_left_out() -> None:
    """A scheme that decides the first state; strategies that invert its singular Q have a reason instead of numbers."""
    matchups = matchups_of(load("measured"))
    assert set(matchups.schemes) == set(SCHEMES) - {"twin-track"}
    assert set(matchups.left_out) == {"twin-track"}
    against = {match.adversary: match.not_defined for match in matchups.undefined if match.scheme == "innovation"}
    (learner,) = matchups_of(load("measured"), ["innovation"], ["learning-em"]).undefined
    assert learner.not_defined == "uses the inverse of Q, and Q may be singular"
    assert not {"bayesian", "likelihood", "genie", "colluding"} & set(against)
    steered = load(
        "measured", {"process.initial_covariance": [[1.0, 0.0], [0.0, 1.0]], "eavesdroppers": {}, "expect": []}
    )
    (undefined,) = matchups_of(steered, ["innovation"], ["colluding"]).undefined
    assert undefined.not_defined is not None
    assert undefined.not_defined.startswith(
        "tests packets against the range of Q, but the sensor's filter moves its estimate"
    )
    with pytest.raises(ScenarioError, match="the scheme twin-track decides x_0 itself"):
        matchups_of(load("measured"), ["twin-track"], ["naive"])


def test_all_wrong_names_are_told_at_once(evedrop: Evedrop) -> None:
    """Exit 2, every unknown name, and the names that exist."""
    options = ("--schemes", "cypher,plain", "--adversaries", "smrt", "--with", "innovation.mu_d=0.7")
    done = evedrop("compare", "numerical", *options)
    assert (done.status, done.out) == (2, "")
    assert [line.split()[0] for line in done.err.splitlines()[1:]] == ["cypher", "smrt", "innovation.mu_d"]
    assert all(name in done.err for name in (*SCHEMES, *adversaries_of(), "innovation.state_probability"))
    assert not list(evedrop.folder.glob("runs/*"))


@pytest.mark.parametrize(
    "options",
    [
        ("--schemes", ""),
        ("--with", "innovation.state_probability"),
        ("--with", "innovation.state_probability=2.0"),
        ("--schemes", "plain", "--with", "innovation.state_probability=0.7"),
        ("--trials", "0"),
        ("--workers", "0"),
        ("--slots", "5000"),
    ],
)
def test_what_cannot_be_compared_is_refused(evedrop: Evedrop, options: tuple[str, ...]) -> None:
    """Exit 2 and a reason, before anything is run."""
    done = evedrop("compare", "numerical", *options)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("evedrop: ")


def test_mistakes_of_a_scheme_name_it() -> None:
    """A scenario's links may be none for a scheme that stays silent."""
    scenario = load("bayesian", {"expect": [], "legitimate.link": {"quality": 0.9, "rate": 0.9}})
    with pytest.raises(ScenarioError, match=r"with the scheme withholding: legitimate\.link\.rate"):
        matchups_of(scenario, ["plain", "withholding"])
    with pytest.raises(UsageError, match="no scheme is named"):
        matchups_of(scenario, schemes=[])


@pytest.mark.long
def test_a_scheme_that_cannot_be_used_is_left_out_with_its_reason(evedrop: Evedrop) -> None:
    """Of μ_d = 0 `withholding` makes a sensor that sends nothing; where its name is given, nothing is compared."""
    silent = ("--set", "encoding.state_probability=0.0", "--adversaries", "naive", "--slots", "5", "--trials", "2")
    done = evedrop("compare", "numerical", *silent, "--out", "found")
    assert (done.status, "grows without bound: state_probability is 0" in done.err) == (0, True)
    (line,) = (line for line in done.out.splitlines() if line.startswith("left out:"))
    assert line.startswith("left out: withholding: encoding.state_probability: is 0.0, so nothing is sent")
    comparison = json.loads((evedrop.folder / "found/compare.json").read_text(encoding="utf-8"))
    assert set(comparison["schemes"]) == set(SCHEMES) - {"withholding"}
    assert [sentence[:24] for sentence in comparison["left_out"]["withholding"]] == ["encoding.state_probabili"]
    assert evedrop("compare", "numerical", *silent, "--schemes", "plain,withholding").status == 2


def test_what_no_scheme_can_use_is_refused() -> None:
    """A mistake in the scenario is not one of its schemes: what does not fit the links of the adversaries, or any scheme."""
    scenario = load("numerical", {"expect": []})
    endless = scenario.model_copy(update={"slots": 10**6})
    with pytest.raises(ScenarioError, match="with the scheme plain: slots: is 1000000"):
        matchups_of(endless)
    learner = {"strategy": "replay-informed", "reads_as": "smart", "learns_at": 20, "link": {"quality": 0.9}}
    late = load("numerical", {"expect": [], "eavesdroppers": {"late": learner}}).model_copy(update={"slots": 5})
    with pytest.raises(ScenarioError, match=r"with the scheme innovation: eavesdroppers.replay-informed.learns_at"):
        matchups_of(late)


def test_a_long_title_is_shortened() -> None:
    """So that there is room for the scheme and the attack."""
    scenario = load("acknowledged", {"title": "t" * 200, "expect": []})
    groups = matchups_of(scenario, ["acknowledged"], ["blocks-all"]).groups
    titles = [group.scenario.title for group in groups]
    assert [len(title) for title in titles] == [200, 200]
    assert titles[1].endswith("t (acknowledged, acknowledgements attacked: all)")


def test_the_command_prints_a_table_and_writes_its_folder(evedrop: Evedrop) -> None:
    """Every scheme and pair in the table; compare.json, two pictures and the scenarios in the folder."""
    names = ("--schemes", "innovation,acknowledged", "--adversaries", "smart,reference,blocks-critical")
    done = evedrop("compare", "acknowledged", *names, "--trials", "30", "--out", "found", "--verbose")
    assert (done.status, done.err) == (0, "")
    for text in ("innovation", "acknowledged", "blocks-critical (reference)", "✗ not secret", "not defined: smart"):
        assert text in done.out
    folder = evedrop.folder / "found"
    files = {"compare.json", "compare.pdf", "compare.png", "report.html", "scenarios"}
    assert {path.name for path in folder.iterdir()} == files
    assert sorted(path.stem for path in (folder / "scenarios").iterdir()) == [
        "acknowledged",
        "acknowledged-blocks-critical",
        "innovation",
    ]
    assert (folder / "compare.png").stat().st_size > 20_000
    with Image.open(folder / "compare.png") as picture:
        kept = {name: picture.info[name] for name in ("Rows", "Columns", "Size")}
    assert kept == {
        "Rows": "innovation,acknowledged",
        "Columns": "smart,reference,blocks-critical",
        "Size": "41 slots, 30 trials, seed 11",
    }


@pytest.mark.thorough
def test_json_is_strict_and_has_what_is_documented(evedrop: Evedrop) -> None:
    """One line on standard output, as compare.json says it, without numbers that JSON lacks."""
    names = ("--schemes", "innovation,acknowledged", "--adversaries", "naive,reference,forges")
    done = evedrop("compare", "acknowledged", *names, "--trials", "30", "--json", "--out", "found")

    def refused(constant: str) -> None:
        raise AssertionError(constant)

    comparison: dict[str, Any] = json.loads(done.out, parse_constant=refused)
    assert done.out.count("\n") == 1
    assert comparison == json.loads((evedrop.folder / "found" / "compare.json").read_text())
    assert set(comparison) == {
        *("scenario", "slots", "trials", "seed", "first_trial", "adversaries", "dominant", "schemes", "left_out"),
    }
    scheme = comparison["schemes"]["acknowledged"]
    assert set(scheme) == {"parameters", "needs", "legitimate", "leak", "closest", "against"}
    assert set(scheme["needs"]) == {
        *("acknowledgements", "payload_bits", "header_bits", "packet_bits", "sent_fraction"),
        *("encrypted_fraction", "bits_per_slot", "energy_per_slot", "standard_errors"),
        *("secret_bits_per_slot", "initial_secret_bits"),
    }
    assert set(scheme["needs"]["standard_errors"]) == {
        *("sent_fraction", "encrypted_fraction", "bits_per_slot", "energy_per_slot"),
    }
    cell = scheme["against"]["forges"]
    ratio = {"ratio", "ratio_standard_error"}
    assert set(cell) == {"reads_as", "attack", "betrayed", "eavesdropper", "legitimate", "verdict", "secrecy"} | ratio
    measured = {"mean", "standard_error", "quantiles", "infinite_variance", "theory", "z", "rare_events"}
    assert set(cell["eavesdropper"]) == set(cell["legitimate"]) == measured
    assert set(cell["legitimate"]["theory"]) == {"mean", "last", "limit", "bound"}
    assert cell["legitimate"]["theory"]["limit"] == "inf"
    assert set(comparison["schemes"]["innovation"]["against"]["reference"]) == {"not_defined"}


def test_rare_events_are_said_below_the_table(evedrop: Evedrop) -> None:
    """For schemes some of whose receivers have more than a tenth of their expected error from them, in these trials."""
    names = ("--schemes", "innovation,plain", "--adversaries", "naive,smart", "--slots", "100", "--out", "found")
    done = evedrop("compare", "eavesdroppers", *names, "--trials", "30", "--verbose")
    (line,) = (
        line
        for line in done.out.splitlines()
        if line.startswith("events that are expected fewer than 20 times in 30 trials")
    )
    comparison = json.loads((evedrop.folder / "found" / "compare.json").read_text())
    for scheme, scheme_ in comparison["schemes"].items():
        cells = [cell for cell in scheme_["against"].values() if "eavesdropper" in cell]
        errors = [scheme_["legitimate"], *(cell[name] for cell in cells for name in ("legitimate", "eavesdropper"))]
        fraction = max(error["rare_events"]["fraction"] for error in errors)
        assert fraction > 0.1
        assert f"{scheme} up to {fraction_text(fraction)}" in line


def test_a_wire_gives_adversaries_the_links_of_those_whose_link_they_have() -> None:
    """And names no eavesdropper that is not there."""
    wire = {"seed": 7, "key": "robot/pose", "links": {"legitimate": "radio", "smart": "air", "equal": "other"}}
    (group,) = matchups_of(load("numerical", {"wire": wire}), ["innovation"], ["smart", "genie"]).groups
    assert group.scenario.wire is not None
    assert group.scenario.wire.links == {"legitimate": "radio", "smart": "air", "genie": "air"}
