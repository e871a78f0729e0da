"""How pages and messages say to install something: from the checkout, because no package index has the name."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "docs/**/*.ipynb", "scenarios/*.toml", "emulator/**/*.py", "peers/*.py")
    for path in ROOT.glob(pattern)
)
EXTRA = re.compile(r"""pip install[^\n]*?['"](?P<from>[\w.-]+)\[(?P<extra>\w+)\]""")


def test_every_extra_is_installed_from_the_checkout_and_exists() -> None:
    """`pip install '.[EXTRA]'` everywhere; `evedrop[EXTRA]` would ask an index for whoever registered the name there."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        extras = set(tomllib.load(file)["project"]["optional-dependencies"])
    installs = [
        (path.name, *match.group("from", "extra"))
        for path in FILES
        for match in EXTRA.finditer(path.read_text("utf-8"))
    ]
    assert len(installs) > 10
    assert [install for install in installs if install[1] != "." or install[2] not in extras] == []


@pytest.mark.parametrize(
    ("text", "groups"),
    [("`pip install 'evedrop[mcap]'`", ("evedrop", "mcap")), ("pip install '.[video]' in the", (".", "video"))],
)
def test_both_forms_are_recognised(text: str, groups: tuple[str, str]) -> None:
    """So that the test above tests something."""
    match = EXTRA.search(text)
    assert match is not None
    assert match.group("from", "extra") == groups
