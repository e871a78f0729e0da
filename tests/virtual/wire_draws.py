"""Draws the file of a simulated wire, the programs at its sides, and mistakes in the file.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

from evedrop.errors import ScenarioError
from evedrop.wire.file import wire_of
from tests.virtual.wire_programs import ANSWERS, USER, WireProgram

Tables = dict[str, Any]
ROBOT, BASE, FIELD = "robot", "base", "field"
SIDES = (ROBOT, BASE, FIELD)
ENDPOINTS = {side: f"tcp/127.0.0.1:{17501 + i}" for i, side in enumerate(SIDES)}
OUTSIDE = "tcp/127.0.0.1:17600"
"""Where a router outside of the wire listens, if a side connects to one."""
_LOSSES: tuple[Tables, ...] = (
    {"model": "bernoulli", "quality": 0.6},
    {"model": "gilbert-elliott", "p": 0.1, "r": 0.4},
    {"model": "gilbert-elliott", "p": 0.05, "r": 0.5, "good": 0.1, "bad": 0.9},
    {"model": "markov", "transitions": [[0.9, 0.1], [0.5, 0.5]], "loss": [0.0, 1.0]},
    {"model": "pattern", "outcomes": "110111"},
    {"model": "trace", "outcomes": "1101110111"},
    {"model": "trace", "outcomes": "1101", "random_start": True},
    {
        "model": "distance",
        "sender": [0.0, 0.0],
        "receiver": [120.0, 0.0],
        "reference_snr": 80.0,
        "exponent": 3.0,
        "threshold": 10.0,
        "shadowing": 6.0,
        "shadowing_block": 5,
    },
)
_DELAYS: tuple[Tables, ...] = (
    {"model": "constant", "value": "30 ms"},
    {"model": "normal", "mean": "50 ms", "standard_deviation": 0.03},
    {"model": "pareto", "least": "5 ms", "shape": 2.0},
    {"model": "trace", "values": [0.0, 0.2, 0.05]},
)
_PUBLISHED = (*(f"{side}/**" for side in SIDES), "0/**")
"""All keys on which programs publish: where keys are limited, nobody may listen to others."""
_RATES = ("2 kB/s", "16 kbit/s", 20000.0)
_QUEUES = ("300 B", "2 kB", 0)


def file_of(draw: random.Random, seconds: float) -> Tables:
    """The tables of a wire that runs for some seconds."""
    names = SIDES if draw.random() < 0.4 else SIDES[:2]
    made: Tables = {"seed": draw.randrange(100), "side": {name: _side(draw, name) for name in names}}
    made["link"] = links = [*_links(draw, names)]
    for entry, chance, values in (
        ("largest", 0.2, ("3 kB", 200)),
        ("query_seconds", 0.4, (1, "2 s")),
        ("held_messages", 0.15, (2, 20)),
        ("held_bytes", 0.15, ("1 kB", 100000)),
        ("lossless", 0.2, (f"{ROBOT}/data", [f"{BASE}/**", "ask/**"])),
    ):
        if draw.random() < chance:
            made[entry] = draw.choice(values)
    named = [link["name"] for link in links]
    if events := [_event(draw, names, links, seconds) for _ in range(draw.choice((0, 0, 1, 2, 3)))]:
        made["event"] = events
    if expectations := [_expectation(draw, named) for _ in range(draw.choice((0, 0, 1, 3)))]:
        made["expect"] = expectations
    return made


def _side(draw: random.Random, name: str) -> Tables:
    if name == FIELD and draw.random() < 0.4:
        return {"connect": OUTSIDE}
    made: Tables = {"listen": ENDPOINTS[name]}
    if draw.random() < 0.1:
        made["listen"] = [ENDPOINTS[name], ENDPOINTS[name].replace(":175", ":176")]
    if draw.random() < 0.1:
        made["users"] = dict(USER)
    if draw.random() < 0.1:
        made["keys"] = [*_PUBLISHED, "ask/**", "alive/**"]
    return made


def _links(draw: random.Random, names: tuple[str, ...]) -> Iterator[Tables]:
    number = 0
    first: Tables = {}
    for source in names:
        for target in names:
            if source == target or (FIELD in (source, target) and draw.random() < 0.4):
                continue
            keys = [f"{source}/data", "**"] if draw.random() < 0.5 else [draw.choice(("**", "**", f"{source}/**"))]
            for expression in keys:
                link = {"name": f"l{number}", "from": source, "to": target, "keys": expression, **_settings(draw)}
                if target == FIELD and draw.random() < 0.4:
                    link["tap"] = True
                if "reorder" not in link and draw.random() < 0.15:
                    link["ordered"] = True
                if first and link.get("loss") == first.get("loss") and draw.random() < 0.6:
                    link["correlation"] = {"with": first["name"], "strength": 0.5}
                first = first or link
                number += 1
                yield link


def _settings(draw: random.Random) -> Tables:
    made: Tables = {}
    if draw.random() < 0.3:
        made["quality"] = draw.choice((0.5, 0.9, 1.0, 0.0))
    elif draw.random() < 0.6:
        made["loss"] = deepcopy(draw.choice(_LOSSES))
    if draw.random() < 0.4:
        made["delay"] = deepcopy(draw.choice(_DELAYS))
        if draw.random() < 0.2:
            made["reorder"] = 0.3
    if draw.random() < 0.2:
        made["duplicate"] = 0.2
    if draw.random() < 0.2:
        made["corrupt"] = 0.1
    if draw.random() < 0.2:
        made["rate"] = draw.choice(_RATES)
        if draw.random() < 0.7:
            made["queue"] = draw.choice(_QUEUES)
    return made


def _event(draw: random.Random, names: tuple[str, ...], links: list[Tables], seconds: float) -> Tables:
    at = round(draw.uniform(0.1, seconds), 2)
    event: Tables = (
        {"at": f"{at} s"} if draw.random() < 0.4 else {"from": at, "to": round(at + draw.uniform(0.1, 3.0), 2)}
    )
    link = draw.choice(links)
    change = draw.choice(({"quality": 0.3}, {"delay": {"model": "constant", "value": "10 ms"}}, {"rate": "4 kB/s"}))
    if "correlation" in link or any(link["name"] == other.get("correlation", {}).get("with") for other in links):
        change = {"duplicate": 0.5}
    happens: tuple[Tables, ...] = (
        {"partition": draw.sample(names, 2)},
        {"cut": link["name"]},
        {"link": link["name"], "set": change},
        {"note": "the robot enters the lift"},
    )
    return event | draw.choice(happens)


def _expectation(draw: random.Random, links: list[str]) -> Tables:
    link = draw.choice(links)
    return draw.choice(
        (
            {"link": link},
            {"metric": f"{link}.delivery", "above": draw.choice((0.0, 0.5))},
            {"metric": f"{link}.heard", "above": 0.0, "below": 1e6},
            {"metric": f"{link}.latency", "quantile": 0.9, "below": "1 s"},
            {"metric": f"{link}.gap_messages", "below": 50},
            {"metric": f"{link}.gap_seconds", "below": "5 s"},
        )
    )


def drawn_programs(draw: random.Random, tables: Tables, seconds: float) -> tuple[WireProgram, ...]:
    """A program at each side."""
    return tuple(_program(draw, side, seconds, "keys" in tables["side"][side]) for side in tables["side"])


def _program(draw: random.Random, side: str, seconds: float, limited: bool) -> WireProgram:
    """limited: whether the side allows only some keys."""
    does = [f"listen {keys}" for keys in _PUBLISHED] if limited else ["listen **"]
    if draw.random() < 0.6:
        does.append(f"watch {draw.choice(('alive/**', 'alive/**' if limited else '**'))}")
    for words, chance in (
        (f"publish {side}/data", 0.7),
        (f"often {side}/often", 0.12),
        (f"many {side}/many", 0.2),
        (f"large {side}/large", 0.1),
        (f"delete {side}/data", 0.2),
        (f"ros {side}", 0.2),
        (f"ask ask/{side}", 0.25),
        (f"ask ask/{side}/*", 0.1),
        (f"answer ask/** {draw.choice(ANSWERS)}", 0.4),
        ("call add", 0.15),
        (f"serve add {draw.choice(ANSWERS)}", 0.2),
        (f"alive alive/{side}", 0.3),
        ("alive alive/all", 0.15),
        (f"blink alive/{side}/blinks", 0.1),
        ("leave", 0.5),
    ):
        if draw.random() < chance:
            does.append(words)
    after = draw.choice((0.0, 0.0, 0.0, round(draw.uniform(0.0, seconds), 2)))
    until = draw.choice((None, None, round(draw.uniform(0.1, seconds), 2)))
    return WireProgram(side, tuple(does), after, until)


def drawn_operations(draw: random.Random, tables: Tables, seconds: float) -> tuple[tuple[float, str], ...]:
    """What operators type, and after how many seconds: the folder's place in the words is the second one."""
    first, second, *_ = tables["side"]
    link = draw.choice(tables["link"])["name"]
    choices = (
        "status",
        f"link {link} cut",
        f"link {link} heal",
        f"link {link} duplicate=0.5",
        f"link {link} qualty=0.5",
        f"partition {first} {second}",
        f"heal {first} {second}",
        f"partition {first} nowhere",
        "pause",
    )
    count = draw.choice((0, 0, 1, 2, 3))
    return tuple((round(draw.uniform(0.2, seconds), 2), draw.choice(choices)) for _ in range(count))


def without_a_part(tables: Tables) -> Iterator[Tables]:
    """The tables without one of their parts, if what is left is a wire."""
    for path in [*_paths(tables)]:
        smaller = deepcopy(tables)
        *parents, last = path
        inner: Any = smaller
        for name in parents:
            inner = inner[name]
        del inner[last]
        try:
            wire_of(smaller)
        except ScenarioError:
            continue
        yield smaller


def _paths(tables: Tables) -> Iterator[tuple[Any, ...]]:
    """The places of parts that may be left out, the largest first."""
    yield from ((name,) for name in tables if name not in ("side", "link"))
    yield from (("side", name) for name in tables["side"])
    for name in ("link", "event", "expect"):
        yield from ((name, i) for i in range(len(tables.get(name, ()))))
    for i, link in enumerate(tables["link"]):
        yield from (("link", i, entry) for entry in link if entry not in ("name", "from", "to"))
    for name, side in tables["side"].items():
        yield from (("side", name, entry) for entry in side if entry != "listen")


def _put(*path: Any, value: Any, named: str = "") -> Callable[[Tables], str]:
    """A mistake: a value at a place; named: the entry that an error names, if it is another one."""

    def broken(tables: Tables) -> str:
        inner: Any = tables
        for name in path[:-1]:
            inner = inner.setdefault(name, {}) if isinstance(inner, dict) else inner[name]
        inner[path[-1]] = value
        return named or ".".join(map(str, path))

    return broken


def _add(table: str, entries: Tables, named: str) -> Callable[[Tables], str]:
    """A mistake: one table more in a list."""

    def broken(tables: Tables) -> str:
        tables.setdefault(table, []).append(dict(entries))
        return f"{table}.{len(tables[table]) - 1}.{named}"

    return broken


def _remove(*path: Any) -> Callable[[Tables], str]:
    """A mistake: an entry is missing."""

    def broken(tables: Tables) -> str:
        inner: Any = tables
        for name in path[:-1]:
            inner = inner[name]
        inner.pop(path[-1], None)
        return ".".join(map(str, path))

    return broken


def _twice(tables: Tables) -> str:
    tables["link"] = [tables["link"][0], {**tables["link"][0]}, *tables["link"][1:]]
    return "link.1.name"


MISTAKES: dict[str, Callable[[Tables], str]] = {
    "a missing source": _remove("link", 0, "from"),
    "no sides": _remove("side"),
    "an unknown entry": _put("qualty", value=0.5),
    "an unknown entry of a link": _put("link", 0, "qualty", value=0.5),
    "an unknown entry of a side": _put("side", ROBOT, "listens", value="x"),
    "a text for a number": _put("link", 0, "duplicate", value="often"),
    "a number for a text": _put("link", 0, "from", value=7),
    "a list for a table": _put("side", value=[ROBOT, BASE]),
    "a text for a link": _put("link", 0, value="radio"),
    "a probability above 1": _put("link", 0, "corrupt", value=1.5),
    "a negative seed": _put("seed", value=-1),
    "an unknown unit": _put("query_seconds", value="2 weeks"),
    "a size that is no number": _put("largest", value="big"),
    "a loss model of another name": _put("link", 0, "loss", value={"model": "gilbert"}),
    "a delay that is negative": _put("link", 0, "delay", value={"model": "constant", "value": -1.0}),
    "a delay in an unknown unit": _put("link", 0, "delay", value={"model": "constant", "value": "3 feet"}),
    "a delay in slots": _put("link", 0, "delay", value={"model": "constant", "value": 1.0, "unit": "slots"}),
    "a trace that ends": _put("link", 0, "loss", value={"model": "trace", "outcomes": "11", "once": True}),
    "a recording that is not there": _put("link", 0, "loss", value={"model": "trace", "file": "no.csv"}),
    "a queue without a rate": _add("link", {"from": ROBOT, "to": BASE, "queue": 10}, "queue"),
    "a rate in an unknown unit": _put("link", 0, "rate", value="2 boxes/s"),
    "a link of two orders": _add(
        "link",
        {"from": ROBOT, "to": BASE, "delay": {"model": "constant", "value": 1}, "reorder": 0.5, "ordered": True},
        "reorder",
    ),
    "a link to nowhere": _put("link", 0, "to", value="moon"),
    "a link to its own side": _add("link", {"from": ROBOT, "to": ROBOT}, "to"),
    "a key that Zenoh refuses": _put("link", 0, "keys", value="//"),
    "a key that is not canonical": _put("link", 0, "keys", value="a/**/**"),
    "a name with capitals": _put("link", 0, "name", value="Radio"),
    "a side with capitals": _put("side", "Moon", value={}),
    "a link of the same name": _twice,
    "a correlation with nothing": _put("link", 0, "correlation", value={"with": "nothing", "strength": 0.5}),
    "a lossy protocol": _put("side", ROBOT, "listen", value="udp/127.0.0.1:1"),
    "an endpoint without a port": _put("side", ROBOT, "listen", value="tcp/127.0.0.1"),
    "a port that is too large": _put("side", ROBOT, "listen", value="tcp/127.0.0.1:70000"),
    "one endpoint twice": _put("side", BASE, "listen", value=ENDPOINTS[ROBOT]),
    "a connection to itself": _put("side", ROBOT, "connect", value=ENDPOINTS[BASE]),
    "encryption without certificates": _put(
        "side", ROBOT, "listen", value="tls/127.0.0.1:17700", named=f"side.{ROBOT}.tls"
    ),
    "certificates without encryption": _put("side", ROBOT, "tls", value={"certificate": "a", "key": "b"}),
    "a user with a colon": _put("side", ROBOT, "users", value={"a:b": "c"}),
    "an event without a time": _add("event", {"note": "when?"}, "at"),
    "an event with two times": _add("event", {"at": 1, "from": 2, "note": "when?"}, "at"),
    "an event that only ends": _add("event", {"at": 1, "to": 2, "note": "when?"}, "to"),
    "an event that ends before it begins": _add("event", {"from": "2 s", "to": "1 s", "note": "when?"}, "to"),
    "an event without anything": _add("event", {"at": 1}, ""),
    "an event of two kinds": _add("event", {"at": 1, "cut": "l0", "note": "both"}, ""),
    "an event of an unknown link": _add("event", {"at": 1, "cut": "nothing"}, "cut"),
    "an event that sets nothing": _add("event", {"at": 1, "link": "l0", "set": {}}, "set"),
    "an event that sets no link": _add("event", {"at": 1, "set": {"quality": 0.5}}, "link"),
    "an event that sets another entry": _add("event", {"at": 1, "link": "l0", "set": {"tap": True}}, "set.tap"),
    "an event that sets a wrong value": _add("event", {"at": 1, "link": "l0", "set": {"corrupt": 3.0}}, "set.corrupt"),
    "a partition of one side": _add("event", {"at": 1, "partition": [ROBOT, ROBOT]}, "partition"),
    "a partition from nowhere": _add("event", {"at": 1, "partition": [ROBOT, "moon"]}, "partition.1"),
    "an expectation of an unknown link": _add("expect", {"metric": "nothing.delivery", "above": 0.5}, "metric"),
    "an expectation of nothing": _add("expect", {}, "metric"),
    "an expectation of an unknown metric": _add("expect", {"metric": "l0.speed", "above": 0.5}, "metric"),
    "an expectation without a bound": _add("expect", {"metric": "l0.delivery"}, "below"),
    "an expectation without a quantile": _add("expect", {"metric": "l0.latency", "below": 1}, "quantile"),
    "an expectation with a pointless quantile": _add(
        "expect", {"metric": "l0.delivery", "below": 1, "quantile": 0.5}, "quantile"
    ),
    "an expectation of two kinds": _add("expect", {"link": "l0", "below": 0.5}, "below"),
    "a bound that is no number": _add("expect", {"metric": "l0.delivery", "below": "much"}, "below"),
}
"""What may be wrong in a file: each puts it there, and returns the name of the entry that an error must name."""
TEXTS = ("cut short", "no text", "not there")
"""What may be wrong with the text of a file."""
