"""Runs to look at."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any
from unittest.mock import patch

import pytest

from evedrop.show.view import recording
from tests.conftest import LIMIT
from tests.show.view.simulated_run import Simulated, orbit, simulate


@pytest.fixture(scope="session", autouse=True)
def unhurried() -> Iterator[None]:
    """However busy the machine is, it gets the time to finish the file of a recording."""
    with patch.object(recording, "FILE_TIMEOUT", LIMIT):
        yield


@pytest.fixture(scope="session")
def simulated() -> Callable[..., Simulated]:
    """`simulate`, over the marginally stable `orbit` unless told otherwise."""

    def make(slots: int = 400, *, n: int = 2, growth: float = 1.0, **options: Any) -> Simulated:
        return simulate(orbit(n, growth), slots, **options)

    return make
