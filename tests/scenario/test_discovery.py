"""Which files are taken for scenarios, and which are left alone."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from evedrop.errors import UsageError
from evedrop.scenario.discovery import is_scenario, scenarios_in
from evedrop.scenarios import shipped
from evedrop.studies.scenario_tests import scenarios_of

SCENARIO = shipped()["eavesdroppers"].read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "text", "taken"),
    [
        ("mine.toml", SCENARIO, True),
        ("mine.toml", "\ufeff" + SCENARIO, True),
        ("mine.toml", "process.A = 1\nencoding = {}\n", True),
        ("mine.toml", "[process]\n[encoding]\nslots = = 3\n", True),
        ("mine.toml", "process and encoding = = 3\n", False),
        ("mine.toml", "process = 3\nencoding = 3\n", False),
        ("mine.toml", "[process]\n", False),
        ("pyproject.toml", '[project]\ndescription = "encoding of a process"\n', False),
        ("_new.toml", SCENARIO, False),
        ("mine.txt", SCENARIO, False),
        ("scenario.toml", SCENARIO, True),
    ],
)
def test_what_looks_like_a_scenario_is_taken(tmp_path: Path, name: str, text: str, taken: bool) -> None:
    """TOML with both tables, or with both headings and a slip of the pen; by name nothing that begins with _."""
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert is_scenario(path) is taken


def test_what_cannot_be_read_is_no_scenario(tmp_path: Path) -> None:
    """Bytes that are not text, a folder of that name, nothing at all."""
    (tmp_path / "a.toml").write_bytes(b"\xff process encoding")
    (tmp_path / "b.toml").mkdir()
    assert not any(is_scenario(tmp_path / f"{name}.toml") for name in "abc")


@pytest.mark.parametrize(
    ("neighbour", "copy"),
    [
        *(
            (name, "scenario.toml")
            for name in ("summary.json", "slots.parquet", "unfinished", "shards", "finished_tasks")
        ),
        ("sweep.json", "scenario.toml"),
        ("compare.json", "scenarios/innovation.toml"),
    ],
)
def test_the_copy_in_a_results_folder_is_none(tmp_path: Path, neighbour: str, copy: str) -> None:
    """Of a run that ended, of one that goes on, of a sweep, and of each scheme of a comparison."""
    path = tmp_path / copy
    path.parent.mkdir(exist_ok=True)
    path.write_text(SCENARIO, encoding="utf-8")
    assert is_scenario(path)
    (tmp_path / neighbour).touch()
    assert not is_scenario(path)


def test_folders_are_searched_in_order_and_each_scenario_is_taken_once(tmp_path: Path) -> None:
    """Hidden folders are left out; a file that is named twice, or is in a folder that is named too, is one test."""
    for place in ("b.toml", "a/z.toml", "a/c.toml", ".hidden/h.toml", "a/_not.toml"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_text(SCENARIO, encoding="utf-8")
    places = [str(tmp_path / place) for place in ("b.toml", "a/c.toml", "a/z.toml")]
    assert [str(path) for path in scenarios_in(tmp_path)] == places
    z, c, b = (places[i] for i in (2, 1, 0))
    assert scenarios_of([z, "vehicle", str(tmp_path), z, str(shipped()["vehicle"])]) == [z, "vehicle", b, c]


def test_a_folder_without_a_scenario_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is named in a warning, unless there is nothing to test: then in an error."""
    bare = str(tmp_path)
    assert scenarios_of([bare, "vehicle"]) == ["vehicle"]
    assert f"warning: no scenario in {bare}; a scenario is a TOML file" in capsys.readouterr().err
    with pytest.raises(UsageError, match=re.escape(f"no scenario in {bare}; ")):
        scenarios_of([bare])


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_scenario_in_another_encoding_is_reported(tmp_path: Path, encoding: str) -> None:
    """A test that is left out would pass."""
    path = tmp_path / "mine.toml"
    path.write_bytes("# für uns\n[process]\nA = 1\n[encoding]\nscheme = 'plain'\n".encode(encoding))
    assert is_scenario(path)
    path.write_bytes("# für uns\n[project]\nname = 'encoding of a process'\n".encode(encoding))
    assert not is_scenario(path)


def test_a_link_to_itself_is_reported_when_it_is_read(tmp_path: Path) -> None:
    """It is a scenario with a mistake, because it was named."""
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    assert scenarios_of([str(tmp_path / "loop.toml")])
