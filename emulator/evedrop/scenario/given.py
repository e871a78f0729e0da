"""States that a scenario takes from a recording or from a program, in place of a simulated process.

Source: docs/scenario.md, process; docs/programs.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from evedrop.model.slot.cores import LARGEST
from evedrop.scenario.table import Found, Table, expected
from evedrop.scenario.words import as_toml

if TYPE_CHECKING:
    from evedrop.scenario.process import ProcessTable

Source = Literal["model", "file", "zenoh"]
"""Where the true states come from: `model`, the process itself."""
_KEY = re.compile(r"[^/*$#?]+(?:/[^/*$#?]+)*")
_ENDPOINT = re.compile(r"[a-z_-]+/\S+")
_WORD = re.compile(r"[^\s\[\],\"#](?:[^\[\],\"#\n\r]*[^\s\[\],\"#])?")
_MOST_BYTES = 65_536
_EXAMPLE = 'zenoh = { key = "robot/pose", connect = "tcp/127.0.0.1:7447" }'


def _key(text: str) -> str:
    if not _KEY.fullmatch(text):
        raise expected("one key without wildcards")
    return text


def _endpoint(text: str) -> str:
    if not _ENDPOINT.fullmatch(text):
        raise expected("an endpoint of Zenoh")
    return text


Endpoint = Annotated[str, Field(strict=True, examples=["tcp/127.0.0.1:7447"]), AfterValidator(_endpoint)]


class ProgramTable(Table):
    """`zenoh = {…}` of a process: the key on which a program publishes the states, and how it is reached."""

    key: Annotated[str, Field(strict=True, examples=["robot/pose"]), AfterValidator(_key)]
    connect: Endpoint | None = None
    listen: Endpoint | None = None
    offsets: Annotated[
        list[Annotated[int, Field(strict=True, ge=0, le=_MOST_BYTES)]] | None, Field(examples=[[4, 12]])
    ] = None

    def mistakes(self) -> Iterator[Found]:
        """Neither or both of `connect` and `listen`."""
        if (self.connect is None) == (self.listen is None):
            which = "is missing" if self.connect is None else "is given together with listen"
            yield (
                "connect",
                f"{which}; expected the endpoint of a router that the program uses, such as connect = "
                '"tcp/127.0.0.1:7447", or listen, the endpoint that the program itself connects to',
            )


def source_mistakes(table: ProcessTable, n: int) -> Iterator[Found]:
    """Mistakes in the entries of `[process]` that say where states come from; n: the number of states."""
    source = table.source
    if source is None:
        entries = {"state_file": table.state_file, "state_values": table.state_values, "zenoh": table.zenoh}
        kinds = [("zenoh" if name == "zenoh" else "file", name) for name, value in entries.items() if value is not None]
        yield from (("source", f'is missing, but {name} is given; expected source = "{kind}"') for kind, name in kinds)
    if source == "file" and table.state_file is None and table.state_values is None:
        yield "state_file", 'is missing; expected state_file = "pose.csv", or state_values'
    if source == "zenoh" and table.zenoh is None:
        yield "zenoh", f"is missing; expected {_EXAMPLE}"
    if table.given and table.states is None:
        yield "states", 'is missing; expected the names of the states in file or message, such as states = ["x", "y"]'
    for entry, words in (("states", table.states or []), ("units", table.units or [])) if table.given else ():
        wrong = next((word for word in words if not _WORD.fullmatch(word)), None)
        if wrong is not None:
            yield entry, f'has {as_toml(wrong)}; expected words for the first line of a CSV file, without [ ] , " and #'
        elif entry == "states" and len({*words}) < len(words):
            yield entry, "has a name twice; expected different names"
    if not table.given and table.theory is not None:
        yield "theory", "is given, but the states are simulated, and theory describes them; remove the line"
    offsets = None if table.zenoh is None else table.zenoh.offsets
    if offsets is not None and len(offsets) != n:
        yield "zenoh.offsets", f"has {len(offsets)} entries; expected {n}, one for each state"
    if table.state_values is not None:
        yield from _row_mistakes(table.state_values, n)


def _row_mistakes(rows: list[list[float]], n: int) -> Iterator[Found]:
    wrong = next((i for i, row in enumerate(rows) if len(row) != n), None)
    if wrong is not None:
        yield "state_values", f"row {wrong} has {len(rows[wrong])} numbers; expected {n}, one for each state"
        return
    values = np.array(rows, np.float64).reshape(-1, n)
    large = np.argwhere(~(np.abs(values) <= LARGEST))
    if large.size:
        i, j = large[0]
        yield "state_values", f"row {i} has {values[i, j]:g}; expected finite numbers of up to {LARGEST:g}"
