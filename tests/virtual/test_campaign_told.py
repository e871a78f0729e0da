"""The command that plays cases prints why a case failed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from evedrop.live.recorder import run_folder
from evedrop.virtual.cases import case_of
from tests.virtual import simulated

GOOD = next(
    case
    for case in map(case_of, range(1, 100))
    if not case.faults and not case.scenario.relayed and case.scenario.slots > 10
)
"""A case that breaks no promise."""


def test_a_failing_seed_is_shrunk_and_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the text that plays it again, which shows the same misses and the same diagram."""
    monkeypatch.setattr(run_folder, "write_rows", lambda *_: None)
    assert simulated.main(["--explain", str(GOOD.seed)]) == 1
    out = capsys.readouterr().out
    assert f"seed {GOOD.seed}: {GOOD}" in out
    _, _, shown = out.partition("to play it again:\n")
    command, _, shown = shown.partition("\n")
    text = re.search(r"--case '(.*)'$", command)
    assert text is not None
    assert "MISS trials lacks 1 of 1 rows" in shown
    assert "recorder" in shown
    assert simulated.main(["--case", text[1]]) == 1
    assert capsys.readouterr().out == shown


def test_a_seed_that_breaks_no_promise_is_shown_as_it_is(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Also from a file, and as a recording."""
    assert simulated.main(["--explain", str(GOOD.seed)]) == 0
    explained = capsys.readouterr().out
    assert "MISS" not in explained
    file, recording = tmp_path / "case.json", tmp_path / "run.rrd"
    file.write_text(GOOD.to_text())
    assert simulated.main(["--case", str(file), "--view", str(recording)]) == 0
    assert explained.endswith(capsys.readouterr().out)
    assert recording.stat().st_size > 0


def test_seeds_that_fail_alike_are_explained_once() -> None:
    """The first of them explains the others."""
    failed = [(5, ("eve0 is left",)), (6, ("trials lacks 1 of 9 rows",)), (7, ("legitimate is left",))]
    assert simulated.unlike(failed) == failed[:2]
