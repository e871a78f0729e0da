"""Runs to look at."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from simulated_run import Simulated, orbit, simulate


@pytest.fixture(scope="session")
def simulated() -> Callable[..., Simulated]:
    """`simulate`, over the marginally stable `orbit` unless told otherwise."""

    def make(slots: int = 400, *, n: int = 2, growth: float = 1.0, **options: float) -> Simulated:
        return simulate(orbit(n, growth), slots, **options)  # type: ignore[arg-type]

    return make
