"""The page of `evedrop test` as a whole."""

from __future__ import annotations

import time
from pathlib import Path
from urllib.parse import unquote

import pytest

from evedrop.studies.scenario_tests import Finding, Outcome
from evedrop.studies.tests_page import TESTS_PAGE, write_tests_page
from tests.conftest import Evedrop
from tests.pages import Checked


def test_the_page_has_a_line_for_each_scenario_that_links_to_its_report(tmp_path: Path) -> None:
    """Outcome and reasons, without the folders of this machine; what has no report has no link."""
    folder = tmp_path / "a folder" / "#1 ü"
    folder.mkdir(parents=True)
    reason = f"expected x below 1: FAILED, found 2; see it again: evedrop run {folder}"
    tested = [
        Finding("good", Outcome.PASSED, 1.0, folder=folder, report=folder / "report.html"),
        Finding("<b>bad", Outcome.FAILED, 2.0, (reason,), folder=folder, report=folder / "report.html"),
        Finding("none", Outcome.MISTAKES, 0.0, ("slots: is missing",)),
    ]
    path = write_tests_page(tmp_path, tested, time.time())
    assert path == tmp_path / TESTS_PAGE
    page = Checked(path.read_text())
    links = [link for link in page.values("href") if not link.startswith("#")]
    assert [unquote(link) for link in links] == ["a folder/#1 ü/report.html"] * 2
    assert {"1 passed, 1 FAILED, 1 MISTAKES", "good", "<b>bad", "none", "slots: is missing"} <= set(page.texts)
    assert "expected x below 1: FAILED, found 2" in page.texts
    assert str(tmp_path) not in path.read_text()


def test_without_results_there_is_no_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nor where it cannot be written, which gives a warning."""
    mistake = Finding("none", Outcome.MISTAKES, 0.0)
    assert write_tests_page(tmp_path, [mistake], 0.0) is None
    assert write_tests_page(tmp_path / "missing", [mistake], 0.0) is None
    (tmp_path / TESTS_PAGE).mkdir()
    done = Finding("good", Outcome.PASSED, 1.0, folder=tmp_path)
    assert write_tests_page(tmp_path, [done], 0.0) is None
    assert "tests.html was not written" in capsys.readouterr().err


def test_the_command_names_its_page(evedrop: Evedrop) -> None:
    """In its last line."""
    done = evedrop("test", "eavesdroppers", "--in-memory", "--trials", "2", "--out", "out")
    assert done.out.splitlines()[-1] == f"report: out/{TESTS_PAGE}"
    assert (evedrop.folder / "out" / TESTS_PAGE).exists()
