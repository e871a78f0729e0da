"""The process that explains recorded states: what is found, and what is refused."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from evedrop.cli.main import main
from evedrop.errors import DisturbanceError, UsageError
from evedrop.model.process import Floats
from evedrop.scenario.loading import checked
from evedrop.scenario.recordings.disturbance_file import table_text
from evedrop.scenario.recordings.process_fit import ProcessFit, fit_process

A = np.array([[0.9, 0.1], [-0.1, 0.8]])
Q = np.array([[0.04, 0.01], [0.01, 0.09]])


def path_of(seed: int, slots: int = 400, around: float = 0.0) -> Floats:
    """A path of the process, (slots, 2)."""
    noise = np.random.default_rng(seed).standard_normal((slots, 2)) @ np.linalg.cholesky(Q).T
    x = [np.array([0.5, -0.5])]
    for w in noise[1:]:
        x.append(A @ x[-1] + w)
    return np.array(x) + around


def fitted(folder: Path, rows: Floats, names: tuple[str, ...] = ("x", "y")) -> ProcessFit:
    """The fit of some rows."""
    path = folder / "pose.csv"
    path.write_text(table_text(names, None, rows.tolist()))
    return fit_process(path)


def test_the_standard_errors_are_those_of_many_fits(tmp_path: Path) -> None:
    """A and Q are found within them, and their scatter is as large as they say."""
    fits = [fitted(tmp_path, path_of(seed)) for seed in range(60)]
    for truth, values, errors in (
        (A, [fit.A for fit in fits], [fit.A_error for fit in fits]),
        (Q, [fit.Q for fit in fits], [fit.Q_error for fit in fits]),
    ):
        z = (np.array(values) - truth) / np.array(errors)
        assert np.all(np.abs(z.mean(axis=0)) < 0.6)
        assert np.all((z.std(axis=0) > 0.7) & (z.std(axis=0) < 1.35))
    assert sum(bool(fit.unexplained) for fit in fits) <= 4


def test_the_estimates_are_those_of_the_normal_equations(tmp_path: Path) -> None:
    """A, Q and their standard errors, for states of very different sizes, by a regression of each state on its own."""
    rows = path_of(4, 60) * np.array([1e-3, 50.0])
    result = fitted(tmp_path, rows)
    X, count = rows[:-1], len(rows) - 1
    inverse = np.linalg.inv(X.T @ X)
    residuals = np.empty_like(X)
    for i in range(2):
        a = inverse @ X.T @ rows[1:, i]
        residuals[:, i] = rows[1:, i] - X @ a
        variance = np.sum(residuals[:, i] ** 2) / (count - 2)
        assert result.A[i] == pytest.approx(a, rel=1e-8)
        assert result.A_error[i] == pytest.approx(np.sqrt(variance * np.diag(inverse)), rel=1e-8)
    Q = np.einsum("ki,kj->ij", residuals, residuals) / (count - 2)
    assert pytest.approx(Q, rel=1e-8) == result.Q
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        spread = Q[i, i] * Q[j, j] + Q[i, j] ** 2
        assert result.Q_error[i, j] == pytest.approx(np.sqrt(spread / (count - 2)), rel=1e-8)


def test_the_fit_is_a_scenario(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command's output, remarks included, is TOML that a scenario can use; with a reference, and units."""
    (tmp_path / "pose.csv").write_text(
        "time [s],x [m],who,y [m]\n"
        + "".join(f"{3 + 0.1 * k},{x},a,{y}\n" for k, (x, y) in enumerate(path_of(1, around=5.0)))
    )
    assert main(["process", "fit", str(tmp_path / "pose.csv"), "--states", "x,y", "--reference", "-5.5,5"]) == 0
    tables = tomllib.loads(capsys.readouterr().out)
    assert tables["slot_seconds"] == 0.1
    process = tables["process"]
    assert np.allclose(process["A"], A, atol=0.2)
    assert (process["theory"], process["units"], process["reference"]) == (True, ["m", "m"], [-5.5, 5.0])
    rest = {"title": "Fitted", "slots": 100, "encoding": {"scheme": "plain"}, "legitimate": {"link": {"quality": 0.9}}}
    assert len(checked({**tables, **rest}, "file").process.state_values or []) == 100
    assert main(["process", "fit", str(tmp_path / "pose.csv"), "--states", "x,y", "--json"]) == 0
    fit_ = json.loads(capsys.readouterr().out)
    assert (fit_["transitions"], fit_["slot_seconds"], "reference" in fit_["process"]) == (
        399,
        pytest.approx(0.1),
        False,
    )
    assert np.shape(fit_["standard_errors"]["A"]) == (2, 2)


def test_each_state_has_its_own_unit(tmp_path: Path) -> None:
    """In the order in which the states are asked for, which need not be that of the columns; none if one has no unit."""
    path = tmp_path / "pose.csv"
    lines = "".join(f"{x},{y},{k}\n" for k, (x, y) in enumerate(path_of(1)))
    path.write_text(f"a [W],b [kW],c\n{lines}")
    table = fit_process(path, ["b", "a"]).table
    assert (table["states"], table["units"]) == (["b", "a"], ["kW", "W"])
    assert "units" not in fit_process(path, ["c", "a"]).table


def test_a_state_without_noise_is_found(tmp_path: Path) -> None:
    """A position that sums up a speed: Q is singular, and Σ0 is not."""
    speed = path_of(2)[:, :1]
    result = fitted(tmp_path, np.hstack([np.vstack([[[0.0]], np.cumsum(0.1 * speed, axis=0)[:-1]]), speed]))
    assert result.exact == ["x"]
    assert result.table["singular_noise"] is True
    assert np.allclose(result.A[0], [1.0, 0.1])
    assert np.all(np.linalg.eigvalsh(result.initial_covariance) > 0.0)
    assert "x: without noise, so Q is singular" in result.remarks
    assert result.as_dict()["residual_correlation"][0] is None


def test_noise_with_fewer_sources_than_states_is_found(tmp_path: Path) -> None:
    """An acceleration moves position and speed alike: Q has rank 1, also for a vehicle that starts at rest in the origin."""
    gain, x = np.array([0.005, 0.1]), [np.zeros(2)]
    for w in np.random.default_rng(6).standard_normal(2000):
        x.append(np.array([[1.0, 0.1], [0.0, 0.9]]) @ x[-1] + gain * w)
    result = fitted(tmp_path, np.array(x))
    assert result.exact == []
    assert np.outer(gain, gain) == pytest.approx(result.Q, rel=0.1)
    assert "the noise of x, y has fewer sources than states, so Q is singular" in result.remarks
    process = tomllib.loads(result.toml)["process"]
    rest = {"title": "Fitted", "slots": 100, "encoding": {"scheme": "plain"}, "legitimate": {"link": {"quality": 0.9}}}
    assert checked({"process": process, **rest}, "file").process.process.singular_noise


def test_noise_that_lasts_is_reported(tmp_path: Path) -> None:
    """A process of the first order does not explain a process of the second."""
    result = fitted(tmp_path, np.cumsum(np.cumsum(path_of(3)[:, :1], axis=0), axis=0), ("x",))
    assert result.unexplained == ["x"]
    assert "no process with white noise explains them" in result.remarks[-1]
    assert result.spectral_radius == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (path_of(1, 20), "has 20 states; expected at least 21, for a process of 2 states"),
        (np.repeat(path_of(1)[:, :1], 2, axis=1), "the states depend on each other"),
        (np.hstack([path_of(1)[:, :1], np.zeros((400, 1))]), "the states depend on each other, or do not move"),
        (np.array([[np.cos(0.1 * k), np.sin(0.1 * k)] for k in range(100)]), "every state follows from those before"),
    ],
)
def test_what_is_no_recording_of_a_process_is_refused(tmp_path: Path, rows: Floats, message: str) -> None:
    """With what can be done."""
    with pytest.raises(UsageError, match=message):
        fitted(tmp_path, rows)


def test_other_files_and_options_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No file, no columns, missing slots; a reference of another length, or without numbers."""
    path = tmp_path / "pose.csv"
    assert main(["process", "fit", str(path)]) == 2
    path.write_text("")
    assert main(["process", "fit", str(path)]) == 2
    path.write_text("time,x\n" + "".join(f"{k + (k > 50)},{k % 7}\n" for k in range(100)))
    assert main(["process", "fit", str(path), "--reference", "1,2"]) == 2
    path.write_text("x,y\n1,2\n1,a\n")
    with pytest.raises(DisturbanceError, match="line 3: y is"):
        fit_process(path)
    path.write_text("time,x\n0,1\n1,2\n0,3\n")
    with pytest.raises(DisturbanceError, match="times that do not grow"):
        fit_process(path)
    path.write_text("x\n" + "1e101\n-2\n" * 10)
    with pytest.raises(UsageError, match=r"has 1e\+101; expected numbers of at most 1e\+100"):
        fit_process(path)
    path.write_text("x,y\n1,2\n")
    with pytest.raises(UsageError, match='has no column "z"'):
        fit_process(path, ["z"])
    path.write_text(table_text(["x"], None, path_of(1)[:, :1].tolist()))
    assert main(["process", "fit", str(path), "--reference", "1,2"]) == 2
    assert main(["process", "fit", str(path), "--reference", "one"]) == 2
    errors = capsys.readouterr().err
    for part in ("cannot be read", "is empty; expected a line of names", "a gap of", "has 2 numbers", "such as 55,50"):
        assert part in errors, errors
