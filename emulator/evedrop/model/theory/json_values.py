"""The JSON of designs: the fields of their dataclasses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any


def json_value(value: Any) -> Any:
    """A value as JSON has it: dataclasses and tables entry by entry, tuples as lists, null for inf and nan."""
    if is_dataclass(value):
        return {field.name: json_value(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {name: json_value(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class JsonFields:
    """A dataclass whose JSON has all its fields."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON; inf is null."""
        return {name: json_value(value) for name, value in vars(self).items()}
