"""What one process has on the network: how it connects, what it declares, when it is ready, how it ends.

Nothing here relies on the transport not to lose: it blocks when full, and what goes down with a connection is seen as a gap
in the slot numbers that every message carries, and sent again. A process whose connection is lost opens another session
and declares all of it there; each message names its key, and what arrives under another key is dropped.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Protocol, Self

import zenoh

from evedrop.errors import BriefError, Gap, MalformedMessage, RunError
from evedrop.live.network.connecting import RouterAddress, Waiting, connected, endpoint_of
from evedrop.live.network.connection import Connection
from evedrop.live.network.container_heartbeat import HeartbeatFile
from evedrop.live.network.declared import Funnel, Inbox, Outlet, Question, Questions, Watch
from evedrop.live.network.launcher_watch import when_launcher_is_gone
from evedrop.live.network.lifeline import Lifeline
from evedrop.live.network.mailbox import allowance
from evedrop.live.network.resending import ReplayBuffer
from evedrop.live.protocol.brief import Brief, Identity
from evedrop.live.protocol.codec import Reader, over, refusal
from evedrop.live.protocol.envelope import Dropped
from evedrop.live.protocol.keys import RunKeys, reader_of
from evedrop.live.protocol.message_limits import low_pass
from evedrop.live.protocol.whereabouts import Place
from evedrop.names import OBSERVER, ROUTER

READY_SECONDS = 30.0
_POLL_SECONDS = 0.004
_LEASE_SECONDS = 4.0  # a connection over which nothing comes for so long is lost
_HEARD_SECONDS = 2.0  # for readers to be found again once a connection is back
_NEVER_MS = 86_400_000
_ANSWER_BYTES = 64 * 2**20  # for the operator
_WINDOWS = 8  # that an inbox has room for: what was sent again in some rounds waits there too
_LOGGED = "error,zenoh_transport::unicast::establishment::open=off"  # that we are not let in we say ourselves


def _transport(identity: Identity | None, largest: int, listens: bool = False) -> dict[str, Any]:
    # A full queue waits a minute, not five seconds, before it gives a reader up: the window bounds what can be under way.
    wait = {"block": {"wait_before_close": 60_000_000}}
    link: dict[str, Any] = {
        "tx": {"lease": int(_LEASE_SECONDS * 1000), "queue": {"congestion_control": wait}},
        "rx": {"buffer_size": 1 << 20, "max_message_size": largest},
    }
    if identity is not None:
        from evedrop.live.network.certificates import tls_section  # noqa: PLC0415 - 50 ms that most runs need not

        link |= {"protocols": ["tls"], "tls": tls_section(identity, listens)}
    # Shared memory would put what the router sends to one receiver into the memory of all.
    return {"link": link, "shared_memory": {"enabled": False}}


class Credentials(Protocol):
    """Where the router is, and who asks to be let in: a brief, or the operator's control file."""

    @property
    def run(self) -> str:
        """Name of the run."""

    @property
    def router(self) -> str:
        """Zenoh endpoint."""

    @property
    def user(self) -> str:
        """Its user."""

    @property
    def password(self) -> str:
        """The user's."""

    @property
    def identity(self) -> Identity | None:
        """Its certificate, if the router takes any."""


def client_config(entry: Credentials) -> dict[str, Any]:
    """Configuration of everybody but the router: one connection, to it, and no other peer is looked for."""
    largest = entry.flow.largest_message if isinstance(entry, Brief) else _ANSWER_BYTES
    auth = {"usrpwd": {"user": entry.user, "password": entry.password}}
    return {
        "mode": "client",
        "connect": {
            "endpoints": [entry.router],
            "timeout_ms": 0,
            "exit_on_failure": True,
            "retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {**_transport(entry.identity, largest), "auth": auth},
    }


def door_of(entry: Credentials) -> RouterAddress:
    """The way in for a brief, or for the operator."""
    return RouterAddress(entry.router, entry.run, client_config(entry), entry.identity, entry.user)


def _once(door: RouterAddress) -> zenoh.Config:
    """The configuration of a session that is closed when its connection is lost: Zenoh is to connect it once at most."""
    config = dict(door.config)
    config["connect"] = {**config["connect"], "retry": {"period_init_ms": _NEVER_MS, "period_max_ms": _NEVER_MS}}
    config["transport"] = {**config["transport"], "unicast": {"open_timeout": int(_LEASE_SECONDS * 1000)}}
    return zenoh.Config.from_json5(json.dumps(config))


def router_config(brief: Brief, users_file: str, access: dict[str, Any], listen: str) -> dict[str, Any]:
    """Configuration of a router: it listens, asks for user and password, and drops what is not granted or too large."""
    transport = _transport(brief.identity, brief.flow.largest_message, listens=True)
    return {
        "mode": "router",
        **({"id": brief.part["zid"]} if brief.role == "router" and brief.part["zid"] is not None else {}),
        "listen": {"endpoints": [listen], "exit_on_failure": True},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {**transport, "auth": {"usrpwd": {"dictionary_file": users_file}}},
        "access_control": access,
        "low_pass_filter": low_pass(brief.run, brief.part["limits"]),
    }


def _listening(listen: str, identity: Identity | None, config: dict[str, Any]) -> zenoh.Session:
    """A router's session. Raises BriefError if it cannot listen where its brief says."""
    endpoint = endpoint_of(listen, identity)
    try:
        endpoint.try_to_listen()
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except socket.gaierror as error:
        raise BriefError(
            f"the host of {listen} is not known here ({error.strerror}); write it into /etc/hosts, or write the "
            f"briefs again with --listen {endpoint.protocol}/0.0.0.0:{endpoint.port} and --connect"
        ) from error
    except OSError as error:
        other = f"--listen {endpoint.protocol}/HOST:PORT"
        raise BriefError(
            f"the router cannot listen at {listen} ({error.strerror}); end the program that does, or write the briefs "
            f"again with another {other}, of the host that the router is started on"
        ) from error
    except zenoh.ZError as error:
        raise BriefError(
            f"the router cannot listen at {listen} ({error}); write the briefs again with another --listen"
        ) from error


class Session:
    """What a process has on the network. Final; use it as a context manager, or its threads outlive the program."""

    def __init__(
        self,
        brief: Brief,
        config: dict[str, Any] | None = None,
        listen: str | None = None,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> None:
        """config, listen: of a router, and where it listens; meanwhile: called while there is no router to connect to yet."""
        zenoh.init_log_from_env_or(_LOGGED)
        if brief.ends_with_stdin:
            when_launcher_is_gone(lambda: os._exit(3))
        self.keys = RunKeys(brief.run)
        self._process = brief.process
        self.patience = float(brief.patience)
        """Seconds that are waited for the others."""
        self.place = Place()
        """Where this process is, to be kept up to date as it works."""
        self.allowance = allowance(brief.flow.largest_message, brief.flow.window, brief.flow.batch)
        """Bytes that one sender may have waiting to be read."""
        self._room = _WINDOWS * (brief.flow.window + 8)
        self._dropped = Dropped(brief.process, self._mistaken)
        self._lifeline = Lifeline(brief) if brief.role not in ("router", "relay", "observer") else None
        self._waiting = Waiting(brief.process, brief.router)
        if config is None or listen is None:
            door = door_of(brief)
            once = _once(door)
            first = connected(door, self.patience, meanwhile)
            self._connection = Connection(first, lambda: self._waiting.attempt(lambda: zenoh.open(once)), self._changed)
        else:
            self._connection = Connection(_listening(listen, brief.identity, config), None)
        self._outlets: dict[str, Outlet] = {}
        self._kept: list[ReplayBuffer] = []
        self._commands: SimpleQueue[bytes] = SimpleQueue()
        self._rounds: SimpleQueue[Reader] = SimpleQueue()
        self._control = self.keys.control(self._process)
        self._by_hand = not brief.ends_with_stdin
        # A router has nobody to connect to: it is its network.
        self._heartbeat = HeartbeatFile((lambda: True) if brief.role in ("router", "relay") else self.linked)
        self.funnel(self._control, self._told)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, MalformedMessage | Gap):
            self._complain(error)
        if self._lifeline is not None:
            self._lifeline.release()
        self._heartbeat.stop()
        self._connection.close()

    def _complain(self, error: MalformedMessage | Gap) -> None:
        """Tell the observer, which ends the run, what cannot be read and why; wait a moment for it to do so."""
        outlet = self._reporting
        if outlet is not None and outlet.matched:
            outlet(refusal(error.key, str(error)))
            with suppress(Empty):
                self._commands.get(timeout=_HEARD_SECONDS)

    @property
    def _reporting(self) -> Outlet | None:
        """Where this process reports to the observer, if it does."""
        key = self.keys.journal if self._process == ROUTER else self.keys.telemetry(self._process)
        return self._outlets.get(key)

    def _changed(self, connected: bool) -> None:
        """The connection was lost or is back."""
        self._waiting.begin(again=True)
        if self._lifeline is not None:
            self._lifeline.changed(connected)

    def _mistaken(self) -> None:
        """A message of another key arrived: the connection takes one for the other."""
        self._connection.renew()

    @property
    def dropped(self) -> int:
        """How many messages this process has dropped because they name another key than the one they came on."""
        return self._dropped.count

    def inbox(self, key: str) -> Inbox:
        """Subscribe to one exact key, to be read in order with `recv`."""
        return self._connection.add(Inbox(key, self._dropped, self.place, self._room))

    def funnel(self, key: str, receive: Callable[[bytes], None]) -> None:
        """Subscribe to one exact key; `receive` is called on a thread of Zenoh's and must only hand the bytes on."""
        self._connection.add(Funnel(key, self._dropped, receive))

    def outlet(self, key: str) -> Callable[[bytes], None]:
        """A publisher for one exact key."""
        self._outlets[key] = self._connection.add(Outlet(key))
        return self._outlets[key]

    def kept(
        self,
        key: str,
        span: int | None = None,
        head: Callable[[int, int, int], bytes] | None = None,
        back: int = 0,
    ) -> ReplayBuffer:
        """A publisher for one exact key, of what is sent once more after a connection was lost; as in `ReplayBuffer`."""
        kept = ReplayBuffer(self.outlet(key), span, head, back)
        self._kept.append(kept)
        return kept

    def reaches(self, key: str) -> bool:
        """Whether somebody reads a key that this process has a publisher for: who does has opened its session."""
        return key in self._outlets and self._outlets[key].matched

    def asked(self, key: str, receive: Callable[[Question], None]) -> None:
        """Be asked at one exact key; `receive` is called on a thread of Zenoh's and must only hand the question on."""
        self._connection.add(Questions(key, self._dropped, receive))

    def watch(self, process: str, changed: Callable[[bool], None]) -> None:
        """Call `changed` with true when a process is there, with false when it is gone; it must only hand that on."""
        self._connection.add(Watch(self.keys.alive(process), changed))

    @property
    def router_id(self) -> str | None:
        """Which router there is a connection with; one that was started again is another one."""
        return next((str(found) for found in self._connection.session.info.routers_zid()), None)

    def attendance(self, processes: Iterable[str]) -> dict[str, bool]:
        """Process → whether it is there, kept up to date by a thread of Zenoh's."""
        present = dict.fromkeys(processes, False)
        for name in present:
            self.watch(name, lambda there, name=name: present.__setitem__(name, there))  # type: ignore[misc]
        return present

    def linked(self) -> bool:
        """Whether there is a link with another router."""
        return self.router_id is not None

    def wait_for_link(self) -> None:
        """Wait until there is one. Raises RunError after the brief's patience."""
        deadline = time.monotonic() + self.patience
        self._waiting.begin()
        while not self.linked():
            self._waiting.look("no link yet")
            if time.monotonic() > deadline:
                raise RunError(
                    f"{self._process}: no link with the router within {self.patience:.0f} s; look at its log"
                )
            time.sleep(_POLL_SECONDS)

    def ready(self) -> None:
        """Wait until every publisher has a reader, then show that this process is there.

        Raises RunError after the brief's patience, naming who is missing and the keys that they do not read; but while the
        observer is there it is left to that one to say who is missing.
        """
        deadline = time.monotonic() + self.patience
        while unread := self._unread():
            missing = dict.fromkeys(reader_of(key) for key in unread)
            if OBSERVER not in missing and self._process != OBSERVER:
                deadline = time.monotonic() + self.patience
            if time.monotonic() > deadline:
                raise RunError(
                    f"{self._process}: {', '.join(missing)} did not appear within {self.patience:.0f} s, and nobody reads "
                    f"{', '.join(unread)}; start them, or look at their logs"
                )
            time.sleep(_POLL_SECONDS)
        self.appear()

    def appear(self) -> None:
        """Show that this process is there."""
        outlet = self._reporting
        if outlet is not None:
            self.place.answer(outlet)
        if self._kept:
            threading.Thread(target=self._send_again, name="sends-again", daemon=True).start()
        self._connection.appear(self.keys.alive(self._process))
        self._heartbeat.start()

    def conclude(self) -> None:
        """Confirm that this process ends because it was told to, and say how many messages it has dropped.

        The relay, which reports nothing, withdraws its token instead.
        """
        outlet = self._reporting
        if outlet is not None:
            outlet(over(self.dropped))
        else:
            self._connection.disappear()

    def _unread(self) -> list[str]:
        """The keys that have no reader."""
        return [key for key, outlet in self._outlets.items() if not outlet.matched]

    def _send_again(self) -> None:
        """On a thread of its own, since whoever works may be waiting for just what is to come of it."""
        while True:
            command = self._rounds.get()
            deadline = time.monotonic() + _HEARD_SECONDS
            while self._unread() and time.monotonic() < deadline:
                time.sleep(_POLL_SECONDS)
            for kept in self._kept:
                kept.again(command.integer("n"), command.integer("k"))

    def _told(self, payload: bytes) -> None:
        """Sort what the conductor says; what is no message is for whoever reads commands, who says so."""
        with suppress(MalformedMessage):
            command = Reader(self._control, payload)
            if self._by_hand and command.text("do") == "abandon":
                # Whatever this process waits for will not come, and nobody has launched it who would end it.
                sys.stderr.write(f"evedrop: {self._process}: the observer gave the run up: {command.text('why')}\n")
                sys.stderr.flush()
                os._exit(RunError.exit_status)
            if command.text("do") == "where":
                self.place.ask()
                return
            if self._kept and command.text("do") == "again":
                command.integer("n"), command.integer("k")
                self._rounds.put(command)
                return
        self._commands.put(payload)

    def wait_for(self, command: str) -> None:
        """Wait for one command of the conductor: `start` or `end`."""
        with self.place.waiting(self._control):
            while self.command().text("do") != command:
                pass
        if command == "end":
            self.conclude()

    def command(self) -> Reader:
        """The next command of the conductor; its field `do` says what."""
        return Reader(self._control, self._commands.get())

    def commanded(self) -> Reader | None:
        """The next command of the conductor if there is one."""
        return None if self._commands.empty() else self.command()
