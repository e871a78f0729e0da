"""The house of a run: table, metrics in the summary, expectations, and that workers and blocks change nothing."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from evedrop.cli import main as cli
from evedrop.cli.api import montecarlo
from evedrop.errors import ScenarioError
from evedrop.model import controllers
from evedrop.scenario.loading import checked
from evedrop.score.energy import Meter, energy
from evedrop.simulate.montecarlo import Plan
from evedrop.studies.applications.microgrid import household
from tests.builders import changed, listener, places_of
from tests.conftest import Evedrop
from tests.golden.pages import Golden
from tests.scenario.test_plant import LOOP
from tests.studies.applications.microgrid.test_microgrid import part_of_day

SLOTS = 1200


HOUSE: dict[str, Any] = {
    **LOOP,
    "slot_seconds": 1.0,
    "household": {"grid": "P_grid", "load": "P_load", "sun": "P_solar", "battery": "SOC"},
    "eavesdroppers": {"eve": listener("smart", 0.6)},
}
"""The scenario of the plant's tests with a house."""


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"household__grid": "P_net"}, "household.grid"),
        ({"household__load": "P_H"}, "household.load"),
        ({"household__battery": "soc"}, "household.battery"),
        ({"process__states": None}, "household.battery"),
        ({"household__grid": None}, "household.grid"),
        ({"plant__input_units": ["kW", "W"]}, "household.grid"),
        ({"plant__disturbance_units": ["kW", "W"]}, "household.load"),
        ({"slot_seconds": None}, "slot_seconds"),
        ({"household__window_seconds": 0.0}, "household.window_seconds"),
        ({"household__stove": "x"}, "household.stove"),
        ({"expect": [{"metric": "household.bought", "below": 1.0}]}, "expect.0.metric"),
        ({"expect": [{"metric": "household.adam.activity_area", "below": 1.0}]}, "expect.0.metric"),
        ({"expect": [{"metric": "household.sold_energy", "below": 1.0, "slots": [0, 2]}]}, "expect.0.slots"),
        ({"household": None, "expect": [{"metric": "household.sold_energy", "below": 1.0}]}, "expect.0.metric"),
    ],
    ids=str,
)  # fmt: skip
def test_a_mistake_about_the_house_is_named(changes: dict[str, Any], place: str, golden: Golden) -> None:
    """With its path, what was found and what there is."""
    with pytest.raises(ScenarioError) as caught:
        checked(changed(HOUSE, **changes), "file")
    assert place in places_of(caught.value.mistakes)
    golden("check", caught.value.mistakes)


def test_without_the_solver_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only the scenario that uses the extra needs it; the list of scenarios and the other scenarios do not."""
    monkeypatch.setattr(controllers, "find_spec", lambda _: None)
    assert cli.main(["check", "microgrid-mpc", "--set", "slots=200"]) == 2
    told = capsys.readouterr().err
    assert told.count("'.[microgrid]'") == 1
    assert "microgrid-mpc: 1 mistake" in told
    assert (
        "controller.strategy: is mpc, whose solver is not installed; expected pip install '.[microgrid]' in the checkout first"
        in told
    )
    assert cli.main(["check", "microgrid", "--set", "slots=200"]) == 0
    assert cli.main(["list"]) == 0
    assert "microgrid-mpc" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("raise ImportError('libosqp.so: cannot open')", "importing osqp raised ImportError: libosqp.so: cannot open"),
        ("raise OSError('wrong ELF class')", "importing osqp raised OSError: wrong ELF class"),
        (
            "import numpy.no_such_module",
            "importing osqp raised ModuleNotFoundError: No module named 'numpy.no_such_module'",
        ),
        ("OSQP = object", "importing osqp raised AttributeError: module 'osqp' has no attribute 'SolverStatus'"),
        ("def", "importing osqp raised SyntaxError: "),
    ],
)
def test_a_broken_solver_is_told_in_one_line(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is there and cannot be used: why, and what to do; status 2."""
    (tmp_path / "osqp.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "osqp", raising=False)
    try:
        assert cli.main(["check", "microgrid-mpc", "--set", "slots=200"]) == 2
    finally:
        sys.modules.pop("osqp", None)  # the broken one, which other tests must not find
    told = capsys.readouterr().err
    assert f"controller.strategy: is mpc, whose solver is broken ({message}" in told
    assert "expected pip install --force-reinstall osqp first, or the strategy lqr" in told
    assert "Traceback" not in told


def test_a_house_needs_a_plant() -> None:
    """And a controller."""
    with pytest.raises(ScenarioError) as caught:
        checked(changed(HOUSE, plant=None, controller=None, legitimate__knows_input=False), "file")
    assert "household: is given without a [plant] and a [controller]" in caught.value.mistakes[0]


def test_the_metrics_are_those_of_the_tables(tmp_path: Path) -> None:
    """Energies from the recorded inputs of every trial; a run that acts on the truth differs from that by nothing."""
    made = {}
    for acts_on in ("estimate", "truth"):
        made[acts_on] = montecarlo(
            "microgrid", trials=3, slots=SLOTS, out=tmp_path / acts_on, record_trials=3,
            controller__acts_on=acts_on, encoding__state_probability=0.3, plan=Plan(workers=1),
        )  # fmt: skip
    power = {}
    for acts_on, results in made.items():
        assert results.inputs is not None
        u = np.array(results.inputs["u"].to_pylist()).reshape(SLOTS, 3, 2)
        power[acts_on] = u[:, :, 1]
    meter = Meter.over(power["estimate"], power["truth"])
    household = made["estimate"].summary["household"]
    assert household["bought_energy"] == pytest.approx(energy(meter.bought, 1.0).mean())
    assert household["sold_energy"] == pytest.approx(energy(meter.sold, 1.0).mean())
    assert household["knowing_truth"]["bought_energy"] == pytest.approx(energy(meter.other_bought, 1.0).mean())
    for name in ("net", "total", "summed"):
        assert household[f"{name}_difference"] == pytest.approx(getattr(meter.difference, name).mean(), rel=1e-9)
        assert made["truth"].summary["household"][f"{name}_difference"] == 0.0
    assert household["summed_difference"] > 1e-4


@pytest.mark.long
def test_active_windows_are_the_days(tmp_path: Path) -> None:
    """A receiver without information has an area near ½, the legitimate one nearly 1; the windows are those of the load."""
    scenario = part_of_day("microgrid", 25_200, 4800, eavesdroppers__bayesian__strategy="smart")
    house = montecarlo(scenario, trials=2, out=tmp_path / "x", plan=Plan(workers=1)).summary["household"]
    load_power = np.array(scenario.plant.disturbance_values)[: 79 * 60, 1]
    assert house["windows"] == 79
    assert house["active_windows"] == int(household.active(load_power, 60, 0.7).sum()) > 5
    told = house["receivers"]
    assert told["legitimate"]["activity_area"] > 0.99
    assert told["smart"]["activity_area"] > 0.97
    assert 0.3 < told["naive"]["activity_area"] < 0.7


@pytest.mark.long
def test_blocks_and_workers_change_nothing(tmp_path: Path) -> None:
    """The same metrics from one process and from two."""
    options: dict[str, Any] = {"trials": 501, "slots": 130, "eavesdroppers__bayesian__strategy": "smart"}
    single = montecarlo("microgrid", out=tmp_path / "one", plan=Plan(workers=1), **options)
    two = montecarlo("microgrid", out=tmp_path / "two", plan=Plan(workers=2), **options)
    assert single.summary["household"] == two.summary["household"]
    assert single.summary["household"]["windows"] == 2
    first, rest = (
        montecarlo(
            "microgrid",
            out=tmp_path / str(at),
            plan=Plan(workers=1),
            **{**options, "trials": trials, "first_trial": at},
        ).summary["household"]
        for at, trials in ((0, 400), (400, 101))
    )
    for name in ("bought_energy", "sold_energy", "net_difference", "summed_difference"):
        mean = (400 * first[name] + 101 * rest[name]) / 501
        assert single.summary["household"][name] == pytest.approx(mean, rel=1e-9)


def test_expectations_of_a_house_are_judged(tmp_path: Path) -> None:
    """One that holds, one that fails, and one that the run does not tell: no window has been active yet."""
    expect = [
        {"metric": "household.sold_energy", "below": 100.0},
        {"metric": "household.summed_difference", "above": 3.0},
        {"metric": "household.naive.activity_area", "below": 0.9},
    ]
    results = montecarlo("microgrid", trials=1, slots=200, out=tmp_path / "x", expect=expect)
    assert [expectation["held"] for expectation in results.summary["expectations"]] == [True, False, None]


@pytest.mark.long
def test_a_sweep_over_a_house_has_its_metrics(evedrop: Evedrop) -> None:
    """In every row, and in a plot of their own."""
    options = ["--slots", "130", "--trials", "2", "--set=eavesdroppers.bayesian.strategy=smart"]
    done = evedrop("sweep", "microgrid", "--over", "encoding.state_probability=0.1,0.9", *options, "--out", "house")
    assert done.status == 0, done.err
    table = pq.read_table(evedrop.folder / "house" / "sweep.parquet").to_pylist()
    assert len(table) == 2 * 4
    assert all(row["sold_energy"] >= 0.0 for row in table)
    assert table[0]["summed_difference"] > table[4]["summed_difference"] > 0.0
    assert (evedrop.folder / "house" / "household.png").stat().st_size > 10_000


def test_a_sweep_over_the_eavesdroppers_of_a_house_is_drawn(evedrop: Evedrop) -> None:
    """Not every point has every receiver."""
    over = "eavesdroppers={},{spy={strategy='smart',link={quality=0.8}}}"
    done = evedrop(
        "sweep", "microgrid", "--over", over, "--slots", "70", "--trials", "2", "--set=expect=[]", "--out", "house"
    )
    assert (done.status, done.err) == (0, "")
    assert (evedrop.folder / "house" / "household.png").stat().st_size > 10_000


def test_the_closing_report_says_what_became_of_the_house(evedrop: Evedrop) -> None:
    """What it buys and sells, and by how much that differs; without active windows nothing on which receiver detects them."""
    done = evedrop("montecarlo", "microgrid", "--slots", "200", "--trials", "1", "--out", "x")
    assert "the house buys 0.0" in done.out
    assert "slot by slot" in done.out
    assert "detection of" not in done.out
