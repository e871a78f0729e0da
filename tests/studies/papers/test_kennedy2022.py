import io
import re
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from evedrop.cli import main as cli
from evedrop.studies.papers import kennedy2022, microgrid
from evedrop.studies.papers.kennedy2022 import Size
from tests.examples import mostly_long

NAMES = ("numerical", "microgrid", "strategies", "chain")
DRAWN = ("chain",)
"""The figures that are drawn in `make test`: most of the time goes into drawing."""


def made_in(folder: Path, drawn: tuple[str, ...]) -> Path:
    """figures.md of a small set of figures, made by the command; of those that are not drawn the files are empty."""
    small = Size(microgrid_trials=20, microgrid_slots=1000, strategy_trials=400, chain_trials=50, chain_slots=300)
    out, err = io.StringIO(), io.StringIO()
    from matplotlib.figure import Figure  # slow to import

    honest = Figure.savefig

    def savefig(self: Figure, path: Path, **how: Any) -> None:
        return honest(self, path, **how) if path.stem in drawn else path.touch()

    with (
        patch.object(kennedy2022, "Size", lambda **_: small),
        patch.object(Figure, "savefig", savefig),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        assert cli.main(["figures", str(folder)]) == 0
    assert out.getvalue() == f"{folder / 'figures.md'}\n"
    assert "numerical illustration" in err.getvalue(), "progress was never reported"
    return folder / "figures.md"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In a directory that did not exist, with some of the figures drawn."""
    return made_in(tmp_path_factory.mktemp("figures") / "new" / "folder", DRAWN)


@pytest.fixture(scope="module")
def all_drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With all figures drawn."""
    return made_in(tmp_path_factory.mktemp("drawn"), NAMES)


def test_nothing_else_is_written(report: Path) -> None:
    """A picture for the screen and one for print of each figure, and the report."""
    pictures = {f"{name}.{kind}" for name in NAMES for kind in ("png", "pdf")}
    assert {path.name for path in report.parent.iterdir()} == {"figures.md", *pictures}


@pytest.mark.parametrize("name", mostly_long(NAMES, DRAWN))
def test_every_figure_is_drawn(name: str, request: pytest.FixtureRequest) -> None:
    """Each figure is there as PNG with something on it, and as PDF, and figures.md shows it."""
    from matplotlib.image import imread

    report: Path = request.getfixturevalue("report" if name in DRAWN else "all_drawn")
    picture = imread(report.parent / f"{name}.png")
    assert picture.shape[0] > 600
    assert picture.shape[1] > 1200
    ink = np.mean(picture[:, :, :3].min(axis=2) < 0.9)
    assert 0.01 < ink < 0.5
    assert (report.parent / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    assert f"({name}.png)" in report.read_text(encoding="utf-8")


def test_numbers_are_judged(report: Path) -> None:
    """The table says agrees or erratum for each number of the paper, with a reason for the latter."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in report.read_text(encoding="utf-8").splitlines()
        if line.startswith(("| numerical illustration |", "| microgrid |"))
    ]
    verdicts = {(row[1], row[2]): row[5] for row in rows}
    assert verdicts[("ρ(A)", "1.3878")] == "agrees"
    assert verdicts[("legitimate stability bound", "0.5342")] == "agrees"
    assert verdicts[("upper end of perfect secrecy, μ_e = 0.85", "0.5656")] == "agrees"
    assert verdicts[("slots in a day of one-second slots", "86400")] == "agrees"
    errata = {name: verdict for name, verdict in verdicts.items() if verdict.startswith("erratum: ")}
    assert len(errata) == 7
    assert all(len(verdict) > 30 for verdict in errata.values())
    assert sum(verdict == "agrees" for verdict in verdicts.values()) == 5
    assert sum(verdict.startswith("not comparable: ") for verdict in verdicts.values()) == 2


def test_formulas_are_shown_as_printed_and_corrected(report: Path) -> None:
    """The finite-k values at k = 1: printed, corrected, and the recursion that agrees with the correction."""
    text = report.read_text(encoding="utf-8")
    for name, printed, corrected in (
        ("legitimate", "1.0775", "0.1079"),
        ("smart", "0.9209", "0.1087"),
        ("naive", "1.8864", "1.7099"),
    ):
        assert re.search(rf"\| {name} \| {printed} \| {corrected} \| {corrected} \|", text)


def test_captions_state_the_size(report: Path) -> None:
    """The figure says what was simulated, how often, and how precise the result is."""
    text = report.read_text(encoding="utf-8")
    assert "mean over 1000 slots of one second and 20 trials" in text
    assert "400 trials of the real model" in text
    assert "50 trials × 300 slots" in text


def test_simulated_microgrid_agrees_with_theory() -> None:
    """Means over slots of the simulated covariances are within five standard errors of the finite-k theory."""
    day = microgrid.simulate(trials=60, slots=1500, progress=lambda _: None)
    assert np.all(np.abs(day.simulated - day.theory) <= 5.0 * day.error)
    assert np.all(day.simulated[1] > day.simulated[0])
