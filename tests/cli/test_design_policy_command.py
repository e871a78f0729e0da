"""`evedrop design --policy` as it is typed: keys, numbers, text, refusals and their remedies."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from evedrop.cli.api import design_policy
from tests.conftest import Evedrop
from tests.golden.pages import Golden

SCENARIO = """
title = "Silence as a defence"
slots = 40
process = { A = [[1.0, 0.3], [0.5, 1.001]], Q = [[1e-3, 0.0], [0.0, 1e-3]], initial_covariance = [[1e-3, 0.0], [0.0, 1e-3]] }
encoding = { scheme = "scheduled", threshold = 3 }
acknowledgements = { link = { quality = 0.9 } }
legitimate = { link = { quality = 0.9 } }

[eavesdroppers.near]
strategy = "naive"
link = { quality = 0.95 }

[eavesdroppers.far]
strategy = "selective"
link = { quality = 0.5 }

[eavesdroppers.deaf]
strategy = "constant"
link = { quality = 0.5 }
"""


@pytest.fixture
def scenario(tmp_path: Path) -> str:
    """The file of the scenario."""
    (tmp_path / "silent.toml").write_text(SCENARIO, encoding="utf-8")
    return str(tmp_path / "silent.toml")


def fronts(evedrop: Evedrop, *words: str) -> dict[str, Any]:
    """The JSON of the policies, which must be strict."""
    done = evedrop("design", *words, "--policy", "--json")
    assert (done.status, done.err) == (0, "")
    assert done.out.count("\n") == 1
    fronts: dict[str, Any] = json.loads(done.out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    return fronts


def test_json(evedrop: Evedrop, scenario: str) -> None:
    """Exactly the promised keys; `scheduled` by its closed form; null for unbounded; the strategy without theory is named."""
    result = fronts(evedrop, scenario, "--weight", "0.6", "0.9", "1", "--price", "0", "1e-3", "--states", "6")
    assert list(result) == ["mu", "states", "eavesdroppers", "left_out"]
    assert (result["mu"], result["states"], result["left_out"]) == (0.9, 6, {"deaf": "constant"})
    assert list(result["eavesdroppers"]) == ["near", "far"]
    for eavesdropper in result["eavesdroppers"].values():
        assert list(eavesdropper) == ["scheduled", "policies", "never", "dominated"]
        assert [row["threshold"] for row in eavesdropper["scheduled"]] == [1, 2, 3, 4, 5, 6]
        assert eavesdropper["scheduled"][2]["transmissions"] == pytest.approx((1 / 0.81) / (2 + 1 / 0.81))
        for row in eavesdropper["policies"]:
            assert list(row) == [
                "weights", "price", "thresholds", "legitimate", "eavesdropper", "transmissions", "scheduled",
            ]  # fmt: skip
            assert len(row["thresholds"]) == 6
        assert eavesdropper["policies"][-1]["weights"][1] == 1.0
    assert result["eavesdroppers"]["far"]["scheduled"][5]["eavesdropper"] is None
    assert result["eavesdroppers"]["far"]["scheduled"][0]["legitimate"] == pytest.approx(2.2837e-4, rel=1e-4)


def test_for_people(evedrop: Evedrop, scenario: str) -> None:
    """Two tables for each eavesdropper, ∞ for unbounded, and a line for what was left out, with the reason."""
    done = evedrop("design", scenario, "--policy", "--states", "6", "--price", "0", "1e-2", "--csv", "a.csv")
    assert (done.status, done.err) == (0, "")
    files = [evedrop.folder / f"a{number}.csv" for number in ("", "-2", "-3", "-4")]
    assert [file.read_text().splitlines()[-1].partition(",")[0] for file in files] == ["near", "near", "far", "far"]
    for words in (
        "legitimate link quality μ = 0.9",
        "against near, the scheme with its threshold:",
        "against far, the scheme with its threshold:",
        "best θ",
        "∞",
        "the best policy never sends: with λ = 0 the weights 0, 0.05",
        "policies that another one dominates",
        "left out: deaf (constant)",
    ):
        assert words in done.out, words


def test_in_python(scenario: str) -> None:
    """The same from Python, whose default weights are all twentieths."""
    result = design_policy(scenario, states=4, changes={"eavesdroppers.far.link.quality": 0.3})
    points = result.fronts["far"].points
    assert points[-1].thresholds == (1, 1, 1, 1)
    assert {weight for weight, _ in result.fronts["far"].never} < {i / 20 for i in range(21)}


@pytest.mark.parametrize(
    "words",
    [
        ("--weight", "1.5"),
        ("--weight", "nan"),
        ("--price", "-1"),
        ("--price", "inf"),
        ("--states", "1"),
        ("--states", "23"),
        ("--states", "22", "--set", "process.A=[[1e8,0.0],[0.0,0.5]]", "--set", "legitimate.link.quality=1.0"),
        ("--weight", "0.2"),
        ("--price", "1e9"),
        ("--set", "legitimate.link.quality=0.48"),
        ("--set", "legitimate.link.quality=0.0"),
        ("--set", "process.A=[[0.5,0.0],[0.0,0.5]]", "--set", "legitimate.link.quality=0"),
        ("--set", 'legitimate.link={loss={model="gilbert-elliott",p=0.1,r=0.5}}'),
        ("--max-trace", "1"),
        ("--set", 'eavesdroppers={deaf={strategy="constant",link={quality=0.5}}}'),
    ],
    ids=str,
)
def test_refusals(evedrop: Evedrop, scenario: str, words: tuple[str, ...], golden: Golden) -> None:
    """A design that does not exist is refused, with the bound and the remedy."""
    done = evedrop("design", scenario, "--policy", *words)
    assert (done.status, done.out) == (2, "")
    golden("design", done.err)


def test_options_of_policies_alone_are_refused(evedrop: Evedrop) -> None:
    """They mean nothing for μ_d."""
    done = evedrop("design", "numerical", "--weight", "0.5")
    assert done.status == 2
    assert "--weight is for --policy and --schedule; leave it out" in done.err


@pytest.mark.long
def test_another_scheme_is_refused_with_a_command_that_works(evedrop: Evedrop, tmp_path: Path) -> None:
    """The advised command writes a scenario that can be designed."""
    done = evedrop("design", "numerical", "--policy")
    assert done.status == 2
    advised = "evedrop compare SCENARIO --schemes scheduled --out DIR"
    assert f"this scenario has innovation; {advised} writes DIR/scenarios/scheduled.toml" in done.err
    words = advised.replace("SCENARIO", "numerical").replace("DIR", str(tmp_path / "out")).split()[1:]
    assert evedrop(*words, "--trials", "2", "--set", "slots=30").status == 0
    assert fronts(evedrop, str(tmp_path / "out" / "scenarios" / "scheduled.toml"))["eavesdroppers"]


def test_the_least_weight_of_a_refusal_works(evedrop: Evedrop, scenario: str) -> None:
    """The weight that a refusal names gives a policy that sends."""
    changes = ("--set", 'eavesdroppers={near={strategy="naive",link={quality=0.95}}}')
    done = evedrop("design", scenario, "--policy", "--weight", "0.2", *changes)
    weight = done.err.split("it sends from weight ")[1].split()[0]
    assert fronts(evedrop, scenario, "--weight", weight, *changes)["eavesdroppers"]["near"]["policies"]
