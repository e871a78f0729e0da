"""Who is there: the liveliness tokens that simulated sessions show, pass on and watch.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import final

import zenoh

from evedrop.virtual.zenoh.access import expression_of, intersects
from evedrop.virtual.zenoh.handlers import Callback, Taker, VirtualDeclaration, taker_of
from evedrop.virtual.zenoh.questions import QUERY_SECONDS, VirtualQuestions
from evedrop.virtual.zenoh.transport import End, TransportFrame, VirtualReply, VirtualSample


@final
class VirtualToken(VirtualDeclaration):
    """Shows that its process is there."""

    def __init__(self, liveliness: Liveliness, key: str) -> None:
        self._liveliness, self._key = liveliness, key
        self._shown = True

    def undeclare(self) -> None:
        """Withdraw it. Raises ZError if it is withdrawn already, or its session is closed."""
        if not self._shown:
            raise zenoh.ZError("the token is undeclared")
        self._liveliness.withdraw(self._key)
        self._shown = False


def _token_sample(key: str, *, there: bool) -> VirtualSample:
    return VirtualSample(key, zenoh.ZBytes(b""), zenoh.SampleKind.PUT if there else zenoh.SampleKind.DELETE)


@final
@dataclass(frozen=True)
class VirtualWatch(VirtualDeclaration):
    """Calls a function when somebody comes or goes."""

    liveliness: Liveliness
    key: str
    taker: Taker

    def undeclare(self) -> None:
        """Call it no more."""
        self.taker.end()
        self.liveliness.unwatch(self)


@final
class Liveliness:
    """Who is there, as a session shows and sees it."""

    def __init__(self, questions: VirtualQuestions) -> None:
        """questions: of its session."""
        self._questions, self._session = questions, questions.session
        self.shown: Counter[str] = Counter()
        """Token of this session → how often it is declared."""
        self.watching: list[VirtualWatch] = []

    def declare_token(self, key: str) -> VirtualToken:
        """Show a token. Raises ZError if the session is closed."""
        self._session.expect_open()
        key = expression_of(key)
        self.shown[key] += 1
        if self.shown[key] == 1:
            self._tell(None, key, there=True)
        return VirtualToken(self, key)

    def withdraw(self, key: str) -> None:
        """Withdraw a token. Raises ZError if the session is closed."""
        self._session.expect_open()
        self.shown[key] -= 1
        if not self.shown[key]:
            del self.shown[key]
            self._tell(None, key, there=False)

    def declare_subscriber(
        self, key: str, handler: Callable[[VirtualSample], object], history: bool = False
    ) -> VirtualWatch:
        """Watch tokens; history: also those that are there already. Raises ZError if the session is closed."""
        self._session.expect_open()
        watch = VirtualWatch(self, expression_of(key), taker_of(self._session, handler))
        for token in self.known(key) if history else ():
            watch.taker.put(_token_sample(token, there=True))
        self.watching.append(watch)
        for end in self._session.ends if not self._session.router else ():
            end.send(TransportFrame("declare_liveliness_subscriber", key, number=int(history)))
        return watch

    def unwatch(self, watch: VirtualWatch) -> None:
        """Watch tokens no more; others go on telling."""
        self.watching.remove(watch)

    def get(
        self, key: str, handler: Callback | None = None, timeout: float = QUERY_SECONDS
    ) -> Iterator[VirtualReply] | None:
        """Who is there now; the handler gets that, if there is one. Raises ZError if the session is closed."""
        return self._questions.ask(TransportFrame("liveliness_query", key), timeout, handler)

    def known(self, key: str) -> list[str]:
        """The tokens that this session knows: its own, and those from all ends."""
        others = (token for end in self._session.ends for token in end.tokens)
        return [token for token in dict.fromkeys(chain(self.shown, others)) if intersects(key, token)]

    def to_tell(self, key: str) -> list[str]:
        """The tokens that a question finds at a client, which says what it shows itself; its router adds all that it knows."""
        return self.known(key) if self._session.router else [own for own in self.shown if intersects(key, own)]

    def greet(self, end: End, others: Iterable[End]) -> None:
        """Tell a new end what is shown here and at others, and what is watched here."""
        if end.to_router:
            for key in dict.fromkeys(chain(self.shown, *(other.tokens for other in others))):
                if self._session.lets_out(end, "liveliness_token", key):
                    end.send(TransportFrame("token", key))
        for key in dict.fromkeys(watch.key for watch in self.watching if not self._session.router):
            end.send(TransportFrame("declare_liveliness_subscriber", key, number=1))

    def take(self, end: End, frame: TransportFrame) -> None:
        """Take a message about tokens from an end, if access control allows it."""
        watches = frame.kind == "declare_liveliness_subscriber"
        message, key = frame.kind if watches else "liveliness_token", frame.key
        if not self._session.access.allows(end.peer, "ingress", message, key):
            return
        if watches:
            end.watched[key] = None
            for token in self.known(key) if frame.number else ():
                if self._session.lets_out(end, "liveliness_token", token):
                    end.send(TransportFrame("token", token))
        elif frame.kind == "no token":
            self._forget(end, key)
        elif key not in end.tokens:
            end.tokens[key] = None
            self._tell(end, key, there=True)

    def lose(self, end: End) -> None:
        """An end is gone, and all tokens that it has shown."""
        for key in [*end.tokens]:
            self._forget(end, key)

    def _is_shown(self, key: str, *but: End | None) -> bool:
        """Whether a token is shown elsewhere than at these ends; None: than by this session itself."""
        own = None not in but and key in self.shown
        return own or any(key in end.tokens for end in self._session.ends if end not in but)

    def _tell(self, source: End | None, key: str, *, there: bool) -> None:
        """Tell the watchers here, and the ends, that a token has come or gone; not those that know of one of the same key.

        A router tells it to the client that shows it as well, if that one watches.
        """
        if not self._is_shown(key, source):
            for watch in [*self.watching]:
                if intersects(watch.key, key):
                    watch.taker.put(_token_sample(key, there=there))
        kind = "token" if there else "no token"
        for end in self._session.ends:
            if end.to_router:  # routers are told everything
                wanted = end is not source and (source is None or self._session.router)
                wanted = wanted and not self._is_shown(key, source, end)
            else:  # clients, what they watch
                wanted = any(intersects(pattern, key) for pattern in end.watched) and not self._is_shown(key, source)
            if wanted and self._session.lets_out(end, "liveliness_token", key):
                end.send(TransportFrame(kind, key))

    def _forget(self, end: End, key: str) -> None:
        end.tokens.pop(key, None)  # who watches without history may not know of it
        self._tell(end, key, there=False)
