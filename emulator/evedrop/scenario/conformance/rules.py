"""Rules that a class keeps or breaks, and tools to call its code, guard arrays and compare results."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.registry import CLASS_ERRORS, place_of
from evedrop.model.streams import root_of_seed, stream_key
from evedrop.model.theory.covariances import Outcomes

Array = NDArray[Any]
_ROOT = root_of_seed(0)
_SHOWN = 60  # characters of a value that messages repeat
_SLACK = 1e-9  # on a probability, for rounding


class Broken(Exception):
    """A rule is broken; the message says where, what was found, what was expected, and what to do."""


class _NotAskedFor(Exception):
    """A class used a key that it has not named."""


@dataclass(frozen=True)
class RuleVerdict:
    """The verdict on one rule."""

    rule: str
    broken: str | None
    """How it is broken; None if it is kept on all problems."""


@final
class NamedKeys(dict[str, bytes]):
    """The keys of the streams that a class has named; using any other is an error."""

    @classmethod
    def of(cls, streams: Sequence[str]) -> NamedKeys:
        """The keys of these streams."""
        return cls({name: stream_key(_ROOT, f"secret/{name}") for name in streams})

    def __missing__(self, name: str) -> bytes:
        raise _NotAskedFor(f"reaches for the key of {name!r}, and has asked for {sorted(self) or 'none'}")


def key(name: str) -> bytes:
    """The key of a stream of the problem itself."""
    return stream_key(_ROOT, name)


@contextlib.contextmanager
def calling(call: str, kind: type) -> Iterator[None]:
    """Turn any error of custom code into one that names the call, and the place in that code."""
    try:
        yield
    except Broken:
        raise
    except _NotAskedFor as error:
        named = "in streams()" if hasattr(kind, "streams") else "in secret_streams, and in estimator_streams"
        raise Broken(f"{call} {error}; name every stream {named}, or leave it alone") from error
    except CLASS_ERRORS as error:
        file = getattr(sys.modules.get(kind.__module__), "__file__", None)
        reason = place_of(error, file)
        if is_about_read_only(error):
            raise Broken(f"{call} {changes_in_place(reason)}") from error
        raise Broken(f"{call} raised {reason}; expected no error") from error


def is_about_read_only(error: BaseException) -> bool:
    """Whether an error says that an array cannot be changed."""
    return "read-only" in str(error)


def changes_in_place(reason: str) -> str:
    """What a class does that such an error ended; reason: the error, and where."""
    return f"changes in place what it is given ({reason}); make a new array instead"


def frozen(array: Array) -> Array:
    """A read-only copy."""
    made = np.array(array)
    made.flags.writeable = False
    return made


def read_only(array: Array) -> Array:
    """The same numbers, which cannot be changed by this array."""
    view = array.view()
    view.flags.writeable = False
    return view


def expect_array(where: str, array: Any, dtype: Any, shape: tuple[int, ...], means: str) -> None:
    """Raise Broken unless a value is an array of this type and shape. where: such as `slot 3: Packet.z`."""
    if not isinstance(array, np.ndarray):
        raise Broken(
            f"{where} is {type(array).__name__}; expected an array of {np.dtype(dtype)}, shape {shape}: {means}"
        )
    if array.shape != shape:
        raise Broken(f"{where} has shape {array.shape}; expected {shape}: {means}")
    if array.dtype != np.dtype(dtype):
        raise Broken(
            f"{where} has type {array.dtype}; expected {np.dtype(dtype)}, such as by .astype(np.{np.dtype(dtype)})"
        )


def expect_finite(where: str, array: Array, first: int = 0) -> None:
    """Raise Broken where a number is not finite; the last axis is the trials, from number `first` on."""
    bad = ~np.isfinite(array)
    if bad.any():
        trial = first + int(np.argwhere(bad)[0][-1])
        raise Broken(f"{where}, trial {trial}, is {array[bad].flat[0]}; expected finite numbers")


Row = Mapping[str, Array]
"""The results of one slot: name → array whose last axis is the trials."""


def expect_names(where: str, names_given: Any) -> None:
    """Raise Broken unless a value is a tuple of distinct names."""
    names = isinstance(names_given, (tuple, list)) and all(isinstance(name, str) and name for name in names_given)
    if not names or len(set(names_given)) < len(names_given):
        raise Broken(f"{where} is {_short(names_given)}; expected a tuple of names, each once, such as ('schedule',)")


def expect_bool(where: str, value: Any) -> None:
    """Raise Broken unless a value is True or False."""
    if type(value) is not bool:
        raise Broken(f"{where} is {_short(value)}; expected True or False")


def expect_probability(where: str, value: Any) -> None:
    """Raise Broken unless a value is a number from 0 to 1."""
    if not _is_probability(value, 0.0):
        raise Broken(f"{where} is {_short(value)}; expected a number from 0 to 1")


def _is_probability(value: Any, slack: float) -> bool:
    number = isinstance(value, (int, float, np.floating)) and not isinstance(value, bool)
    return bool(number and -slack <= value <= 1.0 + slack)


def expect_outcomes(where: str, outcomes: Any) -> None:
    """Raise Broken unless a value is `Outcomes` of probabilities, or None."""
    if outcomes is None:
        return
    if not isinstance(outcomes, Outcomes):
        raise Broken(f"{where} is {_short(outcomes)}; expected Outcomes, or None: no closed form")
    for field in fields(Outcomes):
        value = getattr(outcomes, field.name)
        if not _is_probability(value, _SLACK):
            raise Broken(
                f"{where}.{field.name} is {_short(value)}; expected a probability, or None in place of Outcomes"
            )


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def expect_same(
    first_rows: Sequence[Row],
    second_rows: Sequence[Row],
    trials: slice,
    first: int,
    words: str,
    remedy: str,
    start: int = 0,
) -> None:
    """Raise Broken at the first slot, array and trial in which two records differ by a bit.

    trials: those of `first_rows` that `second_rows` has; first: the number of the first of them; words: a text with places for
    both values; start: the first slot.
    """
    for k, (row, again) in enumerate(zip(first_rows, second_rows, strict=True), start):
        for name, value in row.items():
            mine, theirs = value[..., trials], again[name]
            differ = mine.view(np.uint8) != theirs.view(np.uint8) if mine.dtype == np.bool_ else _differ(mine, theirs)
            if differ.any():
                place = tuple(np.argwhere(differ)[0])
                values = words.format(mine[place].item(), theirs[place].item())
                raise Broken(f"slot {k}, trial {first + int(place[-1])}: {name} is {values}; {remedy}")


def _differ(first: Array, second: Array) -> NDArray[np.bool_]:
    """Where bits differ: a NaN equals itself, and 0 differs from −0."""
    width = f"u{first.dtype.itemsize}"
    return np.asarray(np.ascontiguousarray(first).view(width) != np.ascontiguousarray(second).view(width))


Rule = tuple[str, Callable[[Any], None]]
"""A title, and a check on one problem that raises Broken."""


def judged(*groups: tuple[Sequence[Rule], Sequence[Any]]) -> list[RuleVerdict]:
    """The verdict on every rule, on each problem of its group until one breaks it; if the very first is broken, no others."""
    verdicts: list[RuleVerdict] = []
    for rules, problems in groups:
        for title, check in rules:
            broken = next((how for problem in problems if (how := _how_broken(check, problem)) is not None), None)
            verdicts.append(RuleVerdict(title, broken))
            if verdicts[0].broken is not None:
                return verdicts
    return verdicts


def _how_broken(check: Callable[[Any], None], problem: Any) -> str | None:
    how = how_broken(check, problem)
    return None if how is None else f"{problem}: {how}"


def how_broken(check: Callable[[Any], None], problem: Any) -> str | None:
    """How a rule is broken on a problem; None if it is kept."""
    try:
        check(problem)
    except Broken as error:
        return str(error)
    except CLASS_ERRORS as error:
        # A value that the class returned may break any code, including ours.
        return f"what it returned led to {place_of(error)}; expected what the base class describes"
    return None
