"""The router: takes each packet of the uplink, lets every link decide its fate, delivers, and keeps the journal.

    uplink ── k, z ──┬── link of receiver 1 ── fate, γ ── downlink/1
                     ├── link of receiver 2 ── fate, γ ── downlink/2      fates of all ── journal
                     └── …

It never loses a message: a receiver gets one delivery in every slot, with the packets its link did not erase.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emulator.brief import Brief
from emulator.model.links import link_of
from emulator.model.links.link import Fate, Link, losses
from emulator.model.process import Floats
from emulator.model.receiver import Codes, Flags
from emulator.network.access import access_control, grants
from emulator.network.session import Session, router_config
from emulator.network.wire import Journal, delivery, packed_flags, read_uplink

_FAREWELL_SECONDS = 10.0


class Downlink:
    """One receiver's link, decided a batch of slots ahead, and its outlet. Final."""

    def __init__(self, link: Link, put: Callable[[bytes], None]) -> None:
        self._link = link
        self._put = put
        self._first = 0
        self.fates: Codes
        """Of the batch at hand, (c, R)."""
        self._delivered: Flags
        self._masks: list[bytes]
        self._received: list[int]

    def plan(self, slots: range) -> None:
        """Decide the next batch of slots."""
        self._first = slots.start
        self.fates = self._link.fates(slots)
        self._delivered = self.fates == Fate.DELIVERED
        self._masks = [mask.tobytes() for mask in packed_flags(self._delivered)]
        self._received = np.count_nonzero(self._delivered, axis=1).tolist()

    def deliver(self, k: int, z: Floats, whole: bytes) -> None:
        """Send slot k's delivery: the packets z (n, R), or as bytes the whole of them, that the link does not erase."""
        row = k - self._first
        received = self._received[row]
        payload = (
            whole
            if received == z.shape[1]
            else np.compress(self._delivered[row], z, axis=1).tobytes()
            if received
            else b""
        )
        self._put(delivery(k, self._masks[row], payload))


def journal_of(slots: range, downlinks: Mapping[str, Downlink]) -> bytes:
    """The journal message of the batch at hand."""
    fates = {name: downlink.fates for name, downlink in downlinks.items()}
    delivered = {name: codes == Fate.DELIVERED for name, codes in fates.items()}
    return Journal(slots.start, len(slots), delivered, {name: losses(codes) for name, codes in fates.items()}).pack()


def route(brief: Brief) -> None:
    """Run the router of a brief until the conductor ends it and everybody has left."""
    receivers = tuple(brief.part["links"])
    keys, batch = brief.stream_keys, brief.batch
    links = {name: link_of(spec, keys[f"link/{name}"], batch) for name, spec in brief.part["links"].items()}
    shape = (len(brief.model.A), brief.trials)
    table = grants(brief.run, receivers)
    with _opened(brief, access_control(table)) as session:
        present = {grant.process: False for grant in table}
        for name in present:
            session.watch(name, lambda there, name=name: present.__setitem__(name, there))  # type: ignore[misc]
        uplink = session.inbox(session.keys.uplink)
        put_journal = session.outlet(session.keys.journal)
        downlinks = {name: Downlink(link, session.outlet(session.keys.downlink(name))) for name, link in links.items()}
        session.ready()
        for first in range(0, brief.slots, brief.flow.batch):
            slots = range(first, min(first + brief.flow.batch, brief.slots))
            for downlink in downlinks.values():
                downlink.plan(slots)
            for k in slots:
                z = read_uplink(session.keys.uplink, uplink.recv().payload.to_bytes(), k, shape)
                whole = z.tobytes()
                for downlink in downlinks.values():
                    downlink.deliver(k, z, whole)
            put_journal(journal_of(slots, downlinks))
        session.wait_for("end")
        deadline = time.monotonic() + _FAREWELL_SECONDS
        while any(present.values()) and time.monotonic() < deadline:
            time.sleep(0.005)


def _opened(brief: Brief, access: dict[str, Any]) -> Session:
    with _users_file(brief.part["users"]) as users:
        return Session(brief, router_config(brief.router, str(users), access))


@contextmanager
def _users_file(users: Mapping[str, str]) -> Iterator[Path]:
    """The dictionary of users and passwords that Zenoh reads once, when the session opens; then it must not stay."""
    handle, name = tempfile.mkstemp(prefix="evedrop-users-")
    path = Path(name)
    try:
        with os.fdopen(handle, "w") as file:
            file.writelines(f"{user}:{password}\n" for user, password in users.items())
        yield path
    finally:
        path.unlink(missing_ok=True)
