"""`evedrop design --budget`: the threshold from which on to encrypt."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from evedrop.cli.api import design_budget, montecarlo
from evedrop.errors import UsageError
from evedrop.scenario.loading import load
from evedrop.simulate.simulation import Simulation
from tests.conftest import Evedrop

SCENARIO = """
title = "Five bits a state, and encryption for 1.4 times the energy of a packet"
slots = 400

[process]
A = [[0.9, 0.3], [0.0, 0.8]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1e-3, 0.0], [0.0, 1e-3]]

[encoding]
scheme = "quantised-schedule"
threshold = 1.8333
bits = 5
standard_deviations = 6.0

[acknowledgements]
link = { quality = 0.9 }

[legitimate]
link = { quality = 0.8 }

[eavesdroppers.listener]
strategy = "selective"
link = { quality = 0.8 }
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """The file of the scenario."""
    path = tmp_path / "quantised.toml"
    path.write_text(SCENARIO)
    return path


def test_the_budget_is_met_exactly(scenario: Path) -> None:
    """The energy of the threshold found is the budget, and so is that of a run, within five standard errors."""
    changes = {"energy": {"packet": 3.0, "bit": 0.5, "encryption": 4.0}}
    design = design_budget(scenario, 10.0, changes=changes)
    assert design.unencrypted == 3.0 + 0.5 * 11
    assert design.encrypted == design.unencrypted + 4.0
    assert design.best.energy == pytest.approx(10.0)
    assert 1.0 < design.best.threshold < 2.0
    made = load(scenario, {**changes, "encoding.threshold": design.best.threshold, "slots": 200})
    simulation = Simulation(made, range(200))
    for _ in simulation.chunks():
        pass
    fractions = simulation.packets.encrypted / 200
    expected = (199 * design.best.encrypted_fraction + 1.0) / 200  # slot 0 is encrypted
    assert abs(fractions.mean() - expected) < 5.0 * fractions.std() / 200**0.5


def test_errors_are_those_of_runs(scenario: Path, tmp_path: Path) -> None:
    """The limits of legitimate estimator and eavesdropper are those of the threshold's own scenario."""
    design = design_budget(scenario, 1.4)
    made = load(scenario, {"encoding.threshold": design.best.threshold})
    peers = montecarlo(made, trials=300, out=tmp_path / "run").summary["peers"]
    for name, limit in (("legitimate", design.legitimate), ("listener", design.best.eavesdroppers["listener"])):
        error = peers[name]["standard_errors"]["mean_squared_error"]
        assert abs(peers[name]["mean_squared_error"] - limit) < 5.0 * error + 0.01 * limit  # the first slots differ
    energies = [other.energy for other in design.others]
    assert energies == sorted(energies, reverse=True)


@pytest.mark.parametrize(("budget", "threshold"), [(2.0, 1.0), (7.5, 1.0), (1.28, 2.0), (1.0784, 3.0)])
def test_the_table_has_the_threshold(evedrop: Evedrop, scenario: Path, budget: float, threshold: float) -> None:
    """As its own row, marked, and as the line to paste; the JSON is the same."""
    done = evedrop("design", str(scenario), "--budget", str(budget))
    assert done.status == 0
    (marked,) = [line for line in done.out.splitlines() if "the budget's" in line]
    assert float(marked.split()[0]) == pytest.approx(threshold, abs=1e-6)
    assert done.out.splitlines()[-1].startswith("threshold = ")
    designed_ = json.loads(evedrop("design", str(scenario), "--budget", str(budget), "--json").out)
    assert designed_["best"]["threshold"] == pytest.approx(threshold)
    assert set(designed_) == {"budget", "unencrypted", "encrypted", "legitimate", "best", "others"}


def test_what_has_no_limit_is_unbounded(evedrop: Evedrop, scenario: Path) -> None:
    """A process that does not forget needs more and more bits; an eavesdropper without a closed form is left out."""
    spy = 'eavesdroppers.spy={strategy = "naive", link = {quality = 0.5}}'
    words = ("design", str(scenario), "--budget", "1.5", "--set", "process.A=[[1.0, 0.3], [0.0, 0.8]]", "--set", spy)
    done = evedrop(*words)
    assert "the legitimate one is ∞" in done.out
    assert "left out: spy (naive)" in done.out
    designed_ = json.loads(evedrop(*words, "--json").out)
    assert designed_["legitimate"] is None
    assert designed_["best"]["eavesdroppers"] == {"listener": None}
    assert designed_["left_out"] == {"spy": "naive"}


@pytest.mark.parametrize(
    ("budget", "changes", "why"),
    [
        (1.0, {}, r"no threshold up to \d+ meets the budget 1: unencrypted packets cost 1 .* such as 1.5"),
        (0.2, {}, "no threshold"),
        (1.5, {"acknowledgements.link.quality": 0.0}, "no acknowledgement arrives, so nothing less than 2 is enough"),
        (float("nan"), {}, "expected a finite number"),
        (1.5, {"legitimate.link.delay": {"model": "constant", "value": 1.0}}, "independent losses"),
        (1.5, {"encoding": {"scheme": "encrypted-schedule", "threshold": 2}}, "of the scheme quantised-schedule"),
    ],
)
def test_budgets_that_cannot_be_kept_are_refused(
    scenario: Path, budget: float, changes: dict[str, object], why: str
) -> None:
    """With the reason, and what to do."""
    with pytest.raises(UsageError, match=why):
        design_budget(scenario, budget, changes=changes)
