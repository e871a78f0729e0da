"""Runs behind links that remember: the same bits live and in memory, and theory met where there is one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow.compute as pc
import pytest
import tomli_w

from evedrop.cli.api import design, montecarlo, run
from evedrop.errors import UsageError
from evedrop.model.links import LOSS_MODELS
from evedrop.results.reading import Results
from evedrop.scenario.estimates import warnings_of
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from tests.builders import MARGINAL, digests_of, tables_of
from tests.conftest import Evedrop

LOSSES: dict[str, dict[str, Any]] = {
    "bernoulli": {"model": "bernoulli", "quality": 0.8},
    "distance": {
        "model": "distance",
        "sender": [0, 0],
        "receiver": [[0, 90.0, 5.0], [200, 10.0, 90.0]],
        "reference_snr": 70.0,
        "exponent": 3.0,
        "threshold": 8.0,
        "shadowing": 6.0,
        "shadowing_block": 20,
    },
    "gilbert-elliott": {"model": "gilbert-elliott", "p": 0.1, "r": 0.4, "good": 0.05, "bad": 0.9},
    "markov": {"model": "markov", "transitions": [[0.8, 0.2], [0.5, 0.5]], "loss": [0, 1]},
    "pattern": {"model": "pattern", "outcomes": "1101"},
    "trace": {"model": "trace", "outcomes": "110100111", "random_start": True},
}
UNKNOWN = ("distance", "pattern", "trace")
"""Those that no theory covers."""


def lossy(**changes: Any) -> dict[str, Any]:
    """An eavesdropper behind each loss model, the legitimate estimator behind bursts."""
    eavesdroppers = {
        name: {"strategy": "smart", "link": {"loss": loss}} for name, loss in LOSSES.items() if name != "bernoulli"
    }
    suspicious = {"strategy": "suspicious", "use_state": 0.8, "use_innovation": 0.1}
    tables = tables_of(
        MARGINAL,
        slots=300,
        encoding={"scheme": "innovation", "state_probability": 0.3},
        legitimate={"link": {"loss": LOSSES["gilbert-elliott"]}},
        eavesdroppers={
            "bernoulli": {**suspicious, "link": {"loss": LOSSES["bernoulli"]}},
            **eavesdroppers,
            "guesser": {**suspicious, "link": {"loss": LOSSES["markov"]}},
        },
    )
    return {**tables, **changes}


@pytest.fixture(scope="module")
def every_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scenario's file."""
    path = tmp_path_factory.mktemp("scenario") / "every.toml"
    path.write_text(tomli_w.dumps(lossy()), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def memory(every_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Seven trials of it in memory."""
    return montecarlo(every_model, trials=7, out=tmp_path_factory.mktemp("memory") / "run")


@pytest.fixture(scope="module")
def live(every_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """The same seven trials in processes."""
    return run(every_model, trials=7, out=tmp_path_factory.mktemp("live") / "run")


def test_every_model_is_in_the_scenario() -> None:
    """A new loss model must be added here."""
    assert set(LOSSES) == set(LOSS_MODELS)


def test_live_and_memory_are_the_same_bits(live: Results, memory: Results) -> None:
    """Every loss model gives one digest, in processes and in memory, and every packet is accounted for."""
    assert digests_of(live) == digests_of(memory)
    assert all(link["unexplained"] == 0 for link in live.summary["links"].values())
    lost = live.summary["links"]["pattern"]["lost"]
    assert lost == 7 * 300 // 4


def test_where_there_is_no_theory_the_results_say_null(memory: Results) -> None:
    """A link that follows no chain has no theoretical trace: null in the summary and in the table, and no verdict of theory."""
    peers = memory.summary["peers"]
    assert [name for name, peer in peers.items() if peer["theoretical_trace_covariance"] is None] == [*UNKNOWN]
    assert json.loads((memory.folder / "summary.json").read_text())["peers"]["pattern"]["infinite_variance"] is False
    nulls = memory.slots.filter(pc.is_null(memory.slots["theoretical_trace_covariance"]))
    assert set(nulls["peer"].to_pylist()) == set(UNKNOWN)
    assert nulls.num_rows == 300 * len(UNKNOWN)
    verdict = memory.summary["secrecy"]["pattern"]
    assert (verdict["relative_by_theory"], verdict["perfect_by_theory"]) == (None, None)
    assert verdict["sentence"].endswith("no theory covers these links")
    assert memory.summary["secrecy"]["markov"]["relative_by_theory"] is not None


@pytest.mark.thorough
def test_the_report_survives_a_metric_that_is_not_there(every_model: Path, evedrop: Evedrop) -> None:
    """The closing table has a dash, and a sweep goes through."""
    done = evedrop("montecarlo", str(every_model), "--trials", "3", "--slots", "60", "--out", "here")
    assert (done.status, done.err) == (0, "")
    (row,) = [line for line in done.out.splitlines() if line.split()[:1] == ["pattern"]]
    assert " – " in row
    swept = evedrop("sweep", str(every_model), "--trials", "3", "--over", "slots=20,40", "--out", "swept")
    assert (swept.status, swept.err) == (0, "")


def test_simulated_errors_agree_with_the_theory_of_bursts(every_model: Path, tmp_path: Path) -> None:
    """Receivers behind chains, 600 trials: in no slot judged is the mean error 4.5 standard errors off (7e-6 each)."""
    table = montecarlo(every_model, slots=121, trials=600, seed=5, out=tmp_path / "many").slots.to_pydict()
    judged = 0
    for i, slot in enumerate(table["slot"]):
        if slot % 20 == 0 and table["peer"][i] not in UNKNOWN:
            difference = table["mean_squared_error"][i] - table["theoretical_trace_covariance"][i]
            assert abs(difference) < 4.5 * table["standard_error"][i] + 1e-15, (slot, table["peer"][i])
            judged += 1
    assert judged == 7 * 5


def test_design_is_for_independent_losses(every_model: Path, evedrop: Evedrop) -> None:
    """μ_d is not designed for bursts: one line that names the link and the remedy, exit 2; the remedy is one."""
    done = evedrop("design", str(every_model))
    assert (done.status, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert "the link of legitimate is different" in line
    assert "such as legitimate.link={quality = 0.9}" in line
    quality = {"quality": 0.9}
    with pytest.raises(UsageError, match=r"such as eavesdroppers\.distance\.link="):
        design(every_model, changes={"legitimate.link": quality})
    links = {f"eavesdroppers.{name}.link": quality for name in lossy()["eavesdroppers"]}
    result = design(every_model, changes={"legitimate.link": quality, **links})
    # A scenario that is checked already takes the same changes.
    assert design(load(every_model), changes={"legitimate.link": quality, **links}).trace == result.trace


def test_bursts_that_last_too_long_are_a_warning() -> None:
    """An unstable process behind bursts is warned of exactly where its expected error has no bound."""
    link = {"loss": {"model": "gilbert-elliott", "p": 0.02, "r": 0.1}}
    (warning,) = warnings_of(load("numerical", {"legitimate.link": link}))
    assert "grows without bound" in warning
    assert warnings_of(load("numerical", {"legitimate.link": {"loss": {**link["loss"], "r": 0.9}}})) == []
    assert warnings_of(Scenario.model_validate(lossy())) == []


@pytest.mark.long
def test_the_view_survives_where_there_is_no_theory(live: Results) -> None:
    """A replayed recording of a run in which one receiver's theoretical trace is nowhere."""
    from rerun.chunk import RrdReader

    from evedrop.show.view.scene_slots import replay

    shown = {str(chunk.entity_path) for chunk in RrdReader(replay(live.folder)).stream().filter(is_static=False)}
    assert {"/error/pattern", "/trace/pattern", "/theory/legitimate"} <= shown
    assert "/theory/pattern" not in shown
    assert live.slots["theoretical_trace_covariance"].null_count == 300 * len(UNKNOWN)
