"""Every scheme in a run: the same bits live and in memory, every packet accounted for, no process told more than its part."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop import montecarlo, run
from evedrop.errors import ScenarioError, UsageError
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol.brief import RouterPart, SensorPart
from evedrop.model.acknowledgements import OVERHEARING
from evedrop.model.detection import Chart
from evedrop.model.schemes import scheme_of
from evedrop.scenario.loading import checked
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import expectations_of
from evedrop.score.links import Detection, chart_of
from evedrop.score.summary import DetectionSummary
from evedrop.simulate.montecarlo import check_mode
from evedrop.simulate.simulation import Mode, Simulation
from tests.builders import digests_of, mistakes_of, part_of
from tests.examples import mostly_long

STABLE = [[0.9, 0.3], [0.0, 0.8]]
UNSTABLE = [[1.0, 0.3], [0.5, 1.001]]
MIXED = [[1.2, 0.1], [0.0, 0.5]]
LATE = {"quality": 0.8, "delay": {"model": "constant", "value": 1.0}, "duplicate": 0.1}
JAM = {"from": 10, "to": 20, "jam": "acknowledgements"}
PAUSE = {"from": 12, "to": 17, "pause": "legitimate"}
RUNS: dict[str, dict[str, Any]] = {
    "acknowledged": {"A": UNSTABLE, "attack": {"attack": "critical", "jammer": "ref"}, "event": [JAM]},
    "cipher": {"A": STABLE},
    "encrypted-schedule": {"A": STABLE, "threshold": 2, "attack": {"attack": "forge"}, "event": [PAUSE]},
    "noise": {
        "A": STABLE,
        "state_probability": 0.6,
        "noise_covariance": [[1e-3, 2e-4], [2e-4, 1e-3]],
        "reads_as": "bayesian",
        "event": [PAUSE],
    },
    "open-loop": {"A": MIXED, "attack": {"attack": "forge"}, "event": [JAM, PAUSE]},
    "quantised-schedule": {
        "A": STABLE,
        "threshold": 1.5,
        "bits": 4,
        "standard_deviations": 6.0,
        "attack": {"attack": "hijack", "jammer": "ref"},
        "event": [PAUSE],
    },
    "scheduled": {"A": STABLE, "threshold": 3, "attack": {"attack": "all"}, "event": [JAM]},
    "twin-track": {"A": UNSTABLE, "reads_as": "tracker"},
    "withholding": {"A": STABLE, "state_probability": 0.5},
}
NEEDS = ("acknowledged", "encrypted-schedule", "open-loop", "quantised-schedule", "scheduled")
SILENT = ("scheduled", "withholding")
USUAL = ("acknowledged", "quantised-schedule", "withholding")
"""With references, with packets of few bits, and with slots in which nothing is sent."""


def tables_of(scheme: str, **more: Any) -> dict[str, Any]:
    """A small scenario of a scheme, with eavesdroppers of all kinds, late packets, an attack or an outage."""
    spec = dict(RUNS[scheme])
    A, attack, event = spec.pop("A"), spec.pop("attack", {}), spec.pop("event", [])
    spy = {"strategy": "replay-informed", "reads_as": spec.pop("reads_as", "reference"), "learns_at": 9}
    tables = {
        "title": scheme,
        "slots": 30,
        "trials": 5,
        "process": {"A": A, "Q": [[1e-3, 0.0], [0.0, 1e-3]], "initial_covariance": [[1e-3, 0.0], [0.0, 1e-3]]},
        "encoding": {"scheme": scheme, **spec},
        "legitimate": {"link": {"quality": 0.8}},
        "eavesdroppers": {
            "naive": {"strategy": "naive", "link": {"quality": 0.7}},
            "ref": {"strategy": "reference", "link": {"quality": 0.7}},
            "sel": {"strategy": "selective", "window": 2, "link": dict(LATE)},
            "spy": {**spy, "link": {"quality": 0.6}},
        },
        "event": [dict(entry) for entry in event],
    }
    if scheme in NEEDS:
        tables["acknowledgements"] = {"link": {"quality": 0.9}, **attack}
    return {**tables, **more}


def running(scheme: str, **more: Any) -> Scenario:
    """The same, checked."""
    return checked(tables_of(scheme, **more), scheme)


@pytest.mark.thorough
@pytest.mark.parametrize("scheme", mostly_long(RUNS, USUAL))
def test_live_and_memory_are_the_same_bits(scheme: str, tmp_path: Path) -> None:
    """Equal digests and accounts of every receiver, the same alarms, and no packet unaccounted for."""
    scenario = running(scheme)
    live = run(scenario, out=tmp_path / "live")
    memory = montecarlo(scenario, trials=5, out=tmp_path / "memory")
    assert all(digests_of(live).values())
    assert digests_of(live) == digests_of(memory)
    assert live.summary["links"] == memory.summary["links"]
    assert live.summary["detection"] == memory.summary["detection"]
    rows = live.trials.to_pydict()
    for name, link in live.summary["links"].items():
        assert link["unexplained"] == 0
        assert link["delivered"] + link["lost"] == link["offered"]
        assert (link["offered"] < 5 * 30) == (scheme in SILENT)
        silent = [i for i, peer in enumerate(rows["peer"]) if peer == name and rows["sent"][i] == "nothing"]
        assert bool(silent) == (scheme in SILENT)
        assert all(rows["action"][i] == "dropped" for i in silent)
    journal = live.journal.to_pydict()
    offered = sum(n for n, name in zip(journal["offered"], journal["link"], strict=True) if name == "naive")
    assert offered == live.summary["links"]["naive"]["offered"]


@pytest.mark.parametrize("scheme", RUNS)
def test_who_is_given_what(scheme: str) -> None:
    """Only the sensor's brief has what only it needs, and the leaks' states; only the router's has the acknowledgements' link."""
    briefs = briefs_of(running(scheme), endpoints_at("tcp/127.0.0.1:1"), RecorderTask(Path("nowhere"), False))
    scenario = running(scheme)
    kind = scheme_of(scenario.process.process, scenario.encoding.spec)
    assert set(briefs["sensor"].keys) == {"process", *kind.secret_streams}
    assert set(briefs["legitimate"].keys) == set(kind.estimator_streams)
    assert briefs["naive"].keys == briefs["ref"].keys == briefs["spy"].keys == {}
    holders = {name for name, brief in briefs.items() if "link/acknowledgements" in brief.keys}
    assert holders == ({"router"} if scheme in NEEDS else set())
    assert part_of(briefs["router"], RouterPart).leaks == part_of(briefs["sensor"], SensorPart).leaks == {"spy": 9}
    assert {brief.model.header for brief in briefs.values()} == {len(kind.header)}


@pytest.mark.parametrize("scheme", RUNS)
@pytest.mark.parametrize("mode", [Mode.COVARIANCE_ONLY, Mode.ERROR_COORDINATES])
def test_studies_of_events_refuse_what_they_cannot_follow(scheme: str, mode: Mode) -> None:
    """Packets that are read, acknowledged or not sent, and receivers that take a masked or shifted packet for the state."""
    alone = {"naive": {"strategy": "naive", "link": {"quality": 0.7}}}
    scenario = running(scheme, eavesdroppers=alone, event=[], **_unattacked(scheme))
    with pytest.raises(UsageError, match="follows events, not packets"):
        check_mode(scenario, mode)


def _unattacked(scheme: str) -> dict[str, Any]:
    return {"acknowledgements": {"link": {"quality": 0.9}}} if scheme in NEEDS else {}


def test_a_scheme_and_its_acknowledgements_go_together() -> None:
    """A scheme that needs them wants the table, and no other; a jammer is an eavesdropper; a jam needs an attack."""
    tables = tables_of("acknowledged", event=[])
    del tables["acknowledgements"]
    with pytest.raises(ScenarioError, match=r"acknowledgements: is missing; the scheme acknowledged acts on"):
        checked(tables, "it")
    link = {"link": {"quality": 0.9}}
    assert "the scheme cipher needs none; remove the table" in str(
        mistakes_of(running, "cipher", acknowledgements=link)
    )
    attacked = {**link, "attack": "critical"}
    assert "acknowledgements.jammer: is missing" in str(mistakes_of(running, "scheduled", acknowledgements=attacked))
    nobody = {**attacked, "jammer": "nobody"}
    assert "expected an eavesdropper: naive, ref, sel or spy" in str(
        mistakes_of(running, "scheduled", acknowledgements=nobody)
    )
    assert "does not depend on what it hears" in str(
        mistakes_of(running, "scheduled", acknowledgements={**link, "attack": "all", "jammer": "ref"})
    )
    assert "expected none, all, critical or forge" not in str(
        mistakes_of(running, "scheduled", acknowledgements=nobody)
    )
    assert "event.0.jam: no attack is described" in str(mistakes_of(running, "scheduled", acknowledgements=link))
    assert "has no acknowledgements that could be jammed" in str(mistakes_of(running, "cipher", event=[JAM]))
    twice = [{"at": 3, "jam": "acknowledgements"}, JAM]
    assert "begins in slot 10, while another one lasts" in str(mistakes_of(running, "scheduled", event=twice))


def test_a_queue_and_silence_do_not_go_together() -> None:
    """A link of limited rate counts on a packet in every slot of every trial."""
    slow = {"link": {"quality": 0.8, "rate": 0.5}}
    assert "legitimate.link.rate: is given, but the scheme withholding may stay silent" in str(
        mistakes_of(running, "withholding", legitimate=slow)
    )


def test_an_attack_is_on_in_its_slots_alone() -> None:
    """Without events always; with them from slot to slot, or to the end."""
    assert running("scheduled", event=[]).timeline.jams is None
    assert running("scheduled").timeline.jams == [(10, 20)]
    later = [dict(JAM), {"at": 25, "jam": "acknowledgements"}]
    spans = running("scheduled", event=later).timeline.jams
    assert spans is not None
    assert spans[0] == (10, 20)
    assert spans[1][0] == 25
    assert spans[1][1] > 10**9


def test_the_sensor_notices_what_it_cannot_miss() -> None:
    """Where every packet should be acknowledged, one that is not settles it; the delay counts from the attack's start."""
    perfect = {"link": {"quality": 1.0}, "attack": "all"}
    scenario = running("acknowledged", acknowledgements=perfect, legitimate={"link": {"quality": 1.0}}, event=[JAM])
    assert chart_of(scenario) == Chart(acknowledged=0, missing=1, threshold=1)
    detection = Detection(5)
    for chunk in Simulation(scenario, range(5)).chunks():
        assert chunk.slots is not None
        assert chunk.slots.sensor.alarms is not None
        detection.add_alarms(chunk.first, chunk.slots.sensor.alarms)
    assert np.array_equal(detection.first, np.full(5, 10))
    assert detection.summary(scenario) == DetectionSummary(
        attack_from=10,
        alarms=5,
        false_alarms=0,
        mean_delay=1.0,
        first_alarm=10,
        standard_errors={"mean_delay": 0.0},
    )


@pytest.mark.parametrize(
    ("scheme", "receiver", "attack"),
    [
        ("scheduled", "legitimate", "none"),
        ("scheduled", "naive", "critical"),
        ("scheduled", "ref", "critical"),
        ("scheduled", "ref", "hijack"),
        ("scheduled", "naive", "hijack"),
        ("scheduled", "legitimate", "hijack"),
        ("scheduled", "legitimate", "forge"),
        ("encrypted-schedule", "sel", "critical"),
        ("encrypted-schedule", "legitimate", "none"),
        ("withholding", "naive", "none"),
        ("quantised-schedule", "sel", "critical"),
        ("quantised-schedule", "legitimate", "forge"),
    ],
)
def test_errors_in_runs_agree_with_the_closed_forms(scheme: str, receiver: str, attack: str) -> None:
    """At no time the mean error of 3000 trials is 5 standard errors off, whichever receiver jams."""
    jam = {"attack": attack, **({"jammer": "ref"} if attack in OVERHEARING else {})}
    table = {"acknowledgements": {"link": {"quality": 0.9}, **jam}} if scheme in NEEDS else {}
    eavesdroppers = tables_of(scheme)["eavesdroppers"]
    eavesdroppers["sel"] = {"strategy": "selective", "link": {"quality": 0.8}}
    scenario = running(scheme, event=[], eavesdroppers=eavesdroppers, slots=24, trials=3000, **table)
    expected = expectations_of(scenario)[receiver]
    assert expected.known
    assert np.isfinite(expected.limit)
    errors = np.concatenate([chunk.receivers[receiver].error for chunk in Simulation(scenario, range(3000)).chunks()])
    apart = np.abs(errors.mean(axis=1) - expected.traces(24))
    assert (apart <= 5.0 * errors.std(axis=1) / np.sqrt(3000) + 1e-12).all()


def test_whose_reference_is_kept_and_whose_is_lost() -> None:
    """Blocking the critical acknowledgements is expected to be as good as being the legitimate estimator; listening is not."""
    eavesdroppers = {name: {"strategy": "reference", "link": {"quality": 0.8}} for name in ("ref", "listener")}
    scenario = running("acknowledged", event=[], eavesdroppers=eavesdroppers)
    expectations = expectations_of(scenario)
    assert np.allclose(expectations["ref"].traces(30), expectations["legitimate"].traces(30), rtol=1e-9)
    assert not expectations["listener"].known
    floor = expectations["listener"].bound
    assert floor is not None
    assert floor.traces(30)[-1] > 100.0
    assert (floor.limit, expectations["listener"].infinite_variance) == (np.inf, False)  # it grows alike in all trials
    assert np.isfinite(expectations["ref"].limit)
    jammed_later = running("acknowledged", eavesdroppers=eavesdroppers)
    assert not expectations_of(jammed_later)["listener"].known
    assert expectations_of(jammed_later)["legitimate"].known


@pytest.mark.long
def test_a_betrayed_state_opens_twin_tracks(tmp_path: Path) -> None:
    """Live as in memory: slots after it the spy's error is below a millionth of that of the same reader without the leak.

    Before it the two err alike, each behind a link of its own.
    """
    link = {"link": {"quality": 0.9}}
    tracker = {"strategy": "tracker", **link}
    spy = {"strategy": "replay-informed", "reads_as": "tracker", "learns_at": 20, **link}
    scenario = running("twin-track", slots=40, trials=30, eavesdroppers={"tracker": tracker, "spy": spy})
    live = run(scenario, out=tmp_path / "live")
    memory = montecarlo(scenario, trials=30, out=tmp_path / "memory")
    assert all(digests_of(live).values())
    assert digests_of(live) == digests_of(memory)
    rows = live.slots.to_pydict()
    error = {
        name: np.array([e for e, peer in zip(rows["mean_squared_error"], rows["peer"], strict=True) if peer == name])
        for name in ("tracker", "spy")
    }
    assert error["spy"][10:20] == pytest.approx(error["tracker"][10:20], rel=0.2)
    assert error["spy"][20] == 0.0
    assert np.all(error["spy"][21:] < 1e-6 * error["tracker"][21:])
    assert error["spy"][21:].mean() < 0.01
