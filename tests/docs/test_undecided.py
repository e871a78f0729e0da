"""What the pages say of expectations that a run or a wire cannot decide is what the commands do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from evedrop.cli import main as cli
from evedrop.loading import load
from evedrop.score.acknowledging import chart_of

DOCS = Path(__file__).parents[2] / "docs"
SCENARIO = """
title = "An expectation that nobody can decide"
slots = 20

[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-4]]
initial_covariance = [[1.0, 0.0], [0.0, 0.1]]

[encoding]
scheme = "innovation"
state_probability = 0.4

[legitimate]
link = { quality = 0.9 }

[[expect]]
figure = "legitimate.mean_squared_error"
below = 100.0
"""


def page(name: str) -> str:
    """A page with single spaces."""
    return re.sub(r"\s+", " ", (DOCS / name).read_text(encoding="utf-8"))


def test_a_test_fails_and_a_study_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A covariance-only study has no squared errors: it says so, with status 0; docs/testing.md says that a test fails."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.toml").write_text(SCENARIO, encoding="utf-8")
    assert cli.main(["montecarlo", "one.toml", "--trials", "20", "--covariance-only", "--workers", "1"]) == 0
    assert "not evaluated" in capsys.readouterr().out
    text = page("testing.md")
    assert "makes a test `FAILED`, with `evedrop test` and with pytest" in text
    assert "call it *not evaluated* instead, and their exit status stays 0" in text


def test_where_the_sensor_detects_nothing_detection_is_null() -> None:
    """Not only without acknowledgements: no chart tells a hijacked sensor, as docs/results.md says."""
    assert chart_of(load("hijacked")) is None
    assert "null without acknowledgements, and where no chart can tell the attack" in page("results.md")
    assert "as under `hijack`" in page("results.md")
