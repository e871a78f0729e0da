"""The pictures of the view that are in the repository are what the program draws. `make docs` runs these tests."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib.image
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from evedrop.cli import main as cli
from tests.docs.pictures import DOCS, PICTURES, ROOT, SCENES, SIZES, drawn, quoted, run_of, scene_of

SQUARE = 10
"""Pixels along a side of the squares whose mean colours are compared, so that the edges of letters matter little."""
FEW_COLOURS = 0.01
"""The same for pictures in few colours."""
TOLERANCE = 0.002
"""Of the mean difference, from 0 to 1: the same slot, drawn again, differed by 0.0002, and one a second later by 0.005."""


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
def test_the_picture_of_the_tutorial_is_what_its_command_draws(tmp_path: Path) -> None:
    """The slot that the page names looks as the picture there; the one a second later does not."""
    words = quoted(DOCS / "tutorial.md", "live_view.png")
    run = run_of("vehicle", tmp_path)
    assert difference(drawn(words, run, tmp_path / "same.png"), DOCS / "live_view.png") < TOLERANCE
    at = words.index("--slot") + 1
    words[at] = str(int(words[at]) + 50)
    assert difference(drawn(words, run, tmp_path / "later.png"), DOCS / "live_view.png") > 2 * TOLERANCE


@pytest.mark.long
def test_the_picture_of_a_day_is_what_its_command_draws(tmp_path: Path) -> None:
    """A day of `microgrid` looks as the picture in docs/view.md; a slot at noon does not."""
    words = quoted(DOCS / "view.md", "microgrid_view.png")
    run = run_of("microgrid", tmp_path)
    assert difference(drawn(words, run, tmp_path / "same.png"), DOCS / "microgrid_view.png") < TOLERANCE
    noon = drawn([*words, "--slot", "43200"], run, tmp_path / "noon.png")
    assert difference(noon, DOCS / "microgrid_view.png") > 2 * TOLERANCE


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in SCENES if name != "wire"])
def test_a_scene_is_the_one_on_the_page_of_screens(name: str, tmp_path: Path) -> None:
    """In both sizes. That of a wire depends on when its messages came, and is only drawn again."""
    for size in SIZES:
        picture = scene_of(name, size, tmp_path, tmp_path / f"{size}.png")
        assert difference(picture, DOCS / "screens" / f"{name}-{size}.png") < FEW_COLOURS


@pytest.mark.parametrize("theme", ["", "-light"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", SCENES)
def test_the_page_of_screens_has_every_scene(name: str, size: str, theme: str) -> None:
    """In its size, in both themes."""
    with Image.open(DOCS / "screens" / f"{name}-{size}{theme}.png") as picture:
        assert "x".join(map(str, picture.size)) == size


def test_every_picture_has_a_command_that_draws_it() -> None:
    """So that `make pictures` draws all of them again."""
    assert {path.name for path in DOCS.iterdir() if path.suffix in {".png", ".gif"}} == PICTURES.keys()
    for page, picture in (
        (DOCS / "tutorial.md", "live_view.png"),
        (ROOT / "README.md", "wire.gif"),
        (DOCS / "view.md", "vehicle.gif"),
        (DOCS / "view.md", "microgrid_view.png"),
        (DOCS / "wire" / "results.md", "wire_view.png"),
    ):
        assert cli.parser_of().parse_args(quoted(page, picture)).command is not None


@pytest.mark.parametrize(("name", "seconds"), [("vehicle.gif", 10), ("wire.gif", 9.125)])
def test_a_video_is_a_small_loop(name: str, seconds: float) -> None:
    """As wide as a page, so that its words are sharp, and below 3 MB."""
    path = DOCS / name
    assert path.stat().st_size < 3_000_000
    with Image.open(path) as gif:
        assert gif.width == 880
        length = 0
        for number in range(getattr(gif, "n_frames", 1)):
            gif.seek(number)
            length += gif.info["duration"]
    assert length == pytest.approx(1000 * seconds, rel=0.05)


def test_a_picture_is_described_alike_wherever_it_is_shown() -> None:
    """The words for those who do not see it."""
    pages = [ROOT / "README.md", *DOCS.rglob("*.md")]
    descriptions = {
        text for page in pages for text in re.findall(r"!\[([^]]+)\]\([\w/.]*live_view\.png\)", page.read_text("utf-8"))
    }
    assert len(descriptions) == 1
