"""Bytes that somebody else made are read or refused in our words: by every reader, whatever they are.

Source: docs/architecture.md, the trust boundary.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import example, given, seed, settings
from hypothesis import strategies as st

from evedrop.errors import UsageError
from evedrop.scenario.estimates import warnings_of
from evedrop.scenario.loading import parse
from evedrop.scenarios import shipped
from tests.examples import examples
from tests.fuzz.fuzzing import CORPUS, broken_by, campaign
from tests.fuzz.message_readers import MESSAGES
from tests.fuzz.mutation import REALS
from tests.fuzz.readers import FILES, READERS

CHEAP = {"change", "disturbances", "disturbances-gz", "trace", "trace-parquet", "brief", "control"}
CHEAP |= {"states", "state-message", "state-bytes"}
"""Readers of files that take less than a millisecond or two."""
QUICK = {**dict.fromkeys(READERS, 25), **dict.fromkeys(CHEAP, 50), "scenario": 15, "wire": 25, "summary": 8}
QUICK |= {name: 4 for name in FILES if name.startswith(("results-", "unfinished-", "view-"))}
QUICK |= {name: 3 for name in FILES if name.startswith("wire-")}
"""How many changed examples `make test` has each reader read."""
LONG_FILES = {"scenario": 10_000, "wire": 10_000, "change": 20_000, "summary": 5_000}
LONG_FILES |= {name: 2_000 for name in FILES if name.startswith(("results-", "unfinished-", "view-", "wire-"))}
LONG_FILES |= dict.fromkeys(CHEAP - {"change"}, 25000)
LONG_MESSAGES = (1_000_000 - sum(LONG_FILES.values())) // len(MESSAGES) + 1
LONG = {**dict.fromkeys(MESSAGES, LONG_MESSAGES), **LONG_FILES}
"""How many `make test-long` does, with another seed: a million in all."""
KEPT = sorted(path for path in CORPUS.glob("*/*") if path.is_file())


@pytest.mark.parametrize("path", KEPT, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_broke_a_reader_once_does_so_no_more(path: Path, tmp_path: Path) -> None:
    """Everything that ever did is kept."""
    failure = broken_by(READERS[path.parent.name], path.read_bytes(), tmp_path / "of-one")
    assert failure is None, failure.how


@pytest.mark.parametrize("name", READERS)
def test_examples_are_read(name: str, tmp_path: Path) -> None:
    """The bytes are valid before they are changed: so a reader gets bytes that it almost understands."""
    reader = READERS[name]
    for data in reader.examples()[:4]:
        (tmp_path / "of-one").mkdir(exist_ok=True)
        reader.read(data, tmp_path / "of-one")


@pytest.mark.parametrize("name", READERS)
def test_changed_bytes_are_read_or_refused(name: str) -> None:
    """Some of each reader, up to fifty, by what one costs; always the same ones."""
    failures = campaign(name, seed=0, count=QUICK[name])
    assert not failures, f"{failures[0].data!r:.2000}\n{failures[0].how}"


@pytest.mark.long
@pytest.mark.parametrize("name", READERS)
def test_a_million_changed_bytes_are_read_or_refused(name: str) -> None:
    """In a process of its own, whose memory has a limit; what breaks a reader is kept in the corpus."""
    at_once = 100 if name.startswith("view-") else LONG[name]  # Rerun keeps some threads of every recording
    for first in range(0, LONG[name], at_once):
        command = [sys.executable, "-m", "tests.fuzz.fuzzing", name, "--seed", "1"]
        command += ["--first", str(first), "--count", str(at_once)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
        assert done.returncode == 0, done.stdout + done.stderr


def test_a_million_is_a_million() -> None:
    """Of all readers together, as the documents say."""
    assert sum(LONG.values()) >= 1_000_000
    assert sum(LONG_FILES.values()) > 190_000


SCENARIOS = {name: tomllib.loads(path.read_text(encoding="utf-8")) for name, path in shipped().items()}
SCENARIOS |= {
    path.stem: tomllib.loads(path.read_text(encoding="utf-8"))
    for path in Path(__file__).with_name("examples").glob("_*.toml")
}


def paths_of(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The place of every entry, at any depth."""
    entries = value.items() if isinstance(value, dict) else enumerate(value[:5]) if isinstance(value, list) else ()
    return [place for name, inner in entries for place in ((*path, name), *paths_of(inner, (*path, name)))]


PLAIN = st.one_of(
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.sampled_from(REALS),
    st.floats(),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=20).filter(lambda text: ":" not in text),
)
VALUES = st.recursive(
    PLAIN,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("abAB._- \x1b", max_size=8), inner, max_size=3),
)
CHANGES = st.sampled_from(sorted(SCENARIOS)).flatmap(
    lambda name: st.tuples(
        st.just(name), st.lists(st.tuples(st.sampled_from(paths_of(SCENARIOS[name])), VALUES | st.none()), max_size=4)
    )
)
"""A scenario, and places in it with what is put there; None takes out what is there."""


def changed(tables: Any, path: tuple[Any, ...], value: Any) -> Any:
    """Tables with another value at a place, if that is still there."""
    if not path:
        return value
    name, rest = path[0], path[1:]
    if isinstance(tables, dict) and name in tables:
        inner = {key: entry for key, entry in tables.items() if key != name or rest or value is not None}
        return {**inner, name: changed(tables[name], rest, value)} if rest or value is not None else inner
    if isinstance(tables, list) and isinstance(name, int) and name < len(tables):
        items = [changed(tables[name], rest, value)] if rest or value is not None else []
        return [*tables[:name], *items, *tables[name + 1 :]]
    return tables


def checked(change: tuple[str, list[tuple[tuple[Any, ...], Any]]]) -> None:
    """Check a changed scenario; a mistake is one of ours."""
    name, changes = change
    tables = SCENARIOS[name]
    for path, value in changes:
        tables = changed(tables, path, value)
    message = ""
    try:
        warnings_of(parse(tomli_w.dumps(tables), name))
    except UsageError as error:
        message = str(error)
    assert "\x1b" not in message


@seed(1)
@settings(max_examples=examples(60), database=None)
@example(("vehicle", []))
@given(CHANGES)
def test_a_changed_scenario_is_checked_or_refused(change: tuple[str, list[tuple[tuple[Any, ...], Any]]]) -> None:
    """Entries of any other type and value, and entries that are not there."""
    checked(change)


@pytest.mark.long
@seed(2)
@settings(max_examples=5_000, database=None)
@given(CHANGES)
def test_thousands_of_changed_scenarios_are_checked_or_refused(
    change: tuple[str, list[tuple[tuple[Any, ...], Any]]],
) -> None:
    """As above, for longer."""
    checked(change)
