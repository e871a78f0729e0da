"""`[process]`: the process model, which every process of a run knows, and states that are given in place of a simulated process.

Such states come from a recording or from a program.

Source: docs/scenario.md, process; docs/programs.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from evedrop.counting import counted
from evedrop.model.process import Process, mistakes_of
from evedrop.model.slot.cores import LARGEST
from evedrop.scenario.table import Labels, Matrix, Mistake, Number, ProcessName, Table, expected
from evedrop.scenario.words import as_toml, listed

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
    """The Zenoh key on which the program publishes the states, without wildcards."""
    connect: Endpoint | None = None
    """The endpoint of a router that the program uses. Either this or `listen`."""
    listen: Endpoint | None = None
    """The endpoint to which the program itself connects. Either this or `connect`."""
    offsets: Annotated[
        list[Annotated[int, Field(strict=True, ge=0, le=_MOST_BYTES)]] | None, Field(examples=[[4, 12]])
    ] = None
    """For binary messages: the byte at which each state's float64 begins. Without it, messages are JSON."""

    def mistakes(self) -> Iterator[Mistake]:
        """Neither or both of `connect` and `listen`."""
        if (self.connect is None) == (self.listen is None):
            which = "is missing" if self.connect is None else "is given together with listen"
            yield (
                "connect",
                f"{which}; expected the endpoint of a router that the program uses, such as connect = "
                '"tcp/127.0.0.1:7447", or listen, the endpoint that the program itself connects to',
            )


def source_mistakes(table: ProcessTable, n: int) -> Iterator[Mistake]:
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
        if (sentence := word_mistake(words)) is not None:
            yield entry, sentence
    if not table.given and table.theory is not None:
        yield "theory", "is given, but the states are simulated, and theory describes them; remove the line"
    offsets = None if table.zenoh is None else table.zenoh.offsets
    if offsets is not None and len(offsets) != n:
        yield "zenoh.offsets", f"has {counted(len(offsets), 'entry')}; expected {n}, one for each state"
    if table.state_values is not None and (sentence := row_mistake(table.state_values, n, "state")) is not None:
        yield "state_values", sentence


def word_mistake(words: Sequence[str]) -> str | None:
    """What is wrong with words that the first line of a CSV file cannot have; None if it can have all."""
    wrong = next((word for word in words if not _WORD.fullmatch(word)), None)
    if wrong is None:
        return None
    return f'has {as_toml(wrong)}; expected words for the first line of a CSV file, without [ ] , " and #'


def row_mistake(rows: Sequence[Sequence[float]], count: int, each: str) -> str | None:
    """What is wrong with rows of this many numbers, one for each of what `each` names; None if nothing is."""
    wrong = next((i for i, row in enumerate(rows) if len(row) != count), None)
    if wrong is not None:
        return f"row {wrong} has {counted(len(rows[wrong]), 'number')}; expected {count}, one for each {each}"
    values = np.array(rows, np.float64).reshape(-1, count)
    large = np.argwhere(~(np.abs(values) <= LARGEST))
    if not large.size:
        return None
    i, j = large[0]
    return f"row {i} has {values[i, j]:g}; expected finite numbers of up to {LARGEST:g}"


_MATRICES = ("A", "Q", "initial_covariance")


class ProcessTable(Table):
    """`[process]`: the linear model x⁺ = A x + w with w ~ N(0, Q) and x₀ ~ N(0, Σ₀), and where else true states come from."""

    A: Annotated[Matrix, Field(examples=[[[1.0, 0.3], [0.5, 1.001]]])]
    """The system matrix, n × n, with at most 64 states."""
    Q: Annotated[Matrix, Field(examples=[[[0.001, 0.0], [0.0, 0.001]]])]
    """The covariance of the process noise, symmetric and positive definite, or `"filter"`: that of what the sensor's
    Kalman filter adds to its estimate in each slot."""
    initial_covariance: Annotated[Matrix, Field(examples=[[[1.0, 0.0], [0.0, 1.0]]])]
    """Σ₀, the covariance of the first state, positive definite, or `"filter"`: that of the filter's steady state."""
    singular_noise: Annotated[bool, Field(strict=True, examples=[True])] = False
    """Whether Q may be singular. `Q = "filter"` implies it."""
    reference: Annotated[list[Number] | None, Field(examples=[[55.0, 50.0]])] = None
    """The public levels that states are deviations from: tables and view show `reference` + x; packets contain x."""
    states: Annotated[Labels | None, Field(examples=[["SOC", "LOH"]])] = None
    """The names of the states, for tables and view, and in files and messages of states."""
    units: Annotated[Labels | None, Field(examples=[["%", "%"]])] = None
    """The units of the states."""

    directions: Annotated[dict[ProcessName, list[Number]] | None, Field(examples=[{"sum": [1.0, 1.0]}])] = None
    """Vectors v, by name: the error of vᵀx is given for each receiver, with a verdict on secrecy in this direction."""
    source: Annotated[Source | None, Field(examples=["file"])] = None
    """Where the true states come from: the model above (default), a recording, or a program."""
    state_file: Annotated[str | None, Field(strict=True, examples=["pose.csv"])] = None
    """For `source = "file"`: a CSV file with a column for each of `states`, and a line for each slot."""
    state_values: Annotated[list[list[Number]] | None, Field(examples=[[[0.0, 0.1], [0.1, 0.1]]])] = None
    """The same numbers in place of a file: a row for each slot."""
    zenoh: Annotated[ProgramTable | None, Field(examples=[{"key": "robot/pose", "connect": "tcp/127.0.0.1:7447"}])] = (
        None
    )
    """For `source = "zenoh"`: how the program that publishes the states is reached."""
    theory: Annotated[bool | None, Field(strict=True, examples=[True])] = None
    """For a recording or a program: whether A and Q describe its states, so that theory's errors are given."""

    def mistakes(self) -> Iterator[Mistake]:
        """Matrices that are not square or do not fit each other, and lists without an entry for each state.

        A matrix that is not square is not compared with the others.
        """
        shapes = {name: sentence for name in _MATRICES if (sentence := self._shape_mistake(name)) is not None}
        yield from shapes.items()
        square = {name: np.array(getattr(self, name), np.float64) for name in _MATRICES if name not in shapes}
        if not square:
            return
        n = len(next(iter(square.values())))
        A, Q, initial = (square.get(name, np.eye(n)) for name in _MATRICES)
        yield from (mistake for mistake in mistakes_of(A, Q, initial, self.singular_noise) if mistake[0] in square)
        for name, weights in (self.directions or {}).items():
            if len(weights) != n:
                yield f"directions.{name}", f"has {counted(len(weights), 'entry')}; expected {n}, one for each state"
            elif not any(weights):
                yield f"directions.{name}", "is zero; expected a direction, such as [1.0, 0.0]"
        yield from source_mistakes(self, n)
        for name in ("reference", "states", "units"):
            values = getattr(self, name)
            if values is not None and len(values) != n:
                yield name, f"has {counted(len(values), 'entry')}; expected {n}, one for each state"
        if self.states is not None and len({*self.states}) < len(self.states):
            yield "states", "has a name twice; expected different names"

    def _shape_mistake(self, name: str) -> str | None:
        """What is wrong with the shape of a matrix; None if it is square."""
        rows = getattr(self, name)
        lengths = {len(row) for row in rows}
        if lengths == {len(rows)}:
            return None
        shape = (
            f"{counted(len(rows), 'row')} of {listed([str(n) for n in sorted(lengths)])} numbers" if rows else "no rows"
        )
        return f"has {shape}; expected a square matrix, such as {self._example(name)}"

    @property
    def around(self) -> list[float]:
        """The public reference, (n,): states are transmitted as deviations from it. Zeros unless it is given."""
        return [0.0] * len(self.A) if self.reference is None else self.reference

    @property
    def given(self) -> bool:
        """Whether the true states come from a recording or a program, and A and Q are only what the receivers assume."""
        return self.source in {"file", "zenoh"}

    @property
    def directions_as_arrays(self) -> dict[str, NDArray[np.float64]]:
        """Name of a direction → its weights, (n,)."""
        return {name: np.array(weights) for name, weights in (self.directions or {}).items()}

    @property
    def process(self) -> Process:
        """The process it describes."""
        return Process(np.array(self.A), np.array(self.Q), np.array(self.initial_covariance), self.singular_noise)
