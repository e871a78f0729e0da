"""What runs beside the programs of a simulated wire: the wire itself, a router, operators, and what reads the folder afterwards.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from evedrop.cli.simulated import program
from evedrop.system.output import say
from evedrop.system.world import world
from evedrop.virtual.endings import status_of
from evedrop.wire.file import load_wire
from evedrop.wire.journal_place import JOURNAL_FOLDER
from evedrop.wire.plan import WirePlan
from evedrop.wire.run import run_wire
from tests.virtual.small_limits import HUNG, LIMITS
from tests.virtual.wire_draws import BASE, ENDPOINTS, OUTSIDE, ROBOT
from tests.virtual.wire_programs import Course
from tests.wire.wire_recordings import shown

VIEW, REPLAY, OPENED, SCENARIO = "view", "replay", "opened from Python", "scenario"
"""What is done besides: the wire records its view; afterwards it is recorded again from the journal; a program opens the wire.

Instead, a scenario is run whose links are those of the wire, if one of the drawn ones can have them.
"""
JOINED, MOVED, DAMAGED = "joined outside", "journal moved away", "damaged"
"""What happens meanwhile: a router outside joins the first two sides for some time; somebody moves the journal away.

Afterwards copies of its folder are damaged, as `wire_damage.py` says.
"""
FURTHER = {
    VIEW: 0.06,
    REPLAY: 0.1,
    OPENED: 0.15,
    SCENARIO: 0.12,
    JOINED: 0.15,
    MOVED: 0.03,
    DAMAGED: 0.1,
    **dict.fromkeys(LIMITS, 0.12),
    HUNG: 0.08,
}
"""How often each of it is drawn, and each of the limits."""
_FITS: tuple[tuple[str, ...], ...] = (
    (),
    ("--gaps",),
    ("--key", "*/data"),
    ("--key", "0/**", "--gaps"),
    ("--key", "//"),
)
"""Further words for `evedrop links fit`."""
VIEW_FILE, REPLAY_FILE = "view.rrd", "replay.rrd"


def run_the_wire(file: Path, folder: Path, seconds: float, *, view: bool) -> int:
    """The wire, as the command runs it, without its report: pictures take longer than all the rest."""
    shown = str(folder.parent / VIEW_FILE) if view else "off"
    return status_of(
        lambda: run_wire(load_wire(file), folder, seconds=seconds, say=lambda _: None, complain=say, view=shown)
    )


def route() -> int:
    """The router outside of the wire."""
    settings = {"mode": "router", "listen": {"endpoints": [OUTSIDE]}}
    with world().zenoh.open(zenoh.Config.from_json5(json.dumps(settings))):
        while True:
            world().sleep(100.0)


def join(sides: Sequence[Mapping[str, Any]], seconds: float) -> int:
    """A router that connects to sides which listen, and joins them for some seconds."""
    endpoints = [ENDPOINTS[ROBOT], ENDPOINTS[BASE]]
    settings: dict[str, Any] = {"mode": "router", "connect": {"endpoints": endpoints}}
    for user, password in next((side["users"] for side in sides if "users" in side), {}).items():
        settings["transport"] = {"auth": {"usrpwd": {"user": user, "password": password}}}
    with world().zenoh.open(zenoh.Config.from_json5(json.dumps(settings))):
        world().sleep(seconds)
    return 0


def move_journal(folder: Path) -> int:
    """Somebody moves the journal of a wire."""
    with suppress(FileNotFoundError):
        (folder / JOURNAL_FOLDER).rename(folder.parent / "moved")
    return 0


def type_words(folder: Path, words: str, course: Course) -> int:
    """Somebody types a command."""
    verb, *rest = words.split()
    status = program([verb, str(folder), *rest])
    course.typed.append((words, status))
    return status


def readers(folder: Path, file: Path, plan: WirePlan, seed: int, further: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """What reads the folder afterwards, each with its name."""
    beside = folder.parent
    keys = [f"{ROBOT}/data", "ask/robot", "**"]
    yield "wire", lambda: program(["wire", str(file), *keys, "--check"])
    yield "export", lambda: program(["export", str(folder), str(beside / "rows.csv")])
    yield "view", lambda: program(["view", str(folder), "--table"])
    yield "links", lambda: program(["links", "fit", str(folder), *(["--gaps"] if seed % 8 else [])])
    for link in plan.links[seed % 3 : 1 + seed % 3]:
        yield (
            "links",
            lambda link=link: program(["links", "fit", str(folder), "--link", link.name, *_FITS[seed % len(_FITS)]]),
        )
    if REPLAY in further:
        yield REPLAY, lambda: status_of(lambda: _replay(folder, beside / REPLAY_FILE))


def wrong_recording(path: Path, rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """The table of a recording counts the messages of the latest start, whose rows these are."""
    counts = Counter("no link" if row["link"] is None else row["link"] for row in rows)
    tables = shown(path, "table", "TextDocument:text")
    lines = [line.split("|") for line in (tables[-1][1][0].splitlines()[2:] if tables else ())]
    told = {line[1].strip(): int(line[3].replace(",", "")) for line in lines}
    if told != {**dict.fromkeys(told, 0), **counts}:
        yield f"{path.name} counts {told}, and the journal {dict(counts)}"


def _replay(folder: Path, path: Path) -> int:
    from evedrop.wire.recording import replay_wire, wire_seconds

    wire_seconds(folder)
    replay_wire(folder, path)
    return 0
