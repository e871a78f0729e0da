"""A connection that loses its session: whatever becomes of the lost one, another is opened."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import zenoh

from evedrop.live.network.connection import Connection
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
