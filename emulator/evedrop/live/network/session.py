"""A process's session on the network: how it connects, what it declares, when it is ready, how it ends.

Nothing here assumes that the transport loses no messages. The transport blocks when full; a subscription that is not read
forgets its oldest messages. Messages lost in either way, or with a connection, show as a gap in the slot numbers that every
message carries, and are sent again. A process whose connection is lost opens
another session and declares everything there. Each message names its key; messages that arrive under another key are
dropped.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from functools import partial
from queue import Empty
from types import TracebackType
from typing import Self, final

from evedrop.errors import Gap, MalformedMessage, MissingProcesses, RunError
from evedrop.live.network.connecting import (
    LOGGED,
    Credentials,
    WaitReporter,
    connected,
    listening,
    open_session,
)
from evedrop.live.network.connection import (
    FULL_SECONDS,
    CallbackSubscription,
    Connection,
    ConnectionWatchdog,
    HeartbeatFile,
    Publisher,
    Question,
    Questions,
    RecorderWatchdog,
    Subscription,
    Watch,
)
from evedrop.live.network.launcher_pipe import emit, when_launcher_is_gone
from evedrop.live.network.process_session import ReplayBuffer, allowance
from evedrop.live.protocol.brief import AnyBrief, Brief, Identity, RouterPart, RoutingPart
from evedrop.live.protocol.codec import Dropped, Reader
from evedrop.live.protocol.commands import (
    Abandon,
    Again,
    Bounds,
    ControlCommand,
    EndRun,
    ReportStatus,
    StatusReporter,
    read_command,
)
from evedrop.live.protocol.keys import RunKeys, ZenohConfig, low_pass, reader_of
from evedrop.live.protocol.launcher_events import RouterListens
from evedrop.live.protocol.notices import EndReport, RefusalNotice
from evedrop.names import RECORDER, ROUTER
from evedrop.system.threads import Queue
from evedrop.system.waiting import wait_until
from evedrop.system.world import world

READY_SECONDS = 30.0
_POLL_SECONDS = 0.004
_LEASE_SECONDS = 4.0  # a connection on which nothing arrives for this long is lost
_HEARD_SECONDS = 2.0  # to find the readers again when a connection is back
_SENT_BYTES = 1 << 20  # under way to one reader: a full buffer would keep Zenoh from noticing that the reader is lost
_NEVER_MS = 86_400_000
# Of what Zenoh sends at once. A message that waits to be read keeps the whole batch in memory that it came in.
_BATCH_PACKETS, _LEAST_BATCH_BYTES, _LARGEST_BATCH_BYTES = 64, 1 << 14, (1 << 16) - 1
_ANSWER_BYTES = 64 * 2**20  # for the operator
_WINDOWS = (
    8  # how many windows a subscription holds: messages that were sent again in the latest rounds wait there, too
)
ATTEMPT: ZenohConfig = {"open_timeout": int(_LEASE_SECONDS * 1000)}
"""Zenoh's limit of one attempt to connect again: one that a cut connection has swallowed holds up the next for so long."""
_LOGGED = f"{LOGGED},zenoh_transport::unicast::establishment::open=off"  # the program reports a refusal itself


def _transport(identity: Identity | None, largest: int, packet: int, listens: bool = False) -> ZenohConfig:
    """The limits of a connection; largest, packet: bytes of the run's largest message and of a packet's numbers."""
    wait = {"block": {"wait_before_close": int(FULL_SECONDS * 1e6)}}
    link: ZenohConfig = {
        "tx": {
            "lease": int(_LEASE_SECONDS * 1000),
            "batch_size": max(_LEAST_BATCH_BYTES, min(_BATCH_PACKETS * packet, _LARGEST_BATCH_BYTES)),
            "queue": {"congestion_control": wait},
        },
        "rx": {"buffer_size": 1 << 20, "max_message_size": largest},
    }
    if identity is not None:
        from evedrop.live.network.certificates import tls_section  # noqa: PLC0415 - saves most runs 50 ms

        link |= {"protocols": ["tls"], "tls": {**tls_section(identity, listens), "so_sndbuf": _SENT_BYTES}}
    else:
        link["tcp"] = {"so_sndbuf": _SENT_BYTES}
    # Shared memory would expose the router's messages for one receiver to all.
    return {"link": link, "shared_memory": {"enabled": False}}


def _packet_bytes(brief: AnyBrief) -> int:
    return 8 * len(brief.model.A) * brief.trials


def client_config(entry: Credentials) -> ZenohConfig:
    """Zenoh configuration of every process but the router: one connection, to the router, and no scouting for others."""
    largest, packet = _ANSWER_BYTES, 0
    if isinstance(entry, Brief):
        largest, packet = entry.flow.largest_message, _packet_bytes(entry)
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
        "transport": {**_transport(entry.identity, largest, packet), "auth": auth},
    }


def _once(config: ZenohConfig) -> ZenohConfig:
    """The same for sessions that are closed when their connection is lost: Zenoh must not reconnect them."""
    never = {"period_init_ms": _NEVER_MS, "period_max_ms": _NEVER_MS}
    return {
        **config,
        "connect": {**config["connect"], "retry": never},
        "transport": {**config["transport"], "unicast": dict(ATTEMPT)},
    }


def listening_config(listen: str, users_file: str, access: ZenohConfig, transport: ZenohConfig) -> ZenohConfig:
    """Zenoh configuration of any router of ours: it finds nobody by itself, and asks for user and password."""
    return {
        "mode": "router",
        "listen": {"endpoints": [listen], "exit_on_failure": True},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {**transport, "auth": {"usrpwd": {"dictionary_file": users_file}}},
        "access_control": access,
    }


def router_config(brief: Brief[RoutingPart], users_file: str, access: ZenohConfig, listen: str) -> ZenohConfig:
    """Zenoh configuration of a router: it listens, asks for user and password, and drops messages not granted or too large."""
    transport = _transport(brief.identity, brief.flow.largest_message, _packet_bytes(brief), listens=True)
    return {
        **listening_config(listen, users_file, access, transport),
        **({"id": brief.part.zid} if isinstance(brief.part, RouterPart) and brief.part.zid is not None else {}),
        "low_pass_filter": low_pass(brief.run, brief.part.limits),
    }


@final
class Session:
    """A process's session on the network; use it as a context manager, or its threads outlive the program."""

    def __init__(
        self, brief: AnyBrief, config: ZenohConfig | None = None, meanwhile: Callable[[], None] = lambda: None
    ) -> None:
        """config: a router's configuration; meanwhile: called while waiting for the router."""
        world().zenoh.init_log_from_env_or(_LOGGED)
        if brief.ends_with_stdin:
            when_launcher_is_gone(lambda: world().process.exit(3))
        world().process.prepare_for_messages(brief.flow.largest_message)
        self.keys = RunKeys(brief.run)
        self._process = brief.process
        self.patience = float(brief.patience)
        """How many seconds to wait for other processes."""
        self.status = StatusReporter()
        """The slot this process is at and what it waits for; to be kept up to date."""
        self.allowance = allowance(brief.flow.largest_report, brief.flow.window, brief.flow.batch)
        """How many unread bytes of one sender may wait."""
        self._room = _WINDOWS * (brief.flow.window + 8)
        self._watchdog = ConnectionWatchdog(brief) if brief.role not in ("router", "relay", "recorder") else None
        self._wait = WaitReporter(brief.process, brief.router)
        if config is None:
            once = _once(client_config(brief))
            first = connected(brief, once, self.patience, meanwhile)
            self.connection = Connection(first, lambda: self._wait.attempt(lambda: open_session(once)), self._changed)
        else:
            self.connection = Connection(listening(brief.identity, config), None)
            if brief.ends_with_stdin:
                emit(RouterListens(brief.process))
        self.dropped = Dropped(brief.process, self.connection.renew)
        """Counts the messages that this process has dropped because they arrived under another key than they name."""
        self._publishers: dict[str, Publisher] = {}
        self._replays: list[ReplayBuffer] = []
        self._commands: Queue[bytes] = world().queue()
        self._rounds: Queue[Again] = world().queue()
        self._slots = brief.slots
        self._control = self.keys.control(self._process)
        self._by_hand = not brief.ends_with_stdin
        # A router connects to no other process, so it is always on its network.
        linked = (lambda: True) if brief.role in ("router", "relay") else self.linked
        self._heartbeat = HeartbeatFile(linked)
        self._recorder_watchdog = RecorderWatchdog(brief, linked)
        self.subscribe_with(self._control, self._sort_command)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, MalformedMessage | Gap):
            self._complain(error)
        if self._watchdog is not None:
            self._watchdog.release()
        self._recorder_watchdog.release()
        self._heartbeat.stop()
        self.connection.close()

    def _complain(self, error: MalformedMessage | Gap) -> None:
        """Tell the recorder which message cannot be read, and why; wait a moment for it to end the run."""
        publisher = self._reporting
        if publisher is not None and publisher.matched:
            publisher(RefusalNotice.of(error.key, str(error)).pack())
            with suppress(Empty):
                self._commands.get(timeout=_HEARD_SECONDS)

    @property
    def _reporting(self) -> Publisher | None:
        """The publisher for reports to the recorder, if this process has one."""
        key = self.keys.journal if self._process == ROUTER else self.keys.telemetry(self._process)
        return self._publishers.get(key)

    def _changed(self, connected: bool) -> None:
        """Handle the loss or the return of the connection."""
        self._wait.begin(again=True)
        if self._watchdog is not None:
            self._watchdog.changed(connected)

    def subscribe(self, key: str) -> Subscription:
        """Subscribe to one exact key; read its messages in order with `recv`."""
        return self.connection.declare(Subscription(key, self.dropped, self.status, self._room))

    def subscribe_with(self, key: str, receive: Callable[[bytes], None]) -> None:
        """Subscribe to one exact key; `receive` is called on a thread of Zenoh's and must only hand the bytes on."""
        self.connection.declare(CallbackSubscription(key, self.dropped, receive))

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """A publisher for one exact key."""
        self._publishers[key] = self.connection.declare(Publisher(key))
        return self._publishers[key]

    def replaying_publisher(
        self, key: str, span: int | None = None, head: Callable[[int, int, int], bytes] | None = None, back: int = 0
    ) -> ReplayBuffer:
        """A publisher for one exact key, whose messages are sent again after a lost connection; as in `ReplayBuffer`."""
        replay = ReplayBuffer(self.publisher(key), span, head, back)
        self._replays.append(replay)
        return replay

    def reaches(self, key: str) -> bool:
        """Whether a key that this process publishes has a reader: such a reader has opened its session."""
        return key in self._publishers and self._publishers[key].matched

    def asked(self, key: str, receive: Callable[[Question], None]) -> None:
        """Answer questions at one exact key; a thread of Zenoh's calls `receive`, which must only hand the question on."""
        self.connection.declare(Questions(key, self.dropped, receive))

    def watch(self, process: str, changed: Callable[[bool], None]) -> None:
        """Call `changed` with true when a process appears, with false when it leaves; it must only hand that on."""
        self.connection.declare(Watch(self.keys.alive(process), changed))

    @property
    def router_id(self) -> str | None:
        """Zenoh id of the connected router; a restarted router has another id."""
        return next((str(zid) for zid in self.connection.session.info.routers_zid()), None)

    def presence(self, processes: Iterable[str]) -> dict[str, bool]:
        """Process → whether it is present, kept up to date by a thread of Zenoh's."""
        present = dict.fromkeys(processes, False)
        for name in present:
            self.watch(name, partial(present.__setitem__, name))
        return present

    def linked(self) -> bool:
        """Whether there is a link with another router."""
        return self.router_id is not None

    def wait_for_link(self) -> None:
        """Wait until there is a link with another router. Raises RunError after the brief's patience."""
        deadline = world().monotonic() + self.patience
        self._wait.begin()
        while not self.linked():
            self._wait.poll("no link yet")
            if world().monotonic() > deadline:
                raise RunError(
                    f"{self._process}: no link with the router within {self.patience:.0f} s; look at its log"
                )
            world().sleep(_POLL_SECONDS)

    def ready(self) -> None:
        """Wait until every publisher has a reader, then show that this process is present.

        Raises MissingProcesses after the brief's patience, naming them and the keys without a reader. While the
        recorder is present, this process waits on: the recorder reports the missing processes.
        """
        waited, before = 0.0, world().monotonic()
        self._answer_requests()
        while unread := self._unread():
            self.status.waits = (unread[0],)
            missing = dict.fromkeys(reader_of(key) for key in unread)
            now = world().monotonic()
            if RECORDER not in missing and self._process != RECORDER:
                waited = 0.0
            elif self._watchdog is None or self.linked():
                waited += now - before  # not without a connection: then it sees nobody, and its watchdog ends it
            before = now
            if waited > self.patience:
                raise MissingProcesses(
                    self._process,
                    tuple(missing),
                    f"within {self.patience:.0f} s, and nobody reads {', '.join(unread)}; start them, or look at their logs",
                )
            world().sleep(_POLL_SECONDS)
        self.status.waits = ()
        self._show()

    def appear(self) -> None:
        """Show that this process is present, without waiting for others."""
        self._answer_requests()
        self._show()

    def _answer_requests(self) -> None:
        """Answer the recorder's requests for the status from now on."""
        if self._reporting is not None:
            self.status.answer(self._reporting)

    def _show(self) -> None:
        publisher = self._reporting
        if publisher is not None:
            self.end_without_recorder(lambda: publisher.matched, self.patience)
        if self._replays:
            world().thread(self._send_again, name="sends-again").start()
        self.connection.appear(self.keys.alive(self._process))
        self._heartbeat.start()

    def end_without_recorder(self, reached: Callable[[], bool], patience: float) -> None:
        """If no launcher would end this process, end it if the recorder is not there, or no longer.

        reached: whether the recorder is there; patience: how many seconds to wait until it is.
        """
        if self._by_hand:
            self._recorder_watchdog.start(reached, patience)

    def conclude(self) -> None:
        """Confirm that this process ends on the conductor's command, and report how many messages it has dropped.

        The relay, which reports nothing, withdraws its token instead.
        """
        self._recorder_watchdog.release()
        publisher = self._reporting
        if publisher is not None:
            publisher(EndReport(self.dropped.count).pack())
        else:
            self.connection.disappear()

    def _unread(self) -> list[str]:
        """The keys that have no reader."""
        return [key for key, publisher in self._publishers.items() if not publisher.matched]

    def _send_again(self) -> None:
        """Send messages again as asked; on a thread of its own, since the working thread may be waiting for the effect."""
        while True:
            asked = self._rounds.get()
            wait_until(lambda: not self._unread(), _HEARD_SECONDS, _POLL_SECONDS)
            for replay in self._replays:
                replay.again(asked.round, asked.slot)

    def _sort_command(self, payload: bytes) -> None:
        """Sort the conductor's commands; a malformed one is left to the reader of the commands, which raises the error."""
        with suppress(MalformedMessage):
            match self._read(payload):
                case Abandon(why) if self._by_hand:
                    # Its messages will not come, and there is no launcher to end it.
                    sys.stderr.write(f"evedrop: {self._process}: the recorder gave the run up: {why}\n")
                    sys.stderr.flush()
                    world().process.exit(RunError.exit_status)
                case ReportStatus():
                    self.status.request()
                    return
                case Again() as asked if self._replays:
                    self._rounds.put(asked)
                    return
        self._commands.put(payload)

    def _read(self, payload: bytes, receivers: Collection[str] | None = None) -> ControlCommand:
        # Changes of a link are as many as its events, and each has several lists and maps.
        return read_command(Reader(self._control, payload, parts=len(payload)), Bounds(self._slots, receivers))

    def wait_for(self, kind: type[ControlCommand]) -> None:
        """Wait for one command of the conductor: `Start` or `EndRun`."""
        with self.status.waiting(self._control):
            while not isinstance(self.command(), kind):
                pass
        if kind is EndRun:
            self.conclude()

    def command(self, receivers: Collection[str] | None = None) -> ControlCommand:
        """Wait for the next command of the conductor; receivers: those that it may name, any by default."""
        return self._read(self._commands.get(), receivers)

    def commanded(self, receivers: Collection[str] | None = None) -> ControlCommand | None:
        """The next command of the conductor, or None without waiting."""
        return None if self._commands.empty() else self.command(receivers)
