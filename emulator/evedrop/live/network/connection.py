"""A process's connection with its router: one Zenoh session after another, each with everything the process has declared.

Zenoh would reconnect a session by itself, but then may deliver one key's messages to another key's subscriber
(docs/upstream.md). So a session that has lost its router is closed and another one is opened, which holds nothing that
could be out of date.

Source: docs/protocol.md, lost connections.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from typing import TypeVar, final

import zenoh

from evedrop.errors import EvedropError
from evedrop.live.network.declared import Declared, Subscription, Watch

_AGAIN_SECONDS = 0.02, 0.25  # between attempts, the first and the longest
_ANSWER_SECONDS = 1.0
_RENEW_SECONDS = 1.0  # between sessions that are closed because they confuse keys
_POLL_SECONDS = 0.02
_LINGER_SECONDS = 10.0  # longer than a router needs to find out that a connection is lost

One = TypeVar("One", bound=Declared)


@final
class Connection:
    """A connection that survives the loss of a session; thread-safe; close it, or its threads outlive the program.

    first: the open session. again: makes one attempt to open another; None for a router, to which the others connect.
    changed: called with false at each loss, with true at each new session, on a thread of the connection's.
    """

    def __init__(
        self,
        first: zenoh.Session,
        again: Callable[[], zenoh.Session] | None,
        changed: Callable[[bool], None] = lambda _: None,
    ) -> None:
        self._again, self._changed = again, changed
        self._lock = threading.RLock()
        self._declared: list[Declared] = []
        self._token_key: str | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._losses: SimpleQueue[zenoh.Session | None] = SimpleQueue()
        self._over = threading.Event()
        self._keeper: threading.Thread | None = None
        self.session = first
        """The current session, which is closed while another one is opened."""
        self._opened = time.monotonic()
        self.openings = 1
        """How many sessions there have been."""
        if again is not None:
            self._listen(first)
            self._keeper = threading.Thread(target=self._keep_open, name="keeps-open", daemon=True)
            self._keeper.start()

    def declare(self, one: One) -> One:
        """Declare an object, now and on every later session."""
        with self._lock:
            self._declared.append(one)
            self._declare(self.session, one)
        return one

    def appear(self, key: str) -> None:
        """Show that this process is present, now and on every later session."""
        with self._lock:
            self._token_key = key
            self._show(self.session)

    def disappear(self) -> None:
        """Withdraw the token that `appear` declared."""
        with self._lock:
            self._token_key = None
            if self._token is not None and not self.session.is_closed():
                with suppress(zenoh.ZError):
                    self._token.undeclare()

    def renew(self) -> None:
        """Open another session, since this one confuses keys; at most once per second."""
        if self._again is not None and time.monotonic() - self._opened > _RENEW_SECONDS:
            self._losses.put(self.session)

    def close(self) -> None:
        """Close the connection for good."""
        self._over.set()
        self._losses.put(None)
        if self._keeper is not None and self._keeper is not threading.current_thread():
            self._keeper.join(_LINGER_SECONDS)  # it may be opening a session that nobody needs any more
        _close(self.session)
        for one in self._declared:
            if isinstance(one, Subscription):
                one.close()

    def _declare(self, session: zenoh.Session, one: Declared) -> None:
        """Declare an object on a session that may be closed already: the next session will have it, too."""
        try:
            one.declare(session)
        except zenoh.ZError:
            if not session.is_closed():
                raise

    def _show(self, session: zenoh.Session) -> None:
        if self._token_key is not None and not session.is_closed():
            with suppress(zenoh.ZError):
                self._token = session.liveliness().declare_token(self._token_key)

    def _listen(self, session: zenoh.Session) -> None:
        """Notice when the session loses its router. Closing it here, on a thread of Zenoh's, would deadlock."""
        session.info.declare_transport_events_listener(
            lambda event: self._losses.put(session) if event.kind == zenoh.SampleKind.DELETE else None
        )
        if not session.info.routers_zid():  # lost before there was a listener
            self._losses.put(session)

    def _keep_open(self) -> None:
        while (lost := self._losses.get()) is not None:
            if lost is self.session and not self._over.is_set():
                self._replace(lost)

    def _replace(self, lost: zenoh.Session) -> None:
        self._changed(False)
        for one in list(self._declared):
            if isinstance(one, Watch):
                one.lose()
        _close(lost)
        pause, longest = _AGAIN_SECONDS
        while not self._over.is_set() and self._again is not None:
            try:
                session = self._again()
            except (EvedropError, OSError, zenoh.ZError):
                self._over.wait(pause)
                pause = min(longest, pause * 1.5)
                continue
            self._adopt(session)
            return

    def _adopt(self, session: zenoh.Session) -> None:
        """Declare everything on another session, in the same order; the token of this process comes last."""
        with self._lock:
            self.session, self._opened = session, time.monotonic()
            self.openings += 1
            self._listen(session)
            for one in self._declared:
                self._declare(session, one)
            key = self._token_key
        self._changed(True)
        if key is not None:
            self._wait_for_own_end(session, key)
        with self._lock:
            self._show(session)

    def _wait_for_own_end(self, session: zenoh.Session, key: str) -> None:
        """Wait until the router knows that the previous session is lost: others must see this process leave and return.

        The router may find out later than this process: until then it has the previous token, and a new one would not show.
        """
        deadline = time.monotonic() + _LINGER_SECONDS
        with suppress(zenoh.ZError):
            while (
                not self._over.is_set()
                and session.info.routers_zid()
                and time.monotonic() < deadline
                and any(answer.ok is not None for answer in session.liveliness().get(key, timeout=_ANSWER_SECONDS))
            ):
                time.sleep(_POLL_SECONDS)


def _close(session: zenoh.Session) -> None:
    """Close a session. If its router is stopped, Zenoh gives up after ten seconds; the session is of no use then either."""
    with suppress(zenoh.ZError):
        session.close()
