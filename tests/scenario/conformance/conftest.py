"""A folder with the classes of the tutorial."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from evedrop.model.eavesdroppers import REMOTE_CALLS, remote_class
from evedrop.scenario.conformance import answering
from evedrop.scenario.plugins import look_in
from tests.conftest import Evedrop
from tests.scenario.conformance.own_classes import BLOCK, TEXT


@pytest.fixture
def imports_forgotten(tmp_path: Path) -> Iterator[None]:
    """Modules that a test imports from its folder are not visible to other tests."""
    before = list(sys.path)
    REMOTE_CALLS.forget()
    yield
    sys.path[:] = before
    REMOTE_CALLS.forget()
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


class AnswersHere:
    """In the place of a process that answers for a class: the class answers in this one."""

    def __init__(self, folder: str | None, seconds: float) -> None:
        del seconds
        if folder is not None:
            look_in(folder)

    def answer(self, question: str) -> dict[str, Any]:
        """The class's answer to a question."""
        answer: dict[str, Any] = json.loads(answering._answered(question.encode()))
        return answer

    def end(self) -> None:
        """There is nothing to end."""


@pytest.fixture
def asked_here(imports_forgotten: None) -> Iterator[None]:
    """Classes of anybody's own answer in this process, which takes a hundredth of the time."""
    with patch.object(remote_class, "_Child", AnswersHere):
        yield


@pytest.fixture
def tutorial(evedrop: Evedrop) -> Evedrop:
    """The command in a folder with the files of the tutorial."""
    for name, text in BLOCK.findall(TEXT):
        (evedrop.folder / name).write_text(text, encoding="utf-8")
    return evedrop
