"""`evedrop export` with the ending of a picture or a table."""

from __future__ import annotations

import csv
import shlex

import pytest
from PIL import Image
from pyarrow import parquet

from evedrop.cli.api.results import SweepResults, study_in
from evedrop.results.tables import swept_strategies
from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.pages import checked

SMALL = ("--slots", "20", "--trials", "2", "--out", "study")
STUDIES = {
    "run": ("montecarlo", "eavesdroppers", *SMALL),
    "without states": ("montecarlo", "eavesdroppers", "--covariance-only", *SMALL),
    "sweep": ("sweep", "eavesdroppers", "--over", "seed=1,2", *SMALL),
    "comparison": ("compare", "eavesdroppers", "--schemes", "plain", "--adversaries", "naive", *SMALL),
}


@pytest.mark.thorough
@pytest.mark.parametrize("study", mostly_long(STUDIES, ["run", "sweep"]))
def test_the_picture_and_the_tables_of_any_study(study: str, evedrop: Evedrop) -> None:
    """As PDF, PNG and SVG, as CSV and LaTeX; the command says which files it wrote."""
    assert evedrop(*STUDIES[study]).status in {0, 1}
    for ending, begin in (("pdf", b"%PDF"), ("png", b"\x89PNG"), ("svg", b"<?xml"), ("tex", b"")):
        done = evedrop("export", "study", f"out.{ending}")
        assert (done.status, done.out) == (0, f"out.{ending}\n")
        assert (evedrop.folder / f"out.{ending}").read_bytes().startswith(begin)
    assert "\\begin{tabular}" in (evedrop.folder / "out.tex").read_text()
    done = evedrop("export", "study", "out.csv")
    tables = [list(csv.reader((evedrop.folder / name).read_text().splitlines())) for name in done.out.split()]
    assert all(len(table) > 1 for table in tables)
    done = evedrop("export", "study", "column.png", "--width", "column")
    assert done.status == (0 if study in {"run", "without states"} else 2)
    if done.status == 0:
        with Image.open(evedrop.folder / "column.png") as picture:
            assert picture.width == 1050


def test_what_a_picture_shows_is_called_what_it_is(evedrop: Evedrop) -> None:
    """Covariances are no squared errors; a title in letters that the font lacks is no reason for a warning."""
    named = ("--set", "title=机器人")
    for study, shown, not_shown in (
        ("run", "squared error", "covariance"),
        ("without states", "trace of the actual covariance", "squared error"),
    ):
        assert evedrop(*STUDIES[study], "--out", study, *named).status in {0, 1}
        done = evedrop("export", study, "out.svg", "--panel", "errors")
        assert (done.status, done.err) == (0, "")
        drawn = (evedrop.folder / "out.svg").read_text()
        assert shown in drawn
        assert not_shown not in drawn


@pytest.mark.thorough
def test_a_panel_is_drawn_alone(evedrop: Evedrop) -> None:
    """The errors of a run are lower than the whole picture, and as wide; other studies have no such panel."""
    assert evedrop(*STUDIES["run"]).status in {0, 1}
    sizes = []
    for name, panel in (("whole", ()), ("errors", ("--panel", "errors"))):
        assert evedrop("export", "study", f"{name}.png", *panel).status == 0
        with Image.open(evedrop.folder / f"{name}.png") as picture:
            sizes.append(picture.size)
    (wide, high), (alone_wide, alone_high) = sizes
    assert alone_wide == wide
    assert alone_high < 0.8 * high
    for name in ("out.csv", "out.tex", "out.mcap"):
        for option in (("--panel", "errors"), ("--width", "column")):
            done = evedrop("export", "study", name, *option)
            assert done.status == 2
            assert f"{option[0]} is for pictures" in done.err
            assert not (evedrop.folder / name).exists()


@pytest.mark.thorough
def test_what_cannot_be_exported(evedrop: Evedrop) -> None:
    """A width without a picture, a folder without results, a file that cannot be written."""
    assert evedrop(*STUDIES["run"]).status in {0, 1}
    assert evedrop("export", "study", "out.mcap", "--width", "column").status == 2
    assert evedrop("export", "nowhere", "out.pdf").status == 2
    assert evedrop("export", "study", "nowhere/out.pdf").status == 2


@pytest.mark.parametrize("mode", ["", "--covariance-only", "--error-coordinates"])
def test_the_command_that_shows_results_shows_them(mode: str, evedrop: Evedrop) -> None:
    """Both that of the closing report and that of the page: only some modes have a trial to view, and a name may have spaces."""
    made = ("montecarlo", "eavesdroppers", "--slots", "20", "--trials", "2", "--out", "my study", *filter(None, [mode]))
    [line] = [line for line in evedrop(*made).out.splitlines() if line.startswith("results: ")]
    shown = f"evedrop view 'my study'{' --table' if mode else ''}"
    assert line == f"results: my study; to look at them: {shown}"
    texts = checked(evedrop.folder / "my study").texts
    assert any(text.endswith(f"\nevedrop view again{' --table' if mode else ''}") for text in texts)
    if mode:
        done = evedrop(*shlex.split(shown)[1:])
        assert (done.status, "receiver" in done.out) == (0, True)


def test_a_sweep_has_the_colours_of_its_own_picture_again(evedrop: Evedrop) -> None:
    """The strategies of its receivers, which their colours say, are in its table's metadata."""
    values = ("--over", "seed=1,2", "--set", "eavesdroppers.antenna={strategy='smart', link={quality=0.5}}")
    assert evedrop("sweep", "eavesdroppers", *values, *SMALL).status == 0
    read = study_in(evedrop.folder / "study")
    assert isinstance(read, SweepResults)
    assert swept_strategies(read.table)["antenna"] == "smart"
    assert read.table.equals(parquet.read_table(evedrop.folder / "study" / "sweep.parquet"), check_metadata=True)
