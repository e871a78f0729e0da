"""What stands for the module `zenoh` in the simulated world, and what a nemesis can do to its connections.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import errno
import math
import os
import socket
import ssl
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self, final

import zenoh

from evedrop.system.world import Address
from evedrop.virtual import notes
from evedrop.virtual.scheduler import VirtualScheduler, VirtualTask
from evedrop.virtual.zenoh import certificates
from evedrop.virtual.zenoh.access import Peer, section
from evedrop.virtual.zenoh.handlers import Callback, FifoChannel, RingChannel
from evedrop.virtual.zenoh.session import VirtualSession
from evedrop.virtual.zenoh.transport import End, VirtualConnection

_OPEN_SECONDS = 2e-3
"""The mean time that it takes to open a session."""
_OPEN_MS, _POLL_SECONDS = 10_000, 0.05
_SLOW = 300.0
"""By which a slow connection takes longer."""
_NEVER_SECONDS = 86_400.0
_UNKNOWN = "unknown"
"""The name of a host that no host knows."""


@final
class _Link:
    """A connection with a router, on which nothing is said, or with another program."""

    def __init__(self, scheduler: VirtualScheduler, certificate: bytes | None, says: bytes | None = None) -> None:
        """certificate: that of the router at its other end, if it has one.

        says: what another program says there, nothing if it hangs up.
        """
        self._scheduler, self._certificate, self._says, self._seconds = scheduler, certificate, says, 0.0

    def settimeout(self, seconds: float) -> None:
        """How long to wait for something."""
        self._seconds = seconds

    def recv(self, most: int) -> bytes:
        """A router says nothing to who says nothing."""
        if self._says is not None:
            return self._says[:most]
        self._scheduler.sleep(self._seconds)
        raise TimeoutError

    def certificate(self, trust: ssl.SSLContext, host: str, now: float) -> bytes:
        """What the router shows. Raises SSLCertVerificationError, or ConnectionResetError if it shows nothing."""
        if self._certificate is None:
            raise ConnectionResetError(errno.ECONNRESET, os.strerror(errno.ECONNRESET))
        certificates.check(self._certificate, trust, host, now)
        return self._certificate

    def close(self) -> None:
        """Close it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@final
class VirtualScout:
    """Looks for peers until it is stopped."""

    def __init__(self) -> None:
        self.is_stopped = False

    def stop(self) -> None:
        """Look no more."""
        self.is_stopped = True


@final
class VirtualZenoh:
    """The simulated Zenoh: its sessions, and the network between them."""

    Config, ZError, ZBytes, KeyExpr = zenoh.Config, zenoh.ZError, zenoh.ZBytes, zenoh.KeyExpr
    SampleKind, CongestionControl, Reliability = zenoh.SampleKind, zenoh.CongestionControl, zenoh.Reliability
    handlers = SimpleNamespace(FifoChannel=FifoChannel, RingChannel=RingChannel, Callback=Callback)

    def __init__(self, scheduler: VirtualScheduler) -> None:
        self.scheduler = scheduler
        self._routers: dict[str, VirtualSession] = {}
        """Endpoint → the session that listens there."""
        self._sessions: list[VirtualSession] = []
        self._cut: dict[str, float] = {}
        """Process that cannot connect → until when."""
        self._unplugged: dict[str, float] = {}
        """Host that is cut off from all others → until when."""
        self._confused: set[str] = set()
        self._changes: dict[str, Callable[[bytes], bytes | None]] = {}
        """Process → what becomes of the next message to it."""
        self._occupied: dict[Address, bytes] = {}
        """Address at which another program listens → what that says."""
        self.listeners: list[Callable[[str, bytes], object]] = []
        """Are called with each message that arrives at a session, and the name of its process."""
        scheduler.on_stop = self._stopped

    # What programs call

    @staticmethod
    def init_log_from_env_or(level: str) -> None:
        """There is no log."""

    def open(self, config: zenoh.Config) -> VirtualSession:
        """Open a session. Raises ZError if it cannot listen or connect."""
        scheduler = self.scheduler
        thread = scheduler.current
        assert thread is not None  # noqa: S101 - only programs open sessions
        scheduler.sleep(scheduler.random.expovariate(1.0 / _OPEN_SECONDS))
        session = VirtualSession(self, thread.task, config)
        self._sessions.append(session)
        try:
            for place in self._listens_at(session, config):
                if place in self._routers or _address(place) in self._occupied:
                    raise zenoh.ZError(f"{place} is in use")
                self._routers[place] = session
                session.places.append(place)
            places = section(config, "connect/endpoints") or []
            for place in places:
                self._wait_while_suspended(place, (section(config, "transport/unicast/open_timeout") or _OPEN_MS) / 1e3)
                connected = self._connect(session, place)
                wait = section(config, "connect/timeout_ms") or 0
                deadline = scheduler.now + wait / 1e3 if wait >= 0 else math.inf
                while not connected and not session.router and scheduler.now < deadline:
                    scheduler.sleep(session.again)
                    connected = self._connect(session, place)
                if not connected and not session.router:
                    raise zenoh.ZError(f"cannot connect to {place}")
                session.connects_to = place
                if not connected:
                    self.connect_again(session)
        except zenoh.ZError:
            session.close()
            raise
        return session

    def scout(self, heard: Callable[[Any], object], what: str, config: zenoh.Config) -> VirtualScout:
        """Call a function with each peer that answers multicast scouting, until it is stopped; what: "peer"."""
        del what, config
        scheduler, scout = self.scheduler, VirtualScout()
        assert scheduler.current is not None  # noqa: S101 - only programs scout

        def ask() -> None:
            for session in [*self._sessions]:
                scheduler.sleep(scheduler.random.expovariate(1.0 / _OPEN_SECONDS))
                if session.answers_scouts and not scout.is_stopped:
                    heard(SimpleNamespace(zid=session.zid))

        scheduler.thread("scouts", ask, scheduler.current.task).start()
        return scout

    def dial(self, address: Address) -> _Link:
        """Connect to whatever listens at an address. Raises OSError if nothing does."""
        thread = self.scheduler.current
        assert thread is not None  # noqa: S101 - only programs dial
        self.scheduler.sleep(self.scheduler.random.expovariate(1.0 / _OPEN_SECONDS))
        _expect_known(address)
        if address in self._occupied:
            return _Link(self.scheduler, None, self._occupied[address])
        router = next((router for place, router in self._routers.items() if _address(place) == address), None)
        if router is None or self._is_cut(thread.task, router.task):
            raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
        return _Link(self.scheduler, router.certificate)

    def expect_free(self, address: Address) -> None:
        """Raise OSError if something listens at an address, or if nobody knows it."""
        _expect_known(address)
        if address in self._occupied or any(_address(place) == address for place in self._routers):
            raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))

    # Connections

    @staticmethod
    def _listens_at(session: VirtualSession, config: zenoh.Config) -> list[str]:
        if not session.router:
            return []
        places = section(config, "listen/endpoints") or []
        return list(places["router"] if isinstance(places, dict) else places)

    def _is_cut(self, task: VirtualTask, router: VirtualTask) -> bool:
        unplugged = [self._unplugged.get(end.host, 0.0) for end in (task, router) if task.host != router.host]
        return max(self._cut.get(task.name, 0.0), *unplugged, 0.0) > self.scheduler.now

    def _wait_while_suspended(self, place: str, seconds: float) -> None:
        """The system takes connections for a router that is suspended; it answers once it goes on."""
        deadline = self.scheduler.now + seconds
        while self.scheduler.now < deadline and (router := self._routers.get(place)) and router.task.stopped:
            self.scheduler.sleep(_POLL_SECONDS)

    def _connect(self, session: VirtualSession, place: str) -> bool:
        """Connect a session with the router at an endpoint; returns whether it is connected."""
        router = self._routers.get(place)
        if router is None or router is session or router.task.stopped or self._is_cut(session.task, router.task):
            return False
        if not router.access.knows(session.user, session.password):
            return False
        if any(end.peer.zid == session.zid for end in router.ends):  # it has not noticed a lost connection yet
            return False
        mine = End(session, Peer(router.zid, None), to_router=True)
        theirs = End(router, Peer(session.zid, session.user, session.peer), to_router=session.router)
        VirtualConnection(self.scheduler, mine, theirs)
        self.scheduler.note(notes.CONNECTS, session.name, router.name)
        session.ends.append(mine)
        router.ends.append(theirs)
        session.greet(mine)
        router.greet(theirs)
        return True

    def connect_again(self, session: VirtualSession) -> None:
        """Try to connect a session that has lost its router: at once, and then from time to time, until it is closed."""

        def attempt() -> None:
            if session.is_closed() or not session.task.alive or session.connects_to is None:
                return
            if session.task.stopped or not self._connect(session, session.connects_to):
                try_after(session.again)

        def try_after(seconds: float) -> None:
            if seconds < _NEVER_SECONDS:
                self.scheduler.after_seconds(seconds, attempt)

        try_after(self.scheduler.random.expovariate(1.0 / _OPEN_SECONDS))

    def close_sessions(self, task: VirtualTask) -> None:
        """Close all sessions of a process."""
        for session in [session for session in self._sessions if session.task is task]:
            session.close()

    def forget(self, session: VirtualSession) -> None:
        """A session has ended: nobody listens at its endpoints."""
        for place in session.places:
            self._routers.pop(place, None)
        if session in self._sessions:
            self._sessions.remove(session)

    def _stopped(self, task: VirtualTask) -> None:
        """A process is suspended: after the lease, the others take it for gone."""
        for session in self._sessions:
            if session.task is task:
                self.scheduler.after_seconds(session.lease, partial(self._expire, session))

    def _expire(self, session: VirtualSession) -> None:
        if session.task.stopped and self.scheduler.now >= session.task.since + session.lease:
            for end in [*session.ends]:
                end.connection.close("nothing came for the lease")

    # What a nemesis does

    def _connections(self, process: str) -> list[VirtualConnection]:
        return [end.connection for session in self._sessions if session.name == process for end in session.ends]

    def _has_session(self, process: str) -> bool:
        return any(session.name == process for session in self._sessions)

    @property
    def clients(self) -> list[str]:
        """The processes that have a session and are no router."""
        return [*dict.fromkeys(session.name for session in self._sessions if not session.router)]

    def cut(self, process: str, seconds: float | None) -> bool:
        """Cut the connections of a process, which cannot be made again, nor for the first time, for some time, or for good."""
        self._keep_away(process, seconds)
        for connection in self._connections(process):
            connection.close("is cut")
        return True

    def heal(self, process: str) -> None:
        """Let a process connect again."""
        self._cut.pop(process, None)

    def _keep_away(self, process: str, seconds: float | None) -> None:
        """Let a process connect with nobody for some time, or for good, and for no less than was said before."""
        self._cut[process] = max(self._cut.get(process, 0.0), self.scheduler.later(seconds))

    def freeze(self, process: str, seconds: float | None) -> bool:
        """Let nothing through the connections of a process for some time, or for good."""
        connections = self._connections(process)
        for connection in connections:
            connection.freeze(seconds)
        if connections:
            self._keep_away(process, seconds)
        return bool(connections)

    def clog(self, router: str) -> bool:
        """Let nothing through the connections of a router for good, though both ends of each take the other for alive."""
        connections = self._connections(router)
        for connection in connections:
            connection.freeze(None, noticed=False)
        return bool(connections)

    def unplug(self, host: str, seconds: float | None) -> None:
        """Let nothing through between the processes of a host and all others for some time, or for good."""
        self._unplugged[host] = max(self._unplugged.get(host, 0.0), self.scheduler.later(seconds))
        for session in self._sessions:
            for end in session.ends if session.task.host == host else ():
                if end.other.session.task.host != host:
                    end.connection.freeze(seconds)

    def slow(self, process: str, seconds: float | None) -> bool:
        """Make everything on the connections of a process take longer for some time, or for good."""
        connections = self._connections(process)
        for connection in connections:
            connection.slow(_SLOW, seconds)
        return bool(connections)

    def confuse(self, process: str) -> bool:
        """Let the next message to a process arrive at the subscriber of another key."""
        if hit := self._has_session(process):
            self._confused.add(process)
        return hit

    def confused(self, session: VirtualSession) -> bool:
        """Whether the message that a session gets now is to arrive at the wrong subscriber."""
        hit = session.name in self._confused
        self._confused.discard(session.name)
        return hit

    def change(self, process: str, change: Callable[[bytes], bytes | None]) -> bool:
        """Let the next message to a process for which `change` has another one be that one when it arrives."""
        if hit := self._has_session(process):
            self._changes[process] = change
        return hit

    def changed(self, session: VirtualSession, message: bytes) -> bytes:
        """What arrives at a session of a message."""
        for listener in self.listeners:
            listener(session.name, message)
        change = self._changes.get(session.name)
        other = None if change is None else change(message)
        if other is None:
            return message
        del self._changes[session.name]
        return other

    def occupy(self, place: str, says: bytes = b"") -> None:
        """Let another program listen at an endpoint, so that no router can; it hangs up unless it says something."""
        self._occupied[_address(place)] = says


def _address(place: str) -> Address:
    protocol, _, where = place.partition("/")
    if protocol == "unixsock-stream":
        return Path(where)
    host, _, port = where.rpartition(":")
    return host, int(port)


def _expect_known(address: Address) -> None:
    if isinstance(address, tuple) and address[0] == _UNKNOWN:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
