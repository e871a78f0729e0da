"""What secrecy costs a house: pairs of days, by hand and by the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import ttest_rel

from evedrop.cli.api import montecarlo
from evedrop.model.process import Floats
from evedrop.scenario.loading import load
from evedrop.simulate.montecarlo import Plan
from evedrop.studies.secrecy_cost import MeanEstimate, secrecy_cost
from tests.conftest import Evedrop

SLOTS, TRIALS = 700, 4
OTHERS: dict[str, Any] = {"eavesdroppers": {}, "expect": []}


def grid_powers(folder: Path, **changes: Any) -> Floats:
    """The grid power of every slot and trial of a separate study, (slots, trials), recomputed from the plant."""
    options = {"slots": SLOTS, "trials": TRIALS, "record_trials": TRIALS, "first_trial": 2, **OTHERS, **changes}
    results = montecarlo("microgrid", out=folder, plan=Plan(workers=1), **options)
    assert results.inputs is not None
    table = results.inputs.to_pydict()
    powers = np.empty((SLOTS, TRIALS))
    for slot, trial, u in zip(table["slot"], table["trial"], table["u"], strict=True):
        powers[slot, trial - 2] = np.clip(u[1], -3.0, 3.0)
    return powers


@pytest.mark.thorough
def test_metrics_are_those_of_pairs_of_studies(tmp_path: Path) -> None:
    """From three studies of the same trials: with the scheme, with plain, and with a controller that sees the truth."""
    ours = grid_powers(tmp_path / "ours")
    plain = grid_powers(tmp_path / "plain", encoding={"scheme": "plain"})
    truth = grid_powers(tmp_path / "truth", controller__acts_on="truth")
    result = secrecy_cost(load("microgrid", {"slots": SLOTS, "trials": TRIALS, "first_trial": 2}), lambda _: None)
    more = result.more_than_plain["net_energy"]
    differences = (ours - plain).sum(axis=0) / 3.6
    assert more.mean == pytest.approx(differences.mean(), rel=1e-6)
    interval = ttest_rel(ours.sum(axis=0) / 3.6, plain.sum(axis=0) / 3.6).confidence_interval()
    assert [more.low, more.high] == pytest.approx([interval.low, interval.high], rel=1e-6)
    for name, mine, other in (
        ("scheme_from_plain", ours, plain),
        ("scheme_from_truth", ours, truth),
        ("plain_from_truth", plain, truth),
    ):
        summed = np.abs(mine - other).sum(axis=0) / np.abs(other).sum(axis=0)
        metric = result.differences[name]["summed"]
        assert metric.mean == pytest.approx(summed.mean(), rel=1e-9)
        assert metric.standard_error == pytest.approx(summed.std(ddof=1) / 2.0, rel=1e-6)
        totals = np.abs(mine).sum(axis=0), np.abs(other).sum(axis=0)
        total = np.abs(totals[0] - totals[1]) / totals[1]
        assert result.differences[name]["total"].mean == pytest.approx(total.mean(), rel=1e-6)


def test_sets_of_trials_side_by_side_change_nothing() -> None:
    """The same bits with two trials at a time."""
    scenario = load("microgrid", {"slots": 130, "trials": 5})
    whole = secrecy_cost(scenario, lambda _: None)
    done: list[int] = []
    assert secrecy_cost(scenario, done.append, side_by_side=2) == whole
    assert sum(done) == 130 * 5


def test_a_controller_that_sees_the_truth_pays_nothing() -> None:
    """Its inputs do not depend on packets, so that all differences are 0 in every trial."""
    result = secrecy_cost(load("microgrid", {"slots": 130, "trials": 2, "controller.acts_on": "truth"}), lambda _: None)
    nothing = MeanEstimate(0.0, 0.0, 0.0, 0.0)
    assert set(result.more_than_plain.values()) == {nothing}
    assert {measure for measures in result.differences.values() for measure in measures.values()} == {nothing}


@pytest.mark.parametrize(
    "named",
    [
        {"legitimate.link": {"quality": 0.6, "correlation": {"with": "smart", "strength": 0.5}}},
        {"event": [{"at": 5, "link": "smart", "set": {"quality": 0.5}}]},
        {"event": [{"from": 5, "to": 9, "cut": ["naive"]}]},
        {},
    ],
    ids=["correlation", "change", "outage", "nothing"],
)
@pytest.mark.parametrize("acknowledged", [False, True])
def test_what_names_an_eavesdropper_is_left_out_with_it(named: dict[str, Any], acknowledged: bool) -> None:
    """Also an attack on acknowledgements, which `plain` has none of; the cost is that without eavesdroppers."""
    encoding: dict[str, Any] = {"encoding": {"scheme": "innovation", "state_probability": 0.1}}
    if acknowledged:
        encoding = {"encoding": {"scheme": "acknowledged"}, "acknowledgements": {"link": {"quality": 0.9}}}
    own = {"slots": 130, "trials": 3, "expect": [], **encoding}
    alone = secrecy_cost(load("microgrid", {**own, **OTHERS}), lambda _: None)
    if acknowledged:
        own |= {"acknowledgements": {**encoding["acknowledgements"], "attack": "critical", "jammer": "naive"}}
        own |= {"eavesdroppers": {name: {"strategy": "naive", "link": {"quality": 0.6}} for name in ("smart", "naive")}}
    assert (alone.more_than_plain["total_energy"].mean == 0.0) is acknowledged
    assert secrecy_cost(load("microgrid", {**own, **named}), lambda _: None) == alone


def test_an_event_of_several_receivers_still_concerns_the_legitimate_one() -> None:
    """As one that names it alone, until another event names it again."""
    own = {"slots": 130, "trials": 2, "expect": []}
    several = [{"from": 20, "to": 60, "partition": ["legitimate", "smart"]}, {"at": 70, "cut": ["smart", "legitimate"]}]
    alone = [{"from": 20, "to": 60, "cut": "legitimate"}, {"at": 70, "cut": "legitimate"}]
    heal = {"at": 80, "heal": "legitimate"}
    costs = [
        secrecy_cost(load("microgrid", {**own, "event": events}), lambda _: None)
        for events in ([*several, heal], [*alone, heal], [])
    ]
    assert costs[0] == costs[1] != costs[2]


@pytest.mark.long
def test_a_days_cost_is_that_of_the_document() -> None:
    """Twenty whole days at μ_d = 0.1, within five standard errors of the table of docs/microgrid.md, made from a hundred."""
    result = secrecy_cost(load("microgrid", {"trials": 20}), lambda _: None)
    documented = {"net": 1.13e-5, "total": 2.00e-4, "summed": 8.59e-3}
    for measure, measure_ in result.differences["scheme_from_plain"].items():
        assert measure_.mean == pytest.approx(documented[measure], abs=5.0 * measure_.standard_error), measure
    more = result.more_than_plain
    assert more["net_energy"].mean == pytest.approx(0.0924, abs=5.0 * more["net_energy"].standard_error)
    assert more["total_energy"].mean == pytest.approx(4.62, abs=5.0 * more["total_energy"].standard_error)
    assert more["total_energy"].low > 0.0


@pytest.mark.thorough
def test_the_command_prints_the_table_and_json(evedrop: Evedrop) -> None:
    """The same metrics in both, and one line for a scenario or a number of trials that cannot be used."""
    command = ("cost", "microgrid", "--trials", "2", "--slots", "200")
    shown, entry = evedrop(*command), evedrop(*command, "--json")
    assert (shown.status, entry.status) == (0, 0)
    costs = json.loads(entry.out)
    assert (costs["scheme"], costs["trials"]) == ("innovation", 2)
    mean = costs["more_than_plain"]["net_energy"]["mean"]
    (line,) = (line for line in shown.out.splitlines() if "net energy: innovation less plain" in line)
    assert f" {mean:.3g} Wh" in line
    fraction = costs["differences"]["scheme_from_plain"]["summed"]["mean"]
    (line,) = (line for line in shown.out.splitlines() if "summed: innovation from plain" in line)
    assert f" {100.0 * fraction:.3g} %" in line
    for words, message in (
        (
            ("cost", "vehicle"),
            "there is no household with a controller; try the scenario microgrid, or evedrop compare for",
        ),
        (("cost", "microgrid", "--trials", "1"), "--trials 1: expected 2 or more"),
    ):
        refused = evedrop(*words)
        assert refused.status == 2
        assert message in refused.err


def test_a_fraction_of_no_energy_is_a_dash(evedrop: Evedrop) -> None:
    """In its first slot the house neither buys nor sells with `plain`: nothing is a fraction of that."""
    shown = evedrop("cost", "microgrid", "--trials", "2", "--slots", "1")
    assert shown.status == 0
    (line,) = (line for line in shown.out.splitlines() if "net: innovation from plain" in line)
    assert line.split()[-3:] == ["–"] * 3
    assert "nan" not in shown.out
