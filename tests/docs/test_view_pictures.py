"""The pictures of the view that are in the repository are what the program draws. `make docs` runs these tests."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import numpy.typing as npt
import pytest

from tests.privileged import CannotRun, skip

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
SQUARE = 10
"""Pixels along a side of the squares whose mean colours are compared, so that the edges of letters matter little."""
TOLERANCE = 0.002
"""Of the mean difference, from 0 to 1: the same slot, drawn again, differed by 0.0002, and one a second later by 0.005."""


def evedrop(*words: str | Path) -> None:
    """Run a command, and fail if it fails. Skips the test where nothing can draw."""
    done = subprocess.run(
        [sys.executable, "-m", "evedrop", *words], check=False, timeout=300, capture_output=True, text=True
    )
    if "no Vulkan driver" in done.stderr:
        skip(CannotRun(done.stderr))
    assert done.returncode == 0, done.stderr


def run_of(scenario: str, folder: Path) -> Path:
    """A run of a built-in scenario, as fast as possible."""
    evedrop("run", scenario, "--pace", "0", "--view", "off", "--out", folder / "run")
    return folder / "run"


def quoted(page: Path, picture: str) -> list[str]:
    """The words of the command with which a page says that one of its pictures is made."""
    text = page.read_text(encoding="utf-8")
    match = re.search(r"`evedrop (view RUN --picture FILE\.png[^`]*)`", text[text.index(f"{picture})") :])
    assert match is not None
    return shlex.split(match[1])


def drawn(words: list[str], run: Path, picture: Path) -> Path:
    """The picture that a quoted command makes of a run."""
    evedrop(*({"RUN": run, "FILE.png": picture}.get(word, word) for word in words))
    return picture


def coarse(picture: Path) -> npt.NDArray[np.float64]:
    """The mean colours of a picture's squares."""
    pixels = np.asarray(matplotlib.image.imread(picture), dtype=float)[..., :3]
    height, width = (length // SQUARE for length in pixels.shape[:2])
    squares = pixels[: height * SQUARE, : width * SQUARE].reshape(height, SQUARE, width, SQUARE, 3)
    means: npt.NDArray[np.float64] = squares.mean(axis=(1, 3))
    return means


def difference(picture: Path, other: Path) -> float:
    """The mean absolute difference of two pictures' squares. Fails if the pictures have different sizes."""
    first, second = coarse(picture), coarse(other)
    assert first.shape == second.shape
    return float(np.abs(first - second).mean())


@pytest.mark.long
def test_the_picture_of_the_readme_is_what_its_command_draws(tmp_path: Path) -> None:
    """The slot that README names looks as the picture there; the one a second later does not."""
    words = quoted(ROOT / "README.md", "live_view.png")
    run = run_of("vehicle", tmp_path)
    assert difference(drawn(words, run, tmp_path / "same.png"), DOCS / "live_view.png") < TOLERANCE
    words[-1] = str(int(words[-1]) + 50)
    assert difference(drawn(words, run, tmp_path / "later.png"), DOCS / "live_view.png") > 2 * TOLERANCE


@pytest.mark.long
def test_the_picture_of_a_day_is_what_its_command_draws(tmp_path: Path) -> None:
    """A day of `microgrid` looks as the picture in docs/view.md; a slot at noon does not."""
    words = quoted(DOCS / "view.md", "microgrid_view.png")
    run = run_of("microgrid", tmp_path)
    assert difference(drawn(words, run, tmp_path / "same.png"), DOCS / "microgrid_view.png") < TOLERANCE
    noon = drawn([*words, "--slot", "43200"], run, tmp_path / "noon.png")
    assert difference(noon, DOCS / "microgrid_view.png") > 2 * TOLERANCE


def test_a_picture_is_described_alike_wherever_it_is_shown() -> None:
    """The words for those who do not see it."""
    pages = [ROOT / "README.md", *DOCS.rglob("*.md")]
    descriptions = {
        text for page in pages for text in re.findall(r"!\[([^]]+)\]\([\w/.]*live_view\.png\)", page.read_text("utf-8"))
    }
    assert len(descriptions) == 1
