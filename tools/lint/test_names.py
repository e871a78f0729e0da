"""Names in the code: one public class for each name, one word for each thing."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = sorted(path for folder in ("emulator", "peers") for path in (ROOT / folder).rglob("*.py"))


CLASS = re.compile(r"^class ([^\W_]\w*)", re.MULTILINE)
"""A public class, or a line of a text that looks like one."""


@cache
def texts() -> dict[Path, str]:
    """Every module of the package; links to folders are followed once."""
    paths = [path for path in SOURCES if ROOT / "emulator" / "evedrop" / "peers" not in path.parents]
    assert len(paths) > 200
    return {path: path.read_text(encoding="utf-8") for path in paths}


def classes_of(text: str) -> list[ast.ClassDef]:
    """All classes of a module, those within others and within functions too."""
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ClassDef)]


def test_no_two_public_classes_have_one_name() -> None:
    """A reader who meets a class's name knows which class it is. Only modules that may be at fault are parsed."""
    places = defaultdict(list)
    for path, text in texts().items():
        for name in CLASS.findall(text):
            places[name].append(path)
    assert len(places) > 500
    twice = {name: where for name, where in places.items() if len(where) > 1}
    real = {
        name: [
            str(path)
            for path in where
            if any(class_.name == name and not class_.col_offset for class_ in classes_of(texts()[path]))
        ]
        for name, where in twice.items()
    }
    assert {name: where for name, where in real.items() if len(where) > 1} == {}


GERUNDS = {
    "Colluding": "a strategy of scenario files",
    "Finding": "a noun",
    "Greeting": "a noun",
    "Jamming": "an attack by the field's name",
    "Nothing": "no gerund",
    "Pending": "an adjective: the messages not handled yet",
    "Recording": "a noun",
    "Resting": "an example of a scheme",
    "Spoofing": "an attack by the field's name",
    "Steering": "a noun: of a run",
    "Wiring": "a noun",
    "Withholding": "a scheme of scenario files",
}
"""Last word of a class's name → why it is no gerund, or may be one."""


def test_no_class_is_named_by_a_gerund() -> None:
    """A class is a thing: a loop, a rule, a reporter."""
    tests = {path: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py")}
    names = re.compile(r"^ *class _?((?:[A-Z]\w*?)??)([A-Z][a-z]*ing)\b", re.MULTILINE)
    words = {word for text in (texts() | tests).values() for _, word in names.findall(text)}
    assert len(words & set(GERUNDS)) > 5
    assert words - set(GERUNDS) == set()


def test_classes_say_that_they_are_final_by_the_decorator() -> None:
    """`@final` is checked by mypy; a sentence in a docstring is not. Only modules with such words are parsed."""
    pattern = re.compile(r"(?:^|[.;] )Final(?:\.|;)")
    tests = {path: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py")}
    for path, text in (texts() | tests).items():
        for node in classes_of(text) if re.search("Final[.;]", text) else []:
            assert not pattern.search(ast.get_docstring(node) or ""), f"{path}: {node.name}"


def modules_of(folder: str) -> set[str]:
    """The modules and packages of a package, and the package itself, by their last names."""
    path = ROOT / "emulator" / "evedrop" / folder
    return {path.name, *(entry.stem for entry in path.iterdir() if entry.suffix == ".py" or entry.is_dir())}


def test_a_test_file_is_named_after_a_module() -> None:
    """The tests of a module P/M.py are in tests/P/test_M.py or test_M_ASPECT.py, and those of a package P in test_P_ASPECT.py.

    In tests/live and tests/cli themselves, a file is named after what somebody does.
    """
    packages = [path.parent.name for path in (ROOT / "emulator" / "evedrop").glob("*/__init__.py")]
    paths = [path for package in packages for path in (ROOT / "tests" / package).rglob("test_*.py")]
    assert len(paths) > 250
    wrong = {
        path.relative_to(ROOT).as_posix()
        for path in paths
        if (folder := path.parent.relative_to(ROOT / "tests").as_posix()) not in {"live", "cli"}
        and not any(f"{path.stem}_".startswith(f"test_{module}_") for module in modules_of(folder))
    }
    assert wrong == set()


GLOSSARY = ROOT / "docs" / "glossary.md"
FORMER = {
    "believed": "reported",
    "caught a state": "regained synchronisation",
    "Crossing": "WireFate",
    "deviation": "standard_deviation",
    "expected_covariance": "theoretical_covariance",
    "expected covariance": "theoretical covariance",
    "expected_trace": "theoretical_trace",
    "expected_traces": "theoretical_traces",
    "ExpectedCovariance": "TheoreticalCovariance",
    "ExpectedTrace": "TheoreticalTrace",
    "figure": "metric",
    "figures": "metrics",
    "filter_noise_read": "replace_filter_noise",
    "floor plan": "drawing of the packages",
    "floor_plan": "package_drawing",
    "fooled": "overconfident",
    "funnel": "callback subscription",
    "heeding": "heed rule",
    "in clear": "unencrypted",
    "in_clear": "unencrypted",
    "in step": "synchronised",
    "in_step": "synchronised",
    "in sync": "synchronised",
    "in_sync": "synchronised",
    "in track": "synchronised",
    "in_track": "synchronised",
    "is_fooled": "is_overconfident",
    "is_regular": "is_nonsingular",
    "launcher_news": "launcher_pipe, launcher_events",
    "law": "distribution",
    "laws": "distributions",
    "legitimate receiver": "legitimate estimator",
    "lifeline": "watchdog",
    "look_seconds": "poll_seconds",
    "lost track": "lost synchronisation",
    "observer": "recorder",
    "outlet": "send queue",
    "rare_share": "rare_fraction",
    "read_news": "read_event",
    "ReceiverTotals": "ReceiverTally",
    "recordings_located": "locate_recordings",
    "regular matrix": "nonsingular matrix",
    "rooms": "packages",
    "set_news_apart": "keep_events_apart",
    "share_of": "fraction_of",
    "stand_in": "remote_class, absence_reporter",
    "StandIn": "RemoteClass, AbsenceReporter",
    "tables_located": "locate_tables",
    "tables_read": "read_tables",
    "the share": "the fraction",
    "TrialTotals": "TrialTally",
    "user_error": "legitimate_error",
    "user_theory": "legitimate_theory",
    "user's error": "legitimate error",
    "user's link": "legitimate link",
    "whereabouts": "process status",
}
"""Former word → the word of the glossary, or the name, in its place. Parts of names count: `open_rooms`, `openRooms`."""
MEANT_OTHERWISE = {
    "the share": (
        "emulator/evedrop/show/view/recording.py",
        "emulator/evedrop/show/view/panels/panel.py",
    ),
    "deviation": ("docs/glossary.md",),
    "figure": (
        "benchmarks/scale.py",
        "docs/errata.md",
        "docs/glossary.md",
        "docs/microgrid.md",
        "docs/papers*",
        "docs/python.md",
        "emulator/evedrop/cli/api/results.py",
        "emulator/evedrop/cli/commands/__init__.py",
        "emulator/evedrop/cli/commands/paper.py",
        "emulator/evedrop/show/report/*_sections.py",
        "emulator/evedrop/show/report/chart.py",
        "emulator/evedrop/show/view/*",
        "emulator/evedrop/studies/applications/microgrid/sweep_picture.py",
        "emulator/evedrop/studies/papers/*",
        "tests/cli/api/test_api_plots.py",
        "tests/cli/test_design_command.py",
        "tests/cli/test_output.py",
        "tests/cli/test_results_are_data.py",
        "tests/commands.py",
        "tests/notebooks/*",
        "tests/show/report/test_report.py",
        "tests/show/view/*",
        "tests/studies/papers/*",
        "tools/site/gallery_pictures.py",
    ),
}
"""Former word → the files in which it, or its plural, means something else: here a picture."""
OTHER_TERMS = (
    r"(?:uses|run)\W in step",
    "deviation from",
    "evedrop figures",
    r"for i in clear\]",
    "paper's figures",
    "permanent deviation",
    "power[- ]law",
    "runs/figures",
    r"seconds in step\b",
    "standard[ _]deviation",
)
"""Patterns of terms that contain a former word and stay, anywhere."""
PROSE = [path for path in ROOT.glob("*.md") if path.name != "CHANGELOG.md"]


def former_words(text: str) -> set[str]:
    """Those of the former words that a text has, as words or as parts of names."""
    text = re.sub("|".join(OTHER_TERMS), "", text)
    low = text.lower()
    return {word for word in FORMER if word.lower() in low and re.search(pattern_of(word), text)}


def meant_otherwise(path: Path) -> set[str]:
    """The former words that mean something else in a file."""
    name = path.relative_to(ROOT).as_posix()
    words = {word for word, files in MEANT_OTHERWISE.items() if any(fnmatchcase(name, pattern) for pattern in files)}
    return words | {f"{word}s" for word in words}


def pattern_of(word: str) -> str:
    """Matches the word with a small or a capital letter, where no other letter continues it."""
    first = word[0]
    if first.isupper():
        return rf"(?<![A-Z]){word}(?![a-z])"
    return rf"(?:(?<![A-Za-z]){first}|{first.upper()}){word[1:]}(?![a-z])|(?<![A-Z]){word.upper()}(?![A-Z])"


@pytest.mark.parametrize(
    ("text", "is_former"),
    [
        ("two rooms", True),
        ("def open_rooms():", True),
        ("OpenRooms()", True),
        ("ROOMS = 3", True),
        ("mushrooms", False),
        ("a room", False),
        ("roomster", False),
    ],
)
def test_parts_of_names_are_words(text: str, is_former: bool) -> None:
    """And parts of words are not."""
    assert former_words(text) == ({"rooms"} if is_former else set())


def test_former_words_are_gone() -> None:
    """The glossary has one word for each thing; the others are in no code, page, test or tool, except as the changelog's."""
    folders = ("emulator/evedrop", "peers", "tests", "tools", "benchmarks", "docs", "scenarios")
    paths = [
        path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in {".py", ".md", ".toml"}
    ]
    assert len(paths) > 800
    own = Path(__file__)
    former = {
        str(path.relative_to(ROOT)): words
        for path in {*PROSE, *paths} - {own}
        if (words := (former_words(path.read_text(encoding="utf-8")) | former_words(path.stem)) - meant_otherwise(path))
    }
    assert former == {}, "docs/glossary.md has the words to use"


def test_the_glossary_says_each_word_once() -> None:
    """In the order of the alphabet, so that a word is found."""
    rows = re.findall(r"^\| ([^|]+?) \|", GLOSSARY.read_text(encoding="utf-8"), re.MULTILINE)[1:]
    words = [word.lower() for word in rows if not word.startswith("-")]
    assert len(words) > 50
    assert words == sorted(set(words))
