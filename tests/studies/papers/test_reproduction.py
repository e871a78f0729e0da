"""`evedrop paper`: every paper's numbers, their verdicts, and the command as it is typed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, final
from unittest.mock import patch

import pytest

from evedrop.studies.papers import PAPERS, reproduce
from evedrop.studies.papers.reproduction import NumberVerdict, Paper, Progress, PublishedNumber, Reproduction
from tests.conftest import Evedrop
from tests.examples import mostly_long

DOCS = Path(__file__).parents[3] / "docs"


def judged(reproduction: Reproduction) -> None:
    """No number differs without an explanation, and each explanation is a sentence."""
    assert reproduction.rows
    assert reproduction.differing == ()
    for row in reproduction.rows:
        assert row.where, row
        assert row.quantity, row
        assert row.verdict is not NumberVerdict.AGREES or row.printed, row
        assert row.verdict is not NumberVerdict.FORMULA or not row.printed, row
        if row.verdict in {NumberVerdict.AGREES, NumberVerdict.FORMULA}:
            assert row.reason == "", row
            assert row.tolerance or not isinstance(row.theirs, float), row
        else:
            assert len(row.reason) > 20, row


@cache
def reproduced_quickly(name: str) -> tuple[Reproduction, list[str]]:
    """A paper with small sizes, computed once for all tests, and the progress that was told."""
    told: list[str] = []
    return reproduce(name, quick=True, progress=told.append), told


@pytest.mark.parametrize("name", mostly_long(PAPERS, {*PAPERS} - {"luecke2022"}))
def test_every_paper_is_reproduced_quickly(name: str) -> None:
    """With small sizes; progress is reported; the JSON is strict."""
    reproduction, progress = reproduced_quickly(name)
    judged(reproduction)
    errata = [row for row in reproduction.rows if row.verdict is NumberVerdict.ERRATUM]
    assert not errata or PAPERS[name].text_read
    assert progress
    assert json.dumps(reproduction.as_dict(), allow_nan=False)


@pytest.mark.long
@pytest.mark.parametrize("name", PAPERS)
def test_every_paper_is_reproduced(name: str) -> None:
    """In full size."""
    judged(reproduce(name))


def test_every_paper_has_a_page() -> None:
    """Linked from the index, with the command that reproduces it."""
    index = (DOCS / "papers.md").read_text(encoding="utf-8")
    for name in PAPERS:
        assert f"| [`{name}`](papers/{name}.md) |" in index
        page = (DOCS / "papers" / f"{name}.md").read_text(encoding="utf-8")
        assert page.startswith(f"# `{name}`\n")
        assert f"    evedrop paper {name}\n" in page
    assert {page.stem for page in (DOCS / "papers").iterdir()} == set(PAPERS)


@pytest.mark.parametrize("name", PAPERS)
def test_a_page_speaks_of_errata_only_if_we_have_read_the_paper(name: str) -> None:
    """Otherwise a number may differ from the published program, or from our evaluation of a formula."""
    page = (DOCS / "papers" / f"{name}.md").read_text(encoding="utf-8")
    claims = re.findall(r"(?<!not \")\berrat(?:um|a)\b", page, re.IGNORECASE)
    assert PAPERS[name].text_read or not claims


def verdict(theirs: float, ours: float, **more: Any) -> NumberVerdict:
    """The verdict on two numbers."""
    return PublishedNumber.compared("here", "it", theirs, ours, **more).verdict


def test_a_number_agrees_within_the_largest_of_its_tolerances() -> None:
    """A fraction of theirs, an absolute bound, or standard errors of the difference."""
    agrees, differs, erratum = NumberVerdict.AGREES, NumberVerdict.DIFFERS, NumberVerdict.ERRATUM
    assert verdict(-2.0, -2.03, relative=0.02) is agrees
    assert verdict(-2.0, -2.05, relative=0.02) is differs
    assert verdict(-2.0, -2.05, relative=0.02, absolute=0.06) is agrees
    assert verdict(1.0, 1.05, standard_error=0.01, errors=3.0) is differs
    assert verdict(1.0, 1.05, standard_error=0.03, errors=3.0) is agrees
    assert verdict(1.0, 1.05, standard_error=0.01, errors=3.0, their_error=0.03) is agrees
    assert verdict(1.0, 2.0, errors=3.0, erratum="the values are interchanged") is erratum
    assert verdict(1.0, float("nan"), relative=0.5) is differs
    with pytest.raises(ValueError, match="no tolerance"):
        verdict(1.0, 1.0)
    with pytest.raises(ValueError, match="needs a reason"):
        PublishedNumber.stated("here", "it", 1.0, None, NumberVerdict.NOT_PUBLIC)


def test_the_papers_are_listed(evedrop: Evedrop) -> None:
    """One line each, or all as JSON."""
    done = evedrop("paper")
    assert (done.status, done.err) == (0, "")
    assert [line.split()[0] for line in done.out.splitlines()] == [*PAPERS]
    listed = json.loads(evedrop("paper", "--json").out)
    assert listed["kennedy2022"]["published"] == "arXiv 2212.08234, 2022"


@pytest.mark.thorough
def test_a_paper_is_printed_and_written(evedrop: Evedrop, tmp_path: Path) -> None:
    """The table with notes; the folder gets JSON and Markdown; `--json` prints one line."""
    folder = tmp_path / "new" / "folder"
    done = evedrop("paper", "kennedy2022", "--out", str(folder))
    assert done.status == 0
    assert "numerical illustration" in done.err
    assert "1.3878 exact" in done.out
    assert "erratum [1]" in done.out
    message = "12 published numbers were compared."
    assert f"agrees: 5, erratum: 7, not comparable: 2. {message}" in done.out
    written = json.loads((folder / "kennedy2022.json").read_text(encoding="utf-8"))
    assert len(written["rows"]) == 14
    assert written["counts"] == {"agrees": 5, "erratum": 7, "not comparable": 2}
    markdown = (folder / "kennedy2022.md").read_text(encoding="utf-8")
    assert written["printed_compared"] == 12
    assert message in markdown
    assert markdown.count("\n| numerical illustration | ") == 10
    assert json.loads(evedrop("paper", "kennedy2022", "--json").out) == written


def test_a_paper_of_which_no_number_is_known_agrees_with_nothing() -> None:
    """Our simulations of its formulas have a verdict of their own, and the count of its own numbers is 0."""
    reproduction, _ = reproduced_quickly("naha2021")
    assert reproduction.printed_compared == 0
    assert reproduction.scope == "No published number was compared: none was available."
    assert set(reproduction.counts) == {"formula", "not public", "not comparable"}
    assert {row["printed"] for row in reproduction.as_dict()["rows"] if row["verdict"] == "formula"} == {False}
    assert reproduced_quickly("crimson2023")[0].printed_compared == 1


@final
class _Wrong(Paper):
    """A paper with a number that is wrong for no known reason."""

    title, authors, published = "Title", "Nobody", "never"

    def rows(self, quick: bool, progress: Progress) -> Iterable[PublishedNumber]:
        """One row that differs, and one of infinity."""
        progress(f"quick: {quick}")
        yield PublishedNumber.compared("Table 1", "it", 1.0, 2.0, 0.1, errors=3.0)
        reason = "their data are not published"
        yield PublishedNumber.stated("Table 1", "that", None, float("inf"), NumberVerdict.NOT_PUBLIC, reason)


def test_a_number_that_differs_fails_the_command(evedrop: Evedrop) -> None:
    """The exit status is 1, and the table says which."""
    with patch.dict(PAPERS, {"wrong": _Wrong}):
        done = evedrop("paper", "wrong", "--quick")
        assert "∞ exact" in done.out
        assert json.loads(evedrop("paper", "wrong", "--json").out)["rows"][1]["ours"] == "inf"
    assert done.status == 1
    assert done.err == "quick: True\n"
    assert "2.0 ± 0.1" in done.out
    assert "differs: 1" in done.out
    assert "without --quick" in done.out


def test_mistakes_are_named(evedrop: Evedrop, tmp_path: Path) -> None:
    """A paper that does not exist, and a folder that cannot be made, before anything is computed."""
    done = evedrop("paper", "kenedy2022")
    assert done.status == 2
    assert "paper kenedy2022: no such paper; did you mean kennedy2022?" in done.err
    assert "expected one of kennedy2022" in evedrop("paper", "xyz").err
    (tmp_path / "file").touch()
    done = evedrop("paper", "kennedy2022", "--out", str(tmp_path / "file" / "folder"))
    assert done.status == 2
    assert "file/folder cannot be written" in done.err
    assert "numerical illustration" not in done.err
