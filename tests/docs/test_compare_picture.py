"""The picture of docs/compare.md shows what the command makes that the page names for it."""

from __future__ import annotations

import shlex
from pathlib import Path

from PIL import Image

from evedrop.cli import main as cli
from evedrop.cli.options import changes_of
from evedrop.scenario.loading import load
from evedrop.studies.matchups import matchups_of

DOCS = Path(__file__).parents[2] / "docs"


def test_the_rows_and_columns_are_those_of_the_command() -> None:
    """The picture's metadata, which `evedrop compare` writes, has the schemes and adversaries of the page's first command."""
    page = (DOCS / "compare.md").read_text(encoding="utf-8")
    assert "compare.png)\n\nThis is the picture of the first command" in page
    words = shlex.split(next(line for line in page.splitlines() if line.startswith("evedrop compare ")))
    options = cli.parser_of().parse_args(words[1:])
    assert (options.schemes, options.adversaries, options.parameters) == (None, None, [])
    matchups = matchups_of(load(options.scenario, changes_of(options)))
    some = matchups.groups[0].scenario
    with Image.open(DOCS / "compare.png") as picture:
        infos = {name: picture.info[name] for name in ("Rows", "Columns", "Size")}
    assert infos == {
        "Rows": ",".join(matchups.schemes),
        "Columns": ",".join(matchups.adversaries),
        "Size": f"{some.slots} slots, {some.trials} trials, seed {some.seed}",
    }
