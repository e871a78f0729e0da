"""`[process]`: the process model, which every process of a run knows.

Source: docs/scenario.md, process.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evedrop.model.process import Process, mistakes_of
from evedrop.scenario.given import ProgramTable, Source, source_mistakes
from evedrop.scenario.table import Found, Matrix, Number, ProcessName, Table
from evedrop.scenario.words import as_toml, listed

_MATRICES = ("A", "Q", "initial_covariance")


class ProcessTable(Table):
    """`[process]`: x_{k+1} = A x_k + w_k, w ~ N(0, Q), x_0 ~ N(0, initial_covariance), or where else states come from."""

    A: Annotated[Matrix, Field(examples=[[[1.0, 0.3], [0.5, 1.001]]])]
    Q: Annotated[Matrix, Field(examples=[[[0.001, 0.0], [0.0, 0.001]]])]
    initial_covariance: Annotated[Matrix, Field(examples=[[[1.0, 0.0], [0.0, 1.0]]])]
    singular_noise: Annotated[bool, Field(strict=True, examples=[True])] = False
    reference: Annotated[list[Number] | None, Field(examples=[[55.0, 50.0]])] = None
    states: Annotated[
        list[Annotated[str, Field(strict=True, min_length=1)]] | None, Field(examples=[["SOC", "LOH"]])
    ] = None
    units: Annotated[list[Annotated[str, Field(strict=True, min_length=1)]] | None, Field(examples=[["%", "%"]])] = None

    directions: Annotated[dict[ProcessName, list[Number]] | None, Field(examples=[{"sum": [1.0, 1.0]}])] = None
    source: Annotated[Source | None, Field(examples=["file"])] = None
    state_file: Annotated[str | None, Field(strict=True, examples=["pose.csv"])] = None
    state_values: Annotated[list[list[Number]] | None, Field(examples=[[[0.0, 0.1], [0.1, 0.1]]])] = None
    zenoh: Annotated[ProgramTable | None, Field(examples=[{"key": "robot/pose", "connect": "tcp/127.0.0.1:7447"}])] = (
        None
    )
    theory: Annotated[bool | None, Field(strict=True, examples=[True])] = None

    def mistakes(self) -> Iterator[Found]:
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
                yield f"directions.{name}", f"has {len(weights)} entries; expected {n}, one for each state"
            elif not any(weights):
                yield f"directions.{name}", "is zero; expected a direction, such as [1.0, 0.0]"
        yield from source_mistakes(self, n)
        for name in ("reference", "states", "units"):
            values = getattr(self, name)
            if values is not None and len(values) != n:
                yield name, f"has {len(values)} entries; expected {n}, one for each state"

    def _shape_mistake(self, name: str) -> str | None:
        """What is wrong with the shape of a matrix; None if it is square."""
        rows = getattr(self, name)
        lengths = {len(row) for row in rows}
        if lengths == {len(rows)}:
            return None
        count = "1 row" if len(rows) == 1 else f"{len(rows)} rows"
        shape = f"{count} of {listed([str(n) for n in sorted(lengths)])} numbers" if rows else "no rows"
        example = (type(self).model_fields[name].examples or [0])[0]
        return f"has {shape}; expected a square matrix, such as {as_toml(example)}"

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
