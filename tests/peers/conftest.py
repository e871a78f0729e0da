"""A stage for each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import evedrop.peers.following
import evedrop.peers.sensor
from evedrop.live.protocol import codec as wire
from tests.peers.stage import Stage


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    """A stage in the place of the network."""
    one = Stage()
    monkeypatch.setattr(evedrop.peers.following, "Session", one.session)
    monkeypatch.setattr(evedrop.peers.sensor, "Session", one.session)
    yield one
    one.commands.put(wire.control("end"))
