"""The paper's application: its table of errors, and what secrecy costs a house in energy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from evedrop.cli.api import montecarlo
from evedrop.results.reading import Results
from evedrop.scenario.loading import checked, load
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from tests.examples import mostly_long

PAPER = 0.0158
"""The change of grid power flow that the paper keeps below, at μ_d = 0.1."""
TABLE = {0.1: (1.333e-4, 3.133e-4), 0.5: (2.667e-5, 4.667e-5), 0.9: (1.481e-5, 1.704e-5)}
"""μ_d → day means of the trace, of the legitimate estimator and smart."""
WIDE = [[2500.0, 0.0], [0.0, 2500.0]]
COVARIANCES = Plan(Mode.COVARIANCE_ONLY, workers=1)
NO_PACKETS: dict[str, Any] = {"eavesdroppers__bayesian__strategy": "smart"}
"""A study of covariances excludes receivers that read packets, and not only their fates."""


def part_of_day(name: str, first: int, slots: int, **changes: Any) -> Any:
    """A shipped house's scenario over some hours of its day."""
    scenario = load(name, {key.replace("__", "."): value for key, value in changes.items()})
    tables = scenario.model_dump(mode="json", exclude_none=True)
    tables["plant"]["disturbance_values"] = tables["plant"]["disturbance_values"][first : first + slots]
    return checked({**tables, "slots": slots, "expect": []}, name)


def energies(results: Results) -> dict[str, float]:
    """The three measures."""
    house = results.summary["household"]
    return {name: house[f"{name}_difference"] for name in ("net", "total", "summed")}


@pytest.mark.long
@pytest.mark.parametrize("name", mostly_long(["microgrid", "microgrid-mpc"], ["microgrid-mpc"]))
def test_secrecy_costs_little_energy(name: str, tmp_path: Path) -> None:
    """Forty minutes before noon at μ_d = 0.1: net and total energy differ from perfect knowledge by less than the paper says."""
    if name == "microgrid-mpc":
        pytest.importorskip("osqp", reason="model predictive control needs the extra `microgrid`")
    scenario = part_of_day(name, 40_800, 2400, **NO_PACKETS)
    result = energies(montecarlo(scenario, trials=1, out=tmp_path / "x", plan=Plan(workers=1)))
    assert result["net"] < PAPER
    assert result["total"] < PAPER
    assert result["summed"] > max(result["net"], result["total"])


@pytest.mark.long
def test_what_is_summed_slot_by_slot_depends_on_the_weights(tmp_path: Path) -> None:
    """The same minutes with a grid power that may change at will: the third measure is beyond what the paper says."""
    eager = {
        "controller__input_weights": [0.02, 0.001],
        "controller__rate_weights": [1.0, 0.0],
        "controller__period": 5,
    }
    scenario = part_of_day("microgrid", 40_800, 2400, **NO_PACKETS, **eager)
    result = energies(montecarlo(scenario, trials=1, out=tmp_path / "x", plan=Plan(workers=1)))
    assert result["net"] < PAPER < result["summed"]


def test_covariances_are_those_of_the_table(tmp_path: Path) -> None:
    """4000 slots and 200 trials: within 2 % of the theory for these slots."""
    results = montecarlo("microgrid", trials=200, slots=4000, out=tmp_path / "x", plan=COVARIANCES, **NO_PACKETS)
    for name in ("legitimate", "smart"):
        peer = results.summary["peers"][name]
        assert peer["mean_actual_trace_covariance"] == pytest.approx(peer["theoretical_trace_covariance"], rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize("mu_d", TABLE)
def test_a_day_of_covariances_is_the_table(mu_d: float, tmp_path: Path) -> None:
    """A whole day, 1000 trials: legitimate and smart within 2 % of the table, naive with ± 50 % within 5 % of its closed form."""
    options: dict[str, Any] = {"trials": 1000, "encoding__state_probability": mu_d, **NO_PACKETS}
    peers = montecarlo("microgrid", out=tmp_path / "x", plan=COVARIANCES, **options).summary["peers"]
    for name, expected in zip(("legitimate", "smart"), TABLE[mu_d], strict=True):
        assert peers[name]["mean_actual_trace_covariance"] == pytest.approx(expected, rel=0.02)
    wide = montecarlo(
        "microgrid", out=tmp_path / "wide", plan=COVARIANCES, process__initial_covariance=WIDE, **options
    ).summary["peers"]["naive"]  # fmt: skip
    assert wide["mean_actual_trace_covariance"] == pytest.approx(wide["theoretical_trace_covariance"], rel=0.05)
    assert wide["mean_actual_trace_covariance"] > 0.95e3


@pytest.mark.long
@pytest.mark.parametrize("name", ["microgrid", "microgrid-mpc"])
def test_a_day_costs_little_energy(name: str, tmp_path: Path) -> None:
    """A whole day at μ_d = 0.1, every expectation of the shipped scenario, and the first two measures below 1.58 %."""
    if name == "microgrid-mpc":
        pytest.importorskip("osqp", reason="model predictive control needs the extra `microgrid`")
    results = montecarlo(name, trials=2, out=tmp_path / "x", plan=Plan(workers=1))
    result = energies(results)
    assert result["net"] < PAPER
    assert result["total"] < PAPER
    assert [verdict["held"] for verdict in results.summary["expectations"]] == [True] * len(
        results.summary["expectations"]
    )
