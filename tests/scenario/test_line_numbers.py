"""The lines of entries in a file, for messages."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import MOST_MISTAKES, ScenarioError
from evedrop.scenario.line_numbers import excerpt, line_of, lines_of_entries
from evedrop.scenario.loading import load, parse
from evedrop.scenarios import shipped
from tests.builders import BASE

TEXT = '''# a comment with [brackets]
a = 1
event = [{ x = 1 },
         { y = 2 }]
[[link]]
from = "r"        # = here
[[link]]
keys = """
[no.table]
"""
[link.loss]
good.bad = 0.5
[x."a b".c]
d = [
  [1.0,
   2.0],
]
'''


def test_every_entry_has_its_line() -> None:
    """Also after values of several lines, in lists of tables, and with dotted and quoted keys."""
    assert lines_of_entries(TEXT) == {
        "a": 2,
        "event": 3,
        "link.0": 5,
        "link.0.from": 6,
        "link.1": 7,
        "link.1.keys": 8,
        "link.1.loss": 11,
        "link.1.loss.good.bad": 12,
        "x.a b.c": 13,
        "x.a b.c.d": 14,
    }


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a = [\n" + "1,\n" * 60 + "] # ]\nb = 1\n[t]\nc = 1", {"a": 1, "b": 63, "t": 64, "t.c": 65}),
        ("[[a]]\n[[a.b]]\n[[a]]\n[[a.b]]\nx=1\n", {"a.0": 1, "a.0.b.0": 2, "a.1": 3, "a.1.b.0": 4, "a.1.b.0.x": 5}),
        ('"a.b" = { x = 1 }\nc.d = { e = 1 }\n', {"a.b": 1, "c.d": 2}),
        ("# a \u2028 b\na = 1\n", {"a": 2}),
        ("a = 1\r\n\r\n[b] # [c]\r\nc = 2", {"a": 1, "b": 3, "b.c": 4}),
        ("""a = '''[\n = ''''\nb = \"""\n\\\"""[ "" \"""\"\nc = "\\"["\nd = '#'""", {"a": 1, "b": 3, "c": 5, "d": 6}),
        ('[ a . "]=" ] # x\nb = 2020-01-01 # = \n', {"a.]=": 1, "a.]=.b": 2}),
    ],
)
def test_brackets_and_signs_count_only_outside_of_strings_and_comments(text: str, expected: dict[str, int]) -> None:
    """Lines end where editors end them, and each list of tables counts its own tables."""
    tomllib.loads(text)
    assert lines_of_entries(text) == expected


def test_a_long_value_takes_time_that_grows_with_its_length() -> None:
    """A list whose every line may be its last one; a reader that asked at each of them would need hours."""
    text = "a = [\n[1.0]\n" + ", [1.0]\n" * 100_000 + "]\nb = 1\n"
    assert lines_of_entries(text) == {"a": 1, "b": 100_004}


def test_what_is_inside_a_value_has_the_line_of_the_value() -> None:
    """An entry that is not in the file has no line."""
    lines = lines_of_entries(TEXT)
    assert line_of("event.1.y", lines) == 3
    assert line_of("link.1.loss.model", lines) == 11
    assert line_of("nowhere.at.all", lines) is None


def paths(value: Any, path: str) -> set[str]:
    """The paths of all entries that are not tables."""
    if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        return {place for i, item in enumerate(value) for place in paths(item, f"{path}.{i}")}
    if not isinstance(value, dict):
        return {path}
    return {place for name, inner in value.items() for place in paths(inner, f"{path}.{name}" if path else name)}


@pytest.mark.parametrize("name", shipped())
def test_every_entry_of_a_built_in_scenario_is_found(name: str) -> None:
    """Itself, or the value or table that holds it."""
    text = shipped()[name].read_text(encoding="utf-8")
    lines = lines_of_entries(text)
    for path in paths(tomllib.loads(text), ""):
        line = line_of(path, lines)
        assert line is not None
        assert path not in lines or path.split(".")[-1] in text.splitlines()[line - 1]


def test_a_mistake_names_its_line_and_a_changed_entry_none(tmp_path: Path) -> None:
    """The line is that of the file; `--set` has no line."""
    path = tmp_path / "mine.toml"
    path.write_text(shipped()["numerical"].read_text(encoding="utf-8").replace('"smart"', '"smrt"'), encoding="utf-8")
    with pytest.raises(ScenarioError) as raised:
        load(path, {"slots": 0})
    line = path.read_text(encoding="utf-8").splitlines().index('strategy = "smrt"') + 1
    told = {mistake.partition(":")[0]: mistake for mistake in raised.value.mistakes}
    assert told["eavesdroppers.smart.strategy"].endswith(f" (line {line})")
    assert "(line" not in told["slots"]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[process]\nA = [[1]]\nA = [\n[2]]\n", "process.A in line 3 is given already in line 2"),
        ("[a]\nb = 1\n[c]\n[a]\n", "a in line 4 is given already in line 1"),
        ("a.b = 1\na = 2\n", "a in line 2 is given already in line 1, as a.b"),
        ("[t]\na = 1\na.b = 2\n", "t.a.b in line 3 is given already in line 2, as t.a"),
        ("[a]\nb = { c = 1 }\n[a.b]\nc = 2\n", "a.b in line 3 is given already in line 2"),
        ("[[a]]\nb = 1\n[a]\nb = 2\n", "a.0 in line 3 is given already in line 1"),
        ("a = { b = 1, b = 2 }\n", "'b'"),
    ],
)
def test_an_entry_that_is_given_twice_is_named(text: str, told: str) -> None:
    """With the lines of both, so that one of them can be left out."""
    with pytest.raises(ScenarioError) as raised:
        parse(text, "mine.toml")
    (mistake,) = raised.value.mistakes
    assert told in mistake


def test_other_mistakes_of_toml_are_told_in_its_readers_words() -> None:
    """They say the place."""
    with pytest.raises(ScenarioError, match=r"not TOML: Expected '=' after a key.*line 2"):
        parse("a = 1\na b = 2\n", "mine.toml")


def test_no_pattern_repeats_a_group_possessively() -> None:
    """`(…)*+` is wrong in the `re` of Python 3.11.2, which Debian 12 has, and right in later ones."""
    root = Path(__file__).parents[2]
    sources = [path for folder in ("emulator", "peers", "tools") for path in (root / folder).rglob("*.py")]
    assert len(sources) > 200
    assert [path for path in sources if re.search(r"\)(?:[*+?]|\{[\d,]+\})\+", path.read_text("utf-8"))] == []


@pytest.mark.parametrize(
    ("row", "name", "marked"),
    [
        ('scheme = "innovatoin"   # a slip', "scheme", '"innovatoin"'),
        ("link = { quality = 1.5, loss = 3 }", "quality", "1.5"),
        ("link = { quality = 1.5, loss = 3 }", "loss", "3"),
        ("  A = [[1.0, 2.0], [3.0]]", "A", "[[1.0, 2.0], [3.0]]"),
        ("[process]", "initial_covariance", "[process]"),
        ('"a b".c = 1 # note', "d", '"a b".c'),
        ("tabs\t= 1", "tabs", "1"),
        ('link = { loss = { model = "trace" }, delay = { model = 3 } }', "legitimate.link.delay.model", "3"),
        ("link = { loss = { quality = 3 }, quality = 1 }", "legitimate.link.loss.quality", "3"),
        ("links = [{ loss = { p = 2 } }, { quality = 3 }]", "eavesdroppers.b.links.1.quality", "3"),
        ("links = [{ quality = 2 }, { quality = 3 }]", "eavesdroppers.b.links.1.quality", "3"),
        ("links = [{ quality = 2 }, { quality = 3 }]", "eavesdroppers.b.links.0.quality", "2"),
        ("quality = 3", "eavesdroppers.links.0.quality", "3"),
    ],
)
def test_an_excerpt_marks_the_value_of_an_entry(row: str, name: str, marked: str) -> None:
    """In its table, or the first key, where the entry has no value of its own in that line."""
    shown, carets = excerpt(row, 12, name).split("\n")
    assert shown.startswith("   12 | ")
    assert shown[carets.index("^") : carets.rindex("^") + 1] == marked


def test_an_excerpt_of_a_long_line_fits_a_terminal() -> None:
    """What is too far right to be shown has none."""
    long = f'title = "{"x" * 300}"'
    assert max(map(len, excerpt(long, 3, "title").split("\n"))) <= 80
    assert excerpt(f"{long}, b = 1", 3, "b") == ""


def test_mistakes_are_illustrated_by_the_lines_of_the_file(tmp_path: Path) -> None:
    """Each below its sentence; the message itself, which programs read, has none."""
    path = tmp_path / "mine.toml"
    text = shipped()["numerical"].read_text(encoding="utf-8").replace("slots = 80", "slots = -80")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError) as caught:
        load(path)
    first, mistake, row, carets = caught.value.illustrated.split("\n")
    assert [first, mistake] == str(caught.value).split("\n")
    assert row.endswith(" | slots = -80")
    assert row[carets.index("^") :].strip() == "-80"
    with pytest.raises(ScenarioError) as caught:
        parse("slots = 10\ntrials == 3\n", "mine.toml")
    assert caught.value.illustrated.split("\n")[-2:] == ["   2 | trials == 3", "     |         ^"]


def test_an_excerpt_marks_the_key_of_an_unknown_entry() -> None:
    """The value of an entry that is not known is not what is wrong."""
    shown, carets = excerpt("legitimate = {quality = 1.4}", 4, "quality", key=True).split("\n")
    assert shown[carets.index("^") : carets.rindex("^") + 1] == "quality"


def test_an_excerpt_has_no_end_of_line() -> None:
    """Of a file that was written on Windows."""
    assert excerpt("slots = 0\r", 3, "slots") == excerpt("slots = 0", 3, "slots")


def test_a_message_has_as_many_mistakes_as_can_be_read() -> None:
    """A hundred, with the lines of the file, and how many more there are."""
    events = [f'[[event]]\nat = 1\ncut = "nobody{k}"\n' for k in range(150)]
    with pytest.raises(ScenarioError) as caught:
        parse(BASE + "\n".join(events), "many.toml")
    first, *lines = str(caught.value).split("\n")
    assert first == "many.toml: 150 mistakes, nothing was started"
    assert [line.strip() for line in lines] == caught.value.mistakes
    assert len(lines) == MOST_MISTAKES + 1
    assert lines[-1] == "  and 50 more"
    illustrated = caught.value.illustrated.split("\n")
    assert len(illustrated) == 1 + 3 * MOST_MISTAKES + 1
    assert illustrated[-1] == "  and 50 more"


def test_a_mistake_is_a_line_whatever_a_name_has() -> None:
    """The excerpt of the file follows it."""
    with pytest.raises(ScenarioError) as caught:
        parse(BASE + '\n[eavesdroppers."a\\nb"]\nstrategy = "naive"\n', "lines.toml")
    first, *lines = str(caught.value).split("\n")
    assert first == f"lines.toml: {len(lines)} mistake{'s' * (len(lines) > 1)}, nothing was started"
    assert any(r"a\nb" in line for line in lines)
    assert "     |" in caught.value.illustrated
