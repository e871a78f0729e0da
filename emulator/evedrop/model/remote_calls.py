"""Calls of classes that must not run in this process: each class answers in a process of its own.

Anybody may write an eavesdropper's class, and launcher and recorder hold the seed and the truth. So they do not import it.
A child process imports it; the child has an empty environment and is told the class's name, its parameters in the
scenario and where modules are. The answers are JSON, and the process that asks checks them.

Every answer is kept: the same question is asked once, and a process that is given the answers need not ask.

Source: docs/your-own.md, where a class runs.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, final

from evedrop.errors import NoAnswer, NotRegistered
from evedrop.system.processes import kill

_MOST_BYTES = 2**20  # in one answer
_MODULE = "evedrop.scenario.conformance.answering"
# Where libraries are, if not in the system's folders; nothing else of our environment is passed on.
_NEEDED = ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "DYLD_FALLBACK_LIBRARY_PATH", "PYTHONHOME")
_PYTHON = str(Path(os.__file__).parent)
"""The folder of Python's own modules."""


@final
class RemoteCalls:
    """Calls of classes in child processes, and the answers so far. Usable from any thread.

    Children are asked one after the other, one for each class, and end by themselves when no more questions can come.

    seconds: how long to wait for an answer; a class may import much.
    """

    def __init__(self, seconds: float = 60.0) -> None:
        self._seconds = seconds
        self._known: dict[str, dict[str, Any]] = {}
        self._children: dict[str, _Child] = {}
        self._folders: dict[str, str | None] = {}
        self._lock = threading.Lock()
        self.folder: str | None = None
        """The folder in which modules are looked for first."""

    def call(self, name: str, do: str, *given: Any) -> Any:
        """The answer of the class `name` to one question, as decoded JSON.

        Raises NotRegistered if no class has this name, NoAnswer if the class does not give a valid answer.
        """
        question = json.dumps([name, do, *given], default=str)
        with self._lock:
            answer = self._known.get(question) or self._asked(name, question)
            if "is" in answer:
                self._known[question] = answer
            elif name in self._children:  # its author may correct it, and ask again
                self._children.pop(name).end()
        if "not_registered" in answer:
            raise NotRegistered(name, str(answer["not_registered"]))
        if "is" not in answer:
            raise NoAnswer(str(answer.get("raised", "its answer was invalid")))
        return answer["is"]

    def of(self, names: Iterable[str]) -> dict[str, Any]:
        """All questions that these classes have answered so far, with the answers: the argument of `learn`."""
        wanted = set(names)
        return {question: answer for question, answer in self._known.items() if json.loads(question)[0] in wanted}

    def learn(self, known: Mapping[str, Any]) -> None:
        """Add answers from a process that has asked."""
        with self._lock:
            self._known.update({str(question): dict(answer) for question, answer in known.items()})

    def folder_of(self, name: str) -> str | None:
        """The folder that was searched first for a class, if the class was asked anything."""
        return self._folders.get(name)

    def forget(self) -> None:
        """Forget all answers, so that questions are asked again."""
        with self._lock:
            for child in self._children.values():
                child.end()
            self._known, self._children, self._folders = {}, {}, {}

    def _asked(self, name: str, question: str) -> dict[str, Any]:
        child = self._children.get(name)
        if child is not None:
            with contextlib.suppress(NoAnswer):  # the process may have ended by itself
                return child.answer(question)
        child = self._children[name] = _Child(self._folders.setdefault(name, self.folder), self._seconds)
        try:
            return child.answer(question)
        except NoAnswer as error:
            return {"raised": str(error)}


@final
class _Child:
    """A process that answers for one class."""

    def __init__(self, folder: str | None, seconds: float) -> None:
        self._seconds = seconds
        # Python's own modules first: pytest puts folders of tests before them, and these may have files with the same names.
        places = json.dumps([_PYTHON, *(str(Path(place).absolute()) for place in sys.path)])
        command = (
            "import json, sys; sys.path[:] = json.loads(sys.stdin.buffer.raw.readline()); "
            f"from {_MODULE} import answer; answer(json.loads(sys.stdin.buffer.raw.readline()))"
        )
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-c", command],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={name: os.environ[name] for name in _NEEDED if name in os.environ},
                cwd="/",
                start_new_session=True,
            )
        except OSError as error:
            raise NoAnswer(f"it cannot be asked: no process can be started ({error})") from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._first = f"{places}\n{json.dumps(folder)}\n"

    def answer(self, question: str) -> dict[str, Any]:
        """The class's answer to a question. Raises NoAnswer, and ends the process, if it gives none."""
        process = self._process
        assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018 - both are pipes
        try:
            limit = _Limit(self._seconds)
            _write(process.stdin.fileno(), f"{self._first}{question}\n".encode(), limit)
            self._first = ""
            found = json.loads(_line(process.stdout.fileno(), limit))
            if not isinstance(found, dict):
                raise NoAnswer("its answer was invalid")
        except BaseException as error:
            self.end()
            status = process.returncode
            if isinstance(error, NoAnswer):
                raise
            if isinstance(error, (OSError, ValueError, RecursionError)):
                raise NoAnswer(f"the process that was to answer for it ended (status {status})") from error
            raise
        return found

    def end(self) -> None:
        """End the process."""
        kill(self._process)
        for pipe in filter(None, (self._process.stdin, self._process.stdout)):
            pipe.close()


@final
class _Limit:
    """The time within which an answer must come."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._deadline = time.monotonic() + seconds

    def wait(self, reading: list[int], writing: list[int]) -> None:
        """Wait for a pipe. Raises NoAnswer if the time is over."""
        if not any(select.select(reading, writing, [], max(0.0, self._deadline - time.monotonic()))):
            raise NoAnswer(f"it did not answer within {self._seconds:g} s")


def _write(handle: int, text: bytes, limit: _Limit) -> None:
    os.set_blocking(handle, False)
    while text:
        limit.wait([], [handle])
        text = text[os.write(handle, text) :]


def _line(handle: int, limit: _Limit) -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        limit.wait([handle], [])
        read = os.read(handle, 65536)
        if not read:
            raise OSError("it ended")
        line += read
        if len(line) > _MOST_BYTES:
            raise NoAnswer(f"its answer was longer than {_MOST_BYTES} bytes")
    return line
