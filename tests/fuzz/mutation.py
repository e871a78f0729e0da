"""Random changes, seeded: of bytes, and of the parts of tables, lists and numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from random import Random
from typing import Any

NUMBERS = (0, 1, -1, 2, 7, 255, 256, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**64 - 1, 10**18)
REALS = (0.0, -0.0, 0.5, 1.0, -1.0, 1e-320, 5e-324, 1e308, -1e308, math.nan, math.inf, -math.inf, 1e-300, 1.0 + 2**-52)
TEXTS = (
    "",
    "a",
    "x" * 300,
    "\u202e",
    "é",
    "../..",
    "/",
    "/dev/null",
    "legitimate",
    "smart",
    "0",
    "1e400",
    "[",
    "{}",
    "naive",
)
_MOST_CHANGES = 4


class Mutator:
    """Changes things by the numbers of one seed."""

    def __init__(self, seed: int | str, texts: tuple[str, ...] = ()) -> None:
        self.random = Random(seed)  # noqa: S311 - for chance, not for secrets
        self._texts = TEXTS + texts

    def raw(self, data: bytes) -> bytes:
        """Bytes with some of them changed, cut out, doubled or put in."""
        mutated = bytearray(data)
        for _ in range(self.random.randint(1, _MOST_CHANGES)):
            at = self.random.randrange(len(mutated) + 1)
            length = self.random.choice((1, 1, 2, 4, 8, 64))
            match self.random.randrange(6):
                case 0 if at < len(mutated):
                    mutated[at] ^= 1 << self.random.randrange(8)
                case 1 if at < len(mutated):
                    mutated[at] = self.random.choice((0, 1, 0x7F, 0x80, 0x90, 0xC0, 0xD9, 0xDD, 0xDF, 0xFF))
                case 2:
                    del mutated[at : at + length]
                case 3:
                    mutated[at:at] = mutated[at : at + length]
                case 4:
                    mutated[at:at] = self.random.randbytes(length)
                case _:
                    del mutated[at : None if self.random.random() < 0.2 else at + 1]
        return bytes(mutated)

    def tree(self, value: Any) -> Any:
        """Tables and lists with some entries of another type or value, taken out, doubled, or named otherwise."""
        for _ in range(self.random.choice((1, 1, 1, 2, _MOST_CHANGES))):
            value = self._changed(value, 0)
        return value

    def _changed(self, value: Any, depth: int) -> Any:
        inside = isinstance(value, (dict, list)) and len(value) > 0
        if not inside or depth > 8 or (depth and self.random.random() < 0.1):
            return self._other(value)
        if isinstance(value, dict):
            return self._changed_table(value, depth)
        place = self.random.randrange(len(value))
        match self.random.randrange(8):
            case 0:
                return [*value[:place], *value[place + 1 :]]
            case 1:
                return [*value, value[place]]
            case 2:
                return [*value[:place], self.anything(), *value[place:]]
        return [*value[:place], self._changed(value[place], depth + 1), *value[place + 1 :]]

    def _changed_table(self, value: dict[Any, Any], depth: int) -> dict[Any, Any]:
        name = self.random.choice(list(value))
        match self.random.randrange(12):
            case 0:
                return {key: inner for key, inner in value.items() if key != name}
            case 1:
                return {**value, self.random.choice(self._texts): value[name]}
            case 2:
                return {**value, self.random.choice(self._texts): self.anything()}
        return {**value, name: self._changed(value[name], depth + 1)}

    def _other(self, value: Any) -> Any:
        if isinstance(value, bytes) and self.random.random() < 0.7:
            return self.raw(value)
        if isinstance(value, str) and value and self.random.random() < 0.5:
            return self.raw(value.encode("utf-8", "replace")).decode("utf-8", "replace")
        if isinstance(value, (int, float)) and not isinstance(value, bool) and self.random.random() < 0.5:
            return self._near(value)
        return self.anything()

    def _near(self, value: float) -> Any:
        with_number: tuple[Callable[[], Any], ...] = (
            lambda: value + 1,
            lambda: -value,
            lambda: value * 2,
            lambda: float(value),
            lambda: self.random.choice(NUMBERS),
            lambda: self.random.choice(REALS),
            lambda: bool(value),
            lambda: str(value),
        )
        try:
            return self.random.choice(with_number)()
        except OverflowError:
            return value

    def anything(self, depth: int = 0) -> Any:
        """A value of any kind."""
        kinds: tuple[Callable[[], Any], ...] = (
            lambda: self.random.choice((True, False)),
            lambda: self.random.choice(NUMBERS),
            lambda: self.random.choice(REALS),
            lambda: self.random.choice(self._texts),
            self.random.random,
            lambda: [self.anything(depth + 1) for _ in range(self.random.choice((0, 1, 2, 3, 40)))],
            lambda: {
                self.random.choice(self._texts): self.anything(depth + 1) for _ in range(self.random.randrange(4))
            },
        )
        return self.random.choice(kinds if depth < 3 else kinds[:5])()


def words_of(trees: list[Any]) -> tuple[str, ...]:
    """Every name and text in tables, each once: what a change is most likely to be understood by."""
    words: dict[str, None] = {}

    def collect(value: Any) -> None:
        if isinstance(value, str) and len(value) < 60:
            words[value] = None
        elif isinstance(value, Mapping):
            for name, inner in value.items():
                collect(name)
                collect(inner)
        elif isinstance(value, list):
            for inner in value[:50]:
                collect(inner)

    collect(trees)
    return tuple(words)
