"""The router: takes each packet of the uplink, lets every link decide its fate, delivers, and keeps the journal.

    uplink ── k, z ──┬── link of receiver 1 ── fate, γ ── downlink/1
                     ├── link of receiver 2 ── fate, γ ── downlink/2      fates of all ── journal
                     └── …

A receiver that is present gets one delivery in every slot, with everything that arrives in the slot. At a barrier on the
uplink the router journals all slots before it and waits until the conductor lets it go on; links change nowhere else. When
packets are sent again, the router routes them again, with the same fates, as a restarted router would.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from queue import SimpleQueue
from typing import final

import numpy as np

from evedrop.errors import NotRegistered
from evedrop.live.network.access import access_control, grants
from evedrop.live.network.delayed_sender import DelayedSender
from evedrop.live.network.linked_routers import at_router
from evedrop.live.network.process_session import ProcessSession
from evedrop.live.network.resending import GapDetector
from evedrop.live.network.router_commands import Commands, ReplayRequested
from evedrop.live.network.router_users import until_all_left, users_file
from evedrop.live.network.session import Session, router_config
from evedrop.live.protocol.brief import AnyBrief, Brief
from evedrop.live.protocol.brief_closed_loop import Wiring
from evedrop.live.protocol.brief_parts import RouterPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import Go, LinkChange
from evedrop.live.protocol.packets import (
    PacketExtras,
    acknowledgement,
    barrier,
    delivery,
    is_barrier,
    is_resend,
    packed_header,
    read_acknowledgement,
    read_beside,
    read_resend,
    read_uplink,
)
from evedrop.live.protocol.telemetry import Journal
from evedrop.live.protocol.zenoh_config import ZenohConfig
from evedrop.model.acknowledgements import AckChannel, WayBackSpec
from evedrop.model.flag_bits import packed_flags
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.model.slot.account import COUNTED_BURSTS, Account, Accountant
from evedrop.model.slot.link import Change, Fates, Link, LinkSchedule, streams_of
from evedrop.model.slot.transit import Late, Transit
from evedrop.names import ACKNOWLEDGEMENTS, LEGITIMATE, ROUTER


@final
class Downlink:
    """One receiver's link, whose fates are decided a batch of slots ahead, and its outlet."""

    def __init__(
        self, name: str, course: LinkSchedule, brief: Brief[RouterPart], put: Callable[[bytes, float], None]
    ) -> None:
        self._course = course
        keys = {stream: brief.stream_keys[stream] for stream in streams_of(name, self._course)}
        self._link = Link(self._course, name, keys, brief.batch)
        self._accountant = Accountant(self._course.window, brief.trials)
        self._transit = Transit()
        self._put = put
        self._pace = brief.part.pace
        self._rests: dict[int, float] = {}
        """Slot → the fraction of a slot that the first trial's packet takes in addition, for packets that may still arrive."""
        self._leak = brief.part.leaks.get(name)
        self._slots = range(0)
        self._fates: Fates
        self._own = False
        self._masks: list[bytes]
        self._received: list[int]

    def plan(self, slots: range) -> None:
        """Decide the fates of the next batch of slots."""
        self._take(slots, self._link.planned(slots))

    def amend(self, at: int, changes: Iterable[Change]) -> None:
        """Decide the slots of the batch from `at` on again, with these changes; none of them may have been journaled."""
        self._take(range(at, self._slots.stop), self._link.amended(at, changes))

    def _take(self, slots: range, fates: Fates) -> None:
        self._slots, self._fates, self._in_time, self._own = slots, fates, fates.in_time, False
        self._masks = [mask.tobytes() for mask in packed_flags(self._in_time)]
        self._received = np.count_nonzero(self._in_time, axis=1).tolist()

    def account(self, slots: range) -> Account:
        """The fates of the packets of the next slots, which belong to the current batch."""
        rows = slice(slots.start - self._slots.start, slots.stop - self._slots.start)
        return self._accountant.account(slots, self._fates.part(rows))

    def present(self, k: int) -> bool:
        """Whether the receiver is present in slot k."""
        return not any(away.start <= k < away.stop for away in self._course.outages)

    def gamma(self, k: int) -> Flags:
        """γ of slot k, which belongs to the current batch and was delivered, (R,)."""
        in_time: Flags = self._in_time[k - self._slots.start]
        return in_time

    def _silence(self, row: int, sent: Flags) -> None:
        """Remove the packets that were not sent from the account."""
        if not self._own:
            self._fates, self._own = self._fates.copied(), True
        self._fates.silence(row, sent)
        self._in_time[row] &= sent
        self._masks[row] = packed_flags(self._in_time[row]).tobytes()
        self._received[row] = int(np.count_nonzero(self._in_time[row]))

    def deliver(self, k: int, z: Floats, whole: bytes, beside: PacketExtras, known: bool = False) -> None:
        """Send slot k's delivery: the packets of z (n, R) that arrive in the slot.

        whole: z as bytes, for a slot in which all packets arrive.
        known: the receiver has the delivery; only update the packets under way.
        """
        row = k - self._slots.start
        if beside.sent is not None:
            self._silence(row, beside.sent)
        late: tuple[Late, ...] = ()
        if self._fates.delays is not None or self._fates.again is not None or self._transit.busy:
            late = self._transit.arrival(k, self._fates, row, z, beside.header).late
        if known or not self.present(k):
            return
        received = self._received[row]
        payload = (
            whole
            if received == z.shape[1]
            else np.compress(self._in_time[row], z, axis=1).tobytes()
            if received
            else b""
        )
        header = packed_header(beside.header, self._in_time[row]) if beside.header is not None else b""
        truth = beside.truth.tobytes() if beside.truth is not None and k == self._leak else b""
        self._put(delivery(k, self._masks[row], payload, late, header, truth), self._rest(k, row, late) * self._pace)

    def _rest(self, k: int, row: int, late: tuple[Late, ...]) -> float:
        """The fraction of a slot by which to delay slot k's delivery: the longest among the first trial's packets in it."""
        if self._fates.rests is not None:
            self._rests[k] = float(self._fates.rests[row])
        if not self._rests:
            return 0.0
        arrived = [one.k for one in late if one.heard.gamma[0]] + [k] * bool(self._in_time[row, 0])
        rest = max((self._rests.get(slot, 0.0) for slot in arrived), default=0.0)
        self._rests.pop(k - self._course.window, None)
        return rest

    def mark(self, k: int) -> None:
        """Pass a barrier on, if the receiver is present."""
        if not any(away.start < k <= away.stop for away in self._course.outages):
            self._put(barrier(k), 0.0)


@final
class Burst:
    """Deliveries to a receiver that nobody waits for, sent many at a time.

    When the sensor waits for another process in every slot, single messages would wake this receiver for each of them, and
    these wake-ups would take most of the time.
    """

    def __init__(self, put: Callable[[bytes], None]) -> None:
        self._put = put
        self._held: list[bytes] = []

    def hold(self, payload: bytes, _: float) -> None:
        """Hold one message back until `flush`."""
        self._held.append(payload)

    def flush(self) -> None:
        """Send all held messages."""
        for payload in self._held:
            self._put(payload)
        self._held.clear()


@final
class WayBackLink:
    """The link of the acknowledgements, from the legitimate estimator to the sensor, and the attack on it."""

    def __init__(self, brief: AnyBrief, session: ProcessSession, spec: WayBackSpec) -> None:
        key = brief.stream_keys[f"link/{ACKNOWLEDGEMENTS}"]
        self._way = AckChannel(spec.attack, spec.quality, key, brief.batch, spec.spans)
        self._jammer = spec.jammer
        self._trials, self._place = brief.trials, session.place
        self._key = session.keys.acknowledged
        self._due = GapDetector(self._key, brief.flow.longest_outage)
        self.sent: SimpleQueue[bytes | None] = SimpleQueue()
        """The legitimate estimator's acknowledgements; None: the conductor sent a command that may end the waiting."""
        session.funnel(self._key, self.sent.put)
        self._put = session.outlet(session.keys.acknowledgements)

    def carry(self, k: int, sent: Flags | None, downlinks: Mapping[str, Downlink], commands: Commands) -> None:
        """Wait for the acknowledgements of slot k, and send on those that reach the sensor; sent (R,): as in `PacketExtras`.

        An absent receiver acknowledges nothing. Raises the errors of `Commands.check`.
        """
        gamma = np.zeros(self._trials, np.bool_)
        if downlinks[LEGITIMATE].present(k):
            gamma = self._acknowledged(k, commands)
        gamma_e = gamma if self._jammer is None else downlinks[self._jammer].gamma(k)
        self._put(acknowledgement(k, self._way.arrived(k, sent, gamma, gamma_e)))

    def _acknowledged(self, k: int, commands: Commands) -> Flags:
        while True:
            with self._place.waiting(self._key):
                payload = self.sent.get()
            if payload is None:
                commands.check()
                continue
            message = Reader(self._key, payload)
            if (found := message.integer("k")) == k:
                return read_acknowledgement(message, k, self._trials)
            self._due.missed(k, found)


def route(brief: Brief[RouterPart]) -> None:
    """Run the router of a brief until the conductor ends it and all other processes have left."""
    table = grants(brief.run, tuple(brief.part.links), brief.part.controller)
    let_in = table if brief.part.zid is None else at_router(brief.run, table)
    with _opened(brief, access_control(let_in, brief.identity is not None)) as session:
        present = session.attendance(grant.process for grant in table if grant.token is not None)
        Routing(brief, session).carry_on()
        session.conclude()
        until_all_left(present, session.linked)


@final
class Routing:
    """The router's work on an open session."""

    def __init__(self, brief: Brief[RouterPart], session: ProcessSession) -> None:
        self._brief, self._session = brief, session
        self._shape = (len(brief.model.A), brief.trials)
        self._uplink = session.inbox(session.keys.uplink)
        self._due = GapDetector(session.keys.uplink, brief.flow.longest_outage)
        self._put_journal = session.outlet(session.keys.journal)
        postman = DelayedSender() if brief.part.pace else None
        self._bursts: list[Burst] = []

        def outlet(name: str, course: LinkSchedule) -> Callable[[bytes, float], None]:
            put = session.outlet(session.keys.downlink(name))
            wiring = brief.part.controller
            if postman is None and wiring is not None and not self._is_waited_for(name, wiring):
                self._bursts.append(Burst(put))
                return self._bursts[-1].hold
            delays = any("delay" in (one or {}) for one in (course.settings, *(c.settings for c in course.changes)))
            return (lambda payload, _: put(payload)) if postman is None or not delays else postman.round(put)

        self._courses = {name: entry.schedule for name, entry in brief.part.links.items()}
        self._outlets = {name: outlet(name, course) for name, course in self._courses.items()}
        acknowledgements = brief.part.acknowledgements
        self._way_back = WayBackLink(brief, session, acknowledgements) if acknowledgements is not None else None
        # A message to the router's own uplink wakes the thread that waits there: only the conductor ends a router.
        knock = session.outlet(session.keys.uplink)
        waiting = [] if self._way_back is None else [self._way_back.sent]
        self._commands = Commands(
            session, tuple(self._courses), lambda: knock(barrier(brief.slots)), waiting, brief.flow.longest_outage
        )
        self._stale = False
        """Whether to ignore packets until the resend begins."""
        self._begin(0, 0)

    def _is_waited_for(self, receiver: str, wiring: Wiring) -> bool:
        """Whether the sensor waits in some slots for a receiver's acknowledgement or estimate."""
        acknowledged = self._brief.part.acknowledgements is not None
        return receiver == LEGITIMATE and (not wiring.on_truth or wiring.knows_input or acknowledged)

    def carry_on(self) -> None:
        """Route all slots, again as often as the conductor asks, until it ends the run."""
        # No need to wait: a process subscribes before it shows its token, and it showed the token to this very session.
        self._session.appear()
        while not self._commands.over():
            try:
                self._take(Reader(self._session.keys.uplink, self._uplink.recv()))
            except ReplayRequested:
                self._stale = True

    def _begin(self, start: int, done: int) -> None:
        """Restore the router's state before slot `start`, which follows from the links alone.

        done: all slots below it have been delivered, acknowledged and journaled.
        """
        self._stale = False
        self._flush()  # nobody needs these messages, but they must not mix with the following ones
        self._k, self._done, self._journaled = start, done, start
        self._downlinks = {
            name: Downlink(name, course, self._brief, self._outlets[name]) for name, course in self._courses.items()
        }
        for first in range(0, start + 1, self._brief.flow.batch):
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

    def _take(self, message: Reader) -> None:
        """Handle a message of the sensor: a packet, a barrier, or the announcement of a resend."""
        if is_resend(message):
            self._resend(message)
            return
        k = message.integer("k")
        if self._stale or k == self._brief.slots:
            return
        if k != self._k:
            self._due.missed(self._k, k)
            return
        if k == self._done:
            self._journal(k)
        if is_barrier(message):
            if k >= self._done:
                self._journal(k)
                self._hold(k)
            return
        self._route(k, message)
        if k + 1 == self._slots.stop:
            self._flush()
            self._journal(k + 1)
            self._plan(k + 1)

    def _route(self, k: int, message: Reader) -> None:
        """Deliver the packet of slot k, unless it is known to have been delivered."""
        z = read_uplink(message, k, self._shape)
        beside = read_beside(message, self._shape, self._brief.model.header)
        whole, known = z.tobytes(), k < self._done
        for downlink in self._downlinks.values():
            downlink.deliver(k, z, whole, beside, known)
        if self._way_back is not None and not known:
            self._way_back.carry(k, beside.sent, self._downlinks, self._commands)
        self._k = self._session.place.slot = k + 1

    def _flush(self) -> None:
        for burst in self._bursts:
            burst.flush()

    def _resend(self, message: Reader) -> None:
        """Begin a resend, which the conductor and the sensor announce in either order; wait for the conductor if need be."""
        number, done, start = read_resend(message, self._brief.slots)
        again = self._commands.resend_of(number)
        if again is None:  # the conductor has asked again since
            self._stale = True
            return
        for name, changes in (again.links or {}).items():
            self._courses[name] = replace(self._courses[name], changes=changes)
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
        """Pass a barrier on, and obey the conductor until it lets the router go on."""
        for downlink in self._downlinks.values():
            downlink.mark(k)
        self._flush()
        while True:
            match self._commands.next():
                case Go(slot) if slot == k:
                    return
                case LinkChange() as change:
                    self._amend(change, k)

    def _amend(self, command: LinkChange, k: int) -> None:
        """Change a link from slot k on, as the conductor's command says."""
        name, changes = command.link, command.changes
        try:
            self._downlinks[name].amend(k, changes)
        except (KeyError, TypeError, ValueError, NotRegistered) as error:
            message = Reader(self._session.keys.control(ROUTER), command.pack())
            raise message.malformed(f"invalid settings ({error!r:.80})", f"settings of the link of {name}") from error
        course = self._courses[name]
        self._courses[name] = replace(course, changes=(*(one for one in course.changes if one.at < k), *changes))


def _opened(brief: Brief[RouterPart], access: ZenohConfig) -> Session:
    with users_file(brief.part.users) as users:
        return Session(brief, router_config(brief, str(users), access, brief.router), brief.router)
