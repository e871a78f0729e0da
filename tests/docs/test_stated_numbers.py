"""Names, numbers and ranges that pages state are those of the code."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from evedrop.errors import MOST_MISTAKES, EvedropError
from evedrop.model.checks import as_toml
from evedrop.model.schemes import SCHEMES
from evedrop.names import RESERVED
from evedrop.scenario import loading, table
from evedrop.scenario.expect import Quantile
from evedrop.scenario.recordings import disturbance_file, message_recording
from tests.privileged import CannotRun, skip

ROOT = Path(__file__).parents[2]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def page(name: str) -> str:
    """A page with each run of white space as a single space."""
    return re.sub(r"\s+", " ", (ROOT / "docs" / name).read_text(encoding="utf-8"))


def git(*words: str) -> str:
    """What git says of this repository; empty if it refuses."""
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def test_the_reserved_names_are_all_there() -> None:
    """Those that an eavesdropper cannot have."""
    (listing,) = re.findall(r"((?:`[a-z]+`(?:, | and )?)+) are reserved\.", page("scenario.md"))
    assert sorted(re.findall(r"`([a-z]+)`", listing)) == sorted(RESERVED)


def test_how_many_mistakes_are_reported() -> None:
    """In all, of one kind in a file, and of values that no entry can have."""
    text = page("scenario.md")
    told = table._MOST_TOLD
    assert f"A report has up to {MOST_MISTAKES} lines, with up to {told} for values that no entry can have" in text
    most = disturbance_file.MOST_REPORTED
    assert f"the first {most} lines with each kind of mistake are reported" in text
    words = {5: "five"}
    assert f"its mistakes, the first {words[most]} lines of each kind" in page("microgrid.md")


@pytest.mark.parametrize("name", [path.relative_to(ROOT).as_posix() for path in PAGES])
def test_no_page_promises_all_mistakes(name: str) -> None:
    """A report is cut off, and tables are compared only once each is right by itself."""
    text = re.sub(r"\s+", " ", (ROOT / name).read_text(encoding="utf-8"))
    assert not re.findall(r"(?i)\b(?:all|every) (?:its |of its )?mistakes?\b", text)


@pytest.mark.parametrize("name", [path.relative_to(ROOT).as_posix() for path in PAGES if path.name != "CHANGELOG.md"])
def test_what_holds_on_every_machine_is_scoped(name: str) -> None:
    """On those where the reference digests come out; nobody has tried all."""
    text = re.sub(r"\s+", " ", (ROOT / name).read_text(encoding="utf-8"))
    assert not re.findall(r"\b(?:every|any|all) machines?\b(?! on which `evedrop selftest` succeeds)", text)


def test_the_limits_of_a_file() -> None:
    """Of its bytes, its values and its depth."""
    assert loading.MOST_BYTES == 256 * 2**20
    assert loading.MOST_VALUES == 1_000_000
    assert (
        "a file has at most 256 MiB, and a million values in lists; nesting is at most "
        f"{table._DEEPEST} deep; whole numbers have at most {table._LARGEST_BITS} bits"
    ) in page("scenario.md")


def test_a_quantile_is_strictly_between_0_and_1() -> None:
    """As its row says."""
    assert "| `quantile` | between 0 and 1, both excluded: the quantile" in page("scenario.md")
    for edge in (0.0, 1.0):
        with pytest.raises(ValidationError):
            TypeAdapter(Quantile).validate_python(edge)


def test_the_table_of_exit_statuses_has_all() -> None:
    """Those of errors, and of a command that completed."""
    kinds, statuses = [EvedropError], {0, 1}
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        statuses.add(kind.exit_status)
    text = (ROOT / "docs" / "exit-statuses.md").read_text(encoding="utf-8")
    assert [int(number) for number in re.findall(r"^\| (\d+) \|", text, re.MULTILINE)] == sorted(statuses)


def test_a_leap_of_a_counter() -> None:
    """The shortest leap that may mean that the counter was set."""
    assert f"**A leap ahead** of more than {message_recording._JUMP} numbers" in page("links.md")


def test_the_parameters_of_compared_schemes() -> None:
    """The table of docs/compare.md has all schemes with parameters, and their values."""

    def rows() -> Iterator[str]:
        for name in SCHEMES:
            entries = [f"`{entry} = {as_toml(value)}`" for entry, value in SCHEMES[name].parameters.items()]
            if entries:
                yield f"| `{name}` | {', '.join(entries)} |"

    written = "\n".join(["| scheme | entries |", "|---|---|", *rows()])
    assert written in (ROOT / "docs" / "compare.md").read_text(encoding="utf-8")


def test_every_commit_that_a_page_names_is_here() -> None:
    """So that what was measured at it can be measured again."""
    named = {
        (path.name, commit)
        for path in PAGES
        for commit in re.findall(r"\bcommit ([0-9a-f]{7,40})\b(?! of )", path.read_text(encoding="utf-8"))
    }
    assert named
    if shutil.which("git") is None or git("rev-parse", "--is-shallow-repository") != "false":
        skip(CannotRun("the commits of this repository are not here"))
    assert {(name, commit) for name, commit in named if git("cat-file", "-t", commit) != "commit"} == set()
