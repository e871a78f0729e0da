"""Values that no entry of a scenario can have: too deep, too large, or with control characters. Found before any other check.

Source: docs/scenario.md, the scenario file.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator
from typing import Any

from evedrop.scenario.words import as_toml
from evedrop.system.output import escaped

_DEEPEST = 16  # levels of nested tables and lists; scenarios use about half as many
_LARGEST_BITS = 4096  # of a whole number; a seed has 256
_LONGEST_NAME = 200
_PLAIN = {"\n", "\t"}
_MOST_TOLD = 20
MOST_EAVESDROPPERS = 64


def unusable(tables: Any) -> Iterator[str]:
    """A sentence with a path for each unusable value, up to 20 of them."""
    for number, sentence in enumerate(_unusable(tables)):
        if number == _MOST_TOLD:
            yield f"and more such mistakes: {_MOST_TOLD} are listed"
            return
        yield sentence


def _unusable(tables: Any) -> Iterator[str]:
    eavesdroppers = tables.get("eavesdroppers")
    if isinstance(eavesdroppers, dict) and len(eavesdroppers) > MOST_EAVESDROPPERS:
        # Otherwise each of them would be checked and reported.
        yield f"eavesdroppers: has {len(eavesdroppers)} entries; expected at most {MOST_EAVESDROPPERS}"
        return
    # An explicit stack: dotted keys can nest tables deeper than Python's recursion limit.
    waiting: list[tuple[tuple[str, ...], Any]] = [((), tables)]
    while waiting:
        path, value = waiting.pop()
        kind = type(value)
        if kind is dict or kind is list:
            if len(path) >= _DEEPEST:
                yield f"{_dotted(path)}: is more than {_DEEPEST} tables deep; expected entries as docs/scenario.md lists them"
                continue
            entries = list(value.items()) if kind is dict else [(str(i), inner) for i, inner in enumerate(value)]
            if kind is dict:
                yield from _name_mistakes(path, entries)
            waiting += [
                ((*path, str(name)), inner) for name, inner in reversed(entries) if type(inner) not in (float, bool)
            ]
        elif kind is int:
            if value.bit_length() > _LARGEST_BITS:
                yield f"{_dotted(path)}: is a whole number of {value.bit_length()} bits; expected at most {_LARGEST_BITS}"
        elif kind is str and not (value.isascii() and value.isprintable()):
            strange = next((character for character in value if _is_strange(character)), None)
            if strange is not None:
                yield (
                    f"{_dotted(path)}: is {as_toml(value)} with the character U+{ord(strange):04X} in it; expected text "
                    "without control characters"
                )


def _name_mistakes(path: tuple[str, ...], entries: list[tuple[Any, Any]]) -> Iterator[str]:
    for name, _ in entries:
        if not isinstance(name, str) or len(name) > _LONGEST_NAME or any(map(_is_strange, name)):
            yield (
                f"{_dotted((*path, str(name)))}: is a name with a control character, or of more than {_LONGEST_NAME} "
                "characters; expected an entry as docs/scenario.md lists them"
            )


def _is_strange(character: str) -> bool:
    """Whether a character moves the cursor, ends a string, changes the direction of text, or is half of a surrogate pair."""
    strange = unicodedata.category(character) in ("Cc", "Cs") or escaped(character) != character
    return strange and character not in _PLAIN


def _dotted(path: tuple[str, ...]) -> str:
    """A dotted path of bounded length, with plain characters only."""
    names = [name if len(name) <= _LONGEST_NAME else f"{name[:20]}…" for name in path[: _DEEPEST + 1]]
    return (
        "".join("?" if _is_strange(character) or character in _PLAIN else character for character in ".".join(names))
        or "the scenario"
    )
