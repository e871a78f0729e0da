"""Runs steered while they go on, by the commands that people type, and run again from their results folders."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from evedrop import load_results
from evedrop.cli.main import main
from evedrop.errors import UsageError
from evedrop.live.network.control_file import Control, read_control, remove_control
from tests.builders import digests_of
from tests.conftest import Done, Evedrop, Live, wait_until
from tests.examples import mostly_long
from tests.steps import stepping

SCENARIO = """
title = "Steered"
slots = {slots}
seed = 11
trials = 3
pace = {pace}

[process]
A = [[1.0, 0.05], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-4]]
initial_covariance = [[1.0, 0.0], [0.0, 0.01]]

[encoding]
scheme = "innovation"
state_probability = 0.4

[legitimate]
window = 2
link = {{ loss = {{ model = "gilbert-elliott", p = 0.1, r = 0.3 }} }}

[eavesdroppers.smart]
strategy = "smart"
link = {{ quality = 0.7 }}

{events}
"""

KILLED = '[[event]]\nfrom = 60\nto = 300\nkill = "smart"\nstate = "last"\n'
DELAYED = '[[event]]\nat = 330\nlink = "legitimate"\nset = { delay = { model = "constant", value = 1.0 } }\n'


class Steered:
    """A live run, which begins paused unless it is told otherwise, and the commands that steer it, in this process."""

    def __init__(
        self, evedrop: Evedrop, capsys: pytest.CaptureFixture[str], slots: int, pace: float, events: str, *options: str
    ) -> None:
        self._capsys = capsys
        path = evedrop.folder / "steered.toml"
        path.write_text(SCENARIO.format(slots=slots, pace=pace, events=events), encoding="utf-8")
        self.live: Live = evedrop.live(str(path), "--json", *options)
        wait_until(self.control.is_file, "a run that can be steered")

    @property
    def control(self) -> Path:
        """The file by which it is found."""
        return self.live.folder / "control.json"

    def try_to(self, command: str, *words: str) -> Done:
        """Type a command."""
        self._capsys.readouterr()
        status = main([command, str(self.live.folder), *words])
        return Done(status, *self._capsys.readouterr())

    def __call__(self, command: str, *words: str) -> str:
        """Type a command that must do what it says; what it said."""
        done = self.try_to(command, *words)
        assert (done.status, done.err) == (0, ""), done
        return done.out.strip()

    def status(self) -> dict[str, Any]:
        """How it is doing."""
        status: dict[str, Any] = json.loads(self("status", "--json"))
        return status

    def end(self) -> Done:
        """The file is removed at the end of the run."""
        done = self.live.end()
        assert not self.control.exists()
        return done


Start = Callable[..., Steered]


@pytest.fixture
def steered(evedrop: Evedrop, capsys: pytest.CaptureFixture[str]) -> Start:
    """Starts a run."""
    return lambda *options, slots=400, pace=0.0, events="": Steered(
        evedrop, capsys, slots, pace, events, *(options or ("--paused",))
    )


def slot_of(answer: str) -> int:
    """The slot that `held before slot 17` or `from slot 17 on: …` names."""
    return int(re.findall(r"slot (\d+)", answer)[-1])


def theory_of(folder: Path) -> object:
    """What theory expects in each slot, to nine digits."""
    columns = load_results(folder).slots.select(["slot", "peer", "theoretical_trace_covariance"])
    return sorted((slot, peer, f"{trace:.9g}") for slot, peer, trace in zip(*columns.to_pydict().values(), strict=True))


@pytest.mark.thorough
def test_a_steered_run_is_the_same_again(steered: Start, evedrop: Evedrop) -> None:
    """Steered in real time, while a receiver is away too: live and in memory its folder gives the same digests again."""
    run = steered(slots=500, pace=0.002, events=KILLED + DELAYED)
    assert run("step", "70") == "slots 0 to 69 passed; held before slot 70"  # the receiver is down
    with stepping(evedrop, run.live.folder, 150):
        answers = [run("link", "legitimate", "quality=0.6"), run("link", "smart", "cut"), run("pause")]
    answers += [
        run(
            "link",
            "legitimate",
            "loss.model=gilbert-elliott",
            "loss.p=0.2",
            "loss.r=0.5",
            "delay.model=constant",
            "delay.value=2",
        )
    ]
    answers += [run("step", "7"), run("link", "smart", "heal"), run("link", "legitimate", "cut"), run("step", "1")]
    answers += [run("link", "legitimate", "heal"), run("resume")]
    assert answers[0].endswith("on: link legitimate: quality = 0.6")
    assert answers[4].startswith("slots ")
    assert slot_of(answers[4]) == slot_of(answers[2]) + 7 == slot_of(answers[3]) + 7
    assert run.end().status == 0
    once = digests_of(run.live.folder)
    assert None not in once.values()
    folder = str(run.live.folder)
    for command in (("run", folder, "--view", "off", "--pace", "0"), ("montecarlo", folder, "--trials", "3")):
        again = evedrop.folder / f"again-{command[0]}"
        assert evedrop(*command, "--out", str(again)).status == 0
        assert digests_of(again) == once
        assert theory_of(again) == theory_of(run.live.folder)
        assert evedrop("diff", folder, str(again)).status == 0
        events = [(event["slot"], event["event"]) for event in load_results(run.live.folder).summary["events"]]
        repeated = [(event["slot"], event["event"]) for event in load_results(again).summary["events"]]
        theirs = ("pause the run", "resume the run", *(f"step {n} slots" for n in (70, 150, 7)), "step 1 slot")
        assert sorted(repeated) == sorted(event for event in events if event[1] not in theirs)
    run.live.nothing_left()


@pytest.mark.thorough
def test_a_paused_run_stands_still(steered: Start, evedrop: Evedrop) -> None:
    """No slot passes until it goes on; status and summary say what was done, and who did it."""
    run = steered(pace=0.002)
    with stepping(evedrop, run.live.folder, 300):
        at = slot_of(run("pause"))
    status = run.status()
    assert (status["slot"], status["state"], status["slots"]) == (at, "paused", 400)
    assert status["processes"] == dict.fromkeys(("router", "sensor", "legitimate", "smart"), True)
    assert status["links"]["smart"]["offered"] == 3 * at
    assert run("pause") == f"held already, before slot {at}"
    assert run("link", "smart", "quality=0.5") == f"from slot {at} on: link smart: quality = 0.5"
    assert run("step", "4") == f"slots {at} to {at + 3} passed; held before slot {at + 4}"
    shown = run("status").splitlines()
    assert shown[0] == f"slot {at + 4} of 400, 0 slots/s, paused before slot {at + 4}"
    assert shown[-2] == f"event at slot {at}: link smart: quality = 0.5 (by the operator)"
    assert run("resume") == f"the run goes on with slot {at + 4}"
    summary = run.end().summary
    assert summary["ended"] == "complete"
    assert [(event["slot"] - at, event["event"], event["by"]) for event in summary["events"]] == [
        (-at, "pause the run", "operator"),
        (-at, "step 300 slots", "operator"),
        *([(0, "pause the run", "operator")] if at < 300 else []),  # the step may be over before the operator says so
        (0, "link smart: quality = 0.5", "operator"),
        (0, "step 4 slots", "operator"),
        (4, "resume the run", "operator"),
    ]


@pytest.mark.thorough
def test_mistakes_are_told_and_change_nothing(steered: Start) -> None:
    """All mistakes at once, with exit status 2; an unknown command is refused before the run hears of it."""
    run = steered()
    before = (run.live.folder / "scenario.toml").read_text()
    done = run.try_to("link", "legitimate", "quality=1.2", "sluts=3")
    assert done.status == 2
    assert done.err.splitlines() == [
        "evedrop: link legitimate: 2 mistakes, nothing was changed",
        "  set.sluts: is not a link setting that can be changed; expected quality, loss, delay, reorder, duplicate, "
        "corrupt, rate or queue",
        "  set.quality: is 1.2; expected a number from 0 to 1, such as 0.9",
    ]
    assert (
        run.try_to("link", "nobody", "cut").err.splitlines()[1] == '  cut: names "nobody"; expected legitimate or smart'
    )
    for words in (("smart", "cut", "heal"), ("smart", "quality"), ("smart", "loss=1", "loss.p=1"), ("smart", "=1")):
        assert run.try_to("link", *words).status == 2
    assert run.try_to("step", "0").status == 2
    assert (run.live.folder / "scenario.toml").read_text() == before
    run("resume")
    assert [event["event"] for event in run.end().summary["events"]] == ["pause the run", "resume the run"]


@pytest.mark.long
def test_a_step_beyond_the_end_ends_the_run(steered: Start) -> None:
    """It is answered with the last slot, and the run is complete."""
    run = steered()
    assert run("step", "3") == "slots 0 to 2 passed; held before slot 3"
    assert run("step", "1000") == "slots 3 to 399 passed; the run is over"
    assert run.end().summary["ended"] == "complete"


@pytest.mark.thorough
def test_a_long_slot_is_not_waited_for(steered: Start) -> None:
    """In a run of a slot an hour the hold comes at once, before the slot that is due next."""
    run = steered("--seed", "11", slots=3, pace=3600.0)
    assert run("pause") == "held before slot 1"
    assert run("link", "smart", "cut") == "from slot 1 on: cut smart"
    run.live.process.send_signal(signal.SIGTERM)
    assert run.end().status == 130


@pytest.mark.thorough
@pytest.mark.parametrize("number", mostly_long([signal.SIGINT, signal.SIGKILL], [signal.SIGINT]))
def test_an_interrupted_pause_leaves_nothing(number: signal.Signals, steered: Start) -> None:
    """Ctrl-C, or the launcher killed, while the run is held: what was measured and done is on disk, the password is not."""
    run = steered()
    at = slot_of(run("step", "40"))
    run("link", "smart", "cut")
    run.live.process.send_signal(number)
    assert run.live.end().status in {130, -signal.SIGKILL}
    wait_until(lambda: not run.live.left(), "no process left of the run")
    assert not run.control.exists()
    summary = run.live.results.summary
    assert (summary["slots"], summary["ended"]) == (at, "interrupted")
    assert [event["event"] for event in summary["events"]] == ["pause the run", "step 40 slots", "cut smart"]


@pytest.mark.thorough
@pytest.mark.parametrize("name", mostly_long(["sensor", "recorder", "router"], ["router"]))
def test_who_waits_is_told_of_the_end(name: str, steered: Start, evedrop: Evedrop) -> None:
    """A process that is killed while a step goes on ends the step's command too, with status 2; a router comes back."""
    run = steered(slots=100_000, pace=0.005)
    waiting = Live(
        evedrop.start(["-m", "evedrop"], ("step", str(run.live.folder), "90000"), {}),
        evedrop.temporary,
        evedrop.folder,
    )
    wait_until(lambda: run.status()["events"][-1]["event"] == "step 90000 slots", "a step that goes on")
    run.live.kill(name)
    done = waiting.end()
    assert done.status == 2, done
    assert re.search("no run is going on in|nothing was changed|recorder or router is away", done.err), done.err
    if name == "router":
        wait_until(lambda: evedrop("status", str(run.live.folder)).status == 0, "a run that answers again")
        run.live.process.send_signal(signal.SIGTERM)
    assert run.live.end().status == (130 if name == "router" else 3)
    assert not run.control.exists()


def test_no_run_is_said(evedrop: Evedrop, tmp_path: Path) -> None:
    """Of a folder without a run, of one that is over, and of one whose run was killed: exit status 2, and why."""
    folder = tmp_path / "over"
    assert "there is no such folder" in evedrop("pause", str(folder)).err
    folder.mkdir()
    done = evedrop("status", str(folder))
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith(f"evedrop: no run is going on in {folder}; it has no control.json (yet); give ")
    (folder / "summary.json").write_text("{}")
    assert "it is over" in evedrop("step", str(folder), "3").err
    Control("r0", "tcp/127.0.0.1:9", "operator", "secret").write(folder)
    done = evedrop("link", str(folder), "smart", "cut")
    assert (done.status, len(done.err.splitlines())) == (2, 1)
    assert "no router answers at tcp/127.0.0.1:9: it was killed, or" in done.err


def test_a_control_file_whose_writer_was_killed_is_removed(tmp_path: Path) -> None:
    """A run that is over leaves no part of it, whose password would stay in the results."""
    Control("r0", "tcp/127.0.0.1:9", "operator", "secret").write(tmp_path)
    (tmp_path / "control.json").rename(tmp_path / "control.json.new")
    remove_control(tmp_path)
    assert not any(tmp_path.iterdir())


def test_the_control_file_is_nobody_elses(tmp_path: Path) -> None:
    """Only its owner can read it, it reads back as it was written, and other files are refused."""
    control = Control("r0", "tcp/127.0.0.1:9", "operator", "secret")
    control.write(tmp_path)
    path = tmp_path / "control.json"
    assert path.stat().st_mode & 0o777 == 0o600
    assert read_control(tmp_path) == control
    for text in ("", "[]", "{}", '{"run": 1}', json.dumps({**json.loads(path.read_text()), "user": 3})):
        path.write_text(text)
        with pytest.raises(UsageError, match="is not a control file"):
            read_control(tmp_path)
