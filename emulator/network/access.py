"""Who may use which key: one table, from which the router's access control is made. Whatever is not in it is denied.

Readers name every key they read: a wildcard subscription is not covered by exact rules and receives nothing.

Source: docs/protocol.md, keys.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

SENSOR = "sensor"
LEGITIMATE = "legitimate"
ROUTER = "router"
OBSERVER = "observer"
OPERATOR = "operator"
ACKNOWLEDGEMENTS = "acknowledgements"
"""No process: the name of their way back, whose random stream is `link/acknowledgements`."""
RESERVED = (SENSOR, LEGITIMATE, ROUTER, OBSERVER, OPERATOR, ACKNOWLEDGEMENTS)


@dataclass(frozen=True)
class Keys:
    """The keys of one run."""

    run: str

    def _under(self, path: str) -> str:
        return f"evedrop/{self.run}/{path}"

    @property
    def uplink(self) -> str:
        """Packets, sensor to router."""
        return self._under("uplink")

    @property
    def journal(self) -> str:
        """Fates, router to observer."""
        return self._under("journal")

    @property
    def acknowledged(self) -> str:
        """Acknowledgements, legitimate estimator to router."""
        return self._under("ack/sent")

    @property
    def acknowledgements(self) -> str:
        """Acknowledgements that were neither lost nor blocked, and those that are forged: router to sensor."""
        return self._under("ack/delivered")

    def downlink(self, receiver: str) -> str:
        """Deliveries, router to one receiver."""
        return self._under(f"downlink/{receiver}")

    def telemetry(self, process: str) -> str:
        """What a process reports to the observer."""
        return self._under(f"telemetry/{process}")

    def progress(self, process: str) -> str:
        """How far a receiver or the observer is, to the sensor."""
        return self._under(f"progress/{process}")

    def control(self, process: str) -> str:
        """Commands to one process."""
        return self._under(f"control/{process}")

    def alive(self, process: str) -> str:
        """Liveliness token of a process."""
        return self._under(f"alive/{process}")


def reader_of(key: str) -> str:
    """The process that reads a key: all of them have one reader."""
    kind, _, name = key.split("/", 2)[2].partition("/")
    if kind == "ack":
        return ROUTER if name == "sent" else SENSOR
    return {"uplink": ROUTER, "journal": OBSERVER, "telemetry": OBSERVER, "progress": SENSOR}.get(kind, name)


@dataclass(frozen=True)
class Grant:
    """What one user may do; everything else is denied."""

    process: str
    writes: tuple[str, ...]
    reads: tuple[str, ...]
    token: str | None
    watches: tuple[str, ...] = ()
    """Liveliness tokens it may watch."""
    answers: tuple[str, ...] = ()
    """Keys at which it may be asked."""
    asks: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    """Liveliness tokens that it may ask for: its own, and so learns no more than that it is there."""


def grants(run: str, receivers: tuple[str, ...]) -> list[Grant]:
    """The table of docs/protocol.md for a run; the router itself needs no grant but to ask whether it is there."""
    keys = Keys(run)
    followers = (*receivers, OBSERVER)
    processes = (SENSOR, *receivers)
    table = [
        Grant(
            SENSOR,
            writes=(keys.uplink, keys.telemetry(SENSOR)),
            reads=(*(keys.progress(name) for name in followers), keys.control(SENSOR), keys.acknowledgements),
            token=keys.alive(SENSOR),
            checks=(keys.alive(SENSOR),),
        ),
        Grant(
            OBSERVER,
            writes=(keys.progress(OBSERVER), *(keys.control(name) for name in (*processes, ROUTER))),
            reads=(*(keys.telemetry(name) for name in processes), keys.journal),
            token=keys.alive(OBSERVER),
            checks=(keys.alive(OBSERVER),),
            watches=tuple(keys.alive(name) for name in (*processes, ROUTER)),
            answers=(keys.control(OBSERVER),),
        ),
        Grant(OPERATOR, writes=(), reads=(), token=None, asks=(keys.control(OBSERVER),)),
        Grant(ROUTER, writes=(), reads=(), token=None, checks=(keys.alive(ROUTER),)),
    ]
    for name in receivers:
        table.append(
            Grant(
                name,
                writes=(
                    keys.telemetry(name),
                    keys.progress(name),
                    *((keys.acknowledged,) if name == LEGITIMATE else ()),
                ),
                reads=(keys.downlink(name), keys.control(name)),
                token=keys.alive(name),
                checks=(keys.alive(name),),
            )
        )
    return table


def access_control(table: list[Grant], certified: bool = False) -> dict[str, Any]:
    """The `access_control` section of the router's Zenoh configuration.

    certified: whether who says to be a user must have that user's certificate, too.
    """
    rules = [rule for grant in table for rule in _rules(grant)]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {
                "id": grant.process,
                "usernames": [grant.process],
                **({"cert_common_names": [grant.process]} if certified else {}),
            }
            for grant in table
        ],
        "policies": [{"subjects": [grant.process], "rules": [rule["id"] for rule in _rules(grant)]} for grant in table],
    }


def _rules(grant: Grant) -> Iterator[dict[str, Any]]:
    """Both directions of every permission: a writer must also learn that its reader is there."""
    kinds: list[tuple[str, str, str, tuple[str, ...]]] = [
        ("write", "ingress", "put", grant.writes),
        ("reader", "egress", "declare_subscriber", grant.writes),
        ("subscribe", "ingress", "declare_subscriber", grant.reads),
        ("read", "egress", "put", grant.reads),
        ("token", "ingress", "liveliness_token", () if grant.token is None else (grant.token,)),
        ("check", "ingress", "liveliness_query", grant.checks),
        ("checked", "egress", "liveliness_token", grant.checks),
        ("watch", "ingress", "declare_liveliness_subscriber", grant.watches),
        ("watched", "egress", "liveliness_token", grant.watches),
        ("offer", "ingress", "declare_queryable", grant.answers),
        ("asked", "egress", "query", grant.answers),
        ("answer", "ingress", "reply", grant.answers),
        ("ask", "ingress", "query", grant.asks),
        ("answered", "egress", "reply", grant.asks),
    ]
    for name, flow, message, keys in kinds:
        if keys:
            yield {
                "id": f"{grant.process}-{name}",
                "permission": "allow",
                "flows": [flow],
                "messages": [message],
                "key_exprs": list(keys),
            }
