"""The command `evedrop wire` with a part that hangs: `python -m tests.wire.hanging_wire HOW FILE …`."""

from __future__ import annotations

import json
import sys
import threading
from typing import Any, NoReturn
from unittest.mock import patch

from evedrop.__main__ import program
from evedrop.wire import side
from evedrop.wire.journal import WireJournal
from evedrop.wire.publications import PublicationRelay
from evedrop.wire.recording import WireView
from evedrop.wire.side import SideSession
from evedrop.wire.watchdog import Watchdog

SOON = 1.0
"""Seconds after which the watchdog ends such a wire."""


def look_soon(where: str) -> None:
    """Let the watchdog end the wire soon if this part hangs; the others may be slow, as on a busy machine."""
    allowed = Watchdog._allowed
    patch.object(Watchdog, "_allowed", lambda self, duty: SOON if duty.where == where else allowed(self, duty)).start()


def for_ever() -> NoReturn:
    """Wait for a lock that nobody releases."""
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()
    raise AssertionError


def a_side() -> None:
    """Zenoh does not answer at the side base."""
    look_soon("at the side base")
    patch.object(SideSession, "answer", lambda self: for_ever() if self.name == "base" else None).start()


def a_message() -> None:
    """The thread that passes messages of the side robot on hangs at the key `hang`."""
    look_soon("among the messages from the side robot")
    way_to = PublicationRelay._way_to

    def hangs(self: PublicationRelay, ways: Any, key: str, expression: Any) -> Any:
        return for_ever() if key == "hang" else way_to(self, ways, key, expression)

    patch.object(PublicationRelay, "_way_to", hangs).start()


def an_end() -> None:
    """The session of the side base cannot be closed."""
    close = SideSession.__exit__

    def hangs(self: SideSession, *error: Any) -> None:
        if self.name == "base":
            with self.duty.busy():
                for_ever()
        close(self, *error)

    patch.object(SideSession, "__exit__", hangs).start()


def an_end_soon() -> None:
    """The same, and the watchdog looks soon."""
    look_soon("at the side base")
    an_end()


def a_start() -> None:
    """The sides cannot be opened, and the main thread is deaf to everything."""
    patch.object(SideSession, "__init__", lambda *_: for_ever()).start()


def a_journal() -> None:
    """The journal answers nobody once it has heard a message, and everything that ends it waits for it."""
    look_soon("in the journal")
    flush = WireJournal.flush

    def hangs(self: WireJournal) -> None:
        if self.counts:
            with self._handing:
                for_ever()
        flush(self)

    patch.object(WireJournal, "flush", hangs).start()


def zenoh() -> None:
    """Every side has the administration space with which a program can stop Zenoh itself."""
    look_soon("at the side base")
    config_of = side.side_config

    def with_administration(*arguments: Any) -> dict[str, Any]:
        config = json.loads(json.dumps(config_of(*arguments)))
        return {**config, "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}}}

    patch.object(side, "side_config", with_administration).start()


def a_view() -> None:
    """Rerun does not end, and keeps the interpreter from exiting."""

    def hangs(self: WireView) -> bool:
        threading.Thread(target=for_ever).start()
        return False

    patch.object(WireView, "close", hangs).start()


if __name__ == "__main__":
    how = sys.argv.pop(1)
    globals()[how]()
    sys.argv[:1] = ["evedrop", "wire"]
    program()
