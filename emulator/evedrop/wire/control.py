"""Lets an operator steer a wire while it runs: `evedrop link`, `partition`, `heal` and `status`, as for a run.

The operator has a router session of its own on this machine, so no program at a side can steer the wire.

Source: docs/wire.md, control.
"""

from __future__ import annotations

import contextlib
import json
import secrets
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self, final

import zenoh

from evedrop.errors import MalformedMessage, ScenarioError
from evedrop.live.network.access import Grant, access_control
from evedrop.live.network.control_file import Control, remove_control
from evedrop.live.network.opening import open_session
from evedrop.live.network.operator import Answer
from evedrop.live.network.router_users import users_file
from evedrop.live.protocol.envelope import enclosed, payload_of
from evedrop.live.protocol.keys import RunKeys, ZenohConfig
from evedrop.live.protocol.requests import LinkRequest, OperatorRequest, StatusRequest, read_request
from evedrop.live.protocol.wire_status import WireLinkStatus, WireStatus
from evedrop.names import OBSERVER, OPERATOR
from evedrop.system.output import warn
from evedrop.system.ports import free_port
from evedrop.wire.conductor import WireConductor
from evedrop.wire.journal import WireJournal
from evedrop.wire.relay import WireRelay
from evedrop.wire.scorekeeper import WireScorekeeper

_ATTEMPTS = 5  # another program may take a port between its choice and its use
_LARGEST = 2**20


@final
class WireControl:
    """The operator's access to a running wire, for the time of a `with` block."""

    def __init__(
        self,
        folder: Path,
        relay: WireRelay,
        conductor: WireConductor,
        scorekeeper: WireScorekeeper,
        journal: WireJournal,
        events: Sequence[str],
    ) -> None:
        """folder: the wire's; events: the events so far, a line each, to which lines may be added."""
        self._folder, self._relay, self._conductor = folder, relay, conductor
        self._scorekeeper, self._journal, self._events = scorekeeper, journal, events
        self._run = f"wire-{secrets.token_hex(8)}"
        self._key = RunKeys(self._run).control(OBSERVER)
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            password = secrets.token_urlsafe(24)
            session, router = self._open(password)
            stack.enter_context(session)
            session.declare_queryable(self._key, self._answer)
            stack.callback(remove_control, self._folder)
            try:
                Control(self._run, router, OPERATOR, password).write(self._folder)
            except OSError as error:
                warn(f"the wire cannot be steered, because control.json cannot be written ({error})")
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _open(self, password: str) -> tuple[zenoh.Session, str]:
        for attempt in range(_ATTEMPTS):
            router = f"tcp/127.0.0.1:{free_port()}"
            with users_file({OPERATOR: password}) as users:
                config = _router_config(self._key, router, users)
                try:
                    return open_session(zenoh.Config.from_json5(json.dumps(config))), router
                except zenoh.ZError:
                    if attempt == _ATTEMPTS - 1:
                        raise
        raise AssertionError

    def _answer(self, query: zenoh.Query) -> None:
        """Carry out a request. Zenoh only logs what is raised here."""
        with query:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            message = payload_of(self._key, payload)
            if message is None:
                return
            try:
                answer = self._carry_out(read_request(self._key, message))
            except MalformedMessage as error:
                answer = Answer(refused=(str(error),))
            except ScenarioError as error:
                answer = Answer(refused=tuple(error.mistakes))
            except Exception as error:  # the operator must not wait in vain
                answer = Answer(refused=(f"the wire failed to do so: {error!r}",))
            query.reply(self._key, enclosed(self._key, answer.pack()))

    def _carry_out(self, request: OperatorRequest) -> Answer:
        if isinstance(request, StatusRequest):
            return Answer(status=self._status())
        if not isinstance(request, LinkRequest):
            why = "programs that know nothing of a wire do not wait for it"
            return Answer(
                refused=(f"a wire cannot be held: {why}; `evedrop link` cuts a link, `evedrop partition` two sides",)
            )
        healed, joined = request.event.get("heal"), request.event.get("join")
        if isinstance(healed, str):
            return Answer(0, self._conductor.end_cut(healed))
        if isinstance(joined, list) and len(joined) == 2:
            return Answer(0, self._conductor.end_partition(*map(str, joined)))
        return Answer(0, self._conductor.change(request.event))

    def _status(self) -> WireStatus:
        self._journal.flush()
        states = self._relay.links
        links = {
            name: WireLinkStatus(heard, delivered, states[name].cut)
            for name, (heard, delivered) in self._scorekeeper.counts().items()
        }
        sides = {name: list(endpoints) for name, endpoints in self._relay.endpoints.items()}
        whole = self._journal.incomplete_since is None
        complete = "complete" if whole else "incomplete, because its folder could not be written"
        bypasses = [event.line for event in self._journal.events if event.bypass]
        return WireStatus(self._conductor.seconds, sides, links, list(self._events), complete, bypasses)


def _router_config(key: str, listen: str, users: Path) -> ZenohConfig:
    """The configuration of a router to which only the operator may connect, and only to ask at one key."""
    return {
        "mode": "router",
        "listen": {"endpoints": [listen], "exit_on_failure": True},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "link": {"rx": {"max_message_size": _LARGEST}},
            "auth": {"usrpwd": {"dictionary_file": str(users)}},
        },
        "access_control": access_control([Grant(OPERATOR, writes=(), reads=(), token=None, asks=(key,))]),
    }
