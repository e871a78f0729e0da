"""Dataclasses as tables of JSON: what a process reads from a file, with arrays as rows of numbers.

msgspec checks the types and bounds of fields, and dataclasses themselves what their fields must have in common.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from evedrop.model.process import Floats, Limits
from evedrop.system.fields import Finite
from evedrop.system.structs import converted

T = TypeVar("T")


def plain(value: Any) -> Any:
    """A dataclass or an array as JSON has it, for `default` of json.dumps. A field that is None by default is left out."""
    if isinstance(value, np.ndarray):
        flat: list[Any] = value.tolist()
        return flat if value.ndim > 1 else [number if math.isfinite(number) else str(number) for number in flat]
    if isinstance(value, Mapping):
        return dict(value)
    own = ((field, getattr(value, field.name)) for field in fields(value))
    return {field.name: entry for field, entry in own if entry is not None or field.default is not None}


def read(kind: type[T], table: Any) -> T:
    """A dataclass from its table. Raises ValueError, with the place in the table and what was expected there."""
    made: T = converted(table, kind, dec_hook=_array)
    _expect_known(table, made, "$")
    return made


def _array(kind: Any, value: Any) -> Floats:
    """An array in a table. Raises ValueError if it is not one of finite numbers, or of numbers and infinities for limits."""
    is_matrix = isinstance(value, list) and len(value) > 0 and isinstance(value[0], list)
    rows: Any = _Limits if kind == Limits else list[list[Finite]] if is_matrix else list[Finite]
    try:
        numbers = converted(value, rows)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from error  # to which msgspec adds the place of the array
    return np.array([float(limit) for limit in numbers] if kind == Limits else numbers, np.float64)


_Limits = list[Finite | Literal["inf", "-inf"]]


def _expect_known(table: Any, made: Any, place: str) -> None:
    """Raise ValueError for an entry that no field of a dataclass has: msgspec passes over those."""
    if isinstance(table, dict):
        own = {field.name: getattr(made, field.name) for field in fields(made)} if is_dataclass(made) else made
        for name, entry in table.items():
            if name not in own:
                raise ValueError(f"Object contains unknown field `{name:.40}` - at `{place}`")
            _expect_known(entry, own[name], f"{place}.{name:.40}")
    elif isinstance(table, list) and isinstance(made, (list, tuple)):
        for number, (entry, own) in enumerate(zip(table, made, strict=True)):
            _expect_known(entry, own, f"{place}[{number}]")
