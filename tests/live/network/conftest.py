"""Benches: a router process of a real brief with everybody else played by the test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.live.network.bench import Bench, bench_of, small_network


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """Makes benches of the small scenario with changes."""
    with ExitStack() as stack:

        def make(**changes: Any) -> Bench:
            folder = tmp_path / str(len(list(tmp_path.iterdir())))
            folder.mkdir()
            return stack.enter_context(bench_of(small_network(**changes), folder))

        yield make
