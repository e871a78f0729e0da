"""An expectation that cannot be decided has failed, with every command: what the pages say is what they do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from evedrop.cli import main as cli
from evedrop.scenario.loading import load
from evedrop.score.links import chart_of
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
metric = "legitimate.mean_squared_error"
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
metric = "radio.delivery"
above = 0.4
"""


def page(name: str) -> str:
    """A page with single spaces."""
    return re.sub(r"\s+", " ", (DOCS / name).read_text(encoding="utf-8"))


def test_a_study_without_the_metric_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A covariance-only study has no squared errors: it says so, with status 1."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.toml").write_text(SCENARIO, encoding="utf-8")
    assert cli.main(["montecarlo", "one.toml", "--trials", "20", "--covariance-only", "--workers", "1"]) == 1
    assert "below 100: FAILED, the run has no value for it" in capsys.readouterr().out
    assert "**An expectation that cannot be decided has failed.**" in page("scenario.md")
    assert "or could not be decided |" in page("testing.md")


def test_a_test_lists_what_it_cannot_decide() -> None:
    """As a reason for its failure, whatever the manner of the test."""
    undecided = Judged("a", None, None, "below 1")
    assert [*_reasons([undecided])] == [undecided.sentence]
    assert "FAILED" in undecided.sentence


@pytest.mark.thorough
@pytest.mark.parametrize(("metric", "status"), [("delivery", 1), ("heard", 0)])
def test_a_wire_that_heard_nothing_fails_unless_it_must_be_silent(
    metric: str, status: int, evedrop: Evedrop, tmp_path: Path
) -> None:
    """Whatever is expected of a link that is silent, such as no loss at all, except that it is silent."""
    text = WIRE.replace("radio.delivery", f"radio.{metric}").replace("above = 0.4", "below = 1")
    (tmp_path / "wire.toml").write_text(text, encoding="utf-8")
    done = evedrop("wire", str(tmp_path / "wire.toml"), "--for", "1 s", "--out", str(tmp_path / "out"))
    assert done.status == status, done.err
    told = f"expected radio.{metric} below 1: {'FAILED, the link heard nothing' if status else 'held, found 0'}"
    assert told in done.out + done.err
    assert "On a silent link, every expectation fails but `heard` below a number" in page("wire/results.md")


def test_where_the_sensor_detects_nothing_detection_is_null() -> None:
    """Not only without acknowledgements: no chart tells a hijacked sensor, as docs/metrics.md says."""
    assert chart_of(load("hijacked")) is None
    assert "null without acknowledgements, and where no chart can tell the attack" in page("results.md")
    assert "as under `hijack`" in page("metrics.md")
