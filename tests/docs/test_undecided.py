"""What the pages say of expectations that a run or a wire cannot decide is what the commands do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from evedrop.cli import main as cli
from evedrop.loading import load
from evedrop.score.acknowledging import chart_of
from evedrop.score.summary import Judged
from evedrop.studies.scenario_tests import _reasons
from tests.conftest import Evedrop

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

WIRE = """
seed = 1

[side.a]
[side.b]

[[link]]
name = "radio"
from = "a"
to = "b"
quality = 0.5

[[expect]]
figure = "radio.delivery"
above = 0.4
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


def test_a_test_lists_what_it_cannot_decide() -> None:
    """As a reason for its failure, whatever the manner of the test."""
    undecided = Judged("a", None, None, "below 1")
    assert [*_reasons([undecided])] == [undecided.sentence]
    assert "not evaluated" in undecided.sentence


def test_a_wire_that_heard_nothing_passes(evedrop: Evedrop, tmp_path: Path) -> None:
    """With status 0, and a line that says so: docs/wire.md warns of it."""
    (tmp_path / "wire.toml").write_text(WIRE, encoding="utf-8")
    done = evedrop("wire", str(tmp_path / "wire.toml"), "--for", "1 s", "--out", str(tmp_path / "out"))
    assert done.status == 0, done.err
    assert "not evaluated" in done.out
    text = page("wire.md")
    assert "the line says that the condition was not evaluated, and the exit status stays 0" in text
    assert "So a wire whose programs never started passes" in text


def test_where_the_sensor_detects_nothing_detection_is_null() -> None:
    """Not only without acknowledgements: no chart tells a hijacked sensor, as docs/results.md says."""
    assert chart_of(load("hijacked")) is None
    assert "null without acknowledgements, and where no chart can tell the attack" in page("results.md")
    assert "as under `hijack`" in page("results.md")
