"""Checks each entry of a brief by itself, its type and its range, before the brief is used.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Any

from evedrop.streams import KEY_BYTES

Check = Callable[[str, Any], Iterator[str]]
"""Takes a path and the value found there; yields a sentence for each mistake."""

_SHOWN = 40  # characters of a value that a message repeats
_MOST_TOLD = 8
_MOST_SLOTS, _MOST_TRIALS, _LAST_TRIAL = 100_000_000, 1_000_000, 2**48
_NEVER = 2**62  # a slot that no run reaches


def _wrong(path: str, found: Any, expected: str) -> Iterator[str]:
    text = f"{type(found).__name__} of {len(found)}" if isinstance(found, (list, dict)) else repr(found)
    yield f"{path} is {text if len(text) <= _SHOWN else text[:_SHOWN] + '…'}, expected {expected}"


def text(path: str, found: Any) -> Iterator[str]:
    """Check that a value is a string."""
    if not isinstance(found, str):
        yield from _wrong(path, found, "a string")


def flag(path: str, found: Any) -> Iterator[str]:
    """Check that a value is true or false."""
    if type(found) is not bool:
        yield from _wrong(path, found, "true or false")


def anything(path: str, found: Any) -> Iterator[str]:
    """Accept any value: another check handles it."""
    del path, found
    yield from ()


def whole(least: int, most: int = _NEVER) -> Check:
    """A check for a whole number in this range."""

    def check(path: str, found: Any) -> Iterator[str]:
        if type(found) is not int or not least <= found <= most:
            yield from _wrong(path, found, f"a whole number from {least} to {most}")

    return check


def number(path: str, found: Any) -> Iterator[str]:
    """Check that a value is a finite number."""
    if type(found) not in (int, float) or abs(found) > 1e308 or math.isnan(found):
        yield from _wrong(path, found, "a finite number")


def positive(path: str, found: Any) -> Iterator[str]:
    """Check that a value is a finite number of 0 or more."""
    wrong = list(number(path, found))
    yield from wrong or (_wrong(path, found, "a number of 0 or more") if found < 0 else ())


def maybe(check: Check) -> Check:
    """A check for null, or a value that passes another check."""
    return lambda path, found: iter(()) if found is None else check(path, found)


def listed(check: Check, least: int = 0) -> Check:
    """A check for a list of values that pass another check."""

    def all_of(path: str, found: Any) -> Iterator[str]:
        if not isinstance(found, list) or len(found) < least:
            yield from _wrong(path, found, f"a list of {least} or more entries" if least else "a list")
            return
        for i, one in enumerate(found):
            yield from check(f"{path}.{i}", one)

    return all_of


def named(check: Check) -> Check:
    """A check for a table of any names, with values that pass another check."""

    def all_of(path: str, found: Any) -> Iterator[str]:
        if not isinstance(found, dict):
            yield from _wrong(path, found, "a table")
            return
        for name, one in found.items():
            yield from check(f"{path}.{name:.{_SHOWN}}", one)

    return all_of


def table(needed: Mapping[str, Check], optional: Mapping[str, Check] | None = None, strict: bool = True) -> Check:
    """A check for a table of these entries; strict: other entries are mistakes."""
    known = {**needed, **(optional or {})}

    def each(path: str, found: Any) -> Iterator[str]:
        if not isinstance(found, dict):
            yield from _wrong(path or "it", found, "a table")
            return
        dot = f"{path}." if path else ""
        for name, check in known.items():
            if name in found:
                yield from check(f"{dot}{name}", found[name])
            elif name in needed:
                yield f"{dot}{name} is missing"
        for name in found if strict else ():
            if name not in known:
                yield f"{dot}{name:.{_SHOWN}} is an unknown entry"

    return each


def _key(path: str, found: Any) -> Iterator[str]:
    try:
        size = len(bytes.fromhex(found)) if isinstance(found, str) else 0
    except ValueError:
        size = 0
    if size != KEY_BYTES:  # the value may be a secret, so the message does not repeat it
        yield f"{path} is not a key, expected {KEY_BYTES} bytes in hexadecimal"


KINDS = ("uplink", "downlink", "ack", "estimate", "state", "input", "telemetry", "journal", "progress", "control")
"""The kinds of a run's keys, as they follow the run's name."""
_MATRIX = listed(listed(number))
_NUMBERS = listed(number)
_LIMITS = listed(maybe(number))
_SLOT = whole(0, _NEVER)
_IDENTITY = table({"authority": text, "certificate": text, "key": text})
_SPEC = named(anything)
_WIRING = maybe(table({"acts_on": text, "knows_input": flag}))
_PLANT: Mapping[str, Check] = {
    "input_matrix": _MATRIX,
    "disturbance_matrix": _MATRIX,
    "noise": _MATRIX,
    "start": _NUMBERS,
    **dict.fromkeys(("input_lower", "input_upper", "state_lower", "state_upper"), _LIMITS),
}
_MEASURED: Mapping[str, Check] = {"output_matrix": _MATRIX, "measurement_noise": _MATRIX}
_OWN: Mapping[str, Check] = {"modules": maybe(text)}
_OUTAGES = listed(listed(anything, 3))

ENTRIES = table(
    {
        **dict.fromkeys(("run", "process", "role", "router", "user", "password"), text),
        "slots": whole(1, _MOST_SLOTS),
        "trials": whole(1, _MOST_TRIALS),
        "first_trial": whole(0, _LAST_TRIAL),
        "recorded": whole(1, _MOST_TRIALS),
        "flow": table(
            {"window": whole(1), "batch": whole(1)}, {"longest_outage": positive, "largest_message": whole(1)}
        ),
        "model": table(
            {"A": _MATRIX, "Q": _MATRIX, "initial_covariance": _MATRIX, "state_probability": number},
            {"header": whole(0, 64), "singular_noise": flag},
        ),
        "keys": named(_key),
        "part": named(anything),
        "ends_with_stdin": flag,
    },
    {"first": whole(0, _MOST_SLOTS), "patience": whole(1), "identity": maybe(_IDENTITY)},
)
"""Checks the entries that every brief has."""

_COURSE = table(
    {
        "settings": table({"loss": _SPEC}, strict=False),
        "window": whole(0, _MOST_SLOTS),
        "changes": listed(table({"at": _SLOT, "settings": maybe(named(anything)), "cut": maybe(flag)})),
        "outages": listed(listed(whole(0, _NEVER), 3)),
        "correlation": maybe(listed(anything, 2)),
    }
)
PARTS: Mapping[str, Check] = {
    "router": table(
        {
            "links": named(_COURSE),
            "pace": positive,
            "users": named(text),
            "leaks": named(_SLOT),
            "acknowledgements": maybe(
                table(
                    {
                        "quality": number,
                        "attack": text,
                        "jammer": maybe(text),
                        "spans": maybe(listed(listed(_SLOT, 2))),
                    }
                )
            ),
            "controller": _WIRING,
            "zid": maybe(text),
            "limits": table(dict.fromkeys(KINDS, whole(1))),
        },
        _OWN,
        strict=False,
    ),
    "relay": table(
        {
            "users": named(text),
            "receivers": listed(text),
            "listen": text,
            "zid": text,
            "controller": _WIRING,
            "limits": table(dict.fromkeys(KINDS, whole(1))),
        },
        strict=False,
    ),
    "sensor": table(
        {
            "scheme": table({"scheme": text}, strict=False),
            "pace": positive,
            "receivers": listed(text),
            "holds": listed(_SLOT),
            "history": whole(0, _MOST_SLOTS),
            "leaks": named(_SLOT),
            "chart": maybe(
                table({"acknowledged": whole(-_NEVER), "missing": whole(-_NEVER), "threshold": whole(-_NEVER)})
            ),
            "plant": maybe(table({**_PLANT, "disturbances": text}, _MEASURED)),
            "controller": maybe(table({"period": whole(1), "acts_on": text})),
        },
        _OWN,
        strict=False,
    ),
    "legitimate": table(
        {
            "scheme": table({"scheme": text}, strict=False),
            "window": whole(0, _MOST_SLOTS),
            "outages": _OUTAGES,
            "controller": maybe(table({"period": whole(1), "acts_on": text, "plant": maybe(table(_PLANT, _MEASURED))})),
        },
        _OWN,
        strict=False,
    ),
    "eavesdropper": table(
        {"strategy": text, "parameters": named(anything), "window": whole(0, _MOST_SLOTS), "outages": _OUTAGES},
        _OWN,
        strict=False,
    ),
    "controller": table(
        {
            "strategy": text,
            "assignment": table(
                {
                    "period": whole(1),
                    "slot_seconds": positive,
                    **dict.fromkeys(("state_weights", "input_weights", "rate_weights"), _NUMBERS),
                    "rate_limits": _LIMITS,
                    "parameters": named(anything),
                }
            ),
            "acts_on": text,
            "plant": table(_PLANT, _MEASURED),
            "disturbances": text,
        },
        strict=False,
    ),
    "observer": table(
        {
            "scenario": named(anything),
            "results": text,
            "recording": flag,
            "operator": text,
            "classes": named(named(anything)),
            "operator_identity": maybe(_IDENTITY),
            "shard": flag,
        },
        strict=False,
    ),
}
"""Role → the check for its part of the scenario."""


def mistakes_in(found: Any) -> list[str]:
    """The first mistakes in a brief; empty if each entry by itself is right."""
    mistakes = list(islice(ENTRIES("", found), _MOST_TOLD))
    if mistakes:
        return mistakes
    if found["role"] not in PARTS:
        return [f"unknown role {found['role']:.{_SHOWN}}, expected one of {', '.join(PARTS)}"]
    return list(islice(PARTS[found["role"]]("part", found["part"]), _MOST_TOLD))
