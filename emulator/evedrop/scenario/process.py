"""`[process]`: the process model, which every process of a run knows.

Source: docs/scenario.md, process.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evedrop.model.checks import is_number
from evedrop.model.process import Process, mistakes_of
from evedrop.scenario.given import ProgramTable, Source, source_mistakes
from evedrop.scenario.table import Found, Matrix, Number, ProcessName, Table, numbers
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

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Matrices that are not square or do not fit each other, and lists without an entry for each state.

        A matrix that is missing or malformed is not compared with the others.
        """
        mistakes: list[Found] = []
        matrices: dict[str, NDArray[np.float64]] = {}
        for name in _MATRICES:
            field = cls.model_fields[name]
            rows = table.get(name)
            if not numbers(rows) or rows is None:
                continue
            lengths = {len(row) for row in rows}
            if lengths == {len(rows)} and rows:
                matrices[name] = np.array(rows, np.float64)
            else:
                count = "1 row" if len(rows) == 1 else f"{len(rows)} rows"
                shape = f"{count} of {listed([str(n) for n in sorted(lengths)])} numbers" if rows else "no rows"
                mistakes.append(
                    (name, f"has {shape}; expected a square matrix, such as {as_toml((field.examples or [0])[0])}")
                )
        if matrices:
            square = matrices.get("A", next(iter(matrices.values())))
            placeholder = np.eye(len(square))
            A, Q, initial = (matrices.get(name, placeholder) for name in _MATRICES)
            singular = table.get("singular_noise") is True
            mistakes += [
                (name, sentence) for name, sentence in mistakes_of(A, Q, initial, singular) if name in matrices
            ]
            mistakes += _direction_mistakes(table.get("directions"), len(square))
            mistakes += source_mistakes(table, len(square))
            for name in ("reference", "states", "units"):
                values = table.get(name)
                if isinstance(values, list) and len(values) != len(square):
                    mistakes.append((name, f"has {len(values)} entries; expected {len(square)}, one for each state"))
        return mistakes

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


def _direction_mistakes(directions: object, n: int) -> list[Found]:
    """Directions that have not n numbers, or only zeros; entries that are malformed are not looked at."""
    if not isinstance(directions, Mapping):
        return []
    mistakes: list[Found] = []
    for name, weights in directions.items():
        if not isinstance(weights, list) or not all(is_number(weight) for weight in weights):
            continue
        if len(weights) != n:
            mistakes.append((f"directions.{name}", f"has {len(weights)} entries; expected {n}, one for each state"))
        elif not any(weights):
            mistakes.append((f"directions.{name}", "is zero; expected a direction, such as [1.0, 0.0]"))
    return mistakes
