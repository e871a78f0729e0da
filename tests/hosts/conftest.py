"""Every process on a host of its own; skipped, with the reason, where network namespaces cannot be made."""

from __future__ import annotations

from pathlib import Path

import pytest
from lan import take_away_leftovers, why_not


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests of this folder are of the mark `hosts`, which `make test` leaves out."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.hosts)


@pytest.fixture(scope="session", autouse=True)
def _namespaces() -> None:
    """Namespaces can be made here, and none is left of tests that were killed."""
    reason = why_not()
    if reason is not None:
        pytest.skip(reason)
    take_away_leftovers()
