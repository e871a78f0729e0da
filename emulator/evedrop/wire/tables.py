"""The tables of a wire file: their entries, and the checks of each table by itself.

Lengths of time, sizes and rates are numbers in seconds, bytes and bytes per second, or texts with a unit. An endpoint says where
a side listens. `[[expect]]` is a condition on what a link delivered, how long it held messages back, and its longest gaps.

Source: docs/wire/file.md, the file and sides; docs/wire/results.md, expectations.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, NamedTuple, Self

import zenoh
from pydantic import AfterValidator, BeforeValidator, Field, ModelWrapValidatorHandler, model_validator
from pydantic_core import PydanticCustomError

from evedrop.errors import UsageError
from evedrop.model.checks import as_toml
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.links import LOSS_MODELS
from evedrop.scenario.receivers import CorrelationTable, LinkTable
from evedrop.scenario.table import Mistake, Table, checked_name, expected, model_mistakes, refuse
from evedrop.scenario.words import listed
from evedrop.system.hints import near
from evedrop.wire.tallies import WIRE_METRICS

_TIMES = {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
_SIZES = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_BITS = {"bit/s": 1 / 8, "kbit/s": 1e3 / 8, "Mbit/s": 1e6 / 8, "Gbit/s": 1e9 / 8}
_RATES = {**{f"{unit}/s": float(size) for unit, size in _SIZES.items()}, **_BITS}
_WITH_UNIT = re.compile(r"(\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)\s*(\S+)")
LONGEST_SECONDS = 1e6
LARGEST_BYTES = 2**40


def in_unit(text: str, units: Mapping[str, float]) -> float | None:
    """The number in a text such as "20 ms", in the base unit; None if it is not a number with one of the units."""
    match = _WITH_UNIT.fullmatch(text.strip())
    if match is None or match[2] not in units:
        return None
    number = float(match[1]) * units[match[2]]
    return round(number, 12)  # 20 ms are the number that 0.02 is


def in_seconds(text: str) -> float | None:
    """The seconds in a text such as "20 ms"; None if it is not a length of time."""
    return in_unit(text, _TIMES)


def seconds_of(text: str, entry: str) -> float:
    """The seconds in a text such as "20 ms" or "0.02". Raises UsageError unless they are within 0 and `LONGEST_SECONDS`.

    entry: what has this value.
    """
    seconds = in_seconds(text if text.strip()[-1:].isalpha() else f"{text} s")
    if seconds is None or not 0.0 < seconds <= LONGEST_SECONDS:
        wanted = f'more than 0 and at most {LONGEST_SECONDS:.0f} seconds, such as 60 or "60 s"'
        raise UsageError(f"{entry} {text}: expected {wanted}")
    return seconds


def _seconds(value: Any) -> Any:
    return _read(value, _TIMES, 'seconds, or a text such as "20 ms"')


def _rate(value: Any) -> Any:
    return _read(value, _RATES, 'bytes per second, or a text such as "2 MB/s"')


def _size(value: Any) -> Any:
    number = _read(value, _SIZES, 'bytes, or a text such as "256 kB"')
    return int(number) if isinstance(number, float) and number.is_integer() else number


def _read(value: Any, units: Mapping[str, float], wanted: str) -> Any:
    if not isinstance(value, str):
        return value
    number = in_unit(value, units)
    if number is None:
        raise expected(f"{wanted}; the units are {', '.join(units)}")
    return number


Seconds = Annotated[float, Field(strict=True, ge=0.0, le=LONGEST_SECONDS), BeforeValidator(_seconds)]
Rate = Annotated[float, Field(strict=True, ge=1.0, le=float(LARGEST_BYTES)), BeforeValidator(_rate)]
"""Bytes per second."""
Size = Annotated[int, Field(strict=True, ge=0, le=LARGEST_BYTES), BeforeValidator(_size)]
"""Bytes."""


RELIABLE = ("tcp", "tls", "quic", "ws", "unixsock-stream")
"""The protocols on which nothing is lost; one that loses by itself would hide what the wire loses."""
ENCRYPTED = frozenset({"tls", "quic"})
FREE = "tcp/127.0.0.1:0"
"""Any free port of the loopback interface."""
_ENDPOINT = re.compile(r"([a-z0-9-]+)/([^?#]+)(?:[?#].*)?")
_HOST_AND_PORT = re.compile(r"(\[[0-9a-fA-F:.%a-z]+\]|[^:\[\]/]+):(\d{1,5})")
_EVERY_HOST = frozenset({"0.0.0.0", "[::]"})  # noqa: S104 - recognised, not bound
_LOOPBACK = re.compile(r"127\.\d+\.\d+\.\d+|\[::1\]|localhost")


class EndpointPlace(NamedTuple):
    """Where an endpoint is."""

    protocol: str
    host: str
    """The host, or the path of a socket."""
    port: int | None
    """None for a socket in the file system."""

    @property
    def loopback(self) -> bool:
        """Whether only programs on this machine can reach it."""
        return self.port is None or _LOOPBACK.fullmatch(self.host) is not None

    def overlaps(self, other: EndpointPlace) -> bool:
        """Whether a program that listens on one keeps others from listening on the other."""
        if (self.port is None) != (other.port is None) or (self.protocol == "quic") != (other.protocol == "quic"):
            return False
        if self.port is None:
            return self.host == other.host
        same = self.host == other.host or bool({self.host, other.host} & _EVERY_HOST)
        return self.port == other.port != 0 and same


def place_of(endpoint: str) -> EndpointPlace | None:
    """The place of an endpoint; None if it is malformed."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or match[1] not in RELIABLE:
        return None
    if match[1] == "unixsock-stream":
        return EndpointPlace(match[1], match[2], None)
    address = _HOST_AND_PORT.fullmatch(match[2])
    if address is None or int(address[2]) > 65_535:
        return None
    host = "127.0.0.1" if address[1] == "localhost" else address[1]
    return EndpointPlace(match[1], host, int(address[2]))


def checked_endpoint(endpoint: str) -> str:
    """The endpoint, if its form is right; otherwise raises the error of a check."""
    if endpoint.startswith("udp/"):
        raise expected(f"{listed(RELIABLE)} in place of udp, which would lose messages of its own")
    if place_of(endpoint) is None:
        raise expected(f"PROTOCOL/HOST:PORT with the protocol {listed(RELIABLE)}, such as tcp/127.0.0.1:7448")
    return endpoint


_BOUNDS = ("below", "above")


def _bound(value: Any) -> Any:
    seconds = in_seconds(value) if isinstance(value, str) else None
    if isinstance(value, str) and seconds is None:
        raise expected('a number, or a length of time such as "20 ms"')
    return value if seconds is None else seconds


def _metric(text: str) -> str:
    _, dot, metric = text.rpartition(".")
    if not dot or metric not in WIRE_METRICS:
        names = [f"LINK.{name}" for name in WIRE_METRICS]
        raise expected(listed(names), near(metric, WIRE_METRICS))
    return text


Bound = Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False), BeforeValidator(_bound)]


class WireExpectTable(Table):
    """`[[expect]]` of a wire file: a metric of a link with its bounds, or a link whose losses must agree with its model."""

    metric: Annotated[Annotated[str, AfterValidator(_metric)] | None, Field(examples=["scan.delivery"])] = None
    below: Annotated[Bound | None, Field(examples=[0.9])] = None
    above: Annotated[Bound | None, Field(examples=[0.5])] = None
    quantile: Annotated[float | None, Field(strict=True, gt=0.0, lt=1.0, examples=[0.99])] = None
    link: Annotated[str | None, Field(strict=True, examples=["scan"])] = None

    def mistakes(self) -> Iterator[Mistake]:
        """Mistakes unless there is a metric with a bound, or a link alone."""
        if self.link is not None:
            others = [name for name, value in self if name != "link" and value is not None]
            alone = 'is set, but a table with link has no other entries; expected link = "scan" alone'
            yield from ((name, alone) for name in others)
            return
        if self.metric is None:
            yield "metric", 'is missing; expected metric = "scan.delivery" with below or above, or link = "scan"'
            return
        metric = WIRE_METRICS[self.metric.rpartition(".")[2]]
        yield from self._bound_mistakes(metric.most)
        if metric.has_quantile == (self.quantile is None):
            names = [name for name, kind in WIRE_METRICS.items() if kind.has_quantile]
            sentence = (
                f"is missing; a {listed(names)} needs one"
                if self.quantile is None
                else f"is set, but only a {listed(names)} has quantiles"
            )
            yield "quantile", f"{sentence}; expected quantile = 0.99 with {listed([f'LINK.{kind}' for kind in names])}"

    def _bound_mistakes(self, most: float) -> Iterator[Mistake]:
        """Bounds that no value from 0 to `most` meets, or none of which is there."""
        if self.below is None and self.above is None:
            yield "below", "is missing, and so is above; add one of them, or both"
        if self.below == 0.0:
            yield "below", "is 0, and no value is below it; expected a number above 0"
        if self.above is not None and self.above >= most:
            yield "above", f"is {self.above:.10g}, and no value is above it; expected a number below {most:g}"
        if self.above is not None and self.below is not None and self.above >= self.below:
            yield "above", f"is {self.above:.10g}, not less than below; expected a number below {self.below:.10g}"

    @model_validator(mode="wrap")
    @classmethod
    def _times_bound_times(cls, entries: Any, check: ModelWrapValidatorHandler[Self]) -> Self:
        """Refuse a length of time as a bound of a metric that is not in seconds."""
        table = check(entries)
        if table.metric is not None and not WIRE_METRICS[table.metric.rpartition(".")[2]].is_time:
            why = f"but {table.metric} is no time; expected a number"
            texts = [(name, entries.get(name)) for name in _BOUNDS]
            refuse((name, f"is {as_toml(text)}, {why}") for name, text in texts if isinstance(text, str))
        return table

    @property
    def subject(self) -> str:
        """The name of the link."""
        return self.link if self.link is not None else str(self.metric).rpartition(".")[0]

    @property
    def wanted(self) -> str:
        """The value that is expected."""
        if self.link is not None:
            return "within the 99 % bounds of its model"
        bounds = [(name, getattr(self, name)) for name in _BOUNDS]
        return " and ".join(f"{name} {value:.10g}" for name, value in bounds if value is not None)

    @property
    def text(self) -> str:
        """The expectation as a part of a sentence."""
        if self.link is not None:
            return f"link {self.link} {self.wanted}"
        quantile = "" if self.quantile is None else f"{self.quantile:.10g} quantile of "
        return f"{quantile}{self.metric} {self.wanted}"

    def holds(self, value: float) -> bool:
        """Whether a metric meets the expectation."""
        return (self.below is None or value < self.below) and (self.above is None or value > self.above)


def expectation_mistakes(expectations: Sequence[WireExpectTable], names: Sequence[str]) -> Iterator[str]:
    """Mistakes in the names of links."""
    for i, table in enumerate(expectations):
        link = table.subject
        if link not in names:
            entry, text = ("link", table.link) if table.metric is None else ("metric", table.metric)
            choice = f"expected a metric or the name of {listed(names)}" if names else "the file has no link"
            yield f"expect.{i}.{entry}: is {as_toml(text)}, but there is no link {link}; {choice}{near(link, names)}"


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
        raise PydanticCustomError("expected", "one value", {"ending": why})
    return text


def _link_name(name: str) -> str:
    if not _LINK_NAME.fullmatch(name):
        raise expected("a name of a lower-case letter, then up to 79 of a-z 0-9 _ -")
    return name


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _user(name: str) -> str:
    if not name or ":" in name:
        raise expected("a user name without a colon")
    return _in_a_line(name)


def _in_a_line(text: str) -> str:
    if any(unicodedata.category(character) == "Cc" for character in text):
        raise expected("text without control characters")  # Zenoh reads a line for each user
    if text != text.strip():
        raise expected("text without spaces at its ends")  # which Zenoh leaves out: nobody could log in with them
    return text


def _some_keys(keys: list[str]) -> list[str]:
    if not keys:
        refuse([("", 'is empty; expected key expressions, such as ["**"]')])
    return keys


KeyExpression = Annotated[str, Field(strict=True), AfterValidator(_key_expression)]
KeyExpressions = Annotated[list[KeyExpression], BeforeValidator(_listed), Field(examples=["robot/**"])]
Endpoints = Annotated[list[Annotated[str, AfterValidator(checked_endpoint)]], BeforeValidator(_listed)]
File = Annotated[str, Field(strict=True, min_length=1)]


def _delay(delay: dict[str, Any]) -> dict[str, Any]:
    """A delay's table with its lengths of time as numbers of seconds."""
    made, mistakes = dict(delay), dict[str, str]()
    model = DELAY_MODELS.get(str(delay.get("model")))
    for name in () if model is None else model.lengths:
        text = made.get(name)
        if isinstance(text, str) and (seconds := in_seconds(text)) is not None:
            made[name] = seconds
        elif isinstance(text, str):
            mistakes[name] = f'is {as_toml(made.pop(name))}; expected seconds, or a text such as "20 ms"'
    if made.pop("unit", "seconds") != "seconds":
        mistakes["unit"] = f"is {as_toml(delay['unit'])}; expected no unit: delays on a wire are in seconds"
    of_model = [mistake for mistake in model_mistakes(made, DELAY_MODELS) if mistake[0] not in mistakes]
    refuse([*mistakes.items(), *of_model])
    return made


def _loss(loss: dict[str, Any]) -> dict[str, Any]:
    mistakes = model_mistakes(loss, LOSS_MODELS)
    if loss.get("once") is True:
        mistakes.append(("once", "is true, but a wire has no last message; expected false: the recording repeats"))
    refuse(mistakes)
    return loss


class WireCorrelationTable(CorrelationTable):
    """`correlation = {…}` of a wire's link."""

    to: Annotated[str, Field(strict=True, alias="with", examples=["robot-base"])]


class WireSettingsTable(LinkTable):
    """The settings of a link: those of a scenario's link, with a message as a packet and seconds and bytes as units."""

    may_be_perfect = True
    correlation: Annotated[WireCorrelationTable | None, Field(examples=[{"with": "robot-base", "strength": 0.5}])] = (
        None
    )
    loss: Annotated[
        Annotated[dict[str, Any], AfterValidator(_loss)] | None,
        Field(examples=[{"model": "gilbert-elliott", "p": 0.05, "r": 0.5}]),
    ] = None
    delay: Annotated[
        Annotated[dict[str, Any], AfterValidator(_delay)] | None,
        Field(examples=[{"model": "constant", "value": "20 ms"}]),
    ] = None
    rate: Annotated[Rate | None, Field(examples=["2 MB/s"])] = None
    queue: Annotated[Size | None, Field(examples=["256 kB"])] = None

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


IN_ORDER = "is given together with ordered = true; expected one of them"
"""The end of a message about `reorder` on a link on which no message overtakes another."""


class WireLinkTable(WireSettingsTable):
    """`[[link]]`: one direction between two sides."""

    name: Annotated[str | None, AfterValidator(lambda name: name and _link_name(name)), Field(examples=["scan"])] = None
    source: Annotated[str, Field(strict=True, alias="from", examples=["robot"])]
    target: Annotated[str, Field(strict=True, alias="to", examples=["base"])]
    keys: Annotated[KeyExpression, Field(examples=["robot/scan/**"])] = "**"
    tap: Annotated[bool, Field(strict=True)] = False
    ordered: Annotated[bool, Field(strict=True)] = False

    def mistakes(self) -> Iterator[Mistake]:
        """Those of the settings, and messages that are to overtake others, on a link on which none does."""
        yield from super().mistakes()
        if self.ordered and self.reorder:
            yield "reorder", IN_ORDER


class TlsTable(Table):
    """`tls = {…}` of a side: PEM files. Only clients of the authority may connect; without one, they need no certificate."""

    certificate: Annotated[File, Field(examples=["robot.pem"])]
    key: Annotated[File, Field(examples=["robot.key"])]
    authority: Annotated[File | None, Field(examples=["authority.pem"])] = None


class SideTable(Table):
    """`[side.NAME]`: a place at which programs connect."""

    listen: Annotated[Endpoints | None, Field(examples=["tcp/127.0.0.1:7448"])] = None
    connect: Annotated[Endpoints, Field(default_factory=list, examples=["tcp/127.0.0.1:7447"])]
    tls: Annotated[TlsTable | None, Field(examples=[{"certificate": "robot.pem", "key": "robot.key"}])] = None
    users: Annotated[
        dict[
            Annotated[str, AfterValidator(_user)],
            Annotated[str, Field(strict=True, min_length=1), AfterValidator(_in_a_line)],
        ]
        | None,
        Field(examples=[{"ada": "a long password"}]),
    ] = None
    keys: Annotated[KeyExpressions, Field(default_factory=lambda: ["**"]), AfterValidator(_some_keys)]
    peers: Annotated[bool, Field(strict=True)] = False

    def mistakes(self) -> Iterator[Mistake]:
        """Certificates without an endpoint that uses them, and encrypted endpoints without certificates."""
        endpoints = [*(self.listen or ()), *self.connect]
        secure = [endpoint for endpoint in endpoints if endpoint.partition("/")[0] in ENCRYPTED]
        if self.tls is None and secure:
            yield "tls", f"is missing; expected a certificate and its key for {secure[0]}"
        if self.tls is not None and not secure:
            yield "tls", f"is given, but no endpoint of the side begins with {listed(sorted(ENCRYPTED))}"

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

    def mistakes(self) -> Iterator[Mistake]:
        """Mistakes unless one thing happens, and its time is stated in one way."""
        kinds = ("partition", "cut", "set", "note")
        given = [name for name in kinds if getattr(self, name) is not None]
        if len(given) != 1:
            sentence = f"has {listed(given)} at once" if given else "does not say what happens"
            yield "event", f'{sentence}; expected one of {listed(kinds)}, such as partition = ["robot", "base"]'
        if (self.link is None) != (self.set is None):
            missing, there = ("link", "set") if self.link is None else ("set", "link")
            yield missing, f'is missing, but {there} is given; expected link = "robot-base" and what to set'
        if self.set == {}:
            yield "set", "is empty; expected what changes, such as set = { quality = 0.2 }"
        if self.at is None and self.start is None:
            yield "at", 'is missing; expected at = "12 s"'
        elif self.at is not None and self.start is not None:
            yield "at", "and from are both there; expected one of them"
        elif self.start is None and self.to is not None:
            yield "to", "is given without from; expected from and to, or only at"

    @model_validator(mode="wrap")
    @classmethod
    def _ends_after_its_start(cls, entries: Any, check: ModelWrapValidatorHandler[Self]) -> Self:
        """Refuse an end that is not after the start, with both times as they are written."""
        event = check(entries)
        if event.start is not None and event.to is not None and event.to <= event.start:
            start, to = as_toml(entries["from"]), as_toml(entries["to"])
            refuse([("to", f"is {to}, not after from, which is {start}; expected a later time")])
        return event


class WireFile(Table):
    """A wire file."""

    seed: Annotated[int, Field(ge=0, lt=2**256, strict=True, examples=[7])] = 0
    side: Annotated[
        dict[Annotated[str, AfterValidator(checked_name)], SideTable],
        Field(
            min_length=2,
            examples=[{"robot": {"listen": "tcp/127.0.0.1:7448"}, "base": {}}],
        ),
    ]
    link: Annotated[list[WireLinkTable], Field(default_factory=list)]
    event: Annotated[list[WireEventTable], Field(default_factory=list)]
    expect: Annotated[list[WireExpectTable], Field(default_factory=list)]
    lossless: Annotated[KeyExpressions, Field(default_factory=list)]
    largest: Annotated[Size, Field(ge=1, examples=["64 MB"])] = 2**30
    query_seconds: Annotated[Seconds, Field(gt=0.0, examples=["10 s"])] = 10.0
    held_messages: Annotated[int, Field(strict=True, ge=1, le=10_000_000, examples=[100_000])] = 100_000
    held_bytes: Annotated[Size, Field(ge=1, examples=["1 GB"])] = 2**30


_NEEDS = {"rate": "queue", "queue": "rate", "reorder": "delay"}
_NO_DELAY: Mapping[str, Any] = {"model": "constant", "value": 0.0}


def changed_settings(
    settings: Mapping[str, Any], changes: Mapping[str, Any], first: Mapping[str, Any]
) -> dict[str, Any]:
    """Those settings of a link that change, from entries of its table. Raises ValidationError if the result is not valid.

    settings: the present ones; first: those at the start. What a change needs and the link did not have at the start is part of
    the result, so that it can be added to the settings at any time.
    """
    replaced = {"loss"} if "quality" in changes else set()
    if "rate" in changes and changes["rate"] is None:
        replaced.add("queue")
    entries = {name: value for name, value in settings.items() if name not in replaced}
    made = WireSettingsTable.model_validate({**entries, **changes}).wire_settings()
    names = ["loss" if name == "quality" else name for name in changes]
    needed = [_NEEDS[name] for name in names if name in _NEEDS]
    names += [name for name in needed if name in made and name not in names and name not in first]
    return {name: made.get(name, _NO_DELAY if name == "delay" else 0.0) for name in names}
