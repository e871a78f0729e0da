"""Which messages a simulated router lets in and out: users, access control and the sizes of messages.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, final

import zenoh

_Rules = Mapping[tuple[str, str], list[tuple[bool, str]]]
"""Flow and message → whether they are allowed, and at which keys."""


class Peer(NamedTuple):
    """The other end of a connection, as a router knows it."""

    zid: str
    user: str | None
    is_peer: bool = False
    """Whether it is in mode peer, and no client."""


@lru_cache(maxsize=1 << 16)
def expression_of(key: str | zenoh.KeyExpr) -> str:
    """A key expression as a text. Raises ZError if it is none."""
    zenoh.KeyExpr(str(key))
    return str(key)


@lru_cache(maxsize=1 << 16)
def intersects(expression: str, other: str) -> bool:
    """Whether two key expressions have a key in common."""
    return expression == other or bool(
        ("*" in expression or "*" in other) and zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(other))
    )


@lru_cache(maxsize=1 << 16)
def includes(wide: str, narrow: str) -> bool:
    """Whether the first key expression has all keys of the second."""
    return wide == narrow or bool("*" in wide and zenoh.KeyExpr(wide).includes(zenoh.KeyExpr(narrow)))


@final
class Access:
    """The rules of a router's configuration."""

    def __init__(self, config: zenoh.Config) -> None:
        control = section(config, "access_control") or {}
        self._enabled = bool(control.get("enabled"))
        self._default = control.get("default_permission") == "allow"
        self._control = control
        self._limits: Sequence[Mapping[str, Any]] = section(config, "low_pass_filter") or []
        self._users = _users(section(config, "transport/auth/usrpwd"))
        self._rules: dict[Peer, _Rules] = {}
        self._allowed: dict[tuple[Peer, str, str, str], bool] = {}
        self._most: dict[tuple[str, str], float] = {}

    def knows(self, user: str | None, password: str | None) -> bool:
        """Whether a user may connect."""
        return self._users is None or (user is not None and self._users.get(user) == password)

    def allows(self, peer: Peer, flow: str, message: str, key: str) -> bool:
        """Whether a message from (`ingress`) or to (`egress`) a peer passes."""
        if not self._enabled:
            return True
        asked = peer, flow, message, key
        allowed = self._allowed.get(asked)
        if allowed is None:
            allowed = self._allowed[asked] = self._by_rules(*asked)
        return allowed

    def _by_rules(self, peer: Peer, flow: str, message: str, key: str) -> bool:
        rules = self._rules.get(peer)
        if rules is None:
            rules = self._rules[peer] = self._of(peer)
        verdicts = [allows for allows, keys in rules.get((flow, message), ()) if includes(keys, key)]
        return all(verdicts) if verdicts else self._default

    def has_room(self, message: str, key: str, size: int) -> bool:
        """Whether a message that comes in is small enough."""
        most = self._most.get((message, key))
        if most is None:
            limits = (
                limit["size_limit"]
                for limit in self._limits
                if message in limit["messages"] and any(includes(keys, key) for keys in limit["key_exprs"])
            )
            most = self._most[message, key] = min(limits, default=math.inf)
        return size <= most

    def _of(self, peer: Peer) -> _Rules:
        subjects = {entry["id"] for entry in self._control["subjects"] if _matches(entry, peer)}
        ids = {
            rule for policy in self._control["policies"] if subjects & {*policy["subjects"]} for rule in policy["rules"]
        }
        rules = defaultdict[tuple[str, str], list[tuple[bool, str]]](list)
        for rule in self._control["rules"]:
            if rule["id"] in ids:
                flows = rule["flows"] or ("ingress", "egress")
                for flow, message, keys in product(flows, rule["messages"], rule["key_exprs"]):
                    rules[flow, message].append((rule["permission"] == "allow", keys))
        return rules


def _matches(subject: Mapping[str, Any], peer: Peer) -> bool:
    """Whether a peer is one of these: each kind of name that is given has to fit."""
    users, zids = subject.get("usernames"), subject.get("zids")
    return (not users or peer.user in users) and (not zids or peer.zid in zids)


def section(config: zenoh.Config, path: str) -> Any:
    """A part of Zenoh's configuration; None if it is not given."""
    try:
        return json.loads(config.get_json(path))
    except zenoh.ZError:
        return None


def _users(given: Mapping[str, str | None] | None) -> dict[str, str] | None:
    """User → password of all that may connect; None if nobody is asked for one."""
    if not given or not any(given.values()):
        return None
    file = given["dictionary_file"]
    lines = [] if file is None else Path(file).read_text("utf-8").splitlines()
    return {user: password for user, _, password in (line.partition(":") for line in lines)}
