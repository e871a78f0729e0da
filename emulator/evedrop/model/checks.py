"""Checks of parameters that the classes of a scenario share, and the way in which messages write values."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

_SHOWN = 80  # characters of a value that messages repeat
MOST_SLOTS = 1_000_000
LAST_SLOT = 2**62
"""The largest number of a slot: others can be added to it without leaving 64 bits."""


class Parametrised:
    """A class that a scenario names, with its parameters there."""

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """The entries that the scenario gives it, each with an example."""

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Mistakes in parameters, all of them known but some perhaps missing: (entry, value found and expected)."""
        del given
        return []


def toml_of(value: Any) -> str:
    """A value as a scenario would write it, in one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml_of(inner)}" for key, inner in value.items()) + " }" if value else "{}"
    if isinstance(value, list):
        return f"[{', '.join(toml_of(inner) for inner in value)}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)


def as_toml(value: Any) -> str:
    """The same for a message: a long value is cut."""
    text = toml_of(value[: _SHOWN + 1] if isinstance(value, (str, list)) else value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def is_number(value: Any, least: float = -math.inf, most: float = math.inf) -> bool:
    """Whether a value is a finite number from `least` to `most`, no whole number beyond those of float64."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and least <= value <= most and abs(value) <= sys.float_info.max


def expect_slots(*slots: int) -> None:
    """Raise ValueError unless each is a slot: a number from 0 to `LAST_SLOT`."""
    beyond = next((slot for slot in slots if not 0 <= slot <= LAST_SLOT), None)
    if beyond is not None:
        raise ValueError(f"{beyond} is not a slot, expected a number from 0 to {LAST_SLOT}")


def expect_shapes(of: object, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ValueError unless the arrays under these names have these shapes."""
    for name, shape in shapes.items():
        own = getattr(getattr(of, name), "shape", None)
        if own != shape:
            raise ValueError(f"{name} has the shape {own}, expected {shape}")


def is_probability(value: Any) -> bool:
    """Whether a value is a number from 0 to 1."""
    return is_number(value, 0.0, 1.0)


def number_mistakes(given: Mapping[str, Any], name: str, least: float, most: float) -> list[tuple[str, str]]:
    """A mistake if the entry is given and is not a number from `least` to `most`."""
    if name not in given or is_number(given[name], least, most):
        return []
    return [(name, f"is {as_toml(given[name])}; expected a number from {least:.10g} to {most:.10g}")]


def whole_number_mistakes(
    given: Mapping[str, Any], name: str, least: int, most: int, of: str = ""
) -> list[tuple[str, str]]:
    """A mistake if the entry is given and is not a whole number from `least` to `most`; of: what it counts."""
    if name not in given or (type(given[name]) is int and least <= given[name] <= most):
        return []
    return [(name, f"is {as_toml(given[name])}; expected a whole number{of and f' of {of}'} from {least} to {most}")]


def probability_mistakes(given: Mapping[str, Any], *names: str) -> list[tuple[str, str]]:
    """A mistake for every one of the names that is given and is not a probability."""
    return [mistake for name in names for mistake in number_mistakes(given, name, 0.0, 1.0)]


def probabilities_mistakes(given: Mapping[str, Any], name: str) -> list[tuple[str, str]]:
    """A mistake if the entry is given and is neither a probability nor a list of them, one for each slot."""
    value = given.get(name)
    if not isinstance(value, list):
        return probability_mistakes(given, name)
    wrong = [k for k, element in enumerate(value) if not is_probability(element)]
    if wrong:
        return [(name, f"is {as_toml(value[wrong[0]])} for slot {wrong[0]}; expected numbers from 0 to 1")]
    return [] if value else [(name, "is an empty list; expected a number from 0 to 1, or one for each slot")]


def flag_mistakes(given: Mapping[str, Any], *names: str) -> list[tuple[str, str]]:
    """A mistake for every one of the names that is given and neither true nor false."""
    return [
        (name, f"is {as_toml(given[name])}; expected true or false")
        for name in names
        if name in given and not isinstance(given[name], bool)
    ]


def word_mistakes(given: Mapping[str, Any], name: str) -> list[tuple[str, str]]:
    """A mistake if the entry is given and is not a word of zeros and ones."""
    word = given.get(name, "1")
    if isinstance(word, str) and word and not set(word) - {"0", "1"}:
        return []
    return [(name, f'is {as_toml(word)}; expected a word of 0 (lost) and 1 (delivered), such as "1101"')]
