"""Attacks on a run from inside: an eavesdropper's class that takes what it can wherever it is loaded."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.errors import NoAnswer
from evedrop.model.eavesdroppers import REMOTE_CALLS
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.eavesdroppers.remote_class import RemoteCalls, RemoteClasses
from evedrop.model.process import Process
from evedrop.model.streams import Batch
from evedrop.results.reading import Results
from tests.conftest import Evedrop, Live, wait_until

SEED = 7318529640182736451
"""That no process knows but the launcher and the recorder, and that nothing holds by chance."""

OURS = tuple(
    f"evedrop.{module}"
    for module in (
        "live.launch",
        "live.recorder",
        "live.network.router",
        "simulate",
        "results",
        "scenario.loading",
        "scenario.tables",
        "score",
        "peers.sensor",
    )
)
"""What only other processes of a run need."""

SPY = f'''
import gc, json, os, sys
from pathlib import Path

from evedrop.model.eavesdroppers.fixed_rules import Naive

SEED = int("{str(SEED)[::-1]}"[::-1])  # so that its own constants are not found
OURS = {OURS!r}


def held(value):
    return value == SEED if type(value) is int else str(SEED) in value if type(value) is str else False


def seen():
    """Where the seed is, of all that this process can get at."""
    found = []
    texts = {{"environ": str(dict(os.environ)), "argv": str(sys.argv), "cmdline": Path("/proc/self/cmdline").read_text()}}
    found += [place for place, text in texts.items() if str(SEED) in text]
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_globals is not globals() and any(map(held, frame.f_locals.values())):
            found.append("frame " + frame.f_code.co_name)
        frame = frame.f_back
    for one in gc.get_objects():
        if one is not globals() and isinstance(one, (dict, list, tuple)):
            values = one.values() if isinstance(one, dict) else one
            if any(map(held, list(values))):
                found.append(str(one)[:200])
    return found


def report(when):
    words = Path("/proc/self/cmdline").read_text().replace("\\0", " ").split()
    line = {{
        "when": when,
        "pid": os.getpid(),
        "words": words,
        "environ": sorted(os.environ),
        "ours": [name for name in sys.modules if name.startswith(OURS)],
        "seen": seen(),
    }}
    with Path(__file__).with_name("spied").open("a") as file:
        file.write(json.dumps(line) + "\\n")


class Spy(Naive):
    def __init__(self, knowledge, batch):
        super().__init__(knowledge, batch)
        report("made")

    @classmethod
    def use_probabilities(cls, parameters):
        report("asked")
        return 1.0, 1.0


report("imported")
'''

SCENARIO = f"""
title = "An eavesdropper that spies"
slots = 300
seed = {SEED}

[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]

[encoding]
scheme = "innovation"
state_probability = 0.6

[legitimate]
link = {{ quality = 0.9 }}

[eavesdroppers.eve]
strategy = "spy:Spy"
link = {{ quality = 0.8 }}

[[event]]
at = 150
link = "eve"
set = {{ quality = 0.5 }}
"""


def spied(folder: Path) -> list[dict[str, Any]]:
    """What the class has reported of the processes in which it ran."""
    return [json.loads(line) for line in (folder / "spied").read_text().splitlines()]


def written(folder: Path) -> None:
    """A scenario with the class, and in its folder modules with the names of some of ours and of a library's."""
    (folder / "spy.py").write_text(SPY)
    (folder / "spy.toml").write_text(SCENARIO)
    for name in ("zenoh", "rerun", "pyarrow", "evedrop", "tomli_w"):
        (folder / f"{name}.py").write_text('import spy\nspy.report("shadow")\nraise SystemExit("taken")\n')


@pytest.mark.thorough
def test_an_eavesdroppers_class_runs_in_its_own_process_alone(evedrop: Evedrop) -> None:
    """Only the eavesdropper's process of a run imports it; the process that it is asked in knows neither seed nor brief."""
    assert all(find_spec(name) for name in OURS)
    written(evedrop.folder)
    command = ["-P", "-m", "evedrop"]  # as the script `evedrop` does, not looking for modules where it was typed
    typed = ("run", "spy.toml", "--view", "off", "--pace", "0.005", "--out", "run")
    live = Live(evedrop.start(command, typed, {}), evedrop.temporary, evedrop.folder / "run")
    children = wait_until(lambda: len(children := live.children()) == 5 and children, "five processes")
    assert live.end().status == 0
    reports = spied(evedrop.folder)
    assert {report["when"] for report in reports} == {"imported", "made", "asked"}
    by_pid = {pid: name for name, pid in children.items()} | {live.process.pid: "launcher"}
    for report in reports:
        assert by_pid.get(report["pid"], "asked alone") in {"eve", "asked alone"}, report
        assert report["seen"] == [], report
        assert report["ours"] == [], report
        if report["pid"] not in by_pid:
            assert set(report["environ"]) <= {"LC_CTYPE", "LD_LIBRARY_PATH"}, report
            assert not any(str(evedrop.folder) in word for word in report["words"]), report
    assert (
        by_pid[next(report["pid"] for report in reports if report["when"] == "made" and report["pid"] in by_pid)]
        == "eve"
    )
    summary = Results.read(live.folder).summary
    assert summary["peers"]["eve"]["theoretical_trace_covariance"] > 0.0, "theory knows the class all the same"


def test_no_process_finds_it_where_it_only_asks(evedrop: Evedrop) -> None:
    """Commands that ask a class about itself, and read results made with it, import it into none of their own processes."""
    written(evedrop.folder)
    REMOTE_CALLS.forget()
    for shadow in evedrop.folder.glob("*.py"):
        if shadow.stem != "spy":
            shadow.unlink()
    assert evedrop("check", "spy.toml").status == 0
    assert evedrop("brief", "spy.toml", "--out", "briefs").status == 0
    pids = {report["pid"] for report in spied(evedrop.folder)}
    assert pids
    assert os.getpid() not in pids
    told = json.loads((evedrop.folder / "briefs" / "recorder.json").read_text())["part"]["classes"]
    assert any('"use_probabilities"' in question for question in told)


@pytest.mark.long
def test_what_a_class_says_of_itself_is_checked(evedrop: Evedrop) -> None:
    """Invalid answers, and processes that end without an answer, are mistakes of the scenario, with the entry or the question."""
    (evedrop.folder / "spy.toml").write_text(SCENARIO)
    wrong = {
        "os._exit(7)": "the process that was to answer for it ended (status",
        "return 0.5, float('nan')": "expected a probability",
        "raise OSError('no way')": "OSError: no way, spy.py line",
    }
    for body, message in wrong.items():
        REMOTE_CALLS.forget()
        text = "import os\nfrom evedrop.model.eavesdroppers.fixed_rules import Naive\n\n\nclass Spy(Naive):\n    @classmethod\n"
        (evedrop.folder / "spy.py").write_text(f"{text}    def use_probabilities(cls, parameters):\n        {body}\n")
        done = evedrop("run", "spy.toml", "--view", "off", "--out", "run")
        assert done.status == 2, (body, done.err)
        assert message in done.err
        assert not (evedrop.folder / "run").exists()
    REMOTE_CALLS.forget()


FACTS = {"parameters": {}, "pools_links": False, "takes": True, "own_outcomes": True}
FRACTIONS = {"predicted": 0.5, "state": 0.5, "misled": 0.0, "decoded": 0.0, "leaked": 0.0, "initial": 0.5}
LIES: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "mistakes": ("none", lambda kind: kind.mistakes({})),
    "streams": ([7], lambda kind: kind.streams({})),
    "betrayed": (-1, lambda kind: kind.betrayed({})),
    "follows_gamma": ("yes", lambda kind: kind.follows_gamma({})),
    "use_probabilities": ([0.5, 1.5], lambda kind: kind.use_probabilities({})),
    "outcomes_at": ({**FRACTIONS, "state": 0.7}, lambda kind: kind.outcomes({}, 0.5)(0.5)),
}


def said_by(lies: dict[str, Any]) -> Any:
    """The remote class of a class that gives these answers, right or wrong."""
    calls = RemoteCalls()
    truth = {"mistakes": [], "streams": [], "betrayed": None, "follows_gamma": True, "use_probabilities": [1.0, 1.0]}
    facts = {**truth, "outcomes": True, "outcomes_at": FRACTIONS, **lies}
    given: dict[str, list[Any]] = {
        "class": ["STRATEGIES"],
        "outcomes": ["STRATEGIES", {}, 0.5],
        "outcomes_at": ["STRATEGIES", {}, 0.5, 0.5],
    }
    answers = {
        json.dumps(["spy:Spy", do, *given.get(do, ["STRATEGIES", {}])]): {"is": answer}
        for do, answer in {"class": FACTS, **facts}.items()
    }
    calls.learn(answers)
    return RemoteClasses(calls, "STRATEGIES")("spy:Spy")


@pytest.mark.parametrize("lie", LIES)
def test_an_answer_that_is_none_is_refused(lie: str) -> None:
    """Each answer has a form and a range; one of another is an error that quotes it, not a number."""
    answer, asked = LIES[lie]
    asked(said_by({}))
    with pytest.raises(NoAnswer, match="; expected "):
        asked(said_by({lie: answer}))


def test_a_remote_class_runs_nowhere() -> None:
    """What stands for a class cannot be put to work in its place."""
    process = Process(np.eye(1), np.eye(1), np.eye(1))
    with pytest.raises(TypeError, match="runs in the eavesdropper's process alone"):
        said_by({})(Knowledge(process, 1.0, {}, {}), Batch(1, 1))
