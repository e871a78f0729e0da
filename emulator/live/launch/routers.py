"""Who is let in at which router, by what: passwords, certificates, and the id by which two routers know each other."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evedrop.live.launch.ports import RouterEndpoint, RouterEndpoints
from evedrop.live.protocol.brief import Identity
from evedrop.names import RELAY, ROUTER, SENSOR


@dataclass(frozen=True)
class Routers:
    """Who is let in where."""

    places: RouterEndpoints
    at_router: Mapping[str, str]
    """User → password."""
    at_relay: Mapping[str, str]
    zid: str | None
    """The router's Zenoh id, by which the relay knows it."""

    @classmethod
    def of(cls, users: Mapping[str, str], places: RouterEndpoints) -> Routers:
        """All at the router; or, if there is a relay, the sensor and the relay there, and all others at the relay."""
        if places.relay is None:
            return cls(places, users, {}, None)
        # Router and relay are users too: of themselves, which ask whether they are there.
        near = {**{user: users[user] for user in (ROUTER, SENSOR)}, RELAY: secrets.token_urlsafe(24)}
        far = {**{user: password for user, password in users.items() if user not in near}, RELAY: near[RELAY]}
        # Zenoh takes ids of up to 16 bytes, in hexadecimal without zeros at the ends.
        zid = f"e{secrets.token_hex(15)}e"
        return cls(places, near, far, zid)

    def endpoint(self, process: str) -> str:
        """What a process connects to."""
        return str((self.places.router if process in self.at_router else self.places.far).connect)

    def password(self, process: str) -> str:
        """A process's."""
        return {**self.at_router, **self.at_relay}.get(process, "")

    def relay_part(self, receivers: tuple[str, ...], relay: RouterEndpoint) -> dict[str, Any]:
        """What the relay is told."""
        listen = str(relay.listen)
        return {"users": self.at_relay, "receivers": list(receivers), "listen": listen, "zid": self.zid}


def identities_of(run: str, places: RouterEndpoints, users: tuple[str, ...]) -> dict[str, Identity]:
    """Process name, or operator → its certificate; nobody has one of a router that listens in clear."""
    if not places.router.secure:
        return {}
    from evedrop.live.launch.authority import Authority  # noqa: PLC0415 - 50 ms that most runs need not

    authority = Authority(run)
    return {
        **{user: authority.identity(user) for user in users},
        ROUTER: authority.identity(ROUTER, hosts=places.router.names),
        **({} if places.relay is None else {RELAY: authority.identity(RELAY, hosts=places.relay.names)}),
    }
