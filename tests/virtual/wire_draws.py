"""Draws the file of a simulated wire and the programs at its sides.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
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
        made["keys"] = [*(["*/data"] if draw.random() < 0.5 else []), *_PUBLISHED, "ask/**", "alive/**"]
    if draw.random() < 0.25:
        made["peers"] = True
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
        (f"odd {side}", 0.1),
        (f"many {side}/data/@adv", 0.08),
        (f"named {side}/named", 0.08),
        (f"ros {side}2", 0.1),
        (f"vary {side}/vary", 0.1),
        ("peer quiet", 0.08),
        ("peer heard", 0.08),
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
        "link nothing heal",
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
