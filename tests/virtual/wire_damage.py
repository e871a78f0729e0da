"""Damages of a folder that a simulated wire has left: the next start in it is refused by name, or goes on where nothing is lost.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zenoh

from evedrop.cli.simulated import program
from evedrop.errors import UsageError
from evedrop.scenario.words import toml_text
from evedrop.system.world import world
from evedrop.virtual.run import SimulatedWorld
from evedrop.wire.history import WireHistory
from evedrop.wire.journal_place import JOURNAL_FOLDER, UNFINISHED, locked
from evedrop.wire.records import RECORD, STORED
from tests.virtual.wire_draws import BASE, ENDPOINTS, Tables

Entry = dict[str, Any]
_EACH = 8
"""How many damages are tried of a wire."""
_SECONDS = 60.0
"""In which a command ends."""
_ELSEWHERE = {side: endpoint.replace(":175", ":177") for side, endpoint in ENDPOINTS.items()}
_HISTORY = "history.jsonl"


def _edited(edit: Callable[[list[Entry]], object]) -> Callable[[Path], None]:
    """A damage: other lines in the history."""

    def damage(journal: Path) -> None:
        file = journal / _HISTORY
        entries = [json.loads(line) for line in file.read_bytes().splitlines()]
        edit(entries)
        file.write_text("".join(json.dumps(entry) + "\n" for entry in entries), "utf-8")

    return damage


def _in_settings(name: str, value: object) -> Callable[[Path], None]:
    """A damage: a setting of all links of the first start."""

    def edit(entries: list[Entry]) -> None:
        for settings in entries[0]["links"].values():
            settings[name] = value

    return _edited(edit)


def _empty_page(journal: Path) -> None:
    with (journal / _HISTORY).open("ab") as file:
        file.write(bytes(64) + b"\n")


def _without(column: str) -> Callable[[Path], None]:
    """A damage: a wire that was killed, in whose files a column is empty."""

    def damage(journal: Path) -> None:
        _edited(lambda entries: entries.__setitem__(slice(None), [one for one in entries if "end" not in one]))(journal)
        for path in journal.glob("*.parquet"):
            table = pq.read_table(path)
            at = table.schema.get_field_index(column)
            field = table.schema.field(at)
            pq.write_table(table.set_column(at, field, pa.nulls(table.num_rows, field.type)), path)

    return damage


def _wrong_record(journal: Path) -> None:
    start = WireHistory.read(journal).start
    records = np.zeros(1, RECORD)
    records["time"], records["kind"], records["fate"] = 1.0, 0x7F, STORED
    (journal / UNFINISHED).mkdir(exist_ok=True)
    (journal / UNFINISHED / f"{start:03d}-9999.rows").write_bytes(records.tobytes())


def _occupied(journal: Path) -> object:
    """A damage: another program listens where a side is to listen."""
    del journal
    settings = {"mode": "router", "listen": {"endpoints": [_ELSEWHERE[BASE]]}}
    return world().zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


class Damage(NamedTuple):
    """A damage, and what a start of the wire says of it: nothing if it goes on."""

    change: Callable[[Path], object]
    named: str | None


DAMAGES: dict[str, Damage] = {
    "a page of the history without contents": Damage(_empty_page, None),
    "the end of another start": Damage(
        _edited(lambda entries: entries.append({"end": 99, "time": 0.0, "counts": [], "missing": 0})), None
    ),
    "a start with a wrong number": Damage(
        _edited(lambda entries: entries[0].update(start=-1)), "is not the history of a wire"
    ),
    "a wrong probability": Damage(_in_settings("corrupt", 2.0), "corrupt is 2.0; expected a number from 0 to 1"),
    "a wrong loss model": Damage(
        _in_settings("loss", {"model": "bernoulli", "quality": 7.0}), "has settings of the link"
    ),
    "another seed": Damage(
        _edited(lambda entries: [one.update(seed=-1) for one in entries if "start" in one]), "had the seed"
    ),
    "files without keys": Damage(_without("key"), "cannot be read"),
    "files without links": Damage(_without("link"), None),
    "a wrong record": Damage(_wrong_record, "is not one of this wire"),
    "a folder in use": Damage(locked, "another wire writes to"),
    "an endpoint in use": Damage(_occupied, "end the program that listens there already"),
}
"""What may happen to the folder `journal`, or to what else a start needs."""


def tried_damages(simulated: SimulatedWorld, folder: Path, tables: Tables, seed: int) -> Iterator[str]:
    """Start the wire again in damaged copies of its folder, and yield what is wrong with what it says.

    tables: those of its file; its sides are elsewhere now, where its programs do not find them.
    """
    history = folder / JOURNAL_FOLDER / _HISTORY
    if not history.is_file():
        return
    copy, file, scheduler = folder.parent / "damaged", folder.parent / "damaged.toml", simulated.scheduler
    sides = {name: {"listen": _ELSEWHERE[name]} for name in tables["side"]}
    file.write_text(toml_text({**tables, "side": sides}), "utf-8")
    start = WireHistory.read(folder / JOURNAL_FOLDER).start
    parts = [pq.read_table(path)["n"] for path in folder.rglob(f"{start:03d}-*.parquet")]
    numbered = any(numbers.null_count < len(numbers) for numbers in parts)
    for name in random.Random(seed).sample([*DAMAGES], _EACH):  # noqa: S311 - to be repeated, not to be secret
        damage = DAMAGES[name]
        if not history.is_file():  # somebody has moved it away meanwhile
            return
        if name == "files without keys" and not numbered:
            continue
        shutil.copytree(folder, copy)
        process = simulated.machine.begin("reader", partial(_start, damage, copy, file))
        scheduler.run(scheduler.now + _SECONDS, lambda process=process: not process.task.alive)  # type: ignore[misc]
        status, said = process.task.status, process.printed
        if damage.named is None and (status not in {0, 1} or "Traceback" in said):
            yield f"{name}: status {status}: {said.strip()[-300:]}"
        if damage.named is not None and (status != UsageError.exit_status or damage.named not in said):
            yield f"{name}: status {status}, and the message does not say {damage.named!r}: {said.strip()[-300:]}"
        shutil.rmtree(copy)


def _start(damage: Damage, folder: Path, file: Path) -> int:
    damage.change(folder / JOURNAL_FOLDER)
    return program(["wire", str(file), "--out", str(folder), "--for", "0.2 s", "--quiet"])
