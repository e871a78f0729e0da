"""The heated room: its metrics against sums written here, its table, its panels, and shards of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.cli.api import montecarlo
from evedrop.errors import ScenarioError
from evedrop.results.reading import Results
from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.closed_loop import controlled_plant
from evedrop.scenario.loading import load
from evedrop.show.view.scene_slots import LoopValues, driven_scene
from evedrop.simulate.montecarlo import Plan
from tests.builders import with_inputs
from tests.conftest import Evedrop
from tests.packages import install

SHORT = {"slots": 300, "expect": []}


def test_its_metrics_are_sums_over_slots(tmp_path: Path) -> None:
    """From the inputs and states that the run recorded, added up here slot by slot."""
    results = montecarlo(load("heated-room", SHORT), trials=1, out=tmp_path / "run")
    scenario = load("heated-room", SHORT)
    loop = controlled_plant(scenario)
    assert loop is not None
    trials = results.trials.to_pylist()
    assert results.inputs is not None
    states = [row["x"] for row in trials if row["peer"] == "legitimate"]
    power = [row["u"] for row in results.inputs.to_pylist()]
    outside = [max(20.5 - room, room - 22.5, 0.0) for room, _ in states]
    comfort = results.summary["comfort"]
    assert comfort["discomfort"] == pytest.approx(sum(outside) / 60)
    assert sum(outside) > 0
    assert comfort["heating_energy"] == pytest.approx(sum(min(max(u, -1.0), 3.0) for (u,) in power) / 60)
    for name in scenario.receivers:
        estimated = [row["x_hat"][0] for row in trials if row["peer"] == name]
        right = [
            (20.5 <= room <= 22.5) == (20.5 <= (guess) <= 22.5)
            for guess, (room, _) in zip(estimated, states, strict=True)
        ]
        assert comfort["receivers"][name]["known_fraction"] == pytest.approx(np.mean(right))


@pytest.mark.long
def test_totals_of_parts_are_the_totals(tmp_path: Path) -> None:
    """Two workers or one: the same bits. And they are the means of the trials' parts, weighted by their trials."""
    scenario = load("heated-room", {**SHORT, "slots": 90})
    whole = montecarlo(scenario, trials=600, out=tmp_path / "one", plan=Plan(workers=1)).summary["comfort"]
    assert montecarlo(scenario, trials=600, out=tmp_path / "two", plan=Plan(workers=2)).summary["comfort"] == whole
    first, rest = (
        montecarlo(scenario, trials=trials, first_trial=at, out=tmp_path / str(at), plan=Plan(workers=1)).summary[
            "comfort"
        ]
        for at, trials in ((0, 450), (450, 150))
    )
    for name in ("discomfort", "heating_energy"):
        assert whole[name] == pytest.approx(0.75 * first[name] + 0.25 * rest[name], rel=1e-12)
    for receiver, entries in whole["receivers"].items():
        known_fractions = [part["receivers"][receiver]["known_fraction"] for part in (first, rest)]
        assert entries["known_fraction"] == pytest.approx(
            0.75 * known_fractions[0] + 0.25 * known_fractions[1], rel=1e-12
        )


def test_the_view_is_given_every_curve_of_its_panels() -> None:
    """In blocks of slots as in one: sums go on where the block before ended."""
    scenario = load("heated-room", SHORT)
    rng = np.random.default_rng(1)
    u = rng.normal(size=(40, 1))
    estimates = {name: rng.normal(size=(40, 2)) for name in scenario.receivers}
    whole, parts = LoopValues.of(scenario), LoopValues.of(scenario)
    assert whole is not None
    assert parts is not None
    at_once = whole.take(with_inputs(u), estimates).curves
    blocks = [
        parts.take(with_inputs(u).rows(rows), {name: estimate[rows] for name, estimate in estimates.items()}).curves
        for rows in (slice(0, 7), slice(7, 40))
    ]
    wanted = {f"{panel.path}/{curve.name}" for panel in driven_scene(scenario)["panels"] for curve in panel.curves}
    assert set(at_once) == wanted
    for path, curve in at_once.items():
        np.testing.assert_allclose(np.concatenate([block[path] for block in blocks], axis=1), curve, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"comfort.heater": "P_grid"}, 'comfort.heater: is "P_grid", which is not among plant.inputs; expected one of P_heat'),
        ({"comfort.temperature": "T"}, 'comfort.temperature: is "T", which is not among process.states; expected one of T_room'),
        ({"plant.input_units": ["W"]}, 'comfort.heater: is "P_heat", which is in W; expected a power in kW'),
        ({"slot_seconds": None}, "slot_seconds: is missing, and the energies of [comfort] need the duration of a slot; expe"),
        ({"comfort.lowest": 25.0}, "comfort.lowest: is 25.0, and highest is 22.5; expected lowest < highest"),
        ({"comfort.lowest": "warm"}, "comfort.lowest: is \"warm\"; expected a number, such as 20.0"),
        ({"comfort.window": 3}, "comfort.window: "),
        ({"comfort": 3}, "comfort: is 3; expected a table"),
        ({"comfrt": {}}, "comfrt: is not an entry of this table; did you mean comfort?"),
        ({"expect": [{"metric": "comfort.cold", "below": 1.0}]}, 'expect.0.metric: is "comfort.cold"; expected comfort.METRIC ('),
        ({"expect": [{"metric": "comfort.bob.known_fraction", "below": 1.0}]}, "expect.0.metric: is "),
        ({"expect": [{"metric": "comfort.discomfort", "below": 1.0, "quantile": 0.5}]}, "expect.0.quantile: is set, but the com"),
    ],
)  # fmt: skip
def test_mistakes_are_named(changes: dict[str, Any], message: str) -> None:
    """Mistakes in the table, in names and in expectations each get a line that says what is expected."""
    with pytest.raises(ScenarioError) as caught:
        load("heated-room", changes)
    assert any(line.startswith(message) for line in caught.value.mistakes), caught.value.mistakes


def test_a_table_without_a_plant_is_refused() -> None:
    """It describes a plant with a controller; and both mistakes of a file are reported at once."""
    comfort = {"temperature": "x", "heater": "u", "lowest": 1.0, "highest": 2.0}
    with pytest.raises(ScenarioError) as caught:
        load("eavesdroppers", {"comfort": comfort, "record_trials": 9})
    lines = caught.value.mistakes
    assert any(line.startswith("comfort: is given without a [plant] and a [controller]") for line in lines), lines
    assert any(line.startswith("record_trials: is 9") for line in lines), lines


SCENARIO = """
title = "Two vehicles"
slots = 200
process = { A = [[1.0]], Q = [[0.01]], initial_covariance = [[0.01]], states = ["gap"] }
plant = { inputs = ["a"], input_matrix = [[1.0]] }
controller = { strategy = "lqr", state_weights = [1.0], input_weights = [1.0] }
platoon = { gap = "gap" }
encoding = { scheme = "innovation", state_probability = 0.5 }
legitimate = { link = { quality = 0.8 } }
expect = [{ metric = "platoon.smallest_gap", below = 0.0 }]
"""
PLATOON = {"evedrop.applications": {"platoon": "platooning:Platoon"}}


@pytest.mark.long
def test_an_application_of_another_package_needs_nothing_here(evedrop: Evedrop) -> None:
    """The one of the docs, a file and a line of metadata: in memory, live and in a sweep, with expectation and closing line."""
    page = (Path(__file__).parents[3] / "docs" / "your-own" / "application.md").read_text(encoding="utf-8")
    install(evedrop.folder, {"platooning.py": page.partition("# platooning.py\n")[2].partition("```")[0]}, PLATOON)
    (evedrop.folder / "two.toml").write_text(SCENARIO)
    environment = {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}
    lines = []
    for arguments in (["montecarlo", "two.toml", "--trials", "1"], ["run", "two.toml", "--view", "off"]):
        done = evedrop.process(*arguments, "--out", arguments[0], env=environment)
        assert done.status == 0, done.err
        lines += [line for line in done.out.splitlines() if line.startswith("the smallest gap is ")]
        assert "expected platoon.smallest_gap below 0: held" in done.out
    assert len(lines) == 2
    assert lines[0] == lines[1]
    done = evedrop.process(
        "sweep", "two.toml", "--over", "slots=50,100", "--trials", "2", "--out", "swept", env=environment
    )
    assert done.status == 0, done.err
    assert "platoon" not in APPLICATIONS.names


ADD, SUMMARY, TALLY = (
    "self.smallest = np.minimum(",
    'return {"smallest_gap": float(self.smallest.min())}',
    "return GapTally(loop.state(table.gap), trials)",
)
FAILING = {
    "an error in a slot": (ADD, f"raise ValueError('no'); {ADD}", "ValueError: no, platooning.py line "),
    "a file that is missing": (ADD, f"open('/nowhere'); {ADD}", "FileNotFoundError: [Errno 2] No such file"),
    "an exit": (ADD, f"raise SystemExit(0); {ADD}", "SystemExit: 0, platooning.py line "),
    "an exit at the end": (SUMMARY, "raise SystemExit(0)", "SystemExit: 0, platooning.py line "),
    "no number": (
        SUMMARY,
        "return {'smallest_gap': 'abc'}",
        "summary() gave 'abc' as smallest_gap; expected a number, or None",
    ),
    "an object": (
        SUMMARY,
        "return {'smallest_gap': 1.0, 'more': object()}",
        "TypeError: Object of type object is not JSON",
    ),
    "no tally": (TALLY, "return None", "it gave None as its tally; expected an ApplicationTally"),
}
"""What fails → the line of the module, its replacement, and the expected message."""


@pytest.mark.parametrize("case", FAILING)
@pytest.mark.parametrize("how", ["in memory", pytest.param("live", marks=pytest.mark.long)])
def test_an_application_that_fails_costs_nothing_else(evedrop: Evedrop, case: str, how: str) -> None:
    """All else is measured and saved; then the run fails with status 3, and names application, error and line."""
    line, instead, message = FAILING[case]
    page = (Path(__file__).parents[3] / "docs" / "your-own" / "application.md").read_text(encoding="utf-8")
    module = page.partition("# platooning.py\n")[2].partition("```")[0]
    install(evedrop.folder, {"platooning.py": module.replace(line, instead)}, PLATOON)
    (evedrop.folder / "two.toml").write_text(SCENARIO)
    command = ("run", "--view", "off") if how == "live" else ("montecarlo", "--workers", "1")
    environment = {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}
    done = evedrop.process(command[0], "two.toml", *command[1:], "--trials", "2", "--out", "run", env=environment)
    assert done.status == 3, done.err
    assert f"the application platoon of an installed package failed: {message}" in done.err
    assert "Traceback" not in done.err
    summary = Results.read(evedrop.folder / "run").summary
    assert summary["ended"] in done.err
    assert summary["slots"] == 200
    assert summary["peers"]["legitimate"]["digest"] is not None
    assert "platoon" not in summary
    assert summary["expectations"][0]["held"] is None


def test_closing_lines_that_fail_are_named(evedrop: Evedrop) -> None:
    """The run has ended well, and the closing report says what its application could not say."""
    page = (Path(__file__).parents[3] / "docs" / "your-own" / "application.md").read_text(encoding="utf-8")
    module = page.partition("# platooning.py\n")[2].partition("```")[0].replace("['smallest_gap']", "['largest_gap']")
    install(evedrop.folder, {"platooning.py": module}, PLATOON)
    (evedrop.folder / "two.toml").write_text(SCENARIO)
    environment = {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}
    done = evedrop.process("montecarlo", "two.toml", "--trials", "2", "--out", "run", env=environment)
    assert (done.status, done.err) == (0, "")
    assert "platoon: its lines cannot be written (KeyError: 'largest_gap', platooning.py line " in done.out


def test_an_application_that_cannot_be_loaded_is_a_mistake_of_who_uses_it(evedrop: Evedrop) -> None:
    """It is refused with the reason, among the scenario's other mistakes; scenarios without its table still run."""
    install(evedrop.folder, {"platooning.py": "import nothing_of_this_name\n"}, PLATOON)
    (evedrop.folder / "two.toml").write_text(SCENARIO.replace("slots = 200", "slots = -1"))
    environment = {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}
    done = evedrop.process("check", "two.toml", env=environment)
    assert done.status == 2
    assert "Traceback" not in done.err
    assert "platoon: is a table, which an installed package says is platooning:Platoon, and the module" in done.err
    assert "No module named 'nothing_of_this_name'" in done.err
    assert "slots: is -1" in done.err
    assert evedrop.process("check", "eavesdroppers", "microgrid", env=environment).status == 0
