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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from emulator.brief import Brief
from emulator.model.links import link_of
from emulator.model.links.link import Fate, losses
from emulator.model.receiver import Codes
from emulator.network.access import access_control, grants
from emulator.network.reporting import Batcher
from emulator.network.session import Session, router_config
from emulator.network.wire import Journal, delivery, packed_flags, read_uplink

_FAREWELL_SECONDS = 10.0


class JournalKeeper:
    """Collects fates and makes journal messages of them. Final."""

    def __init__(self, receivers: tuple[str, ...], trials: int, flow_batch: int) -> None:
        self._fates = {name: np.empty((flow_batch, trials), np.uint8) for name in receivers}
        self._first = 0
        self._count = 0

    def add(self, fates: Mapping[str, Codes]) -> None:
        """Take one slot's fates."""
        for name, codes in fates.items():
            self._fates[name][self._count] = codes
        self._count += 1

    def take(self) -> bytes:
        """A message with all that was added since the last one."""
        fates = {name: codes[: self._count] for name, codes in self._fates.items()}
        message = Journal(
            self._first,
            self._count,
            {name: codes == Fate.DELIVERED for name, codes in fates.items()},
            {name: losses(codes) for name, codes in fates.items()},
        ).pack()
        self._first, self._count = self._first + self._count, 0
        return message


def route(brief: Brief) -> None:
    """Run the router of a brief until the conductor ends it and everybody has left."""
    receivers = tuple(brief.part["links"])
    keys, batch = brief.stream_keys, brief.batch
    links = {name: link_of(spec, keys[f"link/{name}"], batch) for name, spec in brief.part["links"].items()}
    shape = (len(brief.model.A), brief.trials)
    table = grants(brief.run, receivers)
    with (
        _users_file(brief.part["users"]) as users,
        Session(brief, router_config(brief.router, str(users), access_control(table))) as session,
    ):
        present = {grant.process: False for grant in table}
        for name in present:
            session.watch(name, lambda there, name=name: present.__setitem__(name, there))  # type: ignore[misc]
        uplink = session.inbox(session.keys.uplink)
        put_journal = session.outlet(session.keys.journal)
        downlinks = {name: session.outlet(session.keys.downlink(name)) for name in receivers}
        session.ready()
        journal = JournalKeeper(receivers, brief.trials, brief.flow.batch)
        batcher = Batcher(brief.slots, brief.flow.batch)
        for k in range(brief.slots):
            z = read_uplink(session.keys.uplink, uplink.recv().payload.to_bytes(), k, shape)
            whole = z.tobytes()
            fates = {name: link.at(k) for name, link in links.items()}
            for name, codes in fates.items():
                delivered = codes == Fate.DELIVERED
                received = int(np.count_nonzero(delivered))
                payload = whole if received == brief.trials else z[:, delivered].tobytes() if received else b""
                downlinks[name](delivery(k, packed_flags(delivered).tobytes(), payload))
            journal.add(fates)
            if batcher.due(k):
                put_journal(journal.take())
        session.wait_for("end")
        deadline = time.monotonic() + _FAREWELL_SECONDS
        while any(present.values()) and time.monotonic() < deadline:
            time.sleep(0.005)


@contextmanager
def _users_file(users: Mapping[str, str]) -> Iterator[Path]:
    """The dictionary of users and passwords that Zenoh reads once, when the session opens; gone with the router."""
    handle, name = tempfile.mkstemp(prefix="evedrop-users-")
    path = Path(name)
    try:
        with os.fdopen(handle, "w") as file:
            file.writelines(f"{user}:{password}\n" for user, password in users.items())
        yield path
    finally:
        path.unlink(missing_ok=True)
