"""A folder with the classes of the tutorial."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from evedrop.model.eavesdroppers import REMOTE_CALLS
from tests.conftest import Evedrop
from tests.scenario.conformance.own_classes import BLOCK, PAGE


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


@pytest.fixture
def tutorial(evedrop: Evedrop) -> Evedrop:
    """The command in a folder with the files of the tutorial."""
    for name, text in BLOCK.findall(PAGE.read_text(encoding="utf-8")):
        (evedrop.folder / name).write_text(text, encoding="utf-8")
    return evedrop
