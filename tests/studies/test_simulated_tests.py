"""`evedrop test --simulated`: scenarios with their own classes, disturbed, and what is told of a seed that breaks a promise."""

from __future__ import annotations

import re
import shlex
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree as ET

import pytest

from evedrop.cli.simulated import program
from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.results.reading import Results
from evedrop.scenario.loading import Scenario, load
from evedrop.scenarios import shipped
from evedrop.studies import simulated_tests
from evedrop.studies.simulated_tests import check_simulated
from evedrop.virtual import campaign
from evedrop.virtual.campaign import PlayedCase, play_case
from evedrop.virtual.cases import SimulatedCase, case_with
from evedrop.virtual.shrinking import Shrunk
from tests.conftest import Evedrop

BEGINNING = """\
title = "An adversary of my own"
slots = 40
trials = 3
pace = 1.0
[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]
[encoding]
scheme = "own:Sent"
state_probability = 0.6
[legitimate]
link = { quality = 0.9 }
[eavesdroppers.mine]
strategy = "own:Mine"
link = { quality = 0.9 }
"""
NEMESIS = '[nemesis]\nfaults = ["kill", "cut"]\nevery = 10\nlasting = 4\nseed = 3\n'
HOLDS = BEGINNING + NEMESIS + '[[expect]]\nmetric = "legitimate.mean_squared_error"\nslots = [0, 40]\nbelow = 100.0\n'
CLASSES = """\
import numpy as np
from evedrop.extend import Action, Innovation, PacketReader, update

class Sent(Innovation):
    pass

class Mine(PacketReader):
    def step(self, k, belief, heard):
        taken = TAKEN
        action = np.where(heard.gamma, np.where(taken, Action.STATE, Action.DISCARDED), Action.LOST).astype(np.uint8)
        return update.belief(self.process, k, belief, action, heard.z)
"""
REPEATABLE, UNREPEATABLE = "k % 3 > 0", "np.random.default_rng().random(self.trials) < 0.5"


def own(folder: Path, text: str, taken: str = REPEATABLE) -> str:
    """A scenario with its own classes beside it; taken: which packets its eavesdropper takes for the state."""
    module = f"own_{folder.name}"  # another one in each test, because all of them import theirs
    (folder / f"{module}.py").write_text(CLASSES.replace("TAKEN", taken), encoding="utf-8")
    (folder / "own.toml").write_text(text.replace("own:", f"{module}:"), encoding="utf-8")
    return "own.toml"


@pytest.mark.thorough
def test_a_scenario_with_its_own_classes_and_a_nemesis_passes(evedrop: Evedrop) -> None:
    """Four seeds; the results kept are those of the same trials in memory."""
    place = own(evedrop.folder, HOLDS)
    done = evedrop("test", place, "--simulated", "--seeds", "4", "--out", "kept")
    assert (done.status, done.err) == (0, "")
    outcome, told, *_ = done.out.splitlines()
    assert re.fullmatch(r"passed +\d+\.\d s  own.toml", outcome)
    assert re.fullmatch(r" +4 runs from seed 1 on, 0 of which broke a promise; \d+\.\d runs/s", told)
    assert Results.read(evedrop.folder / "kept" / "own").summary["slots"] == 40


def test_seeds_disturb_a_scenario_in_different_ways() -> None:
    """The same seed in the same way."""
    scenario = load(str(shipped()["eavesdroppers"]), {"slots": 60})
    cases = [case_with(scenario, seed) for seed in range(1, 30)]
    assert len({str(case) for case in cases}) > 20
    assert {bool(case.faults) for case in cases} == {True, False}
    assert case_with(scenario, 5) == cases[4]
    assert all(case.scenario is scenario for case in cases)


def test_a_play_ends_in_its_midst(monkeypatch: pytest.MonkeyPatch) -> None:
    """As Ctrl-C wants it: at once, and nothing is left."""
    case = case_with(load(str(shipped()["eavesdroppers"]), {"slots": 60}), 1)
    checks = count()

    def check() -> None:
        if next(checks) == 200:
            raise Interrupted

    with TemporaryDirectory() as folder:  # whose path is short enough for sockets
        monkeypatch.setattr(campaign, "_MEMORY", Path(folder))
        with pytest.raises(Interrupted):
            play_case(case, program, check=check)
        assert next(checks) == 201
        assert not [*Path(folder).iterdir()]
        assert not play_case(case, program).misses


def test_a_long_run_is_not_cut_into_many_messages() -> None:
    """Its sensor may be far ahead, or the run would take minutes."""
    scenario = Scenario({**load(str(shipped()["eavesdroppers"]), {}).as_tables(), "slots": 10_000})
    assert min(case_with(scenario, seed).ahead for seed in range(1, 50)) >= 250


@pytest.mark.parametrize(("slots", "pace"), [(7000, 1.0), (39, 60.0), (10_000, 0.5)])
def test_the_pace_that_is_advised_is_not_refused(slots: int, pace: float) -> None:
    """It has two digits, and is rounded down."""
    scenario = load(str(shipped()["eavesdroppers"]), {"slots": slots, "pace": pace})
    with pytest.raises(UsageError, match="give --set pace=") as refused:
        check_simulated(scenario)
    advised = re.search(r"--set pace=([0-9.e-]+),", str(refused.value))
    assert advised is not None
    check_simulated(load(str(shipped()["eavesdroppers"]), {"slots": slots, "pace": float(advised[1])}))


def test_a_story_that_cannot_be_told_again_leaves_its_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    """A class that does something else each time may fail when the smallest run is played to be shown."""
    case = case_with(load(str(shipped()["eavesdroppers"]), {"slots": 60}), 1)
    failed = play_case(case, program)
    monkeypatch.setattr(simulated_tests, "shrink", lambda *_: Shrunk(case, ("a promise is broken",), 1))

    def play(_: SimulatedCase) -> PlayedCase:
        raise RunError("its class failed")

    story = simulated_tests._story(failed, play)
    assert "a promise is broken" in story
    assert story.endswith("played again, it ends otherwise: its class failed")


@pytest.mark.thorough
def test_a_failed_expectation_fails_the_test(evedrop: Evedrop) -> None:
    """With status 1, though no run broke a promise."""
    place = own(evedrop.folder, HOLDS.replace("below = 100.0", "below = 1e-9"))
    done = evedrop("test", place, "--simulated", "--seeds", "2", "--out", "kept")
    assert (done.status, done.err) == (1, "")
    assert done.out.startswith("FAILED")
    assert "expected legitimate.mean_squared_error over slots 0 to 39 below 1e-09: FAILED" in done.out
    assert "0 of which broke a promise" in done.out


@pytest.mark.thorough
def test_a_class_that_cannot_be_repeated_breaks_a_promise(evedrop: Evedrop) -> None:
    """The first failing seed is told with its faults, the command that repeats it, and a shrunk run, in JUnit too."""
    place = own(evedrop.folder, BEGINNING.replace("slots = 40", "slots = 6"), UNREPEATABLE)
    scenario = load(str(evedrop.folder / place))
    seed = next(seed for seed in count(1) if not case_with(scenario, seed).faults)  # or a fault might end it early
    # With two trials, one run in some thousands was repeated by chance.
    options = ("--simulated", "--trials", "20", "--set", "title=What's wrong?", "--out", "kept")
    done = evedrop("test", place, *options, "--seed", str(seed), "--seeds", "1", "--junit", "junit.xml")
    assert (done.status, done.err) == (3, "")
    outcome, told, reason, *others = done.out.splitlines()
    assert re.fullmatch(r"BROKEN +\d+\.\d s  own.toml", outcome)
    assert f"1 run from seed {seed} on" in told
    found = re.fullmatch(r"    (seed (\d+), .+; see it again: evedrop (.+))", reason)
    assert found is not None
    [smallest] = [line for line in others if "the smallest run found" in line]
    assert smallest.endswith("no fault")
    assert int(re.findall(r"(\d+) slots", smallest)[0]) < 6
    assert any(re.search(r"launcher +router +sensor +legitimate +mine +recorder", line) for line in others)
    again = evedrop(*shlex.split(found[3]), "--out", "again")
    assert load(str(evedrop.folder / "again" / "own")).title == "What's wrong?"
    assert again.status == 3
    assert f"1 run from seed {found[2]} on, 1 of which broke a promise" in again.out
    [[case]] = ET.parse(evedrop.folder / "junit.xml").getroot()  # noqa: S314 - our own
    error = case.find("error")
    assert error is not None
    assert error.get("message") == found[1]
    assert smallest.strip() in str(error.text)
    assert str(error.text).rstrip().endswith("recorder")


@pytest.mark.thorough
def test_scenarios_are_simulated_at_the_same_time(evedrop: Evedrop) -> None:
    """Each in a process of its own, with the same outcomes."""
    place = own(evedrop.folder, HOLDS)
    text = (evedrop.folder / place).read_text(encoding="utf-8").replace("below = 100.0", "below = 1e-9")
    (evedrop.folder / "other.toml").write_text(text, encoding="utf-8")
    done = evedrop("test", place, "other.toml", "--simulated", "--seeds", "2", "--jobs", "2", "--out", "kept")
    assert (done.status, done.err) == (1, "")
    assert [line.split()[0] for line in done.out.splitlines() if line.endswith(".toml")] == ["passed", "FAILED"]
    assert done.out.count("2 runs from seed 1 on, 0 of which broke a promise") == 2


@pytest.mark.parametrize(
    ("changed", "hint"),
    [
        (("trials = 3", "trials = 5000"), "5000 trials are too many for --simulated; give --trials 200, or fewer"),
        (("slots = 40", "slots = 50000"), "50000 slots are too many for --simulated"),
        (("pace = 1.0", "pace = 60.0"), "40 slots at a pace of 60 s are 2400 s, too long for --simulated"),
        (
            (
                "[process]",
                '[process]\nsource = "zenoh"\nstates = ["x", "v"]\nzenoh = { key = "a", connect = "tcp/127.0.0.1:7447" }',
            ),
            "no program of yours publishes states there; test it live",
        ),
    ],
)
def test_what_the_world_cannot_run_is_refused(evedrop: Evedrop, changed: tuple[str, str], hint: str) -> None:
    """With a sentence that says what to give, and no results folder."""
    place = own(evedrop.folder, BEGINNING.replace(*changed))
    done = evedrop("test", place, "--simulated", "--out", "kept")
    assert done.status == 2
    assert done.out.startswith("MISTAKES")
    assert hint in done.out
    assert not (evedrop.folder / "kept").exists()


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        (["--simulated", "--in-memory"], "--in-memory and --simulated are two ways"),
        (["--simulated", "--scheduler", "tcp://127.0.0.1:1"], "--scheduler computes trials in memory"),
        (["--simulated", "--resume"], "--resume goes on with tests in memory"),
        (["--simulated", "--seeds", "0"], "--seeds 0: expected 1 or more"),
        (["--seeds", "5"], "--seeds is of runs in the simulated world; add --simulated"),
        (["--seed", "5"], "--seed is of runs in the simulated world; add --simulated"),
    ],
)
def test_options_that_do_not_go_together_are_refused(evedrop: Evedrop, options: list[str], hint: str) -> None:
    """Before anything is run."""
    done = evedrop("test", "vehicle", *options)
    assert (done.status, done.out) == (2, "")
    assert hint in done.err
