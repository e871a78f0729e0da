"""The options that `montecarlo`, `sweep`, `compare`, `cost` and `learned` share: the number of trials, and changed entries."""

from __future__ import annotations

import json
from typing import Any

import pytest

from evedrop.cli.main import parser_of
from evedrop.cli.options import changes_of
from evedrop.scenario.loading import load
from tests.conftest import Evedrop

SMALL = ("--set", "slots=12", "--set", "expect=[]")
STUDIES = {
    "montecarlo": ("montecarlo", "eavesdroppers", *SMALL, "--out", "out"),
    "sweep": ("sweep", "eavesdroppers", *SMALL, "--out", "out", "--over", "seed=1,2"),
    "compare": ("compare", "eavesdroppers", *SMALL, "--out", "out", "--schemes", "plain", "--adversaries", "naive"),
    "cost": ("cost", "microgrid", "--set", "slots=12"),
    "learned": ("learned", "learning", *SMALL),
}


@pytest.mark.parametrize("command", STUDIES)
def test_a_changed_entry_sets_the_trials(command: str, evedrop: Evedrop) -> None:
    """`--set trials=3` is heeded as `--trials 3` is."""
    words = STUDIES[command]
    by_set = evedrop(*words, "--set", "trials=3", "--json")
    by_option = evedrop(*words, "--trials", "3", "--out", "other", "--json")
    assert (by_set.status, by_set.err) == (0, "")
    found, expected = (json.loads(done.out) for done in (by_set, by_option))
    for each in (found, expected):
        if command == "montecarlo":
            assert each.pop("trials") == 3
            each.pop("wall_seconds"), each.pop("slots_per_second"), each.pop("surprising")
    assert found == expected


def test_changes_are_made_in_the_order_of_the_command_line() -> None:
    """The last change of an entry is made after one of the table around it, or of its other form, that came before."""
    for between in ("legitimate.link={quality = 0.7}", "legitimate.link.loss={model = 'bernoulli', quality = 0.7}"):
        words = [
            f"--set={change}" for change in ("legitimate.link.quality=0.5", between, "legitimate.link.quality=0.1")
        ]
        changed = load("vehicle", changes_of(parser_of("run").parse_whole(["run", "vehicle", *words])))
        assert changed.legitimate.link.quality == 0.1


def test_what_a_comparison_changes_is_the_scenario(evedrop: Evedrop) -> None:
    """`--set` refuses names that a scenario lacks, even if they are arguments of the Python function. No file is removed."""
    assert evedrop(*STUDIES["compare"], "--trials", "2").status == 0
    kept = sorted(path.name for path in (evedrop.folder / "out").iterdir())
    for change in ("overwrite=true", "resume=true", "workers=1", "schemes=3"):
        done = evedrop(*STUDIES["compare"], "--trials", "2", "--set", change)
        assert done.status == 2
        assert f"{change.partition('=')[0]}: is not an entry of this table" in done.err
    assert sorted(path.name for path in (evedrop.folder / "out").iterdir()) == kept


def test_a_comparison_warns_as_a_run_does(evedrop: Evedrop) -> None:
    """Of a legitimate estimator without bound."""
    unbounded = (
        "--set",
        "process.A=[[1.5]]",
        "--set",
        "process.Q=[[1.0]]",
        "--set",
        "process.initial_covariance=[[1.0]]",
    )
    words = (*STUDIES["compare"], *unbounded, "--set", "legitimate.link.quality=0.3", "--trials", "2")
    assert "grows without bound" in evedrop(*words).err


PERFECT = ("--set", 'encoding={scheme="plain"}', "--set", "legitimate.link.quality=1.0", "--set", "expect=[]")


def strict(text: str) -> Any:
    """JSON that has no numbers that JSON lacks."""

    def refuse(name: str) -> None:
        raise AssertionError(name)

    return json.loads(text, parse_constant=refuse)


def test_infinite_numbers_are_strings_in_json(evedrop: Evedrop) -> None:
    """Over an error of 0 a ratio is infinite; it is computed without a warning."""
    smart = ("--set", 'eavesdroppers.smart.strategy="naive"', "--set", "eavesdroppers.smart.link.quality=1.0")
    words = (*PERFECT, *smart, "--slots", "12", "--trials", "3")
    learned = evedrop("learned", "learning", *words, "--json", "--out", "out")
    assert (learned.status, learned.err) == (0, "")
    rows = strict(learned.out)
    assert rows[0]["ratios"]["learning"]["smart"]["ratio"] == "inf"
    assert strict((evedrop.folder / "out" / "learned.json").read_text(encoding="utf-8")) == rows
    assert strict(evedrop("sweep", "learning", *words, "--over", "seed=1,2", "--json").out)
