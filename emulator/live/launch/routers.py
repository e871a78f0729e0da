"""The credentials at each router: passwords, certificates, and the id by which two routers recognise each other."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field

from evedrop.live.launch.ports import RouterEndpoints
from evedrop.live.protocol.brief_parts import Identity
from evedrop.names import RELAY, ROUTER, SENSOR


@dataclass(frozen=True)
class Routers:
    """The users of each router, with their passwords."""

    places: RouterEndpoints
    at_router: Mapping[str, str] = field(repr=False)
    """User of the router → password."""
    at_relay: Mapping[str, str] = field(repr=False)
    zid: str | None
    """The router's Zenoh id, by which the relay recognises it; None without a relay."""

    @classmethod
    def of(cls, users: Mapping[str, str], places: RouterEndpoints) -> Routers:
        """Assign all users to the router; with a relay, the sensor and the relay to the router, all others to the relay."""
        if places.relay is None:
            return cls(places, users, {}, None)
        # Router and relay are users, too: each asks itself whether it is present.
        near = {**{user: users[user] for user in (ROUTER, SENSOR)}, RELAY: secrets.token_urlsafe(24)}
        far = {**{user: password for user, password in users.items() if user not in near}, RELAY: near[RELAY]}
        # Zenoh takes ids of up to 16 bytes, in hexadecimal without zeros at the ends.
        zid = f"e{secrets.token_hex(15)}e"
        return cls(places, near, far, zid)

    def endpoint(self, process: str) -> str:
        """The endpoint that a process connects to."""
        return str((self.places.router if process in self.at_router else self.places.far).connect)

    def password(self, process: str) -> str:
        """The password of a process."""
        return {**self.at_router, **self.at_relay}.get(process, "")


def identities_of(run: str, places: RouterEndpoints, users: tuple[str, ...]) -> dict[str, Identity]:
    """Process name, or operator → its certificate; empty if the router listens without TLS."""
    if not places.router.secure:
        return {}
    from evedrop.live.launch.authority import Authority  # noqa: PLC0415 - saves most runs 50 ms

    authority = Authority(run)
    return {
        **{user: authority.identity(user) for user in users},
        ROUTER: authority.identity(ROUTER, hosts=places.router.names),
        **({} if places.relay is None else {RELAY: authority.identity(RELAY, hosts=places.relay.names)}),
    }
