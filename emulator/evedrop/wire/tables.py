"""The tables of a wire file: their entries, and the checks of each table by itself.

Source: docs/wire.md, the file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any

import zenoh
from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticCustomError

from evedrop.model.checks import as_toml
from evedrop.model.delays import DELAY_MODELS
from evedrop.scenario.link_table import CorrelationTable, LinkTable
from evedrop.scenario.table import NAME, Found, Table, expected
from evedrop.scenario.words import listed
from evedrop.wire.endpoints import ENCRYPTED, FREE, checked_endpoint
from evedrop.wire.expect import WireExpectTable
from evedrop.wire.units import Rate, Seconds, Size, in_seconds

DEFAULT_QUEUE = 256_000
"""Bytes that may wait before a link of limited rate."""
NOTHING_LOST: Mapping[str, Any] = {"model": "bernoulli", "quality": 1.0}
"""The loss model of a link for which the file gives none."""
_LINK_NAME = re.compile(r"[a-z][a-z0-9_-]{0,79}")


def key_expression_mistake(text: str) -> str | None:
    """Why Zenoh refuses a key expression, in words that follow it, and what it would accept; None if it accepts it."""
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError as error:
        why = str(error).partition("`: ")[2].rpartition(" at /")[0]
        try:
            hint = f"; did you mean {zenoh.KeyExpr.autocanonize(text)}?"
        except zenoh.ZError:
            hint = "; expected one such as robot/scan/**"
        return f", which Zenoh refuses ({why}){hint}"
    return None


def _key_expression(text: str) -> str:
    if (why := key_expression_mistake(text)) is not None:
        raise PydanticCustomError("expected", "one value", {"said": why})
    return text


def _side_name(name: str) -> str:
    if not NAME.fullmatch(name):
        raise expected("a name of a lower-case letter, then up to 31 of a-z 0-9 _ -")
    return name


def _link_name(name: str) -> str:
    if not _LINK_NAME.fullmatch(name):
        raise expected("a name of a lower-case letter, then up to 79 of a-z 0-9 _ -")
    return name


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _user(name: str) -> str:
    if not name or ":" in name:
        raise expected("a user name without a colon")
    return name


KeyExpression = Annotated[str, Field(strict=True), AfterValidator(_key_expression)]
KeyExpressions = Annotated[list[KeyExpression], BeforeValidator(_listed), Field(examples=["robot/**"])]
Endpoints = Annotated[list[Annotated[str, AfterValidator(checked_endpoint)]], BeforeValidator(_listed)]
File = Annotated[str, Field(strict=True, min_length=1)]


def delay_in_seconds(delay: Any) -> tuple[Any, list[Found]]:
    """A delay's table with its lengths of time as numbers of seconds, and the mistakes in them."""
    if not isinstance(delay, Mapping):
        return delay, []
    made, found = dict(delay), []
    model = DELAY_MODELS.get(str(delay.get("model")))
    for name in () if model is None else model.lengths:
        text = made.get(name)
        seconds = in_seconds(text) if isinstance(text, str) else None
        if seconds is not None:
            made[name] = seconds
        elif isinstance(text, str):
            made.pop(name)
            found.append((f"delay.{name}", f'is {as_toml(text)}; expected seconds, or a text such as "20 ms"'))
    if made.pop("unit", "seconds") != "seconds":
        found.append(("delay.unit", f"is {as_toml(delay['unit'])}; expected no unit: delays on a wire are in seconds"))
    return made, found


class WireCorrelationTable(CorrelationTable):
    """`correlation = {…}` of a wire's link."""

    to: Annotated[str, Field(strict=True, alias="with", examples=["robot-base"])]


class WireSettingsTable(LinkTable):
    """The settings of a link: those of a scenario's link, with a message as a packet and seconds and bytes as units."""

    correlation: Annotated[WireCorrelationTable | None, Field(examples=[{"with": "robot-base", "strength": 0.5}])] = (
        None
    )
    delay: Annotated[
        dict[str, Any] | None,
        BeforeValidator(lambda found: delay_in_seconds(found)[0]),
        Field(examples=[{"model": "constant", "value": "20 ms"}]),
    ] = None
    rate: Annotated[Rate | None, Field(examples=["2 MB/s"])] = None
    queue: Annotated[Size | None, Field(examples=["256 kB"])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Those of a scenario's link; but a link without losses needs no loss model."""
        delay, found = delay_in_seconds(table.get("delay"))
        said = {entry for entry, _ in found}
        perfect = {"loss": NOTHING_LOST} if table.get("quality") is None and table.get("loss") is None else {}
        of_link = super().mistakes({**table, **perfect, "delay": delay})
        found += [one for one in of_link if one[0] not in said]
        loss = table.get("loss")
        if isinstance(loss, Mapping) and loss.get("once") is True:
            found.append(
                ("loss.once", "is true, but a wire has no last message; expected false: the recording repeats")
            )
        return found

    @property
    def loss_spec(self) -> dict[str, Any]:
        """The loss model and its parameters; without either, nothing is lost."""
        return dict(NOTHING_LOST) if self.quality is None and self.loss is None else super().loss_spec

    def wire_settings(self) -> dict[str, Any]:
        """The settings for `WireLink.settings`."""
        made = self.settings(None)
        if self.rate is not None:
            made["queue"] = DEFAULT_QUEUE if self.queue is None else self.queue
        return made


class WireLinkTable(WireSettingsTable):
    """`[[link]]`: one direction between two sides."""

    name: Annotated[str | None, AfterValidator(lambda name: name and _link_name(name)), Field(examples=["scan"])] = None
    source: Annotated[str, Field(strict=True, alias="from", examples=["robot"])]
    target: Annotated[str, Field(strict=True, alias="to", examples=["base"])]
    keys: Annotated[KeyExpression, Field(examples=["robot/scan/**"])] = "**"
    tap: Annotated[bool, Field(strict=True)] = False
    ordered: Annotated[bool, Field(strict=True)] = False

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Those of the settings, and messages that are to overtake others, on a link on which none does."""
        mistakes = super().mistakes(table)
        if table.get("ordered") is True and table.get("reorder"):
            mistakes.append(("reorder", "is given together with ordered = true; expected one of them"))
        return mistakes


class TlsTable(Table):
    """`tls = {…}` of a side: PEM files."""

    certificate: Annotated[File, Field(examples=["robot.pem"])]
    key: Annotated[File, Field(examples=["robot.key"])]
    authority: Annotated[File | None, Field(examples=["authority.pem"])] = None


class SideTable(Table):
    """`[side.NAME]`: a place at which programs connect."""

    listen: Annotated[Endpoints | None, Field(examples=["tcp/127.0.0.1:7448"])] = None
    connect: Annotated[Endpoints, Field(default_factory=list, examples=["tcp/127.0.0.1:7447"])]
    tls: Annotated[TlsTable | None, Field(examples=[{"certificate": "robot.pem", "key": "robot.key"}])] = None
    users: Annotated[
        dict[Annotated[str, AfterValidator(_user)], Annotated[str, Field(strict=True, min_length=1)]] | None,
        Field(examples=[{"ada": "a long password"}]),
    ] = None
    keys: Annotated[KeyExpressions, Field(default_factory=lambda: ["**"])]
    peers: Annotated[bool, Field(strict=True)] = False

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Certificates without an endpoint that uses them, and encrypted endpoints without certificates."""
        given = (
            one
            for name in ("listen", "connect")
            if isinstance(entry := _listed(table.get(name)), list)
            for one in entry
        )
        secure = [one for one in given if isinstance(one, str) and one.partition("/")[0] in ENCRYPTED]
        if table.get("tls") is None and secure:
            return [("tls", f"is missing; expected a certificate and its key for {secure[0]}")]
        if table.get("tls") is not None and not secure:
            return [("tls", f"is given, but no endpoint of the side begins with {listed(sorted(ENCRYPTED))}")]
        return []

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where it listens: on a free port of the loopback interface, if the file gives no endpoint at all."""
        if self.listen is not None:
            return tuple(self.listen)
        return () if self.connect else (FREE,)


class WireEventTable(Table):
    """`[[event]]`: something that happens at a time, or from one time to another."""

    at: Annotated[Seconds | None, Field(examples=["12 s"])] = None
    start: Annotated[Seconds | None, Field(alias="from", examples=["12 s"])] = None
    to: Annotated[Seconds | None, Field(examples=["15 s"])] = None
    partition: Annotated[list[str] | None, Field(min_length=2, max_length=2, examples=[["robot", "base"]])] = None
    cut: Annotated[str | None, Field(strict=True, examples=["robot-base"])] = None
    link: Annotated[str | None, Field(strict=True, examples=["robot-base"])] = None
    set: Annotated[dict[str, Any] | None, Field(examples=[{"quality": 0.2}])] = None
    note: Annotated[
        str | None, Field(strict=True, min_length=1, max_length=200, examples=["the robot enters the lift"])
    ] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Mistakes unless one thing happens, and its time is stated in one way."""
        kinds = ("partition", "cut", "set", "note")
        given = [name for name in kinds if table.get(name) is not None]
        found: list[Found] = []
        if len(given) != 1:
            said = f"has {listed(given)} at once" if given else "does not say what happens"
            found.append(("event", f'{said}; expected one of {listed(kinds)}, such as partition = ["robot", "base"]'))
        if (table.get("link") is None) == ("set" in given):
            missing, there = ("link", "set") if "set" in given else ("set", "link")
            if table.get(there) is not None:
                found.append(
                    (missing, f'is missing, but {there} is given; expected link = "robot-base" and what to set')
                )
        if table.get("set") == {}:
            found.append(("set", "is empty; expected what changes, such as set = { quality = 0.2 }"))
        return found + cls._time_mistakes(table)

    @classmethod
    def _time_mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        at, start, to = (table.get(name) for name in ("at", "from", "to"))
        if at is None and start is None:
            return [("at", 'is missing; expected at = "12 s"')]
        if at is not None and start is not None:
            return [("at", "and from are both there; expected one of them")]
        if start is None and to is not None:
            return [("to", "is given without from; expected from and to, or only at")]
        first, last = (in_seconds(one) if isinstance(one, str) else one for one in (start, to))
        if isinstance(first, (int, float)) and isinstance(last, (int, float)) and last <= first:
            return [("to", f"is {as_toml(to)}, not after from, which is {as_toml(start)}; expected a later time")]
        return []


class WireFile(Table):
    """A wire file."""

    seed: Annotated[int, Field(ge=0, lt=2**256, strict=True, examples=[7])] = 0
    side: Annotated[
        dict[Annotated[str, AfterValidator(_side_name)], SideTable],
        Field(
            min_length=2,
            examples=[{"robot": {"listen": "tcp/127.0.0.1:7448"}, "base": {}}],
        ),
    ]
    link: Annotated[list[WireLinkTable], Field(default_factory=list)]
    event: Annotated[list[WireEventTable], Field(default_factory=list)]
    expect: Annotated[list[WireExpectTable], Field(default_factory=list)]
    lossless: Annotated[KeyExpressions, Field(default_factory=list)]
    largest: Annotated[Size, Field(examples=["64 MB"])] = 2**30
    query_seconds: Annotated[Seconds, Field(examples=["10 s"])] = 10.0
    held_messages: Annotated[int, Field(strict=True, ge=1, le=10_000_000, examples=[100_000])] = 100_000
    held_bytes: Annotated[Size, Field(examples=["1 GB"])] = 2**30


_NEEDS = {"rate": "queue", "queue": "rate", "reorder": "delay"}


def changed_settings(
    settings: Mapping[str, Any], changes: Mapping[str, Any], first: Mapping[str, Any]
) -> dict[str, Any]:
    """Those settings of a link that change, from entries of its table. Raises ValidationError if the result is not valid.

    settings: the present ones; first: those at the start. What a change needs and the link did not have at the start is part of
    the result, so that it can be added to the settings at any time.
    """
    entries = {name: value for name, value in settings.items() if not (name == "loss" and "quality" in changes)}
    made = WireSettingsTable.model_validate({**entries, **changes}).wire_settings()
    names = ["loss" if name == "quality" else name for name in changes]
    needed = [_NEEDS[name] for name in names if name in _NEEDS]
    names += [name for name in needed if name in made and name not in names and name not in first]
    return {name: made.get(name, 0.0) for name in names}
