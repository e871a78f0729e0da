"""How a run in lock-step saves wake-ups: bursts of deliveries, and few threads."""

from __future__ import annotations

from typing import Any

import pytest

from evedrop.live.network.router import Burst
from evedrop.system.environment import lock_step_environment


def test_a_burst_passes_on_everything_in_order() -> None:
    """Nothing before it is told to, all of it then, and nothing twice."""
    put: list[bytes] = []
    burst = Burst(put.append)
    for payload in (b"a", b"b"):
        burst.hold(payload, 0.0)
    assert put == []
    burst.flush()
    burst.flush()
    burst.hold(b"c", 0.0)
    burst.flush()
    assert put == [b"a", b"b", b"c"]


@pytest.mark.parametrize("role", ["router", "relay", "sensor", "controller"])
def test_nobody_who_passes_messages_on_does_it_on_the_thread_that_receives(role: str) -> None:
    """A router or relay that waited for a full queue on its only thread would wait for itself, until it is given up."""
    result: dict[str, Any] = lock_step_environment(role)
    assert ("tx: (worker_threads: 1)" in result["ZENOH_RUNTIME"]) == (role in {"router", "relay"})
