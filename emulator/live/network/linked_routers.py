"""Two linked routers: which process connects to which, and the keys that cross between them. All other keys are denied.

    sensor ── router ═════ relay ── receivers, observer, operator

The router, at the sensor's site, decides every fate; the relay, at the receivers' site, only passes messages on.

Source: docs/protocol.md, two routers.
"""

from __future__ import annotations

from evedrop.live.network.access import Grant
from evedrop.live.protocol.keys import RunKeys
from evedrop.names import RELAY, ROUTER, SENSOR

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
    return [one for one in table if one.process in _NEAR], [one for one in table if one.process not in _NEAR]


def _tokens(site: list[Grant]) -> tuple[str, ...]:
    return tuple(grant.token for grant in site if grant.token is not None)


def _crossing(table: list[Grant]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The keys of messages that go to the router's site, and of those that come from it."""
    keys = dict.fromkeys(key for grant in table for key in (*grant.writes, *grant.reads))
    to_router, from_router = [], []
    for key in keys:
        # The router writes the keys that no process in the table writes; it reads those that none reads, except the
        # relay's control key.
        writers = {one.process for one in table if key in one.writes} or {ROUTER}
        other = RELAY if key.endswith(f"/control/{RELAY}") else ROUTER
        readers = {one.process for one in table if key in one.reads} or {other}
        if writers - _NEAR and readers & _NEAR:
            to_router.append(key)
        if writers & _NEAR and readers - _NEAR:
            from_router.append(key)
    return tuple(to_router), tuple(from_router)
