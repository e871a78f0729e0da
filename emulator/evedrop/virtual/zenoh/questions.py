"""Questions that simulated sessions ask, pass on and answer.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from types import TracebackType
from typing import Any, Self, final

import zenoh

from evedrop.virtual.zenoh.access import includes, intersects
from evedrop.virtual.zenoh.handlers import Callback, Channel, Taker, VirtualDeclaration, items_of, taker_of
from evedrop.virtual.zenoh.transport import (
    AnySession,
    End,
    MatchingStatus,
    ReplyError,
    TransportFrame,
    VirtualReply,
    bytes_of,
    details_of,
)

QUERY_SECONDS = 10.0
"""How long a question takes at most, if the program does not say."""
_NO_LIMIT = sys.maxsize


@final
class VirtualQuery:
    """A question, as the process that answers it gets it. Once nobody holds it, there is no further answer."""

    def __init__(self, questions: VirtualQuestions, frame: TransportFrame, number: int) -> None:
        self._questions, self.key_expr, self._number = questions, frame.key, number
        self.payload = zenoh.ZBytes(frame.payload) if frame.payload else None
        self.encoding = frame.details.encoding
        self.attachment, self.source_info = frame.details.attachment, frame.details.source_info
        self.parameters = zenoh.Parameters(frame.details.parameters)
        self._open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.drop()

    def __del__(self) -> None:
        if self._open:  # not at once: whoever let it go may be in the middle of something
            self._questions.session.scheduler.after_seconds(0.0, self.drop)

    @property
    def selector(self) -> zenoh.Selector:
        """Key expression and parameters."""
        return zenoh.Selector(self.key_expr, self.parameters)

    @staticmethod
    def accepts_replies() -> zenoh.ReplyKeyExpr:
        """Answers have keys that the question has."""
        return zenoh.ReplyKeyExpr.MATCHING_QUERY

    def reply(self, key: str, payload: bytes | str | zenoh.ZBytes, **details: Any) -> None:
        """Answer it. Raises ZError if the session is closed."""
        self._answer("reply", str(key), payload, details)

    def reply_del(self, key: str, **details: Any) -> None:
        """Answer that what was on a key is deleted. Raises ZError if the session is closed."""
        self._answer("reply", str(key), b"", {**details, "kind": zenoh.SampleKind.DELETE})

    def reply_err(self, payload: bytes | str | zenoh.ZBytes, **details: Any) -> None:
        """Say why there is no answer. Raises ZError if the session is closed."""
        self._answer("error", self.key_expr, payload, details)

    def _answer(self, kind: str, key: str, payload: bytes | str | zenoh.ZBytes, details: Mapping[str, Any]) -> None:
        self._questions.session.expect_open()
        if self._open:
            self._questions.take(
                None, TransportFrame(kind, key, bytes_of(payload), self._number, details_of(**details))
            )

    def drop(self) -> None:
        """Give no further answer."""
        if self._open:
            self._open = False
            self._questions.take(None, TransportFrame("final", self.key_expr, b"", self._number))


@final
@dataclass(frozen=True)
class VirtualQueryable(VirtualDeclaration):
    """Answers questions at a key expression, by a function."""

    questions: VirtualQuestions
    key: str
    taker: Taker

    def undeclare(self) -> None:
        """Answer no more."""
        self.taker.end()
        self.questions.withdraw(self)


@final
class VirtualQuerier(VirtualDeclaration):
    """Asks others, but not its own session, at a key expression."""

    def __init__(self, questions: VirtualQuestions, key: str, timeout: float, latest: bool) -> None:
        """latest: whether its questions get the latest answer of each key."""
        self._questions, self._key, self._timeout, self._latest = questions, key, timeout, latest

    def get(
        self,
        handler: Callback,
        *,
        payload: zenoh.ZBytes | None = None,
        parameters: str | zenoh.Parameters = "",
        encoding: zenoh.Encoding | None = None,
        attachment: zenoh.ZBytes | None = None,
        source_info: zenoh.SourceInfo | None = None,
    ) -> None:
        """Ask; the handler gets the answers, and is told when there are no more. Raises ZError if the session is closed."""
        details = details_of(
            encoding=encoding, attachment=attachment, source_info=source_info, parameters=str(parameters) or None
        )
        frame = TransportFrame("query", self._key, bytes_of(payload), 0, details)
        self._questions.ask(frame, self._timeout, handler, remote=True, latest=self._latest)

    @property
    def matching_status(self) -> MatchingStatus:
        """Whether somebody answers all questions at the key expression. Raises ZError if the session is closed."""
        return MatchingStatus(self._questions.has_answer(self._key))


@dataclass
class _Asked:
    """A question that a session has asked, or passed on."""

    asker: End | None
    """Who asked the session; None if the session itself did."""
    asked_as: int
    """Its number where it came from."""
    left: list[End | None]
    """Who has still to answer; None: a queryable of the session."""
    replies: Taker | None = None
    latest: dict[str, VirtualReply] | None = None
    """Key → its latest answer, if the asker gets no other."""


@final
class VirtualQuestions:
    """The questions of a session: its own, and those that it passes on."""

    def __init__(self, session: AnySession) -> None:
        self.session = session
        self.answering: list[VirtualQueryable] = []
        """What this session answers."""
        self._asked: dict[int, _Asked] = {}

    def declare_queryable(self, key: str, handler: Callable[[VirtualQuery], object]) -> VirtualQueryable:
        """Answer questions at a key expression. Raises ZError if the session is closed."""
        self.session.expect_open()
        queryable = VirtualQueryable(self, key, taker_of(self.session, handler))
        self.answering.append(queryable)
        self.session.declare("declare_queryable", key)
        return queryable

    def withdraw(self, queryable: VirtualQueryable) -> None:
        """Answer no more questions there."""
        if queryable in self.answering:
            self.answering.remove(queryable)
            self.session.withdraw("declare_queryable", queryable.key)

    def has_answer(self, key: str) -> bool:
        """Whether somebody else answers all questions at a key. Raises ZError if the session is closed."""
        self.session.expect_open()
        return any(includes(pattern, key) for end in self.session.ends for pattern in end.answers)

    def ask(
        self,
        frame: TransportFrame,
        timeout: float,
        handler: Callback | None = None,
        *,
        remote: bool = False,
        latest: bool = False,
    ) -> Iterator[VirtualReply] | None:
        """Ask a question, and return the answers, unless a handler gets them. Raises ZError if the session is closed.

        remote: only others. latest: to get the latest answer of each key, when there are no more.
        """
        session = self.session
        session.expect_open()
        channel = Channel(session, _NO_LIMIT)
        taker = channel if handler is None else taker_of(session, handler)
        number = self._pass_on(_Asked(None, 0, [], taker, {} if latest else None), frame, remote=remote)
        session.scheduler.after_seconds(timeout, lambda: self._give_up(number))
        session.scheduler.interruptible()
        return items_of(channel) if handler is None else None

    def pass_from(self, end: End, frame: TransportFrame) -> None:
        """Pass on a question that has come from an end."""
        self._pass_on(_Asked(end, frame.number, []), frame)

    def take(self, source: End | None, frame: TransportFrame) -> None:
        """Deal with an answer, or with the end of all answers, from an end or, None, from this session."""
        asked = self._asked.get(frame.number)
        if asked is None:
            return
        if frame.kind != "final":
            self._reply(frame, asked)
        elif source in asked.left:
            asked.left.remove(source)
            if not asked.left:
                self._finish(frame.number)

    def lose(self, end: End) -> None:
        """An end is gone: it answers nothing more."""
        for number, asked in [*self._asked.items()]:
            if end in asked.left:
                self.take(end, TransportFrame("final", "", b"", number))

    def end(self) -> None:
        """The session ends: nobody answers its questions, and it answers none."""
        asked = [question.replies for question in self._asked.values() if question.replies is not None]
        self._asked.clear()
        for taker in (*(queryable.taker for queryable in self.answering), *asked):
            taker.end()

    def _pass_on(self, asked: _Asked, frame: TransportFrame, *, remote: bool = False) -> int:
        """Ask all who may answer a question; returns its number here."""
        number, source = self.session.scheduler.number(), asked.asker
        targets: list[End] = []
        liveliness = frame.kind == "liveliness_query"
        for end in self.session.ends:
            if end is source or (source is not None and not self.session.router):
                continue
            upward = end.to_router and not self.session.router
            wanted = upward or (not liveliness and any(intersects(pattern, frame.key) for pattern in end.answers))
            if wanted and (upward or self.session.access.allows(end.peer, "egress", frame.kind, frame.key)):
                targets.append(end)
        own = () if liveliness or remote else self.answering
        takers = [queryable.taker for queryable in own if intersects(queryable.key, frame.key)]
        asked.left = [*targets, *([None] * len(takers))]
        self._asked[number] = asked
        if liveliness:
            for token in self.session.tokens_to_tell(frame.key):
                self._reply(TransportFrame("reply", token), asked)
        for target in targets:
            target.send(frame._replace(number=number))
        for taker in takers:
            taker.put(VirtualQuery(self, frame, number))
        if not asked.left and number in self._asked:  # unless a queryable has just ended it
            self._finish(number)
        return number

    def _reply(self, frame: TransportFrame, asked: _Asked) -> None:
        if asked.asker is not None:
            kind = "reply" if frame.payload else "liveliness_token"
            if self.session.access.allows(asked.asker.peer, "egress", kind, frame.key):
                asked.asker.send(frame._replace(number=asked.asked_as))
        elif asked.replies is not None:
            if frame.kind == "error":
                error = ReplyError(zenoh.ZBytes(frame.payload), frame.details.encoding)
                asked.replies.put(VirtualReply(None, error))
            elif asked.latest is None:
                asked.replies.put(VirtualReply(frame.sample()))
            else:
                asked.latest[frame.key] = VirtualReply(frame.sample())

    def _finish(self, number: int, *errors: VirtualReply) -> None:
        asked = self._asked.pop(number)
        if asked.asker is not None:
            asked.asker.send(TransportFrame("final", "", b"", asked.asked_as))
        elif asked.replies is not None:
            for reply in chain((asked.latest or {}).values(), errors):
                asked.replies.put(reply)
            asked.replies.end()

    def _give_up(self, number: int) -> None:
        if number in self._asked:
            self._finish(number, VirtualReply(None, ReplyError(zenoh.ZBytes(b"Timeout")), None))
