"""Queries that cross: a query at one side is asked at the other sides too, and their replies come back, as the links decide.

At each side the wire offers a queryable for everything, which is not complete, and a complete one for each service of ROS 2 that
another side has, since ROS 2 asks complete queryables only. Zenoh hands a query to all queryables of a session that match it,
except that one for complete queryables goes to the complete ones alone. So one queryable is responsible for each query, and the
others ignore it: the first complete one whose expression includes the query's key, or else the one for everything.

Source: docs/wire/semantics.md, queries.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, final

import zenoh

from evedrop.system.threads import Queue
from evedrop.system.waiting import wait_for_thread
from evedrop.system.world import world
from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import LOST_HISTORY_SECONDS, WirePlan, published_key
from evedrop.wire.publications import READY_KEYS
from evedrop.wire.records import AGAIN, HELD, UNLINKED, Kind, WireFate
from evedrop.wire.ros2 import SenderReader, reply_seconds
from evedrop.wire.running_link import Decision, Lane, RunningLink, Scheduler
from evedrop.wire.send_queue import SendQueue, waiting_bytes
from evedrop.wire.side import SideSession, expressions_in_turn
from evedrop.wire.watchdog import Duty

_REMOTE = zenoh.Locality.REMOTE
_MOST_WAITING = 100_000
_ROUTING = 0  # the identifier of Zenoh's routing, which no queryable has


@final
class _Asked:
    """A query that was heard, until all its replies have arrived: then the asker is told that there are no more."""

    def __init__(
        self, query: zenoh.Query, side: str, heard: float, send_queue: SendQueue, query_seconds: float
    ) -> None:
        """heard: when, by the monotonic clock; send_queue: of the side at which it was asked."""
        self.query, self.side, self.heard, self._send_queue = query, side, heard, send_queue
        self.key = str(query.key_expr)
        self._over = heard + reply_seconds(self.key, query_seconds)
        self._open = 1
        self._lock = world().lock()

    @property
    def patience(self) -> float:
        """For how many seconds from now on its asker waits for something that is lost."""
        left = max(0.0, self._over - world().monotonic())
        return left if published_key(self.key) is None else min(left, LOST_HISTORY_SECONDS)

    def tell(self, error: zenoh.ReplyError) -> None:
        """Tell its asker of an error that no program sent: it is no message, and no link decides on it."""
        self._send_queue.follow(partial(self.query.reply_err, error.payload, encoding=error.encoding))

    def hold(self) -> None:
        """One thing more to wait for."""
        with self._lock:
            self._open += 1

    def release(self) -> None:
        """One thing less to wait for."""
        with self._lock:
            self._open -= 1
            over = self._open == 0
        if over:
            self._send_queue.follow(self.query.drop)


@final
class QueryRelay:
    """Takes the queries of all sides, and brings their replies back."""

    def __init__(
        self,
        sides: Mapping[str, SideSession],
        links: Mapping[str, RunningLink],
        send_queues: Mapping[str, SendQueue],
        plan: WirePlan,
        journal: WireJournal,
        tell: Callable[[str], None],
    ) -> None:
        """links, send_queues: by the names of links and of sides; tell: for what the user must know."""
        self._tell = tell
        self._sides, self._plan, self._journal = sides, plan, journal
        self._links, self._send_queues = links, send_queues
        self._states = [state for state in links.values() if not state.link.tap]
        self._lanes: dict[tuple[str, str, str], tuple[Lane, RunningLink]] = {}
        self._queriers: dict[tuple[str, str, bool, bool], zenoh.Querier] = {}
        self._services: tuple[frozenset[tuple[str, str]], tuple[bool, ...]] | None = None
        self._mirrored: dict[str, dict[str, tuple[zenoh.KeyExpr, Any]]] = {name: {} for name in sides}
        self._lock = world().rlock()
        self._read = SenderReader(journal.words.source_code)
        self._patience = Scheduler(_MOST_WAITING, 0, lambda _: None)
        self._heard: Queue[tuple[str, str | None, zenoh.Query, float] | None] = world().queue()
        self.duty = Duty("among the queries")
        self._thread = world().thread(self._run, name="queries")
        self._queryables: list[tuple[str, Any]] = []
        """Side and queryable: those for everything, under the side's key expressions."""
        for name, side in sides.items():
            if not any(state.link.source == name for state in self._states):
                continue
            for expression, earlier in expressions_in_turn(side.side, plan.links):
                taker = self._taker(name, None, earlier)
                queryable = side.session.declare_queryable(expression, taker, allowed_origin=_REMOTE)
                self._queryables.append((name, queryable))

    def start(self) -> None:
        """Begin to take queries."""
        self._thread.start()

    def close(self) -> None:
        """End; queries that still wait get no more replies."""
        for name, queryable in self._queryables:
            with self._sides[name].duty.busy():
                queryable.undeclare()
        self._heard.put(None)
        wait_for_thread(self._thread)
        with self._lock:
            for name, mirrored in self._mirrored.items():
                with self._sides[name].duty.busy():
                    for _, queryable in mirrored.values():
                        queryable.undeclare()
                mirrored.clear()
            for (target, *_), querier in self._queriers.items():
                with self._sides[target].duty.busy():
                    querier.undeclare()
        self._patience.close()

    def update(self, services: Iterable[tuple[str, str]]) -> None:
        """Offer the services of each side, given as side and key, at the others: there each gets a complete queryable."""
        now = (frozenset(services), tuple(state.looped for state in self._states))
        if now == self._services:
            return
        keys: dict[str, dict[str, zenoh.KeyExpr]] = {name: {} for name in self._sides}
        for side, key in now[0]:
            keys[side][key] = zenoh.KeyExpr(key)
        for name, session in ((name, side.session) for name, side in self._sides.items()):
            others = {state.link.target for state in self._states if state.link.source == name and not state.looped}
            wanted = {
                key: expression
                for other in others
                for key, expression in keys[other].items()
                if self._link(name, other, expression) is not None
            }
            mirrored = self._mirrored[name]
            for key in sorted(mirrored.keys() - wanted.keys()):
                with self._lock:
                    _, queryable = mirrored.pop(key)
                queryable.undeclare()
            for key in sorted(wanted.keys() - mirrored.keys()):
                queryable = session.declare_queryable(
                    wanted[key], self._taker(name, key), complete=True, allowed_origin=_REMOTE
                )
                with self._lock:
                    mirrored[key] = (wanted[key], queryable)
        self._services = now  # at the end: what Zenoh refuses is tried again

    def _taker(self, name: str, key: str | None, earlier: Sequence[zenoh.KeyExpr] = ()) -> Any:
        """What takes the queries of a queryable, except those of queryables declared `earlier` with these expressions."""

        def take(query: zenoh.Query) -> None:
            if not any(expression.intersects(query.key_expr) for expression in earlier):
                self._heard.put((name, key, query, world().monotonic()))

        # On the thread that Zenoh calls it on: the queries of a program stay in order.
        return world().zenoh.handlers.Callback(take, indirect=False)

    def _run(self) -> None:
        while (heard := self._heard.get()) is not None:
            self.duty.in_hand = heard
            name, key, query, when = heard
            asked = _Asked(query, name, when, self._send_queues[name], self._plan.query_seconds)
            try:
                if self._responsible(name, query.key_expr) == key:
                    self._ask(asked)
            except Exception as error:  # whatever it is: the next query must be asked
                self._tell(f"a query on {asked.key} at the side {name} was not asked at the other sides ({error!r})")
            asked.release()
            self.duty.in_hand = None

    def _responsible(self, name: str, key: zenoh.KeyExpr) -> str | None:
        """The mirrored queryable that answers for a key; None: the one for everything."""
        with self._lock:
            return min(
                (text for text, (expression, _) in self._mirrored[name].items() if expression.includes(key)),
                default=None,
            )

    def _ask(self, asked: _Asked) -> None:
        """Ask the other sides."""
        key = asked.query.key_expr
        complete = self._responsible(asked.side, key) is not None
        for target in dict.fromkeys(state.link.target for state in self._states if state.link.source == asked.side):
            querier = self._querier(target, asked.query, asked.key, complete)
            # The matching status knows only queryables that include the key.
            if "*" not in asked.key and not _matching(querier):
                continue  # nobody there can hear it
            question = self._question(asked, querier, target)
            self._cross(Kind.QUERY, asked, (asked.side, target), asked.key, key, question, asked.heard)

    def _question(self, asked: _Asked, querier: zenoh.Querier, target: str) -> _Message:
        query = asked.query

        def send() -> None:
            asked.hold()
            handler: Any = world().zenoh.handlers.Callback(
                lambda reply: self._reply(asked, target, reply), asked.release, indirect=False
            )
            querier.get(
                handler,
                parameters=query.parameters,
                payload=query.payload,
                encoding=query.encoding,
                attachment=query.attachment,
                source_info=query.source_info,
            )

        return _Message(send, query.payload, query.attachment, query.source_info)

    def _reply(self, asked: _Asked, source: str, reply: zenoh.Reply) -> None:
        """Bring a reply back over the link from the side that it comes from."""
        answer, error, query = reply.ok, reply.err, asked.query
        if error is None:
            assert answer is not None  # noqa: S101 - a reply without an error
            key, expression = str(answer.key_expr), answer.key_expr
            message = _answer(query, answer)
        elif _nobody_sent(reply.replier_id, error):
            asked.tell(error)
            return
        else:
            key, expression = asked.key, query.key_expr
            message = _Message(lambda: query.reply_err(error.payload, encoding=error.encoding), error.payload)
        self._cross(Kind.REPLY, asked, (source, asked.side), key, expression, message, world().monotonic())

    def _cross(
        self,
        kind: Kind,
        asked: _Asked,
        way: tuple[str, str],
        key: str,
        expression: zenoh.KeyExpr,
        message: _Message,
        since: float,
    ) -> None:
        """Let the link between two sides decide on a message, record it, and send it when it is due. since: when it was heard."""
        heard, size = self._journal.place.clock.ahead + since, message.size
        with self._lock:
            sender, sequence = self._read(message.attachment, message.source)
        code = self._journal.words.key_code(key, way[0])
        state = self._link(*way, expression)
        if state is None:
            self._journal.records.record(
                heard, -1, sequence, 0.0, code, sender, size, UNLINKED, kind, WireFate.UNLINKED
            )
            return
        n, fate, delay, again = -1, int(WireFate.TOO_MANY_KEYS), 0.0, False
        if code:
            n, fate, delay, again = self._decided(state, kind.stream, key, expression, since, size)
        mark = int(kind) | AGAIN if again else int(kind)
        row = self._journal.records.record(
            heard, n, sequence, delay, code, sender, size, state.link.number, mark, fate or HELD
        )
        if fate:
            self._wait_in_vain(asked)
            return
        asked.hold()

        def send() -> None:
            try:
                for _ in range(2 if again else 1):
                    message.send()
            finally:
                asked.release()

        def lost() -> None:
            self._wait_in_vain(asked)
            asked.release()

        # Replies wait for room: one query may have many.
        order = state.order(kind.stream, key)
        room = waiting_bytes(size, key)
        self._send_queues[way[1]].send(
            delay, room, row, send, patient=kind == Kind.REPLY, order=order, lost=lost, since=since
        )

    def _wait_in_vain(self, asked: _Asked) -> None:
        """Let an asker wait for its query, or for a reply, that is lost: nothing tells it so."""
        asked.hold()
        if not self._patience.hold(asked.patience, 0, -1, asked.release):
            asked.release()

    def _link(self, source: str, target: str, key: zenoh.KeyExpr) -> RunningLink | None:
        link = self._plan.link_of(source, target, key, query=True)
        return None if link is None else self._links[link.name]

    def _decided(
        self, state: RunningLink, kind: str, key: str, expression: zenoh.KeyExpr, now: float, size: int
    ) -> Decision:
        with self._lock:
            name = (state.link.name, kind, key)
            if name not in self._lanes:
                if len(self._lanes) >= READY_KEYS:
                    oldest, forget = next(iter(self._lanes.items()))
                    forget[1].forget(*oldest[1:])
                    del self._lanes[oldest]
                self._lanes[name] = (state.lane(kind, key, self._plan.is_lossless(expression)), state)
            return self._lanes[name][0](now, size)

    def _querier(self, target: str, query: zenoh.Query, key: str, complete: bool) -> zenoh.Querier:
        accepts = query.accepts_replies()
        anything = accepts == zenoh.ReplyKeyExpr.ANY
        name = (target, key, complete, anything)
        with self._lock:
            if name not in self._queriers:
                if len(self._queriers) >= READY_KEYS:
                    self._queriers.pop(next(iter(self._queriers)))
                self._queriers[name] = self._sides[target].session.declare_querier(
                    query.key_expr,
                    target=zenoh.QueryTarget.ALL_COMPLETE if complete else zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    accept_replies=accepts,
                    timeout=reply_seconds(key, self._plan.query_seconds),
                    allowed_destination=_REMOTE,
                )
            return self._queriers[name]


@final
class _Message:
    """A query or a reply: how it is sent, and what a link and the journal need to know."""

    def __init__(
        self,
        send: Callable[[], None],
        payload: zenoh.ZBytes | None,
        attachment: zenoh.ZBytes | None = None,
        source: zenoh.SourceInfo | None = None,
    ) -> None:
        self.send, self.attachment, self.source = send, attachment, source
        self.size = sum(len(part) for part in (payload, attachment) if part is not None)


def _answer(query: zenoh.Query, answer: zenoh.Sample) -> _Message:
    """The message that answers a query with a reply that is not an error."""

    def send() -> None:
        how: dict[str, Any] = {
            "express": answer.express,
            "attachment": answer.attachment,
            "timestamp": answer.timestamp,
        }
        if answer.kind == zenoh.SampleKind.PUT:
            query.reply(answer.key_expr, answer.payload, encoding=answer.encoding, **how)
        else:
            query.reply_del(answer.key_expr, **how)

    return _Message(send, answer.payload, answer.attachment, answer.source_info)


def _nobody_sent(replier: zenoh.EntityGlobalId | None, error: zenoh.ReplyError) -> bool:
    """Whether an error is that of a querier, or of Zenoh's routing, whose time for replies is over."""
    return (replier is None or replier.eid == _ROUTING) and error.payload.to_bytes() == b"Timeout"


def _matching(querier: zenoh.Querier) -> bool:
    status: Any = querier.matching_status
    return bool(status.matching)
