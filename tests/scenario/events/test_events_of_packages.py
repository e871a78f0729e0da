"""Kinds of event: of an installed package, and those here, which the registry lists in one line each."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from evedrop.model.slot.link import NEVER
from evedrop.scenario.events import EVENTS
from evedrop.scenario.events.event import Act, EventKind, Jamming
from evedrop.scenario.timeline import Timeline
from tests.builders import digests_of
from tests.conftest import Evedrop
from tests.packages import install

DOCS = Path(__file__).parents[3] / "docs"
SCENARIO = """
title = "A link that is dimmed"
slots = 60
process = { A = [[1.0]], Q = [[0.01]], initial_covariance = [[0.01]] }
encoding = { scheme = "innovation", state_probability = 0.5 }
legitimate = { link = { quality = 0.8 } }
eavesdroppers = { smart = { strategy = "smart", link = { quality = 0.9 } } }
event = [{ at = 20, dim = "smart" }, { from = 30, to = 40, cut = "smart" }]
"""


def with_package(evedrop: Evedrop, code: str) -> dict[str, str]:
    """An environment in which a package with this code says that it has the event `dim`."""
    install(evedrop.folder, {"dimming.py": code}, {"evedrop.events": {"dim": "dimming:Dim"}})
    return {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}


@pytest.mark.thorough
def test_an_event_of_a_package_needs_nothing_here(evedrop: Evedrop) -> None:
    """The one of the docs, a file and a line of metadata: in memory and live, with equal digests, and in both summaries."""
    page = (DOCS / "your-own" / "event.md").read_text(encoding="utf-8")
    environment = with_package(evedrop, page.partition("# dimming.py\n")[2].partition("```")[0])
    (evedrop.folder / "dim.toml").write_text(SCENARIO)
    (evedrop.folder / "bright.toml").write_text(SCENARIO.replace('{ at = 20, dim = "smart" }, ', ""))
    for arguments in (
        ["montecarlo", "dim.toml", "--trials", "1", "--out", "memory"],
        ["montecarlo", "bright.toml", "--trials", "1", "--out", "bright"],
        ["run", "dim.toml", "--view", "off", "--out", "live"],
    ):
        done = evedrop.process(*arguments, env=environment)
        assert done.status == 0, done.err
    memory, live, bright = (digests_of(evedrop.folder / name) for name in ("memory", "live", "bright"))
    assert memory == live
    assert memory["legitimate"] == bright["legitimate"]
    assert memory["smart"] != bright["smart"]
    for name in ("memory", "live"):
        tables = tomllib.loads((evedrop.folder / name / "scenario.toml").read_text(encoding="utf-8"))
        assert {"at": 20, "dim": "smart"} in tables["event"]
        text = (evedrop.folder / name / "summary.json").read_text(encoding="utf-8")
        assert '"dim smart"' in text
        assert '"smart is bright again"' in text
    assert "dim" not in EVENTS.names


@pytest.mark.parametrize(
    ("event", "line"),
    [
        ('{ at = 20, dim = "nobody" }', 'event.0.dim: names "nobody"; expected legitimate or smart'),
        ('{ at = 20, dim = "smart", note = "x" }', "event.0.event: has note or dim at once; expected one of set"),
        ('{ from = 20, to = 30, dim = "smart" }', "event.0.from: is given, but dim happens in one slot; expected at"),
        ("{ at = 20, dim = 3 }", "event.0.dim: is 3; expected a string"),
        ('{ at = 20, din = "smart" }', "event.0.din: is not an entry of this table; did you mean dim?"),
    ],
)
def test_mistakes_in_an_event_of_a_package_are_named(
    evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch, event: str, line: str
) -> None:
    """In the words for the events here."""
    page = (DOCS / "your-own" / "event.md").read_text(encoding="utf-8")
    with_package(evedrop, page.partition("# dimming.py\n")[2].partition("```")[0])
    monkeypatch.syspath_prepend(str(evedrop.folder))
    (evedrop.folder / "dim.toml").write_text(SCENARIO.replace('{ at = 20, dim = "smart" }', event))
    done = evedrop("check", "dim.toml")
    assert done.status == 2
    assert line in done.err


BEGIN = '        yield self.begin(f"dim {self.dim}", LinkSettings({"quality": 0.1}))\n'
FAILING = {
    "acts raise": (
        BEGIN,
        "        raise ValueError('no')\n" + BEGIN,
        "acts() raised ValueError: no, dimming.py line 14",
    ),
    "no acts": (BEGIN, "        return None\n", "acts() gave none; expected an Act, or several"),
    "other acts": (BEGIN, "        yield 3\n", "acts() gave 3; expected an Act with an effect"),
    "no receiver": ('    names_in = "dim"\n', "", "it names no receiver; expected one, or several"),
    "before the run": ("self.first + 1", "-5", "acts() gave an act at -5; expected a slot, 0 to "),
    "no slot": ("self.first + 1", "self.first + 0.5", "acts() gave an act at 20.5; expected a slot"),
    "beyond the run": (
        "self.first + 1",
        "self.first + 41",
        "event.0.dim: has an act at slot 61; expected at most 60, the end of the run",
    ),
    "no receivers": (
        "self.kind, self.names",
        "self.kind, ('nobody',)",
        'event.0.dim: names "nobody"; expected legitimate or',
    ),
    "a text of names": (
        "self.kind, self.names",
        "self.kind, 'smart'",
        "acts() gave an act with the names 'smart'; expected a tuple of receivers",
    ),
    "no entries": (
        "LinkSettings(None)",
        "LinkSettings(5)",
        "acts() gave an act that changes 5; expected a dict of entries",
    ),
    "mistakes raise": (
        "    def acts",
        "    def mistakes(self):\n        raise ValueError('no')\n\n    def acts",
        "cannot be checked: Dim.mistakes raised ValueError: no, dimming.py line 14",
    ),
    "compared raises": (
        "    def acts",
        "    def compared(self, surroundings):\n        raise ValueError('no')\n\n    def acts",
        "event.0.dim: cannot be checked: Dim raised ValueError: no, dimming.py line 14",
    ),
    "in_turn raises": (
        "    def acts",
        "    @classmethod\n    def in_turn(cls, events):\n        raise ValueError('no')\n\n    def acts",
        "event.0.dim: cannot be checked: Dim raised ValueError: no, dimming.py line 15",
    ),
}
"""What fails → the line of the module, its replacement, and the expected message."""


@pytest.mark.parametrize("case", FAILING)
def test_an_event_that_fails_is_a_mistake_of_who_uses_it(evedrop: Evedrop, case: str) -> None:
    """Before anything is started, with the error and its line."""
    line, instead, message = FAILING[case]
    page = (DOCS / "your-own" / "event.md").read_text(encoding="utf-8")
    code = page.partition("# dimming.py\n")[2].partition("```")[0]
    assert line in code
    environment = with_package(evedrop, code.replace(line, instead))
    (evedrop.folder / "dim.toml").write_text(SCENARIO)
    done = evedrop.process("check", "dim.toml", env=environment)
    assert done.status == 2
    assert message in done.err
    assert "Traceback" not in done.err


def test_an_attack_that_only_ends_is_none() -> None:
    """An own class may end what nothing began."""
    end = Act(5, "dim", (), "over", Jamming(on=False))
    begin = Act(7, "dim", (), "again", Jamming(on=True))
    assert Timeline((end, begin), {}, {}).jams == [(7, NEVER)]


def test_an_event_that_names_nobody_is_a_mistake(evedrop: Evedrop) -> None:
    """An empty list."""
    (evedrop.folder / "cut.toml").write_text(SCENARIO.replace('dim = "smart"', "cut = []"))
    done = evedrop("check", "cut.toml")
    assert done.status == 2
    assert "event.0.cut: is an event that cannot be carried out: it names no receiver; expected one" in done.err


def test_an_event_that_cannot_be_loaded_is_a_mistake_of_who_uses_it(evedrop: Evedrop) -> None:
    """It is refused with the reason, among the scenario's other mistakes; scenarios without it still run."""
    environment = with_package(evedrop, "import nothing_of_this_name\n")
    (evedrop.folder / "dim.toml").write_text(SCENARIO.replace("slots = 60", "slots = -1"))
    (evedrop.folder / "bright.toml").write_text(SCENARIO.replace('{ at = 20, dim = "smart" }, ', ""))
    done = evedrop.process("check", "dim.toml", env=environment)
    assert done.status == 2
    assert "event.0.dim: is an event, which an installed package says is dimming:Dim, and the module" in done.err
    assert "slots: is -1" in done.err
    assert "Traceback" not in done.err
    assert evedrop.process("check", "bright.toml", env=environment).status == 0


@pytest.mark.parametrize("name", EVENTS)
def test_a_kind_is_registered_by_its_entry(name: str) -> None:
    """Its name is that of its main entry; where it names receivers is an entry; and it is in the reference."""
    kind = EVENTS[name]
    assert issubclass(kind, EventKind)
    assert name == kind.kind
    assert name in kind.own_entries()
    assert kind.names_in is None or kind.names_in in kind.own_entries()
    reference = (DOCS / "scenario.md").read_text(encoding="utf-8").partition("## `[[event]]`")[2].partition("## ")[0]
    assert all(f"`{entry}`" in reference or f"`{entry} = " in reference for entry in kind.own_entries())


def test_faults_have_places_of_their_own() -> None:
    """A nemesis draws in this order; another order would change the faults of every seed."""
    faults = {name: kind.fault.place for name, kind in EVENTS.items() if kind.fault is not None}
    assert sorted(faults, key=lambda name: faults[name]) == ["kill", "pause", "cut", "set", "partition"]
    assert sorted(faults.values()) == [0, 1, 2, 3, 4]
