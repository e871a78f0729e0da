"""Two routers that are linked: who is at which, and the keys that cross between them. What need not cross is denied.

    sensor ── router ═════ relay ── receivers, observer, operator

The first is the router, which decides every fate, at the sensor's site; the relay only passes on, at the receivers'.

Source: docs/protocol.md, two routers.
"""

from __future__ import annotations

from emulator.network.access import RELAY, ROUTER, SENSOR, Grant, Keys

_NEAR = (SENSOR,)


def at_router(run: str, table: list[Grant]) -> list[Grant]:
    """Who is let in at the router, when there is a relay: those at its own site, and the relay for all others."""
    to_router, from_router = _crossing(table)
    near, far = _sites(table)
    relay = Grant(
        RELAY, to_router, from_router, None, (Keys(run).alive(ROUTER), *_tokens(near)), further_tokens=_tokens(far)
    )
    return [*near, relay]


def at_relay(run: str, table: list[Grant], zid: str) -> list[Grant]:
    """Who is let in at the relay: those of its site, and the router, by its Zenoh id, for all others."""
    to_router, from_router = _crossing(table)
    near, far = _sites(table)
    token = Keys(run).alive(ROUTER)
    router = Grant(ROUTER, from_router, to_router, token, _tokens(far), further_tokens=_tokens(near), zid=zid)
    return [*far, router]


def _sites(table: list[Grant]) -> tuple[list[Grant], list[Grant]]:
    return [one for one in table if one.process in _NEAR], [one for one in table if one.process not in _NEAR]


def _tokens(site: list[Grant]) -> tuple[str, ...]:
    return tuple(grant.token for grant in site if grant.token is not None)


def _crossing(table: list[Grant]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The keys that go to the router's site, and those that come from it."""
    writer = {key: grant.process for grant in table for key in grant.writes}
    reader = {key: grant.process for grant in table for key in grant.reads}
    near = {*_NEAR, ROUTER}
    ends = {key: (writer.get(key, ROUTER) in near, reader.get(key, ROUTER) in near) for key in (*writer, *reader)}
    # What the observer says to the relay does not cross, though no table has the relay as its reader.
    there = {key for key in ends if key.endswith(f"/control/{RELAY}")}
    return (
        tuple(key for key, (from_near, to_near) in ends.items() if to_near and not from_near and key not in there),
        tuple(key for key, (from_near, to_near) in ends.items() if from_near and not to_near),
    )
