"""Every process on a host of its own; skipped, which is said loudly, where network namespaces cannot be made."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.hosts.lan import prove, take_away_leftovers
from tests.privileged import CannotRun, prepare, skip

PACKAGES = {"ip": "iproute2", "ss": "iproute2", "tcpdump": "tcpdump"}
"""Command → the Debian package that has it."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests of this folder are of the mark `hosts`, which `make test` leaves out."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.hosts)


@pytest.fixture(scope="session", autouse=True)
def _namespaces() -> None:
    """Namespaces can be made here, and none is left of tests that were killed."""
    try:
        prepare(PACKAGES)
        prove()
    except CannotRun as error:
        skip(error)
    take_away_leftovers()
