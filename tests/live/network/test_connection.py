"""A connection that loses its session: whatever becomes of the lost one, another is opened."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import zenoh

from evedrop.live.network import connection
from evedrop.live.network.connection import Connection, RecorderWatchdog
from tests.conftest import wait_until


class Session:
    """As much of a Zenoh session as a connection uses; its end can be made to fail as Zenoh's does."""

    def __init__(self, closes: bool) -> None:
        self._closes = closes
        self._heard: Any = None
        self.ended = threading.Event()
        self.info = SimpleNamespace(
            declare_transport_events_listener=lambda heard: setattr(self, "_heard", heard),
            routers_zid=lambda: ["router"],
        )

    def lose(self) -> None:
        """Tell the connection that the router is gone."""
        self._heard(SimpleNamespace(kind=zenoh.SampleKind.DELETE))

    def close(self) -> None:
        """End, or fail to do so in time."""
        self.ended.set()
        if not self._closes:
            raise zenoh.ZError("close operation timed out!")

    def is_closed(self) -> bool:
        """Whether the end was asked for."""
        return self.ended.is_set()


def test_a_session_that_cannot_be_closed_is_replaced_all_the_same() -> None:
    """A router that is stopped answers nothing, so that Zenoh gives up closing; the thread that keeps us connected lives on."""
    first, second = Session(closes=False), Session(closes=False)
    changes: list[bool] = []
    connection = Connection(first, lambda: second, changes.append)  # type: ignore[arg-type,return-value]
    first.lose()
    wait_until(lambda: changes == [False, True], "another session")
    assert connection.session is second  # type: ignore[comparison-overlap]
    assert first.is_closed()
    connection.close()
    assert second.is_closed()


@pytest.mark.parametrize(
    ("longest", "absent", "ends"), [(0.0, 1, False), (0.0, 2, True), (0.5, 3, False), (0.5, 4, True)]
)
def test_a_recorder_is_gone_only_if_it_is_for_long(
    longest: float, absent: int, ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the first step in which it is not there, nobody knows for how much of it it was gone."""
    monkeypatch.setattr(connection, "_STEP_SECONDS", 0.25)
    there, ended, over = iter([True, *[False] * absent, True]), list[int](), Mock()
    over.wait = lambda _: over.set.called
    monkeypatch.setattr(connection, "world", lambda: Mock(event=lambda: over, process=Mock(exit=ended.append)))
    watchdog = RecorderWatchdog(Mock(process="smart", flow=Mock(longest_outage=longest)), lambda: True)

    def reached() -> bool:
        now = next(there, None)
        if now is None:
            watchdog.release()
        return now is not False

    watchdog._watch(reached, 600.0)
    assert ended == ([3] if ends else [])
