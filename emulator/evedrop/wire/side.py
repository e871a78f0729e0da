"""The session of a side: a Zenoh router to which programs connect, their permissions, and where it listens.

Source: docs/wire/file.md, sides.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Self, final

import zenoh

from evedrop.errors import UsageError
from evedrop.live.network.access import users_file
from evedrop.live.network.connecting import open_session
from evedrop.system.ports import free_port
from evedrop.wire.plan import Side, WireLink
from evedrop.wire.tables import TlsTable
from evedrop.wire.watchdog import ANSWER_SECONDS, Duty

_REMOTE = zenoh.Locality.REMOTE
ZenohConfig = dict[str, Any]
PROBES = "@evedrop/*/*"
"""The keys of messages with which the wire finds out whether sides are joined outside it; `**` does not include them."""
_ROS2 = ("@ros2_lv/**", "@/*/@ros2_lv/**")
"""Keys that `**` does not match although programs use them: the graph of ROS 2."""
_CONNECT_SECONDS = 10.0
_ATTEMPTS = 5  # another program may take a port between its choice and its use
_PORT_0 = re.compile(r":0(?=[?#]|$)")
_IN_SOURCE = re.compile(r" at \S+\.rs:\d+\.")
"""Where in its source Zenoh raised an error, as its messages say it."""
_CLIENT_MESSAGES = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)


@final
class SideSession:
    """The open session of a side; use it as a context manager, or its threads outlive the program."""

    def __init__(self, side: Side, largest: int) -> None:
        """largest: bytes of the largest message. Raises UsageError if the side cannot listen or connect where it must."""
        self.side = side
        self.name = side.name
        try:
            self.session, self.endpoints = opened(
                side.listen, side.users, lambda listen, users: side_config(replace(side, listen=listen), largest, users)
            )
            """Its session, and where programs connect: with a free port where the plan has port 0."""
        except zenoh.ZError as error:
            raise UsageError(_refusal(side, str(error))) from error
        self.zid = str(self.session.info.zid())
        self.duty = Duty(f"at the side {side.name}", ANSWER_SECONDS)
        """The work of the main thread on the session when the wire ends."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        # Zenoh gives up after 10 s if a program that does not read keeps its connection: the process ends all the same.
        with self.duty.busy(), contextlib.suppress(zenoh.ZError):
            self.session.close()

    def answer(self) -> None:
        """Return if Zenoh answers at this side: a declaration needs all its locks."""
        self.session.declare_subscriber(
            f"@evedrop/{self.zid}/alive", lambda _: None, allowed_origin=_REMOTE
        ).undeclare()


def opened(
    listen: tuple[str, ...],
    users: Mapping[str, str] | None,
    config_of: Callable[[tuple[str, ...], str | None], ZenohConfig],
) -> tuple[zenoh.Session, tuple[str, ...]]:
    """A session, and the endpoints at which it listens: with free ports in place of port 0. Raises zenoh.ZError.

    users: name → password; config_of: makes the configuration from the endpoints and the path of the file of users.

    Zenoh, too, listens at any free port for port 0, but tells which only in its administration space, which is closed.
    """
    attempts = _ATTEMPTS
    while True:
        attempts -= 1
        endpoints = tuple(_PORT_0.sub(lambda _: f":{free_port()}", endpoint) for endpoint in listen)
        # A file for each attempt: Zenoh has read it before it listens, and what opens the path may share its position.
        with contextlib.nullcontext() if users is None else users_file(users) as file:
            try:
                return open_session(config_of(endpoints, None if file is None else str(file))), endpoints
            except zenoh.ZError as error:
                if not attempts or endpoints == listen or "in use" not in str(error):
                    raise


def expressions_of(side: Side, links: Iterable[WireLink] = ()) -> tuple[str, ...]:
    """The key expressions under which a wire listens at a side: those that the side allows, and those that wildcards hide.

    Among the latter are the histories of all keys. links: whose key expressions may name further keys that `**` hides.
    """
    expressions = list(side.keys)
    if side.keys == ("**",):
        expressions += [*_ROS2, *(link.keys for link in links if "@" in link.keys)]
    expressions += [f"{key}/@adv/**" for key in expressions if key not in _ROS2]
    return tuple(dict.fromkeys(expressions))


def expressions_in_turn(
    side: Side, links: Iterable[WireLink]
) -> Iterator[tuple[zenoh.KeyExpr, tuple[zenoh.KeyExpr, ...]]]:
    """`expressions_of` a side, each with those before it: a message belongs to the first that has keys in common with its own."""
    expressions = [zenoh.KeyExpr(text) for text in expressions_of(side, links)]
    for at, expression in enumerate(expressions):
        yield expression, tuple(expressions[:at])


def side_config(side: Side, largest: int, users: str | None) -> ZenohConfig:
    """The configuration of a side's session; users: the path of the file of its users.

    Messages keep the timestamp that they have, or have none.
    """
    link: ZenohConfig = {"rx": {"max_message_size": max(2 * largest, 2**30)}}  # what is larger is in no journal
    if side.tls is not None:
        link["tls"] = _tls(side.tls)
    config: ZenohConfig = {
        "mode": "router",
        "listen": {"endpoints": list(side.listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(side.connect),
            "timeout_ms": int(_CONNECT_SECONDS * 1000),
            "exit_on_failure": True,
            "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        # A router may hang for ever if its administration space is asked while a program declares something:
        # docs/maintainers/tests.md, Zenoh.
        "adminspace": {"enabled": False},
        "timestamping": {"enabled": False},
        "transport": {"link": link},
    }
    if users is not None:
        config["transport"]["auth"] = {"usrpwd": {"dictionary_file": users}}
    if side.keys != ("**",):
        # Only a side that connects to a router needs probes, and with them its programs could say that sides are joined.
        probes = (PROBES,) if side.connect else ()
        config["access_control"] = _access((*expressions_of(side), *probes))
    return config


def _access(keys: tuple[str, ...]) -> ZenohConfig:
    """Access control that lets every program use some keys and no others."""
    rule = {
        "id": "keys",
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": list(_CLIENT_MESSAGES),
        "key_exprs": list(keys),
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule],
        "subjects": [{"id": "everybody"}],
        "policies": [{"subjects": ["everybody"], "rules": ["keys"]}],
    }


def _tls(tls: TlsTable) -> ZenohConfig:
    section: ZenohConfig = {
        "listen_certificate": tls.certificate,
        "listen_private_key": tls.key,
        "connect_certificate": tls.certificate,
        "connect_private_key": tls.key,
        "enable_mtls": tls.authority is not None,
    }
    if tls.authority is not None:
        section["root_ca_certificate"] = tls.authority
    return section


def _refusal(side: Side, why: str) -> str:
    """The message for a session that Zenoh does not open."""
    where = " and ".join(
        filter(
            None,
            (
                f"listen at {', '.join(side.listen)}" if side.listen else "",
                f"connect to {', '.join(side.connect)}" if side.connect else "",
            ),
        )
    )
    why = _IN_SOURCE.sub("", why.splitlines()[0])
    return (
        f"side {side.name} cannot {where} ({why}); end the program that listens there already, start the router "
        "that it must connect to, or give the side other endpoints"
    )
