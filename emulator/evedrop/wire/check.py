"""Explains a wire file: its links in order, which of them each key takes, and entries that are probably mistakes.

Source: docs/wire.md, which link a key takes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import permutations
from typing import Any

import zenoh

from evedrop.errors import UsageError
from evedrop.model.checks import as_toml
from evedrop.wire.endpoints import ENCRYPTED, place_of
from evedrop.wire.plan import Side, WireLink, WirePlan
from evedrop.wire.tables import NOTHING_LOST, key_expression_mistake


def wire_lines(plan: WirePlan) -> Iterator[str]:
    """The sides, and the links in the order in which they are tried."""
    width = max(len(name) for name in (*plan.sides, *(link.name for link in plan.links)))
    for side in plan.sides.values():
        where = [*side.listen, *(f"connects to {one}" for one in side.connect)]
        yield f"side  {side.name:<{width}}  {', '.join(where)}{_guards(side)}"
    for link in plan.links:
        tap = " (tap)" if link.tap else ""
        yield f"link  {link.name:<{width}}  {link.source} → {link.target}{tap}  {link.keys}  {_effects(link)}"
    for expression in plan.lossless:
        yield f"never lost  {expression}"


def key_lines(plan: WirePlan, keys: Sequence[str]) -> Iterator[str]:
    """Which link each key takes, in each direction that has a link. Raises UsageError for all keys that Zenoh refuses."""
    wrong = [f"key {as_toml(key)}{why}" for key in keys if (why := key_expression_mistake(key)) is not None]
    if wrong:
        raise UsageError("\n".join(wrong))
    ways = [way for way in permutations(plan.sides, 2) if any((link.source, link.target) == way for link in plan.links)]
    for key in keys:
        expression = zenoh.KeyExpr(key)
        yield f"key  {key}{'  (never lost)' if plan.is_lossless(expression) else ''}"
        taken = {way: plan.link_of(*way, expression) for way in ways}
        for (source, target), link in taken.items():
            yield f"  {source} → {target}  {'no link takes it' if link is None else _taken(link, expression)}"
        if "@" in key and not any(taken.values()):
            yield "  wildcards do not match the parts of a key that begin with @: name them in a link's keys"


def warnings_of_wire(plan: WirePlan) -> Iterator[str]:
    """What is allowed, and probably a mistake."""
    for i, link in enumerate(plan.links):
        for before in plan.links[:i]:
            same = (before.source, before.target) == (link.source, link.target)
            if same and before.expression.includes(link.expression):
                yield f"link {link.name} takes no key: {before.name}, which comes first, takes all of them; move {link.name} up"
                break
    for side in plan.sides.values():
        if not any(side.name in (link.source, link.target) for link in plan.links):
            yield f"side {side.name} has no link: nothing crosses to it or from it"
        yield from _openness(side)
    ways = {(link.source, link.target) for link in plan.links if not link.tap}
    for source, target in sorted(ways):
        if (target, source) not in ways:
            yield f"no link leads from {target} back to {source}: queries from {source} get no replies"


def _taken(link: WireLink, key: zenoh.KeyExpr) -> str:
    """The link that takes a key, and what is special about that."""
    notes = ["a copy of publications, no queries"] if link.tap else []
    if not link.takes_all(key):
        notes.append("which takes only some of these keys")
    return f"{link.name} ({'; '.join(notes)})" if notes else link.name


def _effects(link: WireLink) -> str:
    """The settings of a link, without those that do nothing."""
    settings: Mapping[str, Any] = link.settings
    told = [f"{name} = {as_toml(value)}" for name, value in settings.items() if (name, value) != ("loss", NOTHING_LOST)]
    if link.ordered:
        told.append("in order")
    if link.correlation is not None:
        told.append(f"losses tied to {link.correlation[0]} with strength {link.correlation[1]}")
    return ", ".join(told) or "no faults"


def _guards(side: Side) -> str:
    """Who may use a side, if not every client that can reach it."""
    said = [] if side.users is None else [f"users {', '.join(side.users)}"]
    if side.tls is not None and side.tls.authority is not None:
        said.append("certificates required")
    if side.keys != ("**",):
        said.append(f"only {', '.join(side.keys)}")
    if side.peers:
        said.append("mode peer allowed")
    return f"  ({'; '.join(said)})" if said else ""


def _openness(side: Side) -> Iterator[str]:
    """A warning for each endpoint that other machines can reach without proving who they are."""
    for endpoint in side.listen:
        place = place_of(endpoint)
        if place is None or place.loopback:
            continue
        lacking = [] if place.protocol in ENCRYPTED else ["encryption (tls)"]
        if side.users is None and (side.tls is None or side.tls.authority is None):
            lacking.append("users or an authority")
        if lacking:
            without = " and without ".join(lacking)
            yield f"side {side.name} listens on {endpoint}, which other machines may reach, without {without}"
