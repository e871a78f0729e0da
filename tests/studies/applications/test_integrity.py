"""Integrity in scenarios: its table and mistakes, its metrics against sums written here, its panels, live and in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.cli.api import montecarlo, run
from evedrop.errors import ScenarioError
from evedrop.model.slot.records import SensorSlots
from evedrop.scenario.application import ApplicationTally, PowerFeed
from evedrop.scenario.closed_loop import controlled_plant, monitor_of
from evedrop.scenario.loading import load
from evedrop.show.view.scene_slots import LoopValues, driven_scene, replay
from evedrop.simulate.montecarlo import Plan
from evedrop.studies.applications.integrity import Integrity
from evedrop.studies.secrecy_cost import secrecy_cost
from tests.builders import places_of
from tests.examples import mostly_long
from tests.golden.pages import Golden
from tests.show.view.read_back import rows

ALONE = Plan(workers=1)
SHORT: dict[str, Any] = {"expect": [], "plan": ALONE}
PARSIMONIOUS = {"policy": "parsimonious", "watch_from": 0.05, "alarm_from": 0.99, "attack_rate": 1e-3}
ATTACK = {"model": "replace", "matrix": [[0.8]]}


def test_its_metrics_are_those_of_the_recorded_trials(tmp_path: Path) -> None:
    """Alarms, delays, and the watermark's cost, from the tables of forty trials, slot by slot."""
    results = montecarlo("replay-attack", trials=40, record_trials=40, out=tmp_path / "run", **SHORT)
    integrity, table = results.summary["integrity"], results.inputs
    assert table is not None
    by_trial = {
        name: np.array(table[name].to_pylist(), float).reshape(260, 40) for name in ("u", "watermark", "statistic")
    }
    x = np.array([row["x"][0] for row in results.trials.to_pylist() if row["peer"] == "legitimate"]).reshape(260, 40)
    alarms = by_trial["statistic"] >= 8.0
    first = np.where(alarms.any(axis=0), alarms.argmax(axis=0), -1)
    sound = first[(first < 0) | (first >= 160)]
    assert integrity["false_alarm_fraction"] == np.mean((first >= 0) & (first < 160))
    assert integrity["detected_fraction"] == np.mean(sound >= 0)
    assert integrity["mean_delay"] == pytest.approx(np.mean(sound[sound >= 0] - 159))
    assert integrity["watermark_fraction"] == pytest.approx(np.mean(by_trial["watermark"] != 0.0))
    assert integrity["standard_errors"]["mean_delay"] == pytest.approx(
        np.std(sound[sound >= 0], ddof=1) / np.sqrt(len(sound))
    )
    # x is the filter's estimate here, whose error is independent of the watermark.
    e, L, M = by_trial["watermark"][:160], 0.962578, 1.201071
    cost = (M * e * (2.0 * (by_trial["u"] + L * x)[:160] + e)).mean(axis=0)
    assert integrity["watermark_cost"] == pytest.approx(cost.mean(), abs=4.0 * cost.std() / np.sqrt(40))
    assert integrity["expected_watermark_cost"] == pytest.approx(0.3 * M, rel=1e-2)
    assert abs(integrity["watermark_cost_z"]) < 4.0
    assert integrity["divergence"] == pytest.approx(0.74, rel=1e-2)
    assert integrity["expected_delay"] == pytest.approx(8.0 / integrity["divergence"])


HEATED: dict[str, Any] = {
    "slots": 80, "slot_seconds": 60.0, "event": [], "integrity": {"policy": "always", "threshold": 8.0, "watermark": [[1.0]]},
    "plant__input_lower": [-1.0], "plant__input_upper": [1.0], "plant__disturbances": ["load"],
    "plant__disturbance_matrix": [[0.1]], "plant__disturbance_values": [[0.5]] * 80, "process__A": [[0.9]],
    "controller__input_weights": [1.0],
    "comfort": {"temperature": "level", "heater": "valve", "lowest": -1.0, "highest": 1.0},
    "household": {"grid": "valve", "load": "load", "battery": "level"},
}  # fmt: skip
"""A room whose heater has a watermark, which its limits often clip."""


def test_the_watermark_is_power_too(tmp_path: Path) -> None:
    """Clipped inputs, heating and grid power are those of inputs with the watermark, as they enter the plant."""
    scenario = load("replay-attack", {name.replace("__", "."): value for name, value in HEATED.items()})
    results = montecarlo(scenario, trials=5, record_trials=5, out=tmp_path / "run", **SHORT)
    assert results.inputs is not None
    columns = results.inputs.to_pydict()
    asked = np.array(columns["u"])[:, 0] + np.array(columns["watermark"])[:, 0]
    power = np.clip(asked, -1.0, 1.0)
    summary = results.summary
    assert columns["clipped"] == (power != asked).tolist()
    assert summary["controller"]["clipped_fraction"] == np.mean(power != asked) > 0.1
    assert summary["comfort"]["heating_energy"] == pytest.approx(power.sum() / 60.0 / 5)
    assert summary["household"]["bought_energy"] == pytest.approx(power.clip(0.0).sum() / 60.0 / 5)
    assert summary["household"]["sold_energy"] == pytest.approx((-power).clip(0.0).sum() / 60.0 / 5)
    # Over a perfect link the controllers differ by the filter's error alone, and have the same watermark.
    assert summary["household"]["summed_difference"] < 0.5
    cost = secrecy_cost(scenario.model_copy(update={"trials": 5}), lambda _: None, ALONE).differences
    assert cost["scheme_from_truth"]["summed"].mean == pytest.approx(summary["household"]["summed_difference"])
    recording = replay(results.folder, tmp_path / "run.rrd")
    energy = rows(recording, "heating/energy", "Scalars:scalars")
    assert energy[79] == pytest.approx([power[::5].sum() / 60.0])


def test_an_application_may_have_no_use_for_a_watermark() -> None:
    """By default, neither a tally nor a power feed takes it."""
    sensor = SensorSlots(0, np.zeros((1, 1, 1)), np.zeros((1, 1), np.bool_), np.ones((1, 1), np.bool_))
    nothing: Any = None
    ApplicationTally.add_monitored(nothing, sensor.states, sensor.states, sensor)
    PowerFeed.take_monitored(nothing, sensor)


def test_a_filter_that_is_deceived_is_not_compared_with_theory() -> None:
    """Theory expects the error of one that gets the true measurements."""
    for begins in (20, None):
        event = [
            {"note": "no attack", "at": 20} if begins is None else {"from": begins, "to": 40, "spoof": "measurements"}
        ]
        attack = {} if begins is None else {"integrity.attack": ATTACK}
        scenario = load(
            "replay-attack", {"slots": 40, "trials": 40, "event": event, "integrity.attack": None, **attack}
        )
        z = montecarlo(scenario, trials=40, **SHORT).summary["filter"]["z"]
        assert (z is None) == (begins is not None)
        assert z is None or abs(z) < 5.0


@pytest.mark.long
def test_totals_of_parts_are_the_totals(tmp_path: Path) -> None:
    """600 trials are two blocks; whichever worker has them, the entry is the same, and the digest that of all trials."""
    first, second = (
        montecarlo("replay-attack", trials=600, slots=200, out=tmp_path / str(workers), event=[], expect=[],
                   integrity={"policy": "always", "threshold": 3.0, "watermark": [[0.3]]}, plan=Plan(workers=workers))
        .summary["integrity"]
        for workers in (1, 2)
    )  # fmt: skip
    assert first == second
    assert first["digest"]
    assert 0.0 < first["false_alarm_fraction"] < first["false_alarm_bound"] == 1.0
    assert (first["attack_from"], first["detected_fraction"], first["expected_delay"]) == (None, None, None)


@pytest.mark.thorough
@pytest.mark.parametrize("policy", mostly_long(["always", "parsimonious"], ["parsimonious"]))
def test_live_and_memory_have_the_same_digest(policy: str, tmp_path: Path) -> None:
    """With an attack that begins and ends, over links that lose packets, and limits that clip the inputs."""
    table = {"policy": "always", "threshold": 4.0} if policy == "always" else dict(PARSIMONIOUS)
    changes: dict[str, Any] = {
        "slots": 60, "trials": 20, "expect": [], "legitimate__link__quality": 0.8, "plant__input_upper": [1.0],
        "integrity": {**table, "watermark": [[0.5]], "attack": ATTACK},
        "event": [{"from": 20, "to": 40, "spoof": "measurements"}],
    }  # fmt: skip
    live = run("replay-attack", out=tmp_path / "live", **changes).summary
    memory = montecarlo("replay-attack", out=tmp_path / "memory", plan=ALONE, **changes).summary
    assert live["integrity"]["digest"] == memory["integrity"]["digest"] is not None
    assert live["integrity"] == memory["integrity"]
    assert live["controller"]["digest"] == memory["controller"]["digest"]
    assert memory["integrity"]["expected_watermark_cost"] is None
    assert [(event["slot"], event["event"]) for event in live["events"]] == [
        (20, "measurements are attacked"),
        (40, "measurements are no longer attacked"),
    ]


def test_the_recording_has_its_panels(tmp_path: Path) -> None:
    """Made from the tables of a run in memory: statistic and watermark in every slot, and one alarm at the first crossing."""
    results = montecarlo("replay-attack", trials=1, out=tmp_path / "run", **SHORT)
    recording = replay(results.folder, tmp_path / "run.rrd")
    assert results.inputs is not None
    table = results.inputs.to_pydict()
    statistic = rows(recording, "evidence/statistic", "Scalars:scalars")
    assert [statistic[k][0] for k in range(260)] == table["statistic"]
    watermark = rows(recording, "watermark/e0", "Scalars:scalars")
    assert [watermark[k] for k in range(260)] == table["watermark"]
    first = next(k for k in range(260) if table["statistic"][k] >= 8.0)
    assert [*rows(recording, "evidence/alarm", "Scalars:scalars")] == [first]
    assert {value[0] for value in rows(recording, "evidence/threshold", "Scalars:scalars").values()} == {8.0}


def test_the_view_is_given_every_curve_of_its_panels() -> None:
    """In blocks of slots as in one; the alarm is a point, once. Without watermark there is one panel less."""
    scenario = load("replay-attack", {"expect": []})
    u, statistic = np.zeros((6, 1)), np.array([0.0, 1.0, 9.0, 9.0, 9.0, 9.0])[:, None]
    zeros = np.zeros((6, 2, 1))
    watermark = np.arange(6.0)[:, None, None]
    sensor = SensorSlots(0, zeros, zeros[:, 0] > 0.0, u=u[..., None], statistic=statistic, watermark=watermark)
    estimates = {name: np.zeros((6, 1)) for name in scenario.receivers}
    whole, parts = LoopValues.of(scenario), LoopValues.of(scenario)
    assert whole is not None
    assert parts is not None
    at_once = whole.take(sensor, estimates).curves
    blocks = [
        parts.take(sensor.rows(some), {name: estimate[some] for name, estimate in estimates.items()}).curves
        for some in (slice(0, 3), slice(3, 6))
    ]
    panels = driven_scene(scenario)["panels"]
    assert set(at_once) == {f"{panel.path}/{curve.name}" for panel in panels for curve in panel.curves}
    for path, curve in at_once.items():
        assert np.array_equal(np.concatenate([block[path] for block in blocks], axis=1), curve)
    assert at_once["evidence/alarm"].tolist() == [[2.0], [9.0]]
    unmarked = load("replay-attack", {"expect": [], "integrity": {"policy": "always", "threshold": 8.0}, "event": []})
    assert [panel.path for panel in driven_scene(unmarked)["panels"]] == ["evidence"]


def test_an_attack_without_events_lasts_all_run() -> None:
    """As an attack on acknowledgements does; without an attack there are no such slots."""
    table = {"policy": "always", "threshold": 8.0}
    plans = [
        monitor_of(load("replay-attack", {"expect": [], "event": [], "integrity": {**table, **attack}}))
        for attack in ({"attack": ATTACK}, {})
    ]
    assert [None if plan is None else list(plan.spans) for plan in plans] == [[(0, 260)], []]
    scenario = load("heated-room")
    loop = controlled_plant(scenario)
    assert loop is not None
    assert monitor_of(scenario) is None
    assert Integrity.lines({"false_alarm_fraction": None}) == []


def test_the_closing_report_has_its_lines() -> None:
    """With bound, delay and theory where there are any."""
    entries = {
        "false_alarm_fraction": 0.01, "false_alarm_bound": 0.05, "detected_fraction": 1.0, "mean_delay": 12.0,
        "expected_delay": 11.5, "watermark_cost": 0.36, "expected_watermark_cost": 0.35, "watermark_cost_z": 1.5,
        "watermark_fraction": 0.5, "standard_errors": {"mean_delay": 0.5},
    }  # fmt: skip
    assert Integrity.lines(entries) == [
        "false alarms in 1 % of the trials, by theory at most 5 %",
        "the attack is detected in 100 % of the other trials, after 12.0 ± 0.5 slots; h/D is 11.5",
        "the watermark costs 0.36 a slot before the attack, by theory 0.35 (z 1.5); it is on in 50 % of all slots",
    ]
    bare = {**dict.fromkeys(entries), "false_alarm_fraction": 0.0, "detected_fraction": 0.0, "watermark_cost": 0.1}
    bare |= {"standard_errors": {}, "watermark_fraction": 1.0}
    assert Integrity.lines(bare) == [
        "false alarms in 0 % of the trials",
        "the attack is detected in 0 % of the other trials",
        "the watermark costs 0.1 a slot before the attack; it is on in 100 % of all slots",
    ]
    assert len(Integrity.lines({**bare, "watermark_fraction": 0.0})) == 2


BASE = {"policy": "always", "threshold": 8.0, "watermark": [[0.3]]}


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"integrity.threshold": -1.0}, "integrity.threshold"),
        ({"integrity.threshold": "high"}, "integrity.threshold"),
        ({"integrity": {"policy": "always"}}, "integrity.threshold"),
        ({"integrity.policy": "often"}, "integrity.policy"),
        ({"integrity.alarm_from": 0.9}, "integrity.alarm_from"),
        ({"integrity": {**PARSIMONIOUS, "watch_from": 0.995}}, "integrity.watch_from"),
        ({"integrity.watermark": [[-0.3]]}, "integrity.watermark"),
        ({"integrity.watermark": [[0.3, 0.1]]}, "integrity.watermark"),
        ({"integrity.watermark": [[0.3, 0.1], [0.2, 0.3]]}, "integrity.watermark"),
        ({"integrity.watermark": [[0.3, 0.1], [0.1, 0.3]]}, "integrity.watermark"),
        ({"integrity.attack": {}}, "integrity.attack.model"),
        ({"integrity.attack.model": "repla"}, "integrity.attack.model"),
        ({"integrity.attack": {"model": "replay"}}, "integrity.attack.recorded"),
        ({"integrity.attack.recorded": 0}, "integrity.attack.recorded"),
        ({"integrity.attack.recorded": 161}, "integrity.attack.recorded"),
        ({"integrity.attack": {"model": "replace", "matrix": []}}, "integrity.attack.matrix"),
        ({"integrity.attack": {**ATTACK, "noise": 3}}, "integrity.attack.noise"),
        ({"integrity.attack": {**ATTACK, "recorded": 3}}, "integrity.attack.recorded"),
        ({"integrity.attack": {"model": "replace", "matrix": [[1.2]]}}, "integrity.attack.matrix"),
        ({"integrity": BASE}, "integrity.attack"),
        ({"controller.period": 2}, "controller.period"),
        ({"controller.acts_on": "truth"}, "controller.acts_on"),
        ({"controller.rate_weights": [0.1]}, "controller.rate_weights"),
        ({"controller": {"strategy": "mpc", "state_weights": [1.0], "input_weights": [0.1]}}, "controller.strategy"),
        ({"event": [{"at": 160, "spoof": "sensor"}]}, "event.0.spoof"),
        ({"event": [{"at": 150, "spoof": "measurements"}, {"at": 170, "spoof": "measurements"}]}, "event.1.spoof"),
    ],
    ids=str,
)  # fmt: skip
def test_mistakes_are_named(changes: dict[str, Any], place: str, golden: Golden) -> None:
    """Mistakes in the table, and in its use with plant, controller and events, say what is expected."""
    with pytest.raises(ScenarioError) as caught:
        load("replay-attack", {"expect": [], **changes})
    assert place in places_of(caught.value.mistakes)
    golden("check", caught.value.mistakes)


@pytest.mark.parametrize("place", ["integrity.threshold", "integrity.attack.matrix"])
def test_a_number_beyond_float64_is_a_mistake(place: str) -> None:
    """A whole number of a file may have more digits than the detector's arithmetic takes."""
    value: Any = 10**400 if place.endswith("threshold") else [[10**400]]
    with pytest.raises(ScenarioError) as caught:
        load("replay-attack", {"expect": [], "integrity.attack": ATTACK, place: value})
    assert places_of(caught.value.mistakes) == [place]


UNSEEN: dict[str, Any] = {
    "expect": [],
    "process": {
        "A": [[1.1, 0.0], [1.0, 1.1]], "Q": [[1.0, 0.0], [0.0, 1.0]], "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
    },
    "plant": {
        "inputs": ["u"], "input_matrix": [[1.0], [0.0]], "noise": [[1.0, 0.0], [0.0, 1.0]],
        "output_matrix": [[1.0, 0.0]], "measurement_noise": [[0.1]],
    },
    "controller": {"strategy": "lqr", "state_weights": [1.0, 1.0], "input_weights": [0.1]},
}  # fmt: skip
"""The measurements do not show the second state."""


def test_what_integrity_needs_is_named() -> None:
    """A plant with a controller; measurements that show every state; and a table for an event."""
    table = {"policy": "always", "threshold": 8.0, "watermark": [[0.3]]}
    cases: list[tuple[str, dict[str, Any], str]] = [
        ("eavesdroppers", {"integrity": table}, "integrity: is given without a [plant] and a [controller]"),
        (
            "heated-room",
            {"integrity": table},
            "integrity: needs measurements, which its detector tests; expected output_matrix",
        ),
        (
            "heated-room",
            {"event": [{"at": 5, "spoof": "measurements"}]},
            "event.0.spoof: no attack is described; expected",
        ),
        (
            "replay-attack",
            {"plant.output_matrix": [[0.0]], "expect": []},
            "plant.output_matrix: is 0, so that the measurements show nothing",
        ),
        (
            "replay-attack",
            UNSEEN,
            "plant.output_matrix: shows only 1 of 2 directions",
        ),
    ]
    for name, changes, message in cases:
        with pytest.raises(ScenarioError) as caught:
            load(name, changes)
        assert any(line.startswith(message) for line in caught.value.mistakes), caught.value.mistakes


def test_a_distribution_that_does_not_exist_is_refused() -> None:
    """A filter that runs away under attack: (1 − K C)(A − B L) is unstable, though filter and regulator are stable."""
    unstable = {
        "process": {
            "A": [[1.1, 1.0], [0.0, 1.1]], "Q": [[1.0, 0.0], [0.0, 1.0]],
            "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
        },
        "plant": {
            "inputs": ["u"], "input_matrix": [[0.0], [1.0]], "noise": [[1.0, 0.0], [0.0, 1.0]],
            "output_matrix": [[-0.1, 1.0]], "measurement_noise": [[0.01]],
        },
        "controller": {"strategy": "lqr", "state_weights": [1.0, 1.0], "input_weights": [0.01]},
    }  # fmt: skip
    with pytest.raises(ScenarioError) as caught:
        load("replay-attack", {"expect": [], **unstable})
    assert any(line.startswith("integrity: the detector's distribution under attack") for line in caught.value.mistakes)
