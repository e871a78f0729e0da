"""One package with a class of every kind: each is a file and a line of metadata, and nothing here is changed for it."""

from __future__ import annotations

import pytest

from evedrop.results.reading import Results
from tests.builders import digests_of
from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.packages import install
from tests.scenario.conformance.own_classes import BLOCK, TEXT
from tests.show.view.read_back import rows

COMMAND = """
from evedrop.extend import Command

def greet(options):
    print("hello")
    return 0

COMMANDS = (Command("greet", greet, "say hello", ()),)
"""
DELAY = """
from evedrop.extend import ConstantDelay

class Steady(ConstantDelay):
    pass
"""
ENTRIES = {
    "evedrop.schemes": {"flipped": "flipped:Flipped"},
    "evedrop.eavesdroppers": {"chaser": "tracker:Tracker"},
    "evedrop.links": {"shifts": "shifts:Shifts"},
    "evedrop.delays": {"steady": "steady:Steady"},
    "evedrop.events": {"dim": "dimming:Dim"},
    "evedrop.metrics": {"largest_error": "largest:LargestError"},
    "evedrop.panels": {"ratio": "ratio:ErrorRatio"},
    "evedrop.commands": {"greet": "greeting"},
}
SCENARIO = """
title = "One of each"
slots = 60
trials = 3
process = { A = [[1.0, 0.1], [0.0, 1.0]], Q = [[1e-3, 0.0], [0.0, 1e-3]], initial_covariance = [[1.0, 0.0], [0.0, 1.0]] }
encoding = { scheme = "flipped" }
legitimate = { window = 3, link = { quality = 0.9, delay = { model = "steady", value = 1 } } }
event = [{ at = 20, dim = "legitimate" }]
expect = [{ metric = "smart.largest_error", above = 0.0 }]

[eavesdroppers.smart]
strategy = "chaser"
patience = 4.0
link = { loss = { model = "shifts", period = 20, good = 0.95, bad = 0.3 } }
"""
NEW = {"flipped", "chaser", "shifts", "steady", "dim", "largest_error", "ratio", "greet"}


@pytest.fixture
def environment(evedrop: Evedrop) -> dict[str, str]:
    """An environment in which the package is installed."""
    blocks = {name: code for name, code in BLOCK.findall(TEXT) if name.endswith(".py")}
    install(evedrop.folder / "site", {**blocks, "greeting.py": COMMAND, "steady.py": DELAY}, ENTRIES)
    return {**evedrop.environment, "PYTHONPATH": str(evedrop.folder / "site")}


@pytest.mark.thorough
def test_a_package_with_one_of_each_runs(evedrop: Evedrop, environment: dict[str, str]) -> None:
    """Live and in memory with the same digests; schema, expectations, summary, events, view and help have all of them."""
    assert {name for named in ENTRIES.values() for name in named} == NEW
    (evedrop.folder / "each.toml").write_text(SCENARIO)
    for words in (
        ("check", "each.toml"),
        ("run", "each.toml", "--view", "web", "--out", "live"),
        ("montecarlo", "each.toml", "--trials", "3", "--workers", "2", "--out", "memory"),
        ("diff", "live", "memory"),
        ("greet",),
    ):
        done = evedrop.process(*words, env=environment)
        assert done.status == 0, (words, done.out, done.err)
        assert "warning" not in done.err, done.err
    assert done.out == "hello\n"
    live, memory = (Results.read(evedrop.folder / name).summary for name in ("live", "memory"))
    assert digests_of(evedrop.folder / "live") == digests_of(evedrop.folder / "memory")
    assert live["peers"]["smart"]["largest_error"] == memory["peers"]["smart"]["largest_error"] > 0.0
    assert [expectation["held"] for expectation in live["expectations"]] == [True]
    assert [event["event"] for event in live["events"]] == ["dim legitimate", "legitimate is bright again"]
    page = (evedrop.folder / "live" / "report.html").read_text(encoding="utf-8")
    told = {"flipped", "chaser", "shifts", "steady", "smart.largest_error above 0: held", "<td>dim legitimate</td>"}
    assert {word for word in told if word in page} == told
    assert len(rows(evedrop.folder / "live" / "recording.rrd", "ratio/smart", "Scalars:scalars")) == 60
    assert "say hello" in evedrop.process("--help", env=environment).out


CHECKED = [("scheme", "flipped"), ("eavesdropper", "chaser"), ("link", "shifts"), ("delay", "steady")]


@pytest.mark.parametrize(("kind", "name"), mostly_long(CHECKED, [("link", "shifts"), ("delay", "steady")]))
def test_checks_take_them_too(kind: str, name: str, evedrop: Evedrop, environment: dict[str, str]) -> None:
    """`check` with its options for classes, by their short names."""
    done = evedrop.process("check", f"--{kind}", name, env=environment)
    assert done.status == 0, done.out


@pytest.mark.long
def test_studies_take_them_too(evedrop: Evedrop, environment: dict[str, str]) -> None:
    """`design`, `compare` and `sweep`, by their short names."""
    (evedrop.folder / "each.toml").write_text(SCENARIO)
    done = evedrop.process("design", "each.toml", env=environment)
    assert done.status == 2
    assert "flipped" in done.err
    small = ("--slots", "40", "--trials", "4")
    who = ("--schemes", "flipped,plain", "--adversaries", "chaser,naive")
    done = evedrop.process("compare", "each.toml", *small, *who, "--out", "compared", env=environment)
    assert done.status == 0, done.err
    assert "flipped" in done.out
    assert "chaser" in done.out
    done = evedrop.process("sweep", "each.toml", *small, "--over", "slots=30,40", env=environment)
    assert done.status == 0, done.err
    assert "largest error" in done.out
