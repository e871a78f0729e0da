"""The messages of a program that publishes states: JSON, or float64 numbers at known places.

Source: docs/programs.md, messages.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from evedrop.live.protocol.brief import ProgramPart
from evedrop.model.checks import is_number
from evedrop.model.process import Floats
from evedrop.model.slot.cores import LARGEST, deviations

MOST_BYTES = 2**20
"""The most bytes of a message that is read."""
_SHOWN = 80
_DOUBLE = struct.Struct("<d")


def read_state(payload: bytes, entry: ProgramPart) -> Floats:
    """The state in a message of the program, as deviations from the reference, (n,).

    Raises ValueError, with what the message is and what was expected.
    """
    n = len(entry.states)
    if len(payload) > MOST_BYTES:
        raise ValueError(f"has {len(payload)} bytes; expected at most {MOST_BYTES}")
    values = list(_named(payload, entry) if entry.offsets is None else _placed(payload, entry.offsets))
    if len(values) != n:
        raise ValueError(f"is {_shown(payload)}; expected {n} numbers, one for each of {', '.join(entry.states)}")
    for name, value in zip(entry.states, values, strict=True):
        if not is_number(value, -LARGEST, LARGEST):
            raise ValueError(f"has {name} = {str(value)[:_SHOWN]}; expected a finite number of at most {LARGEST:g}")
    return deviations(np.array(values, np.float64), np.array(entry.reference))


def _named(payload: bytes, entry: ProgramPart) -> Iterator[Any]:
    """The values in a JSON list, or under the names of the states in a JSON object."""
    try:
        values = json.loads(payload)
    except (ValueError, RecursionError):
        values = None
    if isinstance(values, Mapping):
        missing = next((name for name in entry.states if name not in values), None)
        if missing is not None:
            raise ValueError(f"is {_shown(payload)}, without {missing}; expected {', '.join(entry.states)} in it")
        yield from (values[name] for name in entry.states)
    elif isinstance(values, list):
        yield from values
    else:
        example = json.dumps(dict.fromkeys(entry.states, 0.0))
        raise ValueError(f"is {_shown(payload)}; expected JSON such as {example}, or a list of numbers")


def _placed(payload: bytes, offsets: Any) -> Iterator[float]:
    """The float64 numbers, little-endian, that begin at these bytes."""
    end = max(offsets) + _DOUBLE.size
    if len(payload) < end:
        raise ValueError(
            f"has {len(payload)} bytes; expected {end} or more, for numbers at {', '.join(map(str, offsets))}"
        )
    yield from (_DOUBLE.unpack_from(payload, offset)[0] for offset in offsets)


def _shown(payload: bytes) -> str:
    """The beginning of a message, as text if it is text."""
    text = payload[:_SHOWN].decode("utf-8", "replace")
    more = " …" if len(payload) > _SHOWN else ""
    return f"{text}{more}" if text.isprintable() and text else f"{payload[:24].hex(' ') or 'empty'}{more}"
