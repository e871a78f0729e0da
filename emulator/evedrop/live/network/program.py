"""The states that a program outside the run publishes, on a Zenoh session of its own.

Source: docs/programs.md.
"""

from __future__ import annotations

from collections import deque
from typing import Self, final

import zenoh

from evedrop.errors import BriefError, RunError
from evedrop.live.network.connecting import open_session
from evedrop.live.network.process_session import LEAST_SECONDS
from evedrop.live.protocol.brief import ProgramPart
from evedrop.live.protocol.keys import ZenohConfig
from evedrop.live.protocol.state_message import MOST_BYTES, read_state
from evedrop.model.process import Floats
from evedrop.system.world import world

_MOST_WAITING = 100_000
_MOST_WAITING_BYTES = 256 * 2**20
_CONNECT_SECONDS = 30.0


def program_config(entry: ProgramPart) -> ZenohConfig:
    """Zenoh configuration of the session: one endpoint, and no scouting for others."""
    scouting = {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}}
    if entry.listen is not None:
        listen = {"endpoints": [entry.listen], "exit_on_failure": True}
        return {"mode": "router", "listen": listen, "scouting": scouting}
    connect = {
        "endpoints": [entry.connect],
        "timeout_ms": int(_CONNECT_SECONDS * 1000),
        "exit_on_failure": True,
        "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5},
    }
    return {"mode": "client", "connect": connect, "scouting": scouting}


@final
class ProgramStates:
    """Takes one state for each slot from the messages of a program; a context manager.

    newest: whether a slot takes the newest state, and older ones are left out; otherwise each message is the state of a slot.
    patience: seconds for which the program may be silent.
    """

    def __init__(self, entry: ProgramPart, newest: bool, patience: float) -> None:
        """Raises BriefError if there is no router at the endpoint, or if the endpoint cannot be listened on."""
        self._entry = entry
        self._patience = max(patience, LEAST_SECONDS)
        self._newest = newest
        self._heard: deque[bytes] = deque()
        self._bytes = 0
        """Of the messages that wait."""
        self._changed = world().condition()
        self._waited = 0.0
        where = entry.listen or entry.connect
        try:
            self._session = open_session(program_config(entry))
        except zenoh.ZError as error:
            problem = (
                "cannot listen at" if entry.listen is not None else f"cannot connect within {_CONNECT_SECONDS:.0f} s to"
            )
            raise BriefError(
                f"process.zenoh: the sensor {problem} {where} ({error}); start the router there first, or give another endpoint"
            ) from error
        self._subscriber = self._session.declare_subscriber(entry.key, self.hear)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()

    def hear(self, sample: zenoh.Sample) -> None:
        """Keep a message; called on a thread of Zenoh's. Deletions, and messages of another key, are not states."""
        if sample.kind != zenoh.SampleKind.PUT or str(sample.key_expr) != self._entry.key:
            return
        large = len(sample.payload) > MOST_BYTES
        payload = bytes(MOST_BYTES + 1) if large else sample.payload.to_bytes()
        with self._changed:
            if self._newest:
                self._heard.clear()
                self._bytes = 0
            if not self._too_many:
                self._heard.append(payload)
                self._bytes += len(payload)
            self._changed.notify()

    @property
    def _too_many(self) -> str:
        """What waits too much, in words; empty while there is room for one message more."""
        if len(self._heard) > _MOST_WAITING:
            return f"more than {_MOST_WAITING} states wait"
        return f"states in more than {_MOST_WAITING_BYTES} bytes wait" if self._bytes > _MOST_WAITING_BYTES else ""

    @property
    def waited(self) -> float:
        """Seconds that the last slot waited for its state."""
        return self._waited

    def take(self, slots: range) -> Floats:
        """The state of one slot, as deviations from the reference, (1, n).

        Raises RunError if the program is silent for too long, sends what is not a state, or sends faster than slots go by.
        """
        k, began = slots.start, world().monotonic()
        with self._changed:
            there = self._changed.wait_for(lambda: self._heard, self._patience)
            self._waited = world().monotonic() - began
            if too_many := self._too_many:
                raise RunError(
                    f"{self._about}: {too_many} at slot {k}: the program sends faster than the run goes; give a pace, so that "
                    "each slot takes the newest state"
                )
            payload = self._heard.popleft() if there else None
            self._bytes -= len(payload or b"")
        if payload is None:
            problem = "no state came" if k == 0 else f"no state came after that of slot {k - 1}"
            raise RunError(
                f"{self._about}: {problem} for {self._patience:.0f} s; check that its program runs and publishes this key, or "
                "raise longest_outage"
            )
        try:
            return read_state(payload, self._entry)[None]
        except ValueError as error:
            raise RunError(f"{self._about}: the message of slot {k} {error}") from error

    @property
    def _about(self) -> str:
        return f"{self._entry.key} at {self._entry.listen or self._entry.connect}"
