"""The routers: one decides the fate of every packet; a second, the relay, passes on the granted messages and decides nothing.

    uplink ── k, z ──┬── link of receiver 1 ── fate, γ ── downlink/1
                     ├── link of receiver 2 ── fate, γ ── downlink/2      fates of all ── journal
                     └── …

The router takes each packet of the uplink, lets every link decide its fate, delivers, and keeps the journal. A receiver that is
present gets one delivery in every slot, with everything that arrives in the slot. At a barrier on the uplink the router journals
all slots before it and waits until the conductor lets it continue; links change nowhere else. When packets are sent again, the
router routes them again, with the same fates, as a restarted router would.

Some of the conductor's commands are carried out at a barrier, others end any waiting. In real time, deliveries may be delayed by
a fraction of a slot: they are sent when they are due, in order, while the router continues. Delays of whole slots are emulated
time, the same in every run.

Source: docs/protocol.md, control, lost connections, and two routers.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import final

import numpy as np

from evedrop.errors import EvedropError, MalformedMessage, RunError
from evedrop.live.network.access import Grant, access_control, at_relay, at_router, grants, until_all_left, users_file
from evedrop.live.network.connecting import connected
from evedrop.live.network.launcher_pipe import launcher_is_gone
from evedrop.live.network.process_session import GapDetector, Pending
from evedrop.live.network.session import ATTEMPT, Session, client_config, router_config
from evedrop.live.protocol.brief import AnyBrief, Brief, RelayPart, RouterPart, RoutingPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import Again, ControlCommand, EndRun, Go, LinkChange
from evedrop.live.protocol.keys import ZenohConfig
from evedrop.live.protocol.packets import (
    acknowledgement,
    barrier,
    delivery,
    is_barrier,
    is_resend,
    packet_format,
    read_acknowledgement,
    read_resend,
    read_uplink,
)
from evedrop.live.protocol.telemetry import Journal
from evedrop.model.acknowledgements import AckChannel, AckChannelSpec
from evedrop.model.receiver import Flags
from evedrop.model.slot.link import COUNTED_BURSTS, Account, Accountant, Change, LinkSchedule, streams_of
from evedrop.model.slot.link_core import Arrivals, Late, LinkCore
from evedrop.model.slot.records import PacketSlots
from evedrop.names import ACKNOWLEDGEMENTS, LEGITIMATE, RECORDER, ROUTER
from evedrop.scenario.conformance.checked import CheckedLink
from evedrop.system.threads import Queue
from evedrop.system.world import world


@final
class Downlink:
    """One receiver's link, whose fates are decided a batch of slots ahead, and its publisher."""

    def __init__(
        self,
        name: str,
        schedule: LinkSchedule,
        brief: Brief[RouterPart],
        put: Callable[[bytes, float], None],
        waited: bool = True,
    ) -> None:
        """waited: whether deliveries are sent at once; in lock-step, waking up others would take most of the time."""
        keys = {stream: brief.stream_keys[stream] for stream in streams_of(name, schedule)}
        self.core = LinkCore(schedule, name, keys, brief.batch)
        self._checked = CheckedLink(name, self.core, schedule, brief.batch)
        self._schedule = schedule
        self._accountant = Accountant(schedule.window, brief.trials)
        self._put = put
        self._pace = brief.part.pace
        self._rests: dict[int, float] = {}
        """Slot → the fraction of a slot that the first trial's packet takes in addition, for packets that may still arrive."""
        self._leak = brief.part.leaks.get(name)
        self._waited, self._most = waited, brief.flow.message
        self._held: list[PacketSlots] = []

    def plan(self, slots: range) -> None:
        """Decide the fates of the packets of the next batch."""
        self._checked.plan(slots)

    def account(self, slots: range) -> Account:
        """The fates of the packets of the next slots, which belong to the current batch."""
        return self._accountant.account(slots, self.core.part(slots))

    def take(self, packets: PacketSlots, again: bool = False) -> None:
        """Take the packets of the next slots of the batch, and deliver them; hold them if nobody waits for them.

        again: the receiver has these deliveries; only update the packets under way.
        """
        if packets.sent is not None:
            self.core.silence(packets.slots, packets.sent)
        if again:
            self._arrivals(packets)
        elif self._waited:
            self._deliver(packets)
        else:
            betrayed = packets.truth is not None
            if self._held and (betrayed or packets.slots.stop - self._held[0].first > self._most):
                self.flush()
            # Unsent packets are silenced already.
            self._held.append(packets if packets.sent is None else packets.changed(sent=None))
            if betrayed:
                self.flush()

    def flush(self) -> None:
        """Deliver all packets that are held."""
        if self._held:
            held, self._held = PacketSlots.joined(self._held), []
            self._deliver(held)

    def _arrivals(self, packets: PacketSlots) -> Arrivals:
        return self.core.arrivals(packets.slots, packets.z, packets.header)

    def _deliver(self, packets: PacketSlots) -> None:
        """Send the delivery of some slots: the packets that arrive in each. Nothing is sent to a receiver that is absent."""
        slots, k = packets.slots, packets.first
        arrivals = self._arrivals(packets)
        if self._schedule.outages and not self.core.present(k):
            return
        if packets.truth is not None and k == self._leak:
            arrivals = arrivals._replace(truth=dict(enumerate(packets.truth)))
        rests = bool(self._rests) or self.core.fates.rests is not None
        seconds = self._rest(k, arrivals.gamma[0], arrivals.late.get(0, ())) if rests and self._pace else 0.0
        self._put(delivery(slots, arrivals), seconds)

    def _rest(self, k: int, gamma: Flags, late: tuple[Late, ...]) -> float:
        """The seconds by which to delay slot k's delivery: the longest rest among the first trial's packets in it."""
        rest = self.core.rest(k)
        if rest is not None:
            self._rests[k] = rest
        arrived = [packet.k for packet in late if packet.heard.gamma[0]] + [k] * bool(gamma[0])
        longest = max((self._rests.get(slot, 0.0) for slot in arrived), default=0.0)
        self._rests.pop(k - self._schedule.window, None)
        return longest * self._pace

    def mark(self, k: int) -> None:
        """Pass a barrier on, if the receiver is present."""
        if not any(away.start < k <= away.stop for away in self._schedule.outages):
            self._put(barrier(k), 0.0)


@final
class AckLink:
    """The link of the acknowledgements, from the legitimate estimator to the sensor, and the attack on it."""

    def __init__(self, brief: AnyBrief, session: Session, spec: AckChannelSpec) -> None:
        key = brief.stream_keys[f"link/{ACKNOWLEDGEMENTS}"]
        self._channel = AckChannel(spec, key, brief.batch)
        self._jammer = spec.jammer
        self._trials, self._status = brief.trials, session.status
        self._key = session.keys.acknowledged
        self._due = GapDetector(self._key, brief.flow.longest_outage)
        self.sent: Queue[bytes | None] = world().queue()
        """The legitimate estimator's acknowledgements; None: the conductor sent a command that may end the waiting."""
        session.subscribe_with(self._key, self.sent.put)
        self._put = session.publisher(session.keys.acknowledgements)

    def carry(self, k: int, sent: Flags | None, downlinks: Mapping[str, Downlink], commands: Commands) -> None:
        """Wait for the acknowledgements of slot k, and send on those that reach the sensor; sent (R,): as in `PacketExtras`.

        An absent receiver acknowledges nothing. Raises the errors of `Commands.check`.
        """
        there = downlinks[LEGITIMATE].core.present(k)
        gamma = self._acknowledged(k, commands) if there else np.zeros(self._trials, np.bool_)
        gamma_e = gamma if self._jammer is None else downlinks[self._jammer].core.gamma(k)
        self._put(acknowledgement(k, self._channel.arrived(k, sent, gamma, gamma_e)))

    def count(self, k: int, sent: Flags | None, downlinks: Mapping[str, Downlink]) -> None:
        """Count slot k, whose acknowledgements have reached the sensor, for those of later slots; sent as for `carry`."""
        if self._jammer is not None:
            self._channel.count(k, sent, downlinks[self._jammer].core.gamma(k))

    def _acknowledged(self, k: int, commands: Commands) -> Flags:
        while True:
            with self._status.waiting(self._key):
                payload = self.sent.get()
            if payload is None:
                commands.check()
                continue
            message = Reader(self._key, payload)
            if (slot := message.integer("k")) == k:
                return read_acknowledgement(message, k, self._trials)
            self._due.missed(k, slot)


def route(brief: Brief[RouterPart]) -> None:
    """Run the router of a brief until the conductor ends it and all other processes have left."""
    table = grants(brief.run, tuple(brief.part.links), brief.part.controller)
    let_in = table if brief.part.zid is None else at_router(brief.run, table)
    with _opened(brief, let_in) as session:
        present = session.presence(grant.process for grant in table if grant.token is not None)
        RouterLoop(brief, session).carry_on()
        session.conclude()
        until_all_left(present, session.linked)


@final
class RouterLoop:
    """The router's work on an open session."""

    def __init__(self, brief: Brief[RouterPart], session: Session) -> None:
        self._brief, self._session = brief, session
        self._packets = packet_format(len(brief.model.A), brief.trials, brief.model.header)
        self._betrayed = frozenset(brief.part.leaks.values())
        self._uplink = Pending(session.subscribe(session.keys.uplink), session.keys.uplink)
        self._due = GapDetector(session.keys.uplink, brief.flow.longest_outage)
        self._put_journal = session.publisher(session.keys.journal)
        delayed_sender = DelayedSender() if brief.part.pace else None

        def publisher(name: str) -> Callable[[bytes, float], None]:
            put = session.publisher(session.keys.downlink(name))
            return (lambda payload, _: put(payload)) if delayed_sender is None else delayed_sender.round(put)

        self._schedules = dict(brief.part.links)
        self._publishers = {name: publisher(name) for name in self._schedules}
        acknowledgements = brief.part.acknowledgements
        self._ack_link = AckLink(brief, session, acknowledgements) if acknowledgements is not None else None
        # A message to the router's own uplink wakes the thread that waits there: only the conductor ends a router.
        knock = session.publisher(session.keys.uplink)
        waiting = [] if self._ack_link is None else [self._ack_link.sent]
        self._commands = Commands(session, tuple(self._schedules), lambda: knock(barrier(brief.slots)), waiting)
        self._stale = False
        """Whether to ignore packets until the resend begins."""
        self._begin(0, 0)

    def _is_waited_for(self, receiver: str) -> bool:
        """Whether the deliveries to a receiver have a pace, or the sensor waits in some slots for what it answers."""
        wiring = self._brief.part.controller
        if self._brief.part.pace or wiring is None:
            return True
        acknowledged = self._brief.part.acknowledgements is not None
        return receiver == LEGITIMATE and (not wiring.on_truth or wiring.knows_input or acknowledged)

    def carry_on(self) -> None:
        """Route all slots, again as often as the conductor asks, until it ends the run."""
        # No need to wait: a process subscribes before it shows its token, and it showed the token to this very session.
        self._session.appear()
        while not self._commands.over():
            try:
                self._take()
            except ReplayRequested:
                self._stale = True

    def _begin(self, start: int, done: int) -> None:
        """Restore the router's state before slot `start`, which follows from the links alone.

        done: all slots below it have been delivered, acknowledged and journaled.
        """
        self._stale = False
        self._k, self._done, self._journaled = start, done, start
        self._downlinks = {
            name: Downlink(name, schedule, self._brief, self._publishers[name], self._is_waited_for(name))
            for name, schedule in self._schedules.items()
        }
        for first in range(0, start + 1, self._brief.flow.batch):
            self._session.status.slot = first  # with many slots and trials this may take longer than an outage
            slots = self._plan(first)
            before = range(first, min(slots.stop, start))
            if before and before.stop > start - COUNTED_BURSTS:  # for unfinished bursts and packets under way
                for downlink in self._downlinks.values():
                    downlink.account(before)

    def _plan(self, first: int) -> range:
        """Decide the fates of the batch that begins with this slot."""
        self._slots = range(first, min(first + self._brief.flow.batch, self._brief.slots))
        if self._slots:
            for downlink in self._downlinks.values():
                downlink.plan(self._slots)
        return self._slots

    def _take(self) -> None:
        """Handle the sensor's next messages: packets, a barrier, or the announcement of a resend."""
        message = self._uplink.peek()
        if is_resend(message):
            self._uplink.drop()
            self._resend(message)
            return
        k = message.integer("k")
        if self._stale or k == self._brief.slots or k != self._k:
            self._uplink.drop()
            if not self._stale and k != self._brief.slots:
                self._due.missed(self._k, k)
            return
        if k == self._done:
            self._journal(k)
        if is_barrier(message):
            self._uplink.drop()
            if k >= self._done:
                self._journal(k)
                self._hold(k)
            return
        most = 1 if self._ack_link is not None else self._slots.stop - k
        packets = read_uplink(self._uplink.drop(), k, self._packets, most)
        if packets.truth is None and k in self._betrayed:
            raise message.malformed("no truth", f"truth, the state of slot {k}, which is betrayed")
        if k < self._done < packets.slots.stop:
            self._route(packets.rows(slice(0, self._done - k)))
            packets = packets.rows(slice(self._done - k, None))
            self._journal(self._done)
        self._route(packets)
        if self._k == self._slots.stop:
            self._flush()
            self._journal(self._k)
            self._plan(self._k)

    def _route(self, packets: PacketSlots) -> None:
        """Deliver the packets of consecutive slots, unless it is known that they have been delivered."""
        first, again = packets.first, packets.first < self._done
        for downlink in self._downlinks.values():
            downlink.take(packets, again)
        if self._ack_link is not None:
            sent = None if packets.sent is None else packets.sent[0]
            if again:
                self._ack_link.count(first, sent, self._downlinks)
            else:
                self._ack_link.carry(first, sent, self._downlinks, self._commands)
        self._k = self._session.status.slot = packets.slots.stop

    def _flush(self) -> None:
        for downlink in self._downlinks.values():
            downlink.flush()

    def _resend(self, message: Reader) -> None:
        """Begin a resend, which the conductor and the sensor announce in either order; wait for the conductor if need be."""
        number, done, start = read_resend(message, self._brief.slots)
        again = self._commands.resend_of(number)
        if again is None:  # the conductor has asked again since
            self._stale = True
            return
        for name, changes in (again.links or {}).items():
            self._schedules[name] = self._changed(name, changes, again)
        self._begin(start, done)

    def _journal(self, end: int) -> None:
        """Journal all slots below `end`; for those already journaled, only keep the state that later slots need."""
        slots = range(self._journaled, end)
        self._journaled = end
        if slots:
            accounts = {name: downlink.account(slots) for name, downlink in self._downlinks.items()}
            if slots.start >= self._done:
                self._put_journal(Journal(slots.start, len(slots), accounts).pack())

    def _hold(self, k: int) -> None:
        """Pass a barrier on, and obey the conductor until it lets the router continue."""
        self._flush()
        for downlink in self._downlinks.values():
            downlink.mark(k)
        while True:
            match self._commands.next():
                case Go(slot) if slot == k:
                    return
                case LinkChange() as change:
                    self._amend(change, k)

    def _amend(self, command: LinkChange, k: int) -> None:
        """Change a link from slot k on, as the conductor's command says."""
        name, changes = command.link, command.changes
        earlier = [change for change in self._schedules[name].changes if change.at < k]
        schedule = self._changed(name, (*earlier, *changes), command)
        if any(change.at < k for change in changes):
            raise self._malformed(command, "a change before the hold", f"slots from {k} on")
        self._downlinks[name].core.amend(k, changes)
        self._schedules[name] = schedule

    def _changed(self, name: str, changes: tuple[Change, ...], command: LinkChange | Again) -> LinkSchedule:
        """The schedule of a link with these changes, which a command asks for. Raises MalformedMessage if they are wrong."""
        schedule = replace(self._schedules[name], changes=changes)
        try:
            schedule.expect_possible()
        except (KeyError, TypeError, ValueError) as error:
            wrong = f"invalid settings ({error!r:.80})"
            raise self._malformed(command, wrong, f"settings of the link of {name}") from error
        return schedule

    def _malformed(self, command: LinkChange | Again, found: str, expected: str) -> MalformedMessage:
        return Reader(self._session.keys.control(ROUTER), command.pack()).malformed(found, expected)


def _opened(brief: Brief[RoutingPart], table: list[Grant]) -> Session:
    """The session of a router or relay that grants its users what the table says."""
    access = access_control(table, brief.identity is not None)
    listen = brief.part.listen if isinstance(brief.part, RelayPart) else brief.router
    with users_file(brief.part.users) as users:
        config = router_config(brief, str(users), access, listen)
        return Session(brief, _linked(brief, config) if isinstance(brief.part, RelayPart) else config)


class ReplayRequested(Exception):
    """The conductor asks for packets again: the message that the router waits for may have been lost."""


_ROUND_SECONDS = 2.0  # for which a round that the sensor has announced waits for the conductor's command


@final
class Commands:
    """Reads the session's commands on a thread of its own.

    knock: wakes the thread that waits for packets when the run has ended.
    waiting: queues that get a None when waiting for their next item may be in vain.
    """

    def __init__(
        self,
        session: Session,
        receivers: Collection[str],
        knock: Callable[[], None],
        waiting: Iterable[Queue[bytes | None]],
    ) -> None:
        """receivers: those that a command may name."""
        self._session, self._receivers, self._knock, self._waiting = session, receivers, knock, tuple(waiting)
        self._orders: Queue[tuple[int, ControlCommand] | None] = world().queue()
        self._changed = world().condition()
        self._asked = Again(0, 0)
        self._heeded = 0
        self._ended = False
        self._failure: EvedropError | None = None
        world().thread(self._listen, name="commands").start()

    def _listen(self) -> None:
        try:
            while not self._ended:
                self._sort(self._session.command(self._receivers))
        except EvedropError as error:  # the working thread raises it
            self._failure = error
        with self._changed:
            self._changed.notify()
        self._wake()
        self._knock()

    def _sort(self, command: ControlCommand) -> None:
        match command:
            case Again():
                with self._changed:
                    self._asked = command
                    self._changed.notify()
                self._wake()
            case EndRun():
                self._ended = True
            case _:
                self._orders.put((self._asked.round, command))

    def _wake(self) -> None:
        self._orders.put(None)
        for queue in self._waiting:
            queue.put(None)

    def over(self) -> bool:
        """Whether the conductor has ended the run. Raises MalformedMessage if it sent a malformed command."""
        if self._failure is not None:
            raise self._failure
        return self._ended

    def check(self) -> None:
        """Raise ReplayRequested if the conductor has ended the run, or asked for packets since the last request obeyed."""
        if self.over() or self._asked.round != self._heeded:
            raise ReplayRequested

    def next(self) -> ControlCommand:
        """The next command of the current round; those of earlier rounds are skipped. Raises ReplayRequested as `check` does."""
        while True:
            with self._session.status.waiting(self._session.keys.control(ROUTER)):
                order = self._orders.get()
            self.check()
            if order is not None and order[0] == self._heeded:
                return order[1]

    def resend_of(self, number: int) -> Again | None:
        """Wait for the conductor's command for this round; None if the conductor has asked for a later one.

        Also None if it has ended the run meanwhile, or if no such command arrives within some seconds.
        """
        with self._changed:
            # Sensor and router are told at the same time: if the command does not arrive, the round does not exist, or another
            # one will follow.
            if not self._changed.wait_for(lambda: self.over() or self._asked.round >= number, _ROUND_SECONDS):
                return None
            if self._ended or self._asked.round > number:
                return None
            self._heeded = number
            return self._asked


Put = Callable[[bytes], None]


@final
class DelayedSender:
    """Sends messages when they are due, on a daemon thread of its own: a run ends only when all have arrived."""

    def __init__(self) -> None:
        self._due: list[tuple[float, int, Put, bytes]] = []
        self._numbers = itertools.count()
        self._changed = world().condition()
        world().thread(self._go_round, name="delayed-sender").start()

    def round(self, put: Put) -> Callable[[bytes, float], None]:
        """A publisher that sends each message the given seconds later, but never before the previous message."""
        last, waiting = 0.0, 0

        def put_due(payload: bytes) -> None:
            nonlocal waiting
            put(payload)
            with self._changed:
                waiting -= 1

        def send(payload: bytes, seconds: float) -> None:
            nonlocal last, waiting
            with self._changed:
                at_once = not seconds and not waiting
                if not at_once:
                    last = max(last, world().monotonic() + seconds)
                    waiting += 1
                    heapq.heappush(self._due, (last, next(self._numbers), put_due, payload))
                    self._changed.notify()
            if at_once:
                put(payload)

        return send

    def _go_round(self) -> None:
        while True:
            with self._changed:
                while not self._due or (wait := self._due[0][0] - world().monotonic()) > 0.0:
                    self._changed.wait(wait if self._due else None)
                _, _, put, payload = heapq.heappop(self._due)
            put(payload)


def relay(brief: Brief[RelayPart]) -> None:
    """Run the relay of a brief until the conductor ends it and all processes connected to it have left.

    Raises BriefError if the router does not accept the brief, RunError if no router answers within the brief's patience.
    """
    part = brief.part
    table = at_relay(brief.run, grants(brief.run, tuple(part.receivers), part.controller, relayed=True), part.zid)
    # Connect as a client first, which reports errors; Zenoh links routers in the background and reports none.
    meanwhile = _end_with_launcher if brief.ends_with_stdin else lambda: None
    with connected(brief, client_config(brief), float(brief.patience), meanwhile):
        pass
    with _opened(brief, table) as session:
        present = session.presence(grant.process for grant in table if grant.token is not None and grant.zid is None)
        session.wait_for_link()
        # The recorder is present only once it sees everybody else, for whom it waits as long again.
        session.end_without_recorder(lambda: present[RECORDER], 2.0 * session.patience)
        session.ready()
        session.wait_for(EndRun)
        until_all_left(present)


def _end_with_launcher() -> None:
    """End at once if the launcher is gone, as a session does once there is one."""
    if launcher_is_gone():
        world().process.exit(RunError.exit_status)


def _linked(brief: AnyBrief, listening: ZenohConfig) -> ZenohConfig:
    """Configuration of a router that also connects to the first router as a client, and reconnects when the link is lost."""
    connecting = client_config(brief)
    auth = {"usrpwd": {**listening["transport"]["auth"]["usrpwd"], **connecting["transport"]["auth"]["usrpwd"]}}
    return {
        **listening,
        "connect": {**connecting["connect"], "timeout_ms": -1, "exit_on_failure": False},
        "transport": {**listening["transport"], "auth": auth, "unicast": dict(ATTEMPT)},
    }
