"""Calls of classes that must not run here: each in a process of its own, whatever the class does in it."""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import NoAnswer, NotRegistered
from evedrop.model.eavesdroppers.remote_class import RemoteCalls

HEAD = "import os, signal, time\nfrom pathlib import Path\nfrom evedrop.extend import Naive\n\n\nclass Mine(Naive):\n"


def written(folder: Path, body: str, name: str = "answering_mine") -> str:
    """The name of a class with this body, in a module of a folder."""
    (folder / f"{name}.py").write_text(f"{HEAD}    {body}\n")
    return f"{name}:Mine"


def method(name: str, code: str) -> str:
    """A method of a class, which takes parameters."""
    return f"@classmethod\n    def {name}(cls, parameters):\n        {code}"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The processes that answer, in order."""
    processes: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def keeping(*given: Any, **options: Any) -> subprocess.Popen[bytes]:
        processes.append(start(*given, **options))
        return processes[-1]

    monkeypatch.setattr(subprocess, "Popen", keeping)
    return processes


@pytest.fixture
def calls(tmp_path: Path, started: list[subprocess.Popen[bytes]]) -> Iterator[RemoteCalls]:
    """Of classes in a folder; afterwards no process is left."""
    remote = RemoteCalls()
    remote.folder = str(tmp_path)
    yield remote
    remote.forget()
    assert all(process.poll() is not None for process in started)


def test_a_class_answers_once_and_its_answers_are_kept(
    calls: RemoteCalls, tmp_path: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    """One process answers all questions; a process that is given the answers asks none."""
    name = written(tmp_path, method("betrayed", "return parameters['slot']"))
    assert calls.folder_of(name) is None
    assert calls.call(name, "class", "STRATEGIES")["parameters"] == {}
    assert [calls.call(name, "betrayed", "STRATEGIES", {"slot": slot}) for slot in (3, 4, 3)] == [3, 4, 3]
    assert len(started) == 1
    assert started[0].poll() is None
    assert calls.folder_of(name) == str(tmp_path)
    answers = calls.of([name])
    assert len(answers) == 3
    assert calls.of(["other:Class"]) == {}
    told = RemoteCalls()
    told.learn(answers)
    assert told.call(name, "betrayed", "STRATEGIES", {"slot": 4}) == 4
    assert len(started) == 1


def test_a_refusal_that_somebody_else_was_given_is_one_here() -> None:
    """And no process is started for it."""
    calls = RemoteCalls()
    calls.learn({json.dumps(["mine:Class", "class"]): {"raised": "it is broken"}})
    with pytest.raises(NoAnswer, match="it is broken"):
        calls.call("mine:Class", "class")


def test_a_process_that_ended_is_started_again(
    calls: RemoteCalls, tmp_path: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    """It ends by itself when it was not asked for a while, and the next question does not notice."""
    name = written(tmp_path, method("betrayed", "return 7"))
    calls.call(name, "class", "STRATEGIES")
    started[0].kill()
    started[0].wait()
    assert calls.call(name, "betrayed", "STRATEGIES", {}) == 7
    assert len(started) == 2


BROKEN = {
    "ends": ("os._exit(3)", "the process that was to answer for it ended (status 3)"),
    "raises": ("return 1 / 0", "ZeroDivisionError: division by zero, answering_raises.py line 9"),
    "types": ("return object()", "its answer is not made of numbers, texts, lists and tables"),
    "long": ("return 'x' * 2**21", "its answer was longer than 1048576 bytes"),
    "writes": (
        r"[os.write(one, b'[1]\n') for one in range(3, 20) if Path(f'/proc/self/fd/{one}').is_fifo()]; time.sleep(60)",
        "its answer was invalid",
    ),
    "garbage": (
        r"[os.write(one, b'no JSON\n') for one in range(3, 20) if Path(f'/proc/self/fd/{one}').is_fifo()]; time.sleep(60)",
        "the process that was to answer for it ended (status -9)",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_class_that_gives_no_answer_is_said_to(
    case: str, calls: RemoteCalls, tmp_path: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    """With the reason. Its process ends, nothing is kept, and a corrected class answers the same question."""
    code, message = BROKEN[case]
    name = written(tmp_path, method("betrayed", code), f"answering_{case}")
    with pytest.raises(NoAnswer) as refused:
        calls.call(name, "betrayed", "STRATEGIES", {})
    assert message in str(refused.value)
    assert started[-1].poll() is not None
    assert calls.of([name]) == {}
    if case == "raises":
        written(tmp_path, method("betrayed", "return 11"), f"answering_{case}")
        assert calls.call(name, "betrayed", "STRATEGIES", {}) == 11


def test_a_class_that_does_not_answer_in_time_is_said_to(tmp_path: Path) -> None:
    """The limit is in the message."""
    calls = RemoteCalls(seconds=0.5)
    calls.folder = str(tmp_path)
    name = written(tmp_path, method("betrayed", "time.sleep(600)"), "answering_slow")
    with pytest.raises(NoAnswer, match=r"it did not answer within 0.5 s"):
        calls.call(name, "betrayed", "STRATEGIES", {})


def test_a_name_without_a_class_is_said_to_have_none(calls: RemoteCalls, tmp_path: Path) -> None:
    """With the reason that the registry gives in the other process."""
    name = written(tmp_path, "pass").replace("Mine", "Other")
    with pytest.raises(NotRegistered) as refused:
        calls.call(name, "class", "STRATEGIES")
    assert re.search(r"and the module answering_mine .* has no Other; expected one of Mine", refused.value.why)


def test_without_a_process_there_is_no_answer(monkeypatch: pytest.MonkeyPatch, calls: RemoteCalls) -> None:
    """Where none can be started."""
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(NoAnswer, match=r"it cannot be asked: no process can be started \(.*No such file or directory"):
        calls.call("mine:Class", "class", "STRATEGIES")


def test_an_interrupt_ends_the_process_that_was_asked(
    monkeypatch: pytest.MonkeyPatch, calls: RemoteCalls, started: list[subprocess.Popen[bytes]]
) -> None:
    """And is not taken for an answer."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(select, "select", interrupted)
    with pytest.raises(KeyboardInterrupt):
        calls.call("mine:Class", "class", "STRATEGIES")
    assert started[-1].poll() is not None
    assert json.dumps(calls.of(["mine:Class"])) == "{}"


def test_a_forked_process_asks_children_of_its_own(calls: RemoteCalls, tmp_path: Path) -> None:
    """On one pipe, each would read the answers to the other's questions."""
    name = written(tmp_path, method("betrayed", "return parameters['slot']"))
    assert calls.call(name, "betrayed", "STRATEGIES", {"slot": 0}) == 0
    ours, theirs = os.pipe()
    process = os.fork()
    if process == 0:  # while the other one does nothing, its child has answers for it only
        with contextlib.suppress(BaseException):
            os.write(
                theirs, f"{len(calls._children)} {calls.call(name, 'betrayed', 'STRATEGIES', {'slot': 1})}".encode()
            )
            calls.forget()
        os._exit(0)
    os.waitpid(process, 0)
    assert os.read(ours, 100) == b"0 1"
    os.close(ours)
    os.close(theirs)
    assert calls.call(name, "betrayed", "STRATEGIES", {"slot": 2}) == 2


def test_a_forked_process_leaves_the_children_to_the_other_one(
    calls: RemoteCalls, tmp_path: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    """They end when nobody has their pipes any more, and it waits for none of them."""
    name = written(tmp_path, method("betrayed", "return parameters['slot']"))
    assert calls.call(name, "betrayed", "STRATEGIES", {"slot": 0}) == 0
    calls._forked()  # as after a fork, in the child
    (left,) = started
    assert left.poll() == 0
    left.returncode = None  # this process is the other one, too
    assert left.wait() == 0
    assert calls.call(name, "betrayed", "STRATEGIES", {"slot": 1}) == 1
    assert len(started) == 2
