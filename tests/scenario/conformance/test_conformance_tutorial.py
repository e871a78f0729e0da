"""Classes of anybody's own: the tutorial as it stands, and other ways to name its classes."""

from __future__ import annotations

import json
import re
import shlex

import pytest

from evedrop import extend
from evedrop.errors import ScenarioError
from evedrop.results.reading import Results
from evedrop.scenario.loading import load, with_event
from tests.builders import digests_of
from tests.conftest import Evedrop
from tests.packages import install
from tests.scenario.conformance.own_classes import BLOCK, TEXT

pytestmark = pytest.mark.usefixtures("imports_forgotten")


def test_the_tutorial_has_short_classes_and_a_scenario() -> None:
    """Each is complete in less than 40 lines; a metric with its tally, and an application, in less than 50."""
    blocks = dict(BLOCK.findall(TEXT))
    modules = {
        "flipped.py",
        "gate.py",
        "tracker.py",
        "shifts.py",
        "platooning.py",
        "ratio.py",
        "dimming.py",
        "largest.py",
        "greeting.py",
    }
    assert set(blocks) == modules | {"three.toml", "pyproject.toml"}
    assert all(blocks.pop(name).count("\n") < 49 for name in ("platooning.py", "largest.py"))
    assert all(text.count("\n") < 39 for text in blocks.values())


@pytest.mark.thorough
def test_the_tutorial_works_as_it_is_typed(tutorial: Evedrop) -> None:
    """Its classes are checked, and run live, in memory and again from the results, with the same digests."""
    lines = TEXT.splitlines()
    commands = [shlex.split(line)[2:] for line in lines if line.startswith("$ evedrop ")]
    assert {words[0] for words in commands} == {"check", "run", "montecarlo", "diff"}
    for words in [*commands, ["check", "--scheme", "flipped:Flipped"]]:
        done = tutorial(*words)
        assert done.status == 0, (words, done.out, done.err)
        assert "BROKEN" not in done.out
    assert "no difference in 180 blocks: legitimate, naive, tracker" in tutorial("diff", "live", "memory").out
    assert "is not the one" not in (again := tutorial("montecarlo", "live", "--trials", "20", "--out", "again")).err
    assert again.status == 0
    assert digests_of(tutorial.folder / "again") == digests_of(tutorial.folder / "live")
    peers = Results.read(tutorial.folder / "live").summary["peers"]
    assert peers["tracker"]["theoretical_trace_covariance"] is None
    assert peers["legitimate"]["theoretical_trace_covariance"] == pytest.approx(0.00059, rel=0.02)


@pytest.mark.long
def test_workers_import_it_too(tutorial: Evedrop) -> None:
    """Trials by worker processes are the trials of this one."""
    for workers in "12":
        options = ("--trials", "502", "--slots", "4", "--workers", workers, "--out", workers)
        assert tutorial("montecarlo", "three.toml", *options).status == 0
    assert digests_of(tutorial.folder / "1") == digests_of(tutorial.folder / "2")


def test_a_module_that_has_changed_since_is_warned_of(tutorial: Evedrop) -> None:
    """Results know the module that they were made with."""
    assert tutorial("montecarlo", "three.toml", "--trials", "1", "--out", "run").status == 0
    with (tutorial.folder / "shifts.py").open("a") as module:
        module.write("# another\n")
    assert "warning: the module shifts is not the one these results were made with" in tutorial("check", "run").out


@pytest.mark.long
def test_the_folder_of_modules_can_be_another(tutorial: Evedrop) -> None:
    """`modules` is relative to the scenario, wherever the command is typed; every process is told what it needs, and no more."""
    lib, home = tutorial.folder / "home" / "lib", tutorial.folder / "home"
    lib.mkdir(parents=True)
    for module in tutorial.folder.glob("*.py"):
        module.rename(lib / module.name)
    scenario = 'modules = "lib"\n' + (tutorial.folder / "three.toml").read_text()
    (home / "three.toml").write_text(scenario)
    short = ("home/three.toml", "--slots", "20", "--set", "trials=2")
    assert tutorial("run", *short, "--view", "off", "--out", "live").status == 0
    assert tutorial("brief", *short, "--out", "briefs").status == 0
    told = {path.stem: json.loads(path.read_text())["part"].get("modules") for path in tutorial.folder.glob("briefs/*")}
    assert {name for name, folder in told.items() if folder == str(lib)} == {
        "sensor",
        "legitimate",
        "tracker",
        "router",
    }
    done = tutorial("check", "home/three.toml", "--set", "modules=nowhere")
    assert done.status == 2
    assert f'modules: is "{str(tutorial.folder)[:60]}' in done.err  # a long path is shortened
    assert ", which is not a folder" in done.err


@pytest.mark.long
def test_an_installed_package_gives_short_names(tutorial: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Entry points of a package on the path are names like any other, in every process; the built-in ones stay."""
    site = tutorial.folder / "site"
    entries = {
        "evedrop.schemes": {"flip": "flipped:Flipped", "plain": "flipped:Flipped"},
        "evedrop.eavesdroppers": {"track": "tracker:Tracker"},
        "evedrop.links": {"shifts": "shifts:Shifts", "bad": "shifts:Shift"},
    }
    install(site, {}, entries)
    for module in tutorial.folder.glob("*.py"):
        module.rename(site / module.name)
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=":")
    monkeypatch.syspath_prepend(str(site))
    changes = ("slots=20", "encoding.scheme=flip", "eavesdroppers.tracker.strategy=track")
    short = ("three.toml", *(word for change in changes for word in ("--set", change)))
    named = ("--set", "eavesdroppers.tracker.link.loss.model=shifts")
    assert tutorial("run", *short, *named, "--view", "off", "--set", "trials=2", "--out", "live").status == 0
    assert tutorial("montecarlo", *short, *named, "--trials", "2", "--out", "memory").status == 0
    assert digests_of(tutorial.folder / "live") == digests_of(tutorial.folder / "memory")
    assert 'scheme = "flip"' in (tutorial.folder / "live" / "scenario.toml").read_text()
    assert tutorial("check", "--scheme", "flip").status == 0
    done = tutorial("check", *short, "--set", "eavesdroppers.tracker.link.loss.model=bad")
    assert 'loss.model: is "bad", which an installed package says is shifts:Shift, and the module shifts' in done.err
    done = tutorial("check", "three.toml", "--set", "encoding.scheme=flop")
    assert done.status == 2
    assert "encrypted-schedule, flip, innovation" in done.err
    assert "did you mean flip?" in done.err


@pytest.mark.long
def test_a_link_of_a_run_that_goes_on_can_be_one_of_its_modules(tutorial: Evedrop) -> None:
    """The router knows where the run's modules are; a run that was started without any gets none on the way."""
    shifts = {"link": "legitimate", "set": {"loss": {"model": "shifts:Shifts", "period": 10, "good": 0.9, "bad": 0.1}}}
    scenario = load(tutorial.folder / "three.toml")
    assert with_event(scenario, shifts, 30).event[0].model_dump(exclude_none=True) == {"at": 30, **shifts}
    with pytest.raises(ScenarioError, match="set: names shifts:Shifts, and the run was started without modules"):
        with_event(load("vehicle"), shifts, 30)
    event = 'event=[{from = 5, to = 15, kill = "tracker"}, {at = 10, link = "naive", set = {loss = {model = "shifts:Shifts", '
    event += "period = 10, good = 0.9, bad = 0.1}}}]"
    for name, command in (
        ("live", ("run", "--view", "off", "--set", "trials=2")),
        ("memory", ("montecarlo", "--trials", "2")),
    ):
        words = (command[0], "three.toml", *command[1:], "--slots", "30", "--out", name, "--set", event)
        assert tutorial(*words).status == 0
    assert digests_of(tutorial.folder / "live") == digests_of(tutorial.folder / "memory")


def test_design_is_for_the_scheme_it_is_for(tutorial: Evedrop) -> None:
    """No closed form is invented for a scheme of somebody's own; an eavesdropper without one is left out and named."""
    done = tutorial("design", "three.toml")
    assert done.status == 2
    assert "no closed form is known for flipped:Flipped" in done.err
    (tutorial.folder / "louder.py").write_text(
        "from evedrop.extend import Plain\n\n\nclass Louder(Plain):\n    'Other packets, maybe.'\n"
    )
    done = tutorial("design", "three.toml", "--set", 'encoding={scheme = "louder:Louder"}')
    assert done.status == 2
    assert "no closed form is known for louder:Louder" in done.err
    paper = ("--set", 'encoding={scheme = "innovation", state_probability = 0.5}')
    done = tutorial("design", "three.toml", *paper, "--set", "eavesdroppers.tracker.link={quality = 0.9}", "--json")
    assert json.loads(done.out)["left_out"] == {"tracker": "tracker:Tracker"}


def test_a_plug_in_needs_one_module(tutorial: Evedrop) -> None:
    """The tutorial imports `evedrop.extend` and nothing else of Evedrop; every name there is documented and importable."""
    text = TEXT
    assert set(re.findall(r"^(?:from|import) (evedrop[\w.]*)", text, flags=re.MULTILINE)) == {"evedrop.extend"}
    assert set(re.findall(r"evedrop\.(?:model|kernels|streams|live|memory)[\w.]*", text)) == set()
    assert all(
        getattr(extend, name).__doc__
        for name in extend.__all__
        if name not in {"Floats", "Flags", "Codes", "OutcomesAt"}
    )
    assert tutorial("check", "three.toml").status == 0


@pytest.mark.long
def test_classes_of_a_plug_in_are_compared(tutorial: Evedrop) -> None:
    """A comparison takes a scheme and an eavesdropper of one's own among the built-in ones."""
    words = (
        "--schemes",
        "flipped:Flipped,plain",
        "--adversaries",
        "naive,tracker:Tracker",
        "--trials",
        "20",
        "--slots",
        "60",
        "--json",
    )
    done = tutorial("compare", "three.toml", *words, "--out", "found")
    assert done.status == 0, done.err
    comparison = json.loads(done.out)
    assert [*comparison["schemes"]] == ["flipped:Flipped", "plain"]
    for scheme in comparison["schemes"].values():
        assert scheme["against"]["tracker:Tracker"]["eavesdropper"]["mean"] > 0.0
        assert scheme["against"]["naive"]["eavesdropper"]["mean"] > 0.0
    assert (tutorial.folder / "found" / "scenarios" / "flipped.Flipped.toml").is_file()
    wrong = tutorial("compare", "three.toml", "--schemes", "flipped:Flop", "--out", "wrong")
    assert wrong.status == 2
    assert "has no Flop; expected one of Sender, Reader, Flipped" in wrong.err
