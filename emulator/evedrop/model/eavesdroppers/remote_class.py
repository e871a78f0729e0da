"""Remote classes, for eavesdroppers' classes that must not run here: they give the classes' answers and cannot be instantiated.

Each class answers in a process of its own, by remote calls.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self, final

from evedrop.errors import NoAnswer, NotRegistered
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, PacketTaker
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.theory.covariances import Outcomes, OutcomesAt
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
        ours = weakref.ref(self)
        os.register_at_fork(after_in_child=lambda: None if (calls := ours()) is None else calls._forked())

    def _forked(self) -> None:
        """Leave the children to the process that forked this one: on one pipe, each would read the other's answers."""
        for child in self._children.values():
            child.leave()
        self._children, self._lock = {}, threading.Lock()

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

    def learn(self, answers: Mapping[str, Any]) -> None:
        """Add answers from a process that has asked."""
        with self._lock:
            self._known.update({str(question): dict(answer) for question, answer in answers.items()})

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
            reply = json.loads(_line(process.stdout.fileno(), limit))
            if not isinstance(reply, dict):
                raise NoAnswer("its answer was invalid")
        except BaseException as error:
            self.end()
            status = process.returncode
            if isinstance(error, NoAnswer):
                raise
            if isinstance(error, (OSError, ValueError, RecursionError)):
                raise NoAnswer(f"the process that was to answer for it ended (status {status})") from error
            raise
        return reply

    def leave(self) -> None:
        """Close the pipes of a process that is another one's child."""
        self._process.returncode = 0  # it is not ours to wait for
        for pipe in filter(None, (self._process.stdin, self._process.stdout)):
            pipe.close()

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


_ROUNDING = 1e-9
_FRACTIONS = ("predicted", "state", "misled", "decoded", "leaked")
"""The entries of `Outcomes` that sum to 1."""


@final
class RemoteClasses:
    """Makes remote classes, whose class methods are calls of `calls`."""

    def __init__(self, calls: RemoteCalls, registry: str) -> None:
        """registry: the attribute of `evedrop.model.eavesdroppers` that contains the classes."""
        self.calls = calls
        self._registry = registry

    def __call__(self, name: str) -> type[Eavesdropper]:
        """The remote class of a name. Raises NotRegistered if there is no such class."""
        try:
            facts = self.calls.call(name, "class", self._registry)
        except NoAnswer as error:
            raise NotRegistered(name, f", and {error}; expected a class that can be asked about itself") from error
        parameters = facts.get("parameters") if isinstance(facts, dict) else None
        if not isinstance(parameters, dict):
            raise NotRegistered(name, ", whose answer is invalid; expected a class that declares its parameters")
        base = _RemoteTaker if facts.get("takes") is True else _RemoteEavesdropper
        attributes = {
            "parameters": parameters,
            "pools_links": facts.get("pools_links") is True,
            **{name: facts.get(name) is True for name in ("inverts_noise", "reads_leaks", "tests_range")},
            "only_against": _only_against(facts.get("only_against")),
            "_own_outcomes": facts.get("own_outcomes") is not False,
            "_ask": staticmethod(lambda do, *given: self.calls.call(name, do, self._registry, *given)),
            "__module__": __name__,
        }
        return type(name.rpartition(":")[2], (base,), attributes)


def _only_against(answer: Any) -> tuple[str | tuple[str, ...], str] | None:
    """A scheme, or several, and a reason, if that is what the class says."""
    if not isinstance(answer, list) or len(answer) != 2 or not isinstance(answer[1], str):
        return None
    if isinstance(answer[0], list) and all(isinstance(name, str) for name in answer[0]):
        return tuple(answer[0]), answer[1]
    return (answer[0], answer[1]) if isinstance(answer[0], str) else None


def _wrong(subject: str, value: Any, expected: str) -> NoAnswer:
    return NoAnswer(f"{subject} is {value!r}; expected {expected}")


class _RemoteEavesdropper(Eavesdropper):
    """The class methods, answered by the class itself. Abstract."""

    _ask: ClassVar[Callable[..., Any]]
    _own_outcomes: ClassVar[bool]

    def __new__(cls, *_: object) -> Self:
        """Raises TypeError: this is a remote class, of a class that must not run here."""
        raise TypeError(f"{cls.__name__} runs in the eavesdropper's process alone; take Registry.imported there")

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The class's answer."""
        answer = cls._ask("mistakes", dict(given))
        if not isinstance(answer, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in answer):
            raise _wrong("mistakes()", answer, "a list of (entry, what is wrong)")
        return [(str(entry), str(sentence)) for entry, sentence in answer]

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:
        """The class's answer."""
        answer = cls._ask("streams", dict(parameters))
        if not isinstance(answer, list) or not all(isinstance(name, str) for name in answer):
            raise _wrong("streams()", answer, "names of streams")
        return tuple(answer)

    @classmethod
    def betrayed(cls, parameters: Mapping[str, Any]) -> int | None:
        """The class's answer."""
        answer = cls._ask("betrayed", dict(parameters))
        if answer is not None and (type(answer) is not int or answer < 0):
            raise _wrong("betrayed()", answer, "a slot, from 0 on, or None")
        return answer

    @classmethod
    def follows_gamma(cls, parameters: Mapping[str, Any]) -> bool:
        """The class's answer."""
        answer = cls._ask("follows_gamma", dict(parameters))
        if not isinstance(answer, bool):
            raise _wrong("follows_gamma()", answer, "True or False")
        return answer

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:
        """The class's answer, at every quality that is asked for."""
        has_outcomes = cls._ask("outcomes", dict(parameters), mu_d)
        if not has_outcomes:
            return None

        def at(mu_e: float) -> Outcomes:
            answer = cls._ask("outcomes_at", dict(parameters), mu_d, float(mu_e))
            names = [*_FRACTIONS, "initial"]
            if not isinstance(answer, dict) or sorted(answer) != sorted(names):
                raise _wrong("outcomes()", answer, f"the probabilities {', '.join(names)}")
            if not all(_is_probability(value) for value in answer.values()):
                raise _wrong("outcomes()", answer, "probabilities")
            if abs(sum_in_order(answer[name] for name in _FRACTIONS) - 1.0) > _ROUNDING:
                raise _wrong("outcomes()", answer, f"{', '.join(_FRACTIONS)} that sum to 1")
            return Outcomes(**answer)

        return at


class _RemoteTaker(_RemoteEavesdropper, PacketTaker):
    """The same for a class that uses packets as the state or ignores them. Abstract."""

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:
        """Outcomes from the two probabilities, unless the class has a theory of its own."""
        if cls._own_outcomes:
            return super().outcomes(parameters, mu_d)
        return PacketTaker.outcomes.__func__(cls, parameters, mu_d)  # type: ignore[attr-defined,no-any-return]

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:
        """The class's answer."""
        answer = cls._ask("use_probabilities", dict(parameters))
        if not isinstance(answer, list) or len(answer) != 2 or not all(map(_is_probability, answer)):
            raise _wrong("use_probabilities()", answer, "two probabilities")
        return answer[0], answer[1]


def _is_probability(value: Any) -> bool:
    number = type(value) in {int, float} and math.isfinite(value)
    return number and -_ROUNDING <= value <= 1.0 + _ROUNDING
