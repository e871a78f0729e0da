"""The endpoints of a run's routers, and the credentials at each of them.

A run on one machine needs no port: its router listens at a Unix socket in the run's private folder. Two routers take free
ports on loopback, with certificates. An endpoint that the user names is taken if it is safe and available. Credentials are
passwords, certificates, and the id by which two routers recognise each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from evedrop.errors import UsageError
from evedrop.live.network.endpoint import AnyEndpoint, Endpoint, SocketEndpoint
from evedrop.live.protocol.brief import Identity
from evedrop.names import RELAY, ROUTER, SENSOR
from evedrop.system.output import warn
from evedrop.system.ports import free_port
from evedrop.system.world import world


@dataclass(frozen=True)
class RouterEndpoint:
    """The endpoint at which a router listens, and the one that the other processes connect to."""

    listen: AnyEndpoint
    connect: AnyEndpoint

    @property
    def secure(self) -> bool:
        """Whether the router takes certificates."""
        return self.listen.secure

    @property
    def names(self) -> tuple[str, ...]:
        """The host names and addresses by which the router is known."""
        ports = (
            endpoint
            for endpoint in (self.connect, self.listen)
            if isinstance(endpoint, Endpoint) and not endpoint.everywhere
        )
        return tuple(dict.fromkeys(endpoint.host for endpoint in ports))


@dataclass(frozen=True)
class RouterEndpoints:
    """The endpoints of a run's routers."""

    router: RouterEndpoint
    relay: RouterEndpoint | None = None
    """The relay's endpoint, in a run with two routers."""

    def check(self, relayed: bool) -> None:
        """Raise UsageError unless there is an endpoint for each of the scenario's routers; relayed: whether it has two."""
        if relayed and self.relay is None:
            raise UsageError(
                "the scenario has two routers; add --relay ENDPOINT with the endpoint where the second one listens"
            )
        if self.relay is not None and not relayed:
            raise UsageError("--relay: the scenario has one router; leave it out, or add --set network.routers=2")
        if self.relay is not None and self.relay.secure != self.router.secure:
            raise UsageError("--relay: both routers take certificates or none does; give both as tls/HOST:PORT")
        if self.relay is not None and str(self.relay.connect) == str(self.router.connect):
            raise UsageError(f"--relay {self.relay.connect} is where the first router is; give another port")


def endpoints_at(
    listen: str,
    connect: str | None = None,
    relay: str | None = None,
    relay_connect: str | None = None,
    insecure: bool = False,
) -> RouterEndpoints:
    """The endpoints that the options of `evedrop brief` name, on any hosts. Raises UsageError if they are malformed."""
    second = None
    if relay is not None:
        second = router_endpoint(relay, relay_connect, insecure, ("--relay", "--relay-connect"))
    elif relay_connect is not None:
        raise UsageError(
            "--relay-connect belongs to a second router; add --relay ENDPOINT with the endpoint where it listens"
        )
    return RouterEndpoints(router_endpoint(listen, connect, insecure), second)


def router_endpoint(
    listen: str,
    connect: str | None = None,
    insecure: bool = False,
    options: tuple[str, str] = ("--listen", "--connect"),
) -> RouterEndpoint:
    """The endpoint of one router that two options name, on any host.

    insecure: whether the user allows an unencrypted endpoint that other machines can reach. Raises UsageError if the router
    cannot listen there or the others cannot connect there.
    """
    listening, connecting = options
    here = _endpoint(listening, listen)
    there = here if connect is None else _endpoint(connecting, connect)
    asked = listening if connect is None else connecting
    if there.everywhere:
        raise UsageError(
            f"{asked} {there} means every address of a host, so nothing can connect to it; add {connecting} {there.protocol}/"
            f"HOST:{there.port} with the name or address by which the others reach it"
        )
    if here.protocol != there.protocol:
        raise UsageError(
            f"{connecting} {there} differs in protocol from {listening} {here}; give both as tls/HOST:PORT"
        )
    if there.secure and there.address is not None and there.address.version == 6:
        raise UsageError(
            f"{asked} {there}: no certificate can be checked against an IPv6 address; give the host's name"
        )
    if not here.secure and not insecure and not here.loopback:
        raise UsageError(
            f"{listening} {here} is not encrypted, and other machines can reach it: they could read everything, and pose as "
            f"the router; give tls/{str(here).partition('/')[2]}, or add --insecure"
        )
    return RouterEndpoint(here, there)


def _endpoint(option: str, text: str, example: str = "tls/router.lan:7447") -> Endpoint:
    try:
        return Endpoint.of(text)
    except ValueError as error:
        raise UsageError(f"{option} {error}; give one such as {example}") from error


def socket_endpoints(folder: Path) -> RouterEndpoints:
    """The endpoint of a run with one router, all on this host: a socket in a private folder."""
    endpoint = SocketEndpoint(folder / ROUTER)
    return RouterEndpoints(RouterEndpoint(endpoint, endpoint))


def loopback_endpoints(listen: str | None, relay: str | None = None, relayed: bool = False) -> RouterEndpoints:
    """The endpoints of a run at ports of this host: the requested ones, or free ports, with certificates.

    Two routers need ports: without certificates, which only TLS has, a router is recognised by its id alone, which is not a
    secret. Raises UsageError unless the endpoints are on loopback and a router can listen there.
    """
    asked = next((text.partition("/")[0] for text in (listen, relay) if text is not None), "tls")
    router = _loopback_endpoint(listen, "--listen", asked)
    second = _loopback_endpoint(relay, "--relay", asked) if relayed or relay is not None else None
    while relay is None and second is not None and str(second.listen) == str(router.listen):
        second = _loopback_endpoint(None, "--relay", asked)
    endpoints = RouterEndpoints(router, second)
    endpoints.check(relayed)
    return endpoints


def warn_if_exposed(endpoints: RouterEndpoints) -> None:
    """Warn of ports of this machine without certificates. Of those that other machines reach, `--insecure` speaks."""
    for place in (endpoints.router, endpoints.relay):
        if place is not None and isinstance(place.listen, Endpoint) and place.listen.loopback and not place.secure:
            warn(
                f"{place.listen} is not encrypted, and a user of this machine who listens there before the router does can pose "
                f"as the router and read everything; give tls/{str(place.listen).partition('/')[2]}"
            )


def _loopback_endpoint(listen: str | None, option: str, protocol: str) -> RouterEndpoint:
    if listen is None:
        return router_endpoint(f"{protocol}/127.0.0.1:{free_port()}")
    endpoint = _endpoint(option, listen, "tls/127.0.0.1:17460")
    if not endpoint.loopback:
        raise UsageError(
            f"{option} {listen} is not a loopback endpoint; give one such as tls/127.0.0.1:17460, or start the processes by "
            "hand: evedrop brief"
        )
    given = router_endpoint(listen)
    try:
        endpoint.try_to_listen()
    except OSError as error:
        raise UsageError(f"{option} {listen}: {error.strerror}; leave it out") from error
    return given


@dataclass(frozen=True)
class Routers:
    """The users of each router, with their passwords."""

    endpoints: RouterEndpoints
    at_router: Mapping[str, str] = field(repr=False)
    """User of the router → password."""
    at_relay: Mapping[str, str] = field(repr=False)
    zid: str | None
    """The router's Zenoh id, by which the relay recognises it; None without a relay."""

    @classmethod
    def for_users(cls, users: Mapping[str, str], endpoints: RouterEndpoints) -> Routers:
        """Assign all users to the router; with a relay, the sensor and the relay to the router, all others to the relay."""
        if endpoints.relay is None:
            return cls(endpoints, users, {}, None)
        # Router and relay are users, too: each asks itself whether it is present.
        near = {**{user: users[user] for user in (ROUTER, SENSOR)}, RELAY: world().token(16).hex()}
        far = {**{user: password for user, password in users.items() if user not in near}, RELAY: near[RELAY]}
        # Zenoh takes ids of up to 16 bytes, in hexadecimal without zeros at the ends.
        zid = f"e{world().token(15).hex()}e"
        return cls(endpoints, near, far, zid)

    def endpoint(self, process: str) -> str:
        """The endpoint that a process connects to."""
        near, far = self.endpoints.router, self.endpoints.relay or self.endpoints.router
        return str((near if process in self.at_router else far).connect)

    def password(self, process: str) -> str:
        """The password of a process."""
        return {**self.at_router, **self.at_relay}.get(process, "")


def identities_of(run: str, endpoints: RouterEndpoints, users: tuple[str, ...]) -> dict[str, Identity]:
    """Process name, or operator → its certificate; empty if the router listens without TLS."""
    if not endpoints.router.secure:
        return {}
    from evedrop.live.network.certificates import Authority  # noqa: PLC0415 - saves most runs 50 ms

    authority = Authority(run)
    return {
        **{user: authority.identity(user) for user in users},
        ROUTER: authority.identity(ROUTER, hosts=endpoints.router.names),
        **({} if endpoints.relay is None else {RELAY: authority.identity(RELAY, hosts=endpoints.relay.names)}),
    }
