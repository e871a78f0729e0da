"""The figures of results: what they show, and that they need no display."""

from __future__ import annotations

import importlib
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from matplotlib.colors import to_hex
from matplotlib.text import Text

from evedrop import Scenario, load_results, montecarlo
from evedrop.cli.api import ComparisonResults, RunResults, SweepResults, compare, sweep
from evedrop.errors import UsageError
from evedrop.model.eavesdroppers.fixed_rules import Naive
from evedrop.show.report.comparison import conclusion
from evedrop.show.report.writing import REPORT
from evedrop.show.view.palette import DROPPED, paper_inks
from evedrop.show.view.result_pictures import sweep_figure
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from tests.builders import GOOD
from tests.examples import mostly_long
from tests.pages import Checked, checked
from tests.scenario.conformance.own_classes import BLOCK, TEXT

SCENARIO = Scenario(GOOD).replace(slots=30, trials=2, record_trials=2)


@pytest.fixture(scope="module")
def results() -> RunResults:
    """A small study with two recorded trials."""
    return montecarlo(SCENARIO, trials=5)


def test_errors_are_those_of_the_table_in_the_colours_of_the_view(results: RunResults) -> None:
    """A curve and a dashed one of theory for each receiver, and a band around it."""
    (axes,) = results.plot("errors").axes
    curves = {str(line.get_label()): line for line in axes.get_lines()}
    inks = paper_inks(results.peers, {name: table.strategy for name, table in SCENARIO.eavesdroppers.items()})
    for name in results.peers:
        rows = [row for row in results.slots.to_pylist() if row["peer"] == name]
        errors = np.maximum([row["mean_squared_error"] for row in rows], 1e-5)  # tr Q / trials is 0.0004
        np.testing.assert_allclose(np.asarray(curves[name].get_ydata()), errors, rtol=1e-12)
        assert to_hex(curves[name].get_color()) == inks[name]
    assert (len(axes.get_lines()), len(axes.collections), axes.get_yscale()) == (4, 2, "log")


@pytest.mark.thorough
def test_no_band_where_rare_events_carry_the_mean() -> None:
    """A lost first packet, with Σ0 far above Q: the mean of its slots is too small, and so is its standard error.

    Theory then lies many standard errors above the mean. Every such slot is without a band, and those of many losses have one.
    """
    changes = {"encoding.state_probability": 0.85, "process.initial_covariance": [[1.0, 0.0], [0.0, 1.0]]}
    unstable = Scenario.load("numerical", changes).replace(slots=20)
    study = montecarlo(unstable, trials=10_000)
    (axes,) = study.plot("errors").axes
    bands = dict(zip(study.peers, axes.collections, strict=True))
    rows = [row for row in study.slots.to_pylist() if row["peer"] == "legitimate"]
    away = np.array([(r["mean_squared_error"] - r["theoretical_trace_covariance"]) / r["standard_error"] for r in rows])
    drawn = {
        x
        for path in bands["legitimate"].get_paths()
        for x in np.asarray(path.vertices)[:, 0].round().astype(int).tolist()
    }
    wrong = set(np.flatnonzero(away < -5.0).tolist())
    assert len(wrong) > 2
    assert not drawn & wrong
    assert set(range(3)) <= drawn
    assert "no band: rare events" in axes.get_title(loc="left")
    assert "none where rare events carry the mean" in study.report().read_text(encoding="utf-8")


def test_the_error_of_the_only_slot_is_a_dot() -> None:
    """A line through one slot would not be seen."""
    (axes,) = montecarlo(SCENARIO.replace(slots=1, trials=1, record_trials=1), trials=1).plot("errors").axes
    assert [line.get_marker() for line in axes.get_lines()] == ["o", "None", "o", "None"]


def test_errors_of_rounding_lie_on_the_lower_edge(results: RunResults) -> None:
    """One trial ends far below tr Q where a state was received; a mean over several is shown further down."""
    alone = montecarlo(SCENARIO.replace(record_trials=1), trials=1)
    (axes,) = alone.plot("errors").axes
    floor = 1e-4  # tr Q is 0.002
    assert min(row["mean_squared_error"] for row in alone.slots.to_pylist()) < 1e-20
    assert axes.get_ylim()[0] == pytest.approx(floor)
    assert "values below 0.0001 lie on the lower edge" in axes.get_title("left")
    assert min(np.min(np.asarray(line.get_ydata())) for line in axes.get_lines()) == pytest.approx(floor)
    (axes,) = results.plot("errors").axes
    assert axes.get_ylim()[0] < floor


def test_errors_far_below_the_highest_lie_on_the_lower_edge() -> None:
    """An axis spans 30 powers of ten; the picture says which errors are not where it shows them, in a title that has room."""
    study = montecarlo("numerical", slots=300, trials=3, plan=Plan(mode=Mode.ERROR_COORDINATES, workers=1))
    (axes,) = study.plot("errors").axes
    low, high = axes.get_ylim()
    assert high / low < 1e32
    assert (study.peers["legitimate"].mean_squared_error or 0.0) < low
    curves = {line.get_label(): np.asarray(line.get_ydata(), float) for line in axes.get_lines()}
    assert curves["legitimate"].min() == pytest.approx(low)
    above, words = axes.get_title("left").split(";\n")
    assert above.endswith("no band: rare events")
    assert words == f"values below {low:.3g} lie on the lower edge"


def test_a_run_without_any_error_has_a_figure() -> None:
    """Without a warning, which would be an error here: no value is positive."""
    results = montecarlo("replay-attack-before", trials=1)
    (axes,) = results.plot("errors").axes
    assert {row["mean_squared_error"] for row in results.slots.to_pylist()} == {0.0}
    assert axes.get_ylim()[1] == pytest.approx(10.0 * axes.get_ylim()[0])


def test_lanes_have_the_outcome_of_every_packet(results: RunResults) -> None:
    """A row for each receiver; a lost packet has the colour that it has in the view."""
    (axes,) = results.plot("lanes", slots=range(5, 25), trial=1).axes
    (image,) = axes.get_images()
    pixels = np.asarray(image.get_array())
    rows = [row for row in results.trials.to_pylist() if row["trial"] == 1 and 5 <= row["slot"] < 25]
    lost = [[row["action"] == "dropped" for row in rows if row["peer"] == name] for name in results.peers]
    assert np.array_equal((pixels == DROPPED).all(axis=2), lost)
    assert [yticklabel.get_text() for yticklabel in axes.get_yticklabels()] == list(results.peers)
    assert "trial 1, slots 5 to 24" in axes.get_title("left")


def test_the_plane_shows_the_truth_and_who_follows_it(results: RunResults) -> None:
    """Estimates far from the truth lie outside the picture; a process of one state is drawn against the slot."""
    (axes,) = results.plot("plane").axes
    truth = np.array([row["x"] for row in results.trials.to_pylist() if row["trial"] == 0 and row["peer"] == "smart"])
    drawn = {str(line.get_label()): np.array(line.get_data()).T for line in axes.get_lines()}
    assert np.array_equal(drawn["truth"], truth)
    assert list(drawn) == ["truth", *results.peers]
    low, high = axes.get_xlim()
    assert low < truth[:, 0].min() <= truth[:, 0].max() < high < truth[:, 0].max() + np.ptp(truth[:, 0])
    process = {"A": [[0.9]], "Q": [[0.1]], "initial_covariance": [[1.0]]}
    (axes,) = montecarlo(SCENARIO, trials=2, process=process).plot("plane").axes
    assert axes.get_xlabel() == "slot"


@pytest.mark.parametrize("receivers", mostly_long([1, 4, 9], [9]))
def test_receivers_are_named_beside_their_errors(receivers: int) -> None:
    """No name covers another, and none is in a legend; the axis has the unit of what it shows."""
    link = {"quality": 0.9}
    eavesdroppers = {f"e{i}": {"strategy": "naive", "link": link} for i in range(receivers - 1)}
    units = {"states": ["position", "speed"], "units": ["m", "m/s"]}
    scenario = SCENARIO.replace(
        eavesdroppers=eavesdroppers, expect=[], process={**SCENARIO.as_tables()["process"], **units}
    )
    results = montecarlo(scenario, trials=3)
    figure = results.plot("errors")
    (axes,) = figure.axes
    assert axes.get_legend() is None
    assert axes.get_ylabel() == "squared error (m² + (m/s)²)"
    assert [text.get_text() for text in axes.texts] == list(results.peers)
    figure.savefig(io.BytesIO(), dpi=figure.dpi)
    boxes = sorted((Text.get_window_extent(text) for text in axes.texts), key=lambda box: float(box.y0))
    assert all(above.y0 > below.y0 + 0.8 * below.height for below, above in pairwise(boxes))
    assert all(box.x1 <= figure.bbox.x1 for box in boxes)


def test_nine_receivers_look_different() -> None:
    """Neighbouring shades of a strategy have other lines and dots, in the legend, too."""
    eavesdroppers = {f"antenna{i}": {"strategy": "naive", "link": {"quality": 0.5}} for i in range(8)}
    results = montecarlo(SCENARIO, trials=2, eavesdroppers=eavesdroppers)
    errors, _, plane = results.plot().axes
    manners = []
    for axes, kind in ((errors, "get_linestyle"), (plane, "get_marker")):
        lines = [line for line in axes.get_lines() if str(line.get_label()) in results.peers]
        assert [line.get_label() for line in lines] == list(results.peers)
        manners += [{(to_hex(line.get_color()), getattr(line, kind)()) for line in lines}]
    assert [len(manner) for manner in manners] == [9, 9]


def test_a_figure_shows_itself_in_a_notebook_without_a_display(
    results: RunResults, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A notebook shows the figure as a PNG, without pyplot and its windows."""
    monkeypatch.delenv("DISPLAY", raising=False)
    figure = results.plot()
    assert len(figure.axes) == 3
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_a_figure_looks_for_no_windows() -> None:
    """Nobody imports pyplot, which would try each windowing toolkit in turn."""
    program = """
import io, sys
from evedrop.show.view.figure_style import drawing
with drawing(3.0, 2.0) as figure:
    figure.savefig(io.BytesIO(), format="svg")
sys.exit("matplotlib.pyplot" in sys.modules)
"""
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)


def test_what_cannot_be_drawn_is_refused(results: RunResults) -> None:
    """The message lists what can be shown; errors alone need no recorded trial."""
    with pytest.raises(UsageError, match="there is no panel 'error'; expected errors, lanes, plane"):
        results.plot("error")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="trial 7 is not recorded; recorded are 0, 1"):
        results.plot(trial=7)
    for slots in (range(31), range(0), range(0, 9, 2)):
        with pytest.raises(UsageError, match=r"expected some such as range\(0, 30\)"):
            results.plot("errors", slots=slots)
    covariances = montecarlo(SCENARIO.replace(record_trials=1), trials=2, plan=Plan(Mode.COVARIANCE_ONLY))
    with pytest.raises(UsageError, match="the run has recorded none, and 'errors' needs none"):
        covariances.plot()
    assert len(covariances.plot("errors", slots=range(10)).axes) == 1


def test_dollar_signs_are_not_mathematics() -> None:
    """A title, a state or a unit may have them; matplotlib would refuse what is between two of them."""
    two = {"process__states": ["$a_$", "b"], "process__units": ["$^$", "m"]}
    scenario = SCENARIO.replace(title=r"costs $5_ to $7^", slots=5, record_trials=1, **two)
    montecarlo(scenario, trials=2).plot().savefig(io.BytesIO())
    compare(scenario, schemes=["innovation"], adversaries=["naive"], trials=2).plot().savefig(io.BytesIO())


def test_a_run_without_slots_has_nothing_to_plot(results: RunResults, tmp_path: Path) -> None:
    """Such as one that was interrupted before its first slot."""
    shutil.copytree(results.folder, tmp_path / "run")
    table = tmp_path / "run" / "slots.parquet"
    pq.write_table(pq.read_table(table).slice(0, 0), table)
    with pytest.raises(UsageError, match=r"plot: .* has no slots to plot"):
        load_results(tmp_path / "run").plot("errors")


def test_panels_that_a_picture_of_a_sweep_lacks_are_counted() -> None:
    """It has six at most."""
    rows = [{"peer": "eve", "slots": 4, "seed": seed, "mean_squared_error": 1.0} for seed in range(8)]
    figure = sweep_figure(pa.Table.from_pylist(rows), ["slots", "seed"])
    assert len(figure.axes) == 6
    assert figure.get_suptitle() == "the first 6 of 8 combinations"


def test_a_receiver_that_only_some_points_have_is_drawn_at_these() -> None:
    """A sweep over the table of eavesdroppers; it has no other points' places, and hides no other receiver's points."""
    rows = [
        {"peer": peer, "over": over, "mean_squared_error": 1.0}
        for over, peer in zip("abb", ("own", "own", "spy"), strict=True)
    ]
    (axes,) = sweep_figure(pa.Table.from_pylist(rows), ["over"]).axes
    assert [list(marks[0].get_xdata()) for marks in axes.containers] == [[0.0, 1.0], [1.0]]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["a", "b"]
    assert axes.get_xlim() == (-0.5, 1.5)


@pytest.mark.long
def test_a_sweep_is_drawn_as_its_file_is() -> None:
    """Errors against the first entry, a panel for each value of the second."""
    result: SweepResults = sweep(SCENARIO, {"encoding.state_probability": [0.3, 0.7], "slots": [4, 6]}, trials=3)
    axes = result.plot().axes
    assert [axis.get_title("left") for axis in axes] == ["slots = 4", "slots = 6"]
    assert axes[0].get_xlabel() == r"$\mu_d$: probability of sending a state"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module `flipped` of the tutorial, imported from a folder as a user does."""
    (tmp_path / "flipped.py").write_text(dict(BLOCK.findall(TEXT))["flipped.py"])
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("flipped")
    del sys.modules["flipped"]


def test_a_comparison_takes_a_class_and_has_a_figure_and_a_page(own: Any) -> None:
    """The figure has a row for each scheme; the page lies in the folder of the results."""
    result = compare(SCENARIO, schemes=[own.Flipped, "plain"], adversaries=[Naive], trials=2, plan=Plan(workers=1))
    assert isinstance(result, ComparisonResults)
    assert list(result.schemes) == ["flipped:Flipped", "plain"]
    assert result.adversaries == ("naive",)
    for scheme, adversary, message in (("plane", "naive", "scheme 'plane'; expected one of flipped:Flipped, plain"),
                                    ("plain", "naiv", "adversary 'naiv'; expected one of naive")):  # fmt: skip
        with pytest.raises(KeyError, match=f"there is no {message}$"):
            result.cell(scheme, adversary)
    texts = {text.get_text() for text in result.plot().axes[0].texts}
    assert {*result.schemes, *result.adversaries} <= texts
    assert result.report() == result.folder / REPORT
    assert any("flipped:Flipped" in text for text in checked(result.folder).texts)
    shown = result._repr_html_()
    glyphs = [result.cell(scheme, "naive").verdict.glyph for scheme in result.schemes]  # type: ignore[union-attr]
    for text in (repr(result), shown):
        assert conclusion(result)[:60] in text
        assert "cannot tell yet" in text
    matrix = [line.split() for line in repr(result).splitlines() if line.endswith(tuple(glyphs))]
    assert matrix == [[scheme, glyph] for scheme, glyph in zip(result.schemes, glyphs, strict=True)]
    assert [f"{glyph}\u00a0" for glyph in glyphs] == [text for text in Checked(shown).texts if text[1:] == "\u00a0"]
    texts_ = Checked(shown).texts
    cells = texts_[texts_.index("beaten by another scheme") + 1 :]
    assert cells[::4] == ["flipped:Flipped", "plain"]
    assert float(cells[5]) == pytest.approx(result.schemes["plain"].price, rel=1e-3)
    assert (cells[3::4], result.dominant) == (["–", "–"], ())  # two trials do not tell


def test_results_write_their_page(results: RunResults) -> None:
    """The page is written into their folder."""
    assert results.report() == results.folder / REPORT
    assert SCENARIO.title in checked(results.folder).headings


@pytest.mark.parametrize("receivers", mostly_long([1, 4, 9], [9]))
def test_a_figure_for_a_column_of_a_journal(receivers: int, tmp_path: Path) -> None:
    """89 mm wide, letters of at least 7 points in embedded fonts, names beside the curves, without title and legend."""
    link = {"quality": 0.9}
    eavesdroppers = {f"e{i}": {"strategy": "naive", "link": link} for i in range(receivers - 1)}
    made = montecarlo(SCENARIO.replace(eavesdroppers=eavesdroppers, expect=[]), trials=3)
    figure = made.plot("errors", width="column")
    assert figure.get_size_inches()[0] == pytest.approx(3.5)
    (axes,) = figure.axes
    assert (axes.get_title(), axes.get_title("left"), axes.get_legend(), figure._suptitle) == ("", "", None, None)  # type: ignore[attr-defined]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("slot", "squared error")
    names = {text.get_text(): text.get_position()[1] for text in axes.texts}
    assert list(names) == list(made.peers)
    places = sorted(names.values())
    assert all(after - before > 0.05 for before, after in pairwise(places))
    texts = [*axes.texts, axes.xaxis.label, axes.yaxis.label, *axes.get_xticklabels()]
    assert {(text.get_fontfamily()[0], text.get_fontsize()) for text in texts} == {("STIXGeneral", 8.0)}
    figure.savefig(tmp_path / "figure.pdf")
    assert b"/CIDFontType2" in (tmp_path / "figure.pdf").read_bytes()
    lanes, plane = made.plot("lanes", "plane", width="column").axes
    assert all(panel.get_legend() is not None for panel in (lanes, plane))
    with pytest.raises(UsageError, match="column"):
        made.plot(width="wide")  # type: ignore[arg-type]
