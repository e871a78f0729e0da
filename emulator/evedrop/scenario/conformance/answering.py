"""The process that answers for one eavesdropper's class, so that it runs nowhere else; see `model/eavesdroppers/remote_class.py`.

It is told where modules are, then one question per line, each a list: the name of a class, the question, and arguments.
Each answer is one line. The process ends when no question comes for some seconds, and when the asking process is gone.

Source: docs/your-own/rules.md, where a class runs.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from evedrop.errors import NotRegistered
from evedrop.model import eavesdroppers
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, PacketTaker
from evedrop.model.process import Process
from evedrop.model.registry import Registry, asked, place_of
from evedrop.model.streams import Batch
from evedrop.scenario.plugins import look_in

_IDLE_SECONDS = 5.0
_PROCESSOR_SECONDS = 600  # the asking process has given up long before


def answer(folder: str | None) -> None:
    """Answer questions from standard input on standard output, which is separate from the class's own output."""
    resource.setrlimit(resource.RLIMIT_CPU, (_PROCESSOR_SECONDS, _PROCESSOR_SECONDS))
    answers = os.dup(1)
    os.dup2(2, 1)
    if folder is not None:
        look_in(folder)
    questions = SimpleQueue[bytes]()
    threading.Thread(target=_read, args=(questions,), daemon=True).start()
    with contextlib.suppress(Empty, OSError):
        while True:
            os.write(answers, _answered(questions.get(timeout=_IDLE_SECONDS)))
    os._exit(0)


def _read(questions: SimpleQueue[bytes]) -> None:
    with open(0, "rb", closefd=False) as lines:
        for line in lines:
            questions.put(line)
    os._exit(0)


def _answered(question: bytes) -> bytes:
    name, do, registry, *given = json.loads(question)
    try:
        kind: type[Eavesdropper] = _registry(registry).imported(name)
        answer: dict[str, Any] = {"is": _ASKED[do](kind, *given)}
    except NotRegistered as error:
        answer = {"not_registered": error.why}
    except BaseException as error:
        answer = {"raised": place_of(error, getattr(sys.modules.get(name.partition(":")[0]), "__file__", None))}
    try:
        return f"{json.dumps(answer)}\n".encode()
    except (TypeError, ValueError):
        return b'{"raised": "its answer is not made of numbers, texts, lists and tables"}\n'


def _registry(name: str) -> Registry[Eavesdropper]:
    registry: Registry[Eavesdropper] = {"READERS": eavesdroppers.READERS, "STRATEGIES": eavesdroppers.STRATEGIES}[name]
    return registry


def _class(kind: type[Eavesdropper]) -> dict[str, Any]:
    """The facts that do not depend on parameters."""
    takes = issubclass(kind, PacketTaker)
    inherited = PacketTaker.outcomes.__func__ if takes else None  # type: ignore[attr-defined]
    return {
        "parameters": dict(kind.parameters),
        "pools_links": bool(kind.pools_links),
        "inverts_noise": bool(kind.inverts_noise),
        "reads_leaks": bool(kind.reads_leaks),
        "tests_range": bool(kind.tests_range),
        "only_against": kind.only_against,
        "takes": takes,
        "own_outcomes": getattr(kind.outcomes, "__func__", None) is not inherited,
    }


def _outcomes_at(kind: type[Eavesdropper], parameters: Mapping[str, Any], mu_d: float, mu_e: float) -> dict[str, float]:
    outcomes_at = kind.outcomes(parameters, mu_d)
    return {} if outcomes_at is None else {name: float(value) for name, value in asdict(outcomes_at(mu_e)).items()}


def _dry_run(
    kind: type[Eavesdropper],
    strategy: str,
    parameters: Mapping[str, Any],
    scheme: Mapping[str, Any],
    process: tuple[Any, ...],
    batch: tuple[int, int, int],
) -> str | None:
    """Report what breaks in some slots of a scenario. Source: docs/your-own/rules.md, mistakes."""
    del kind  # the class of the strategy, or of the strategy it reads as
    from evedrop.model.schemes import SCHEMES  # noqa: PLC0415 - the same
    from evedrop.scenario.conformance.eavesdroppers import EavesdropperChecks  # noqa: PLC0415 - needed last
    from evedrop.scenario.conformance.problems import Problem  # noqa: PLC0415 - the same
    from evedrop.scenario.conformance.rules import how_broken  # noqa: PLC0415 - the same

    A, Q, initial_covariance, singular_noise = process
    model = Process(np.array(A), np.array(Q), np.array(initial_covariance), singular_noise)
    checks = EavesdropperChecks(
        strategy,
        eavesdroppers.STRATEGIES.imported(strategy),
        parameters,
        SCHEMES[scheme["scheme"]],
        {name: value for name, value in scheme.items() if name != "scheme"},
    )
    return how_broken(checks.at_first, Problem(model, Batch(*batch)))


_ASKED: Mapping[str, Callable[..., Any]] = {
    "class": _class,
    "mistakes": asked,
    "streams": lambda kind, parameters: _streams(kind.streams(parameters)),
    "betrayed": lambda kind, parameters: kind.betrayed(parameters),
    "follows_gamma": lambda kind, parameters: kind.follows_gamma(parameters),
    "outcomes": lambda kind, parameters, mu_d: kind.outcomes(parameters, mu_d) is not None,
    "outcomes_at": _outcomes_at,
    "use_probabilities": lambda kind, parameters: [float(one) for one in kind.use_probabilities(parameters)],
    "dry_run": _dry_run,
}


def _streams(streams: Any) -> list[Any]:
    if isinstance(streams, str):
        raise TypeError(f"streams() is {streams!r}; expected a tuple of names of streams")
    return list(streams)
