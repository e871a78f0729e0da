"""The keys that each process may use: one table, from which the router's access control is made. All else is denied.

Readers name every key they read: exact rules do not cover a wildcard subscription, so it receives nothing. Router and relay write
the passwords of the users they let in, and leave after those users.

With two linked routers, the table also says which process connects to which, and which keys cross between them:

    sensor ── router ═════ relay ── receivers, recorder, operator

The router, at the sensor's site, decides every fate; the relay, at the receivers' site, only passes messages on.

Source: docs/protocol.md, keys and two routers.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from evedrop.live.protocol.brief import Wiring
from evedrop.live.protocol.keys import RunKeys, ZenohConfig, reader_of, reads, writer_of
from evedrop.names import CONTROLLER, LEGITIMATE, OPERATOR, RECORDER, RELAY, ROUTER, SENSOR
from evedrop.system.waiting import wait_until


@dataclass(frozen=True)
class Grant:
    """The rights of one user; everything else is denied."""

    process: str
    writes: tuple[str, ...]
    reads: tuple[str, ...]
    token: str | None
    watches: tuple[str, ...] = ()
    """Liveliness tokens it may watch."""
    answers: tuple[str, ...] = ()
    """Keys at which it may answer questions."""
    asks: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    """Liveliness tokens that it may ask for: only its own, so it learns only that it is present itself."""
    further_tokens: tuple[str, ...] = ()
    """Liveliness tokens of the processes on whose behalf it speaks."""
    zid: str | None = None
    """The Zenoh id of a process that has no user name: the router, which does not log in."""


def grants(run: str, receivers: tuple[str, ...], loop: Wiring | None = None, relayed: bool = False) -> list[Grant]:
    """The table of docs/protocol.md for a run, with a controller if there is a loop; routers may only ask for their own token.

    relayed: whether there is a relay, which the recorder watches, and tells when the run ends.
    """
    keys = RunKeys(run)
    steered = () if loop is None else (CONTROLLER,)
    reporters = (SENSOR, *receivers, *steered)
    routers = (ROUTER, RELAY) if relayed else (ROUTER,)
    all_keys = (
        *(keys.uplink, keys.journal, keys.acknowledged, keys.acknowledgements),
        *(() if loop is None else (keys.input, keys.state if loop.on_truth else keys.estimate)),
        *(keys.downlink(name) for name in receivers),
        *(keys.telemetry(name) for name in reporters),
        *(keys.progress(name) for name in (*receivers, RECORDER)),
        *(keys.control(name) for name in (*reporters, *routers)),
    )
    withheld = (LEGITIMATE, keys.input) if loop is not None and not loop.knows_input else None
    table = [
        Grant(
            name,
            writes=tuple(key for key in all_keys if writer_of(key) == name),
            reads=tuple(key for key in all_keys if reads(name, key) and (name, key) != withheld),
            token=keys.alive(name),
            checks=(keys.alive(name),),
            watches=tuple(keys.alive(other) for other in (*reporters, *routers)) if name == RECORDER else (),
            answers=(keys.control(RECORDER),) if name == RECORDER else (),
        )
        for name in (SENSOR, RECORDER, *steered, *receivers)
    ]
    return [
        *table,
        Grant(OPERATOR, writes=(), reads=(), token=None, asks=(keys.control(RECORDER),)),
        *(Grant(name, writes=(), reads=(), token=None, checks=(keys.alive(name),)) for name in routers),
    ]


def access_control(table: list[Grant], certified: bool = False) -> ZenohConfig:
    """The `access_control` section of the router's Zenoh configuration.

    certified: whether a user must have that user's certificate, too.
    """
    rules = [rule for grant in table for rule in _rules(grant)]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [_subject(grant, certified) for grant in table],
        "policies": [{"subjects": [grant.process], "rules": [rule["id"] for rule in _rules(grant)]} for grant in table],
    }


def _subject(grant: Grant, certified: bool) -> ZenohConfig:
    shown = {"usernames": [grant.process]} if grant.zid is None else {"zids": [grant.zid]}
    return {"id": grant.process, **shown, **({"cert_common_names": [grant.process]} if certified else {})}


def _rules(grant: Grant) -> Iterator[ZenohConfig]:
    """Both directions of every permission: a writer must also learn that it has a reader."""
    kinds: list[tuple[str, str, str, tuple[str, ...]]] = [
        ("write", "ingress", "put", grant.writes),
        ("reader", "egress", "declare_subscriber", grant.writes),
        ("subscribe", "ingress", "declare_subscriber", grant.reads),
        ("read", "egress", "put", grant.reads),
        ("token", "ingress", "liveliness_token", (*grant.further_tokens, *filter(None, [grant.token]))),
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


_NEAR = frozenset({SENSOR, ROUTER})


def at_router(run: str, table: list[Grant]) -> list[Grant]:
    """The grants at the router, when there is a relay: processes of its own site, and the relay on behalf of all others."""
    to_router, from_router = _crossing(table)
    near, far = _sites(table)
    relay = Grant(
        RELAY, to_router, from_router, None, (RunKeys(run).alive(ROUTER), *_tokens(near)), further_tokens=_tokens(far)
    )
    return [*near, relay]


def at_relay(run: str, table: list[Grant], zid: str) -> list[Grant]:
    """The grants at the relay: processes of its own site, and the router, known by its Zenoh id, for all others."""
    to_router, from_router = _crossing(table)
    near, far = _sites(table)
    token = RunKeys(run).alive(ROUTER)
    router = Grant(ROUTER, from_router, to_router, token, _tokens(far), further_tokens=_tokens(near), zid=zid)
    return [*far, router]


def _sites(table: list[Grant]) -> tuple[list[Grant], list[Grant]]:
    return [grant for grant in table if grant.process in _NEAR], [
        grant for grant in table if grant.process not in _NEAR
    ]


def _tokens(site: list[Grant]) -> tuple[str, ...]:
    return tuple(grant.token for grant in site if grant.token is not None)


def _crossing(table: list[Grant]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The keys of messages that go to the router's site, and of those that come from it."""
    keys = dict.fromkeys(key for grant in table for key in (*grant.writes, *grant.reads))
    to_router = tuple(key for key in keys if writer_of(key) not in _NEAR and reader_of(key) in _NEAR)
    from_router = tuple(key for key in keys if writer_of(key) in _NEAR and reader_of(key) not in _NEAR)
    return to_router, from_router


_FAREWELL_SECONDS = 10.0


@contextmanager
def users_file(users: Mapping[str, str]) -> Iterator[Path]:
    """The file of users and passwords that Zenoh reads once, when the session opens.

    It has no name in any folder, so nothing of it is left however the process ends: the path is that of an open file.
    """
    with tempfile.TemporaryFile("w", encoding="utf-8") as file:
        file.writelines(f"{user}:{password}\n" for user, password in users.items())
        file.flush()
        file.seek(0)  # where a path of an open file shares its position
        yield Path(f"/dev/fd/{file.fileno()}")


def until_all_left(present: Mapping[str, bool], linked: Callable[[], bool] = lambda: False) -> None:
    """Wait until no process is present and no other router is linked, for a few seconds at most.

    Two routers that close their link at the same time fail in Zenoh 1.10, so one must leave first.
    """
    wait_until(lambda: not (any(present.values()) or linked()), _FAREWELL_SECONDS, 0.005)
