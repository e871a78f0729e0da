"""Mean errors that rare events carry, by splitting: copies in the simulation, closed forms with heavy tails, and doubts."""

from __future__ import annotations

import json
import math
import os
import signal
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.cli.api import montecarlo
from evedrop.cli.report import print_summary
from evedrop.errors import Interrupted
from evedrop.model.process import Process
from evedrop.model.streams import OWN, Lineage
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import expectations_of
from evedrop.score.summary import Summary
from evedrop.simulate import montecarlo as studies
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode, Simulation
from evedrop.simulate.splitting import POPULATIONS, SplitMeans, Splitter, rare_estimates
from tests.builders import UNSTABLE, listener, process_table, scenario_of
from tests.conftest import Evedrop

SURE = 4.5
SETTLED = {**process_table(UNSTABLE), "initial_covariance": [[1e-3, 0.0], [0.0, 1e-3]]}
BURSTS = {"loss": {"model": "gilbert-elliott", "p": 0.1, "r": 0.8}}
MIXED = {"A": [[1.2, 0.1], [0.0, 0.5]], "Q": [[0.6, 0.2], [0.2, 0.5]], "initial_covariance": [[0.6, 0.2], [0.2, 0.5]]}
FLIPPED = {"link": {"quality": 0.9}, "attack": "flip", "flip": 0.1}


def heavy(**more: Any) -> Scenario:
    """The paper's example, whose errors have infinite variance, with a good link, a link with bursts, and a misled receiver."""
    tables = {
        "slots": 30,
        "seed": 3,
        "encoding": {"scheme": "innovation", "state_probability": 0.56},
        "eavesdroppers": {
            "better": listener("smart", 0.95),
            "bursts": {"strategy": "smart", "link": dict(BURSTS)},
            "naive": listener("naive", 0.8),
        },
    }
    return scenario_of(Process(UNSTABLE.A, UNSTABLE.Q, 1e-3 * np.eye(2)), beyond_horizon=True, **{**tables, **more})


ACKNOWLEDGED = {
    "process": MIXED,
    "encoding": {"scheme": "random-code", "plain_probability": 0.305},
    "legitimate": {"link": {"quality": 0.8}},
    "acknowledgements": FLIPPED,
    "eavesdroppers": {"ref": {"strategy": "reference", "link": {"quality": 0.8}}},
}
"""The unstable case of Lücke, Lu and Quevedo."""
LATE: dict[str, Any] = {
    "legitimate": {
        "link": {**BURSTS, "delay": {"model": "normal", "mean": 1.0, "standard_deviation": 0.7}},
        "window": 3,
    },
    "eavesdroppers": {
        "wise": {"strategy": "bayesian", "link": {"quality": 0.9}},
        "coin": {"strategy": "suspicious", "use_state": 0.8, "use_innovation": 0.3, "link": {"quality": 0.9}},
    },
}


def errors_of(scenario: Scenario, mode: Mode, lineage: Lineage = OWN, trials: int = 6) -> dict[str, np.ndarray]:
    """Receiver → its errors, (slots, trials)."""
    chunks = list(Simulation(scenario, range(trials), mode, lineage=lineage).chunks())
    return {name: np.concatenate([chunk.receivers[name].error for chunk in chunks]) for name in chunks[0].receivers}


@pytest.mark.parametrize(("mode", "more"), [("exact", ACKNOWLEDGED), ("exact", LATE), ("covariance-only", {})])
def test_a_copy_is_its_ancestor_up_to_the_split(mode: str, more: dict[str, Any]) -> None:
    """To the bit, with bursts, late packets, acknowledgements and coins; afterwards copies of one trial differ."""
    scenario, ancestors = heavy(**more), np.array([2, 2, 2, 0, 5, 5])
    own = errors_of(scenario, Mode(mode))
    copied = errors_of(scenario, Mode(mode), OWN.split(17, ancestors))
    for name, errors in copied.items():
        assert np.array_equal(errors[:17], own[name][:17, ancestors]), name
        assert not np.array_equal(errors[17:, 0], errors[17:, 1]), name


def test_left_out_eavesdroppers_change_nothing() -> None:
    """The others have the same errors."""
    scenario = heavy()
    left = Simulation(scenario, range(6), Mode.EXACT, leaving_out={"bursts", "naive"})
    chunks = list(left.chunks())
    assert set(chunks[0].receivers) == {"legitimate", "better"}
    whole = errors_of(scenario, Mode.EXACT)
    for name in ("legitimate", "better"):
        assert np.array_equal(np.concatenate([chunk.receivers[name].error for chunk in chunks]), whole[name])


def test_heavy_tails_agree_with_closed_forms() -> None:
    """For legitimate estimator, eavesdropper, bursts and a misled receiver, in the mean and slot by slot; plain means do not."""
    scenario = heavy(slots=30)
    expected = expectations_of(scenario)
    plain = errors_of(scenario, Mode.COVARIANCE_ONLY, trials=POPULATIONS * 100)
    for name in scenario.receivers:
        means = Splitter(scenario, Mode.COVARIANCE_ONLY, name).estimated()
        traces = expected[name].traces(30)
        estimate = means.estimate(100, expected[name])
        assert estimate.doubt is None
        assert estimate.z is not None
        assert abs(estimate.z) < SURE, name
        spread = np.array(estimate.slots["standard_error"])
        assert np.all(np.abs(np.array(estimate.slots["mean_error"]) - traces) <= SURE * spread + 1e-12), name
        if name in ("legitimate", "bursts"):
            assert expected[name].infinite_variance
            assert plain[name].mean() < 0.8 * traces.mean()


def test_an_initial_covariance_that_is_never_lost(tmp_path: Path) -> None:
    """The plain mean of 40 trials is far too small, and has no z; splitting is right."""
    plan = Plan(workers=1, rare=True)
    summary = montecarlo("eavesdroppers", slots=40, trials=40, plan=plan, out=tmp_path / "it").summary
    legitimate = summary["peers"]["legitimate"]
    assert legitimate["mean_squared_error"] < 0.8 * legitimate["theoretical_trace_covariance"]
    assert legitimate["z"] == {"mean_squared_error": None}
    for name in ("legitimate", "naive", "suspicious", "smart"):
        assert abs(summary["peers"][name]["rare_estimate"]["z"]) < SURE, name


def test_the_exact_mode_estimates_the_same() -> None:
    """Squared errors, with packets and estimates, agree with theory too; so do those of a receiver that reads packets."""
    wise = {"wise": {"strategy": "genie", "link": {"quality": 0.9}}}
    scenario = heavy(slots=20, eavesdroppers=wise)
    for name, expected in expectations_of(scenario).items():
        estimate = Splitter(scenario, Mode.EXACT, name).estimated().estimate(100, expected)
        assert estimate.z is not None
        assert abs(estimate.z) < SURE, name


def test_covariances_are_split_as_covariances_although_a_plant_moves_the_states(tmp_path: Path) -> None:
    """They are those of the model, as the means beside them are: the inputs are in neither, so both have the theory's mean."""
    plan = Plan(Mode.COVARIANCE_ONLY, workers=1, rare=True)
    peers = montecarlo("heated-room", slots=20, trials=40, plan=plan, out=tmp_path / "it").summary["peers"]
    for name, peer in peers.items():
        estimate, plain = peer["rare_estimate"], peer["mean_actual_trace_covariance"]
        assert abs(estimate["mean_error"] - plain) < 0.5 * plain, name
        assert abs(estimate["z"]) < SURE, name


@pytest.mark.long
def test_flipped_acknowledgements_agree_with_many_trials() -> None:
    """Where packets depend on acknowledgements, in a run that is short enough for plain trials to contain what matters."""
    scenario = heavy(**ACKNOWLEDGED, slots=7)
    many = errors_of(scenario, Mode.EXACT, trials=4000)
    for receiver in scenario.receivers:
        split, plain = Splitter(scenario, Mode.EXACT, receiver).estimated().of_populations, many[receiver].mean(axis=0)
        spread = math.hypot(split.std(ddof=1) / math.sqrt(len(split)), plain.std(ddof=1) / math.sqrt(len(plain)))
        assert abs(split.mean() - plain.mean()) < SURE * spread
        assert spread < 0.1 * plain.mean()


@pytest.mark.long
def test_results_depend_on_the_seed_alone(tmp_path: Path) -> None:
    """The same estimates for any number of workers and any trials of the study; others for another seed."""
    scenario = heavy(slots=10)

    def entry(folder: str, plan: Plan, **more: Any) -> Any:
        summary = montecarlo(scenario, trials=1001, plan=plan, out=tmp_path / folder, **more).summary
        return {name: peer["rare_estimate"] for name, peer in summary["peers"].items()}

    once = entry("one", Plan(workers=1, rare=True))
    assert once == entry("two", Plan(workers=2, rare=True))
    assert once == entry("later", Plan(Mode.COVARIANCE_ONLY, workers=1, rare=True), first_trial=5000)
    assert once != entry("other", Plan(workers=1, rare=True), seed=4)
    assert Results.read(tmp_path / "one").typed_summary.peers["naive"].rare_estimate is not None


@pytest.mark.long
def test_more_trials_make_it_more_exact() -> None:
    """The populations together have at least the trials of the study."""
    made = {
        trials: rare_estimates(heavy(slots=12, trials=trials), Mode.COVARIANCE_ONLY, lambda: False, lambda _: None)
        for trials in (40, 40 * 800)
    }
    few, many = (made[trials]["legitimate"] for trials in (40, 40 * 800))
    assert (few.trials, many.trials) == (100, 1000)
    assert many.standard_error is not None
    assert few.standard_error is not None
    assert many.standard_error < 0.6 * few.standard_error


def test_what_is_too_skewed_is_refused() -> None:
    """With the reason and the remedy: a large standard error, or errors beyond double precision."""
    expected = expectations_of(heavy())["legitimate"]

    def doubt(populations: list[float]) -> str | None:
        errors = np.repeat(np.array(populations)[:, None], 3, axis=1)
        estimate = SplitMeans(errors, (), np.ones(errors.T.shape)).estimate(100, expected)
        assert (estimate.mean_error is None) == (estimate.doubt is not None)
        assert bool(estimate.slots) == (estimate.doubt is None)
        return estimate.doubt

    assert str(doubt([1.0] * 15 + [9.0])).startswith(
        "its standard error would be 33 % of the mean; give more trials or"
    )
    assert "leaves double precision" in str(doubt([1.0, math.inf]))
    assert doubt([1.0, 1.01]) is None
    assert doubt([0.0, 0.0]) is None


def test_estimates_do_not_depend_on_how_many_trials_are_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """The populations are simulated in groups of about 2000 trials, for the memory; their numbers have the same bits."""
    splitter, sizes = Splitter(heavy(), Mode.COVARIANCE_ONLY, "legitimate", 130), set()
    simulate = Splitter._simulated

    def counted(of: Splitter, numbers: range, splits: Any) -> SplitMeans:
        sizes.add(len(numbers))
        return simulate(of, numbers, splits)

    monkeypatch.setattr(Splitter, "_simulated", counted)
    groups = splitter.estimated()
    assert sizes == {8, 15, 2}
    monkeypatch.setattr("evedrop.simulate.splitting._SIDE_BY_SIDE", 10**6)
    together = splitter.estimated()
    assert 32 in sizes
    assert groups.splits == together.splits != ()
    np.testing.assert_array_equal(groups.errors, together.errors)
    assert groups.counting == together.counting


def test_a_stop_is_noticed_while_the_floor_is_computed() -> None:
    """After the first slots, whose progress is told."""
    told: list[int] = []
    scenario = load("eavesdroppers", {"slots": 1000})
    splitter = Splitter(scenario, Mode.COVARIANCE_ONLY, "legitimate", 100, lambda: True, told.append)
    splitter.estimated()
    assert len(told) == 1
    assert told[0] < 8 * 100 * 1000 / 2


def test_an_interrupted_study_has_no_estimates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stop while trials are split ends the study as interrupted; the results of its trials are there."""

    def stopped_early(*given: Any) -> dict[str, Any]:
        os.kill(os.getpid(), signal.SIGTERM)
        return rare_estimates(*given)

    monkeypatch.setattr(studies, "rare_estimates", stopped_early)
    with pytest.raises(Interrupted):
        montecarlo(heavy(), trials=20, plan=Plan(workers=1, rare=True), out=tmp_path / "it")
    summary = Results.read(tmp_path / "it").summary
    assert summary["trials"] == 20
    assert "rare_estimate" not in summary["peers"]["legitimate"]


def test_the_report_marks_them(evedrop: Evedrop) -> None:
    """In the table with a mark, below it how they were made; in JSON; and a doubt in words."""
    done = evedrop("montecarlo", "numerical", "--rare", "--slots", "12", "--trials", "100", "--out", "it")
    assert done.status == 0
    lines = [line for line in done.out.splitlines() if line.startswith("* ")]
    assert len(lines) == 6
    assert "legitimate: by splitting, 32 populations of 100 trials, copied after" in lines[0]
    row = next(line for line in done.out.splitlines() if line.strip().startswith("naive"))
    assert row.count("*") == 2
    rare_estimate = json.loads((evedrop.folder / "it" / "summary.json").read_text())["peers"]["legitimate"][
        "rare_estimate"
    ]
    assert len(rare_estimate["slots"]["mean_error"]) == 12
    assert rare_estimate["populations"] == POPULATIONS


def test_a_doubt_is_reported(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """The cell keeps the plain mean, and a line says why there is no other."""
    summary = montecarlo(
        "numerical", slots=5, trials=20, plan=Plan(workers=1, rare=True), out=tmp_path / "it"
    ).typed_summary
    rare = summary.peers["smart"].rare_estimate
    assert rare is not None
    assert asdict(rare)["doubt"] is None
    doubtful = type(rare)(None, None, None, 32, 100, 3, 0.2, "its standard error would be 40 % of the mean", {})
    changed: Summary = summary.with_rare_estimates({"smart": doubtful})
    print_summary(changed, "it")
    output = capsys.readouterr().out
    assert "smart: splitting gives no estimate that can be trusted: its standard error would be 40 %" in output
    assert "*" not in output


@pytest.mark.long
def test_the_stated_error_is_true() -> None:
    """Of 300 studies with 32 populations 4 to 12 % have |z| > 1.96: 6 % by Student's t, and more where tails are heavy."""
    for name in ("legitimate", "better", "much-better"):
        z = []
        for seed in range(15):
            scenario = load("numerical", {"slots": 40, "seed": seed}, beyond_horizon=True)
            expected = expectations_of(scenario)[name].traces(40).mean()
            errors = Splitter(scenario, Mode.COVARIANCE_ONLY, name).estimated(32 * 20).of_populations.reshape(20, 32)
            z.append((errors.mean(axis=1) - expected) / (errors.std(axis=1, ddof=1) / math.sqrt(32)))
        beyond = (np.abs(np.concatenate(z)) > 1.96).mean()
        assert 0.04 < beyond < 0.12
