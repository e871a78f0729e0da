"""Files of a simulated wire that have a mistake, which an error must name, or that are only looked at.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from evedrop.cli.simulated import program
from evedrop.errors import UsageError
from evedrop.scenario.words import toml_text
from evedrop.virtual.run import SimulatedWorld
from tests.virtual.wire_draws import BASE, ENDPOINTS, OUTSIDE, ROBOT, Tables

Change = Callable[[Tables], str]
"""Puts something into a file, and returns what the output must name."""
_SECONDS = 60.0
"""In which a command ends."""


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


def _two_links(tables: Tables, *entries: Tables) -> None:
    """Have two links only, in opposite directions."""
    tables["link"] = [
        {"name": "l0", "from": ROBOT, "to": BASE} | entries[0],
        {"name": "l1", "from": BASE, "to": ROBOT} | entries[1],
    ]
    for name in ("event", "expect"):
        tables.pop(name, None)


def _other_model(tables: Tables) -> str:
    loss = {"model": "bernoulli", "quality": 0.6}
    _two_links(tables, {"loss": loss}, {"loss": loss, "correlation": {"with": "l0", "strength": 0.5}})
    tables["event"] = [{"at": 1, "link": "l1", "set": {"loss": {"model": "pattern", "outcomes": "10"}}}]
    return "event.0.set"


def _chain(tables: Tables) -> str:
    loss, tie = {"model": "bernoulli", "quality": 0.6}, {"strength": 0.5}
    _two_links(tables, {"loss": loss}, {"loss": loss, "correlation": {"with": "l0", **tie}})
    tables["link"].append({"from": ROBOT, "to": BASE, "loss": loss, "correlation": {"with": "l1", **tie}})
    return "link.2.correlation.with"


def _two_connect(tables: Tables) -> str:
    for side in (ROBOT, BASE):
        tables["side"][side] = {"connect": OUTSIDE}
    return f"side.{BASE}.connect"


def _one_socket(tables: Tables) -> str:
    for side in (ROBOT, BASE):
        tables["side"][side] = {"listen": ["unixsock-stream//tmp/robot", ENDPOINTS[side]]}
    return f"side.{BASE}.listen.0"


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
    "an endpoint without anything": _put("side", ROBOT, "listen", value="tcp"),
    "an endpoint without a port": _put("side", ROBOT, "listen", value="tcp/127.0.0.1"),
    "a port that is too large": _put("side", ROBOT, "listen", value="tcp/127.0.0.1:70000"),
    "one endpoint twice": _put("side", BASE, "listen", value=ENDPOINTS[ROBOT]),
    "a connection to itself": _put("side", ROBOT, "connect", value=ENDPOINTS[BASE]),
    "encryption without certificates": _put(
        "side", ROBOT, "listen", value="tls/127.0.0.1:17700", named=f"side.{ROBOT}.tls"
    ),
    "certificates without encryption": _put("side", ROBOT, "tls", value={"certificate": "a", "key": "b"}),
    "a user with a colon": _put("side", ROBOT, "users", value={"a:b": "c"}),
    "a user with a line break": _put("side", ROBOT, "users", value={"a\nb": "c"}),
    "a user with a space": _put("side", ROBOT, "users", value={" a": "c"}),
    "a link without keys": _put("link", 0, "keys", value=[]),
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
    "an expectation that nothing meets": _add("expect", {"metric": "l0.delivery", "below": 0.0}, "below"),
    "an expectation beyond everything": _add("expect", {"metric": "l0.delivery", "above": 1.0}, "above"),
    "an expectation whose bounds are exchanged": _add(
        "expect", {"metric": "l0.delivery", "above": 0.6, "below": 0.5}, "above"
    ),
    "an expectation without a quantile": _add("expect", {"metric": "l0.latency", "below": 1}, "quantile"),
    "an expectation with a pointless quantile": _add(
        "expect", {"metric": "l0.delivery", "below": 1, "quantile": 0.5}, "quantile"
    ),
    "an expectation of two kinds": _add("expect", {"link": "l0", "below": 0.5}, "below"),
    "a bound that is no number": _add("expect", {"metric": "l0.delivery", "below": "much"}, "below"),
    "an event that parts a side from nothing": _add("event", {"partition": [ROBOT, BASE], "at": "noon"}, "at"),
    "a list for a loss model": _put("link", 0, "loss", value=[1, 0]),
    "a tied link that is given another model": _other_model,
    "a link that is tied to a tied one": _chain,
    "a text that runs backwards": _put("side", ROBOT, "listen", value="tcp/\u202e127.0.0.1:1"),
    "a router to which two sides connect": _two_connect,
    "one socket twice": _one_socket,
    "an unknown protocol": _put("side", ROBOT, "listen", value="smoke/127.0.0.1:17701"),
}
"""What may be wrong in a file: each puts it there, and returns the name of the entry that an error must name."""
TEXTS = ("cut short", "no text", "not there")
"""What may be wrong with the text of a file."""


def _settings(**entries: Any) -> Change:
    """Two links of which the first one has these settings; the output must name `named`."""
    named = entries.pop("named")

    def changed(tables: Tables) -> str:
        _two_links(tables, entries, {})
        return str(named)

    return changed


def _side(named: str, **entries: Any) -> Change:
    """Two links, and other entries of a side; the output must name `named`."""

    def changed(tables: Tables) -> str:
        _two_links(tables, {}, {})
        tables["side"][ROBOT] = {"listen": ENDPOINTS[ROBOT], **entries}
        return named

    return changed


def _late(tables: Tables) -> str:
    _two_links(tables, {}, {})
    tables["link"].append({"name": "late", "from": ROBOT, "to": BASE})
    return "link late takes no key"


_CERTIFICATE = {"certificate": "robot.pem", "key": "robot.key"}
_TLS = "tls/192.0.2.1:17702"


class Look(NamedTuple):
    """A look at a file, with further words for the command."""

    change: Change
    words: tuple[str, ...] = ()
    status: int = 0


LOOKS: dict[str, Look] = {
    "peers that are allowed": Look(_side("mode peer allowed", peers=True)),
    "certificates of clients": Look(
        _side("certificates required", listen=_TLS, tls={**_CERTIFICATE, "authority": "ca.pem"})
    ),
    "a certificate of the side": Look(_side("without users or an authority", listen=_TLS, tls=_CERTIFICATE)),
    "an open side": Look(
        _side("without encryption (tls) and without users", listen=[ENDPOINTS[ROBOT], "tcp/0.0.0.0:17703"])
    ),
    "an open side with users": Look(_side("without encryption (tls)", listen="tcp/0.0.0.0:1", users={"a": "b"})),
    "sockets": Look(_side("unixsock-stream//tmp/robot", listen=["unixsock-stream//tmp/robot", "unixsock-stream//b"])),
    "a side without links": Look(_put("side", "moon", value={}, named="side moon has no link")),
    "a link that takes no key": Look(_late),
    "a link that loses everything": Look(
        _settings(
            named="loss = ", loss={"model": "markov", "transitions": [[0.5, 0.5], [0.5, 0.5]], "loss": [1.0, 1.0]}
        )
    ),
    "a link that loses everything at last": Look(
        _settings(
            named="loss = ", loss={"model": "markov", "transitions": [[0.5, 0.5], [0.2, 0.8]], "loss": [1.0, 1.0]}
        )
    ),
    "a key that begins with @": Look(_settings(named="begin with @"), ("@ros2_lv/0",)),
    "keys of an advanced publisher": Look(_settings(named="no link takes it", keys="a"), ("a/@adv/pub/b/_", "b")),
    "a key that Zenoh refuses": Look(_settings(named="/topic"), ("/topic",), UsageError.exit_status),
    "a link that is changed by name": Look(_settings(named="quality = 0.25"), ("--set", "link.l0.quality=0.25")),
    "a link that is changed by number": Look(_settings(named="quality = 0.25"), ("--set", "link.1.quality=0.25")),
    "a change of an unknown link": Look(
        _settings(named="radio"), ("--set", "link.radio.quality=0.25"), UsageError.exit_status
    ),
    "a change that is not possible": Look(_settings(named="seed"), ("--set", "seed.x=1"), UsageError.exit_status),
}
"""What may be looked at, and what the output must name."""
TRIALS = (*MISTAKES, *TEXTS, *LOOKS)


def tried(simulated: SimulatedWorld, file: Path, text: str, tables: Tables, trials: tuple[str, ...]) -> Iterator[str]:
    """Give the command one file after the other, and yield what is wrong with its answers; text, tables: of the right file."""
    scheduler = simulated.scheduler
    for trial in trials:
        change, words, status = LOOKS.get(trial) or (MISTAKES.get(trial), (), UsageError.exit_status)
        named = _write(file, trial, text, deepcopy(tables), change)
        folder = file.parent / "wire"
        further = [*words, "--check"] if trial in LOOKS else ["--out", str(folder), "--for", "1 s"]
        process = simulated.machine.begin("wire", partial(program, ["wire", str(file), *further]))
        scheduler.run(scheduler.now + _SECONDS, lambda process=process: not process.task.alive)  # type: ignore[misc]
        printed = process.printed
        if process.task.status != status:
            yield f"status {process.task.status} for a file with {trial}: {printed.strip()[-300:]}"
        yield from (
            f"{trial}: the message does not name {name}: {printed.strip()[-300:]}"
            for name in named
            if name not in printed
        )
        if folder.exists():
            yield f"{trial}: {folder.name} is left"
            return
        file.unlink(missing_ok=True)


def _write(file: Path, trial: str, text: str, tables: Tables, change: Change | None) -> tuple[str, ...]:
    """Write a file for a trial; returns what the output must name."""
    if trial == "not there":
        return (file.name,)
    if trial == "no text":
        file.write_bytes(b"\xff" + text.encode())
        return (file.name,)
    if trial == "cut short":
        file.write_text(text[: text.rindex(" = ") + 3], "utf-8")
        return file.name, "TOML"
    named = () if change is None else (change(tables),)
    file.write_text(toml_text(tables), "utf-8")
    return named
