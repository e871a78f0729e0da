"""The tally of a shard's trials, stored with its tables for the process that scores the whole run.

It never leaves the machine or the user: one process of a run writes it, another reads and removes it. What is stored are values:
numbers, texts, arrays, and the attributes of instances, never a name of code. The reader makes instances only of the classes of
an example object that the program itself built, attribute by attribute, so that bytes from a file decide values and not what
runs. A function is not stored; the reader takes it from the example.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any, final

import msgpack
import numpy as np

from evedrop.errors import RunError
from evedrop.results.folder import private_replacement
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally
from evedrop.system.world import world

_ARRAY, _OBJECT, _TUPLE, _NUMBER, _FUNCTION, _SET = range(1, 7)
"""Types of msgpack's extensions."""
_FUNCTIONS = (FunctionType, BuiltinFunctionType, MethodType)


class NotData(ValueError):
    """An object that cannot be stored as data, or bytes that do not fit the example."""


def packed(value: object) -> bytes:
    """The value as bytes. Raises NotData for what is not a number, a text, an array, a container or an instance of a class."""
    try:
        content: bytes = msgpack.packb(value, default=_extension, strict_types=True)
    except (TypeError, ValueError, OverflowError) as error:
        raise NotData(str(error)) from error
    return content


def _extension(value: Any) -> msgpack.ExtType:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biufc":
            raise NotData(f"an array of {value.dtype}")
        return msgpack.ExtType(_ARRAY, packed([value.dtype.str, list(value.shape), value.tobytes()]))
    if isinstance(value, np.generic):
        return msgpack.ExtType(_NUMBER, packed([value.dtype.str, value.tobytes()]))
    if isinstance(value, tuple):
        return msgpack.ExtType(_TUPLE, packed(list(value)))
    if isinstance(value, set):
        return msgpack.ExtType(_SET, packed(sorted(value, key=repr)))
    if isinstance(value, _FUNCTIONS):
        return msgpack.ExtType(_FUNCTION, b"")
    state = None if isinstance(value, type) else value.__getstate__()
    if not isinstance(state, dict):
        raise NotData(f"an instance of {type(value).__qualname__} without a table of attributes")
    return msgpack.ExtType(_OBJECT, packed(state))


@final
class _Attributes:
    """The attributes of an instance, whose class the example tells."""

    def __init__(self, state: Mapping[str, Any]) -> None:
        self.state = state


@final
class _Function:
    """The place of a function."""


def unpacked(data: bytes, like: object) -> Any:
    """The value whose bytes these are; like: an example, whose instances have the classes of the value's.

    A list, and a table with names that the example lacks, have values like the last of the example.

    Raises NotData if the bytes are damaged or the value has an instance where the example has none.
    """
    try:
        return _filled(_read(data), like)
    except NotData:
        raise
    except Exception as error:  # any bytes may come
        raise NotData(f"{type(error).__name__}: {error}") from error


def _read(data: bytes) -> Any:
    return msgpack.unpackb(data, ext_hook=_value, strict_map_key=False)


def _value(code: int, data: bytes) -> Any:
    readers: Mapping[int, Callable[[Any], Any]] = {
        _ARRAY: lambda parts: np.frombuffer(parts[2], _dtype(parts[0])).reshape(parts[1]).copy(),
        _OBJECT: _Attributes,
        _TUPLE: tuple,
        _SET: set,
        _NUMBER: lambda parts: np.frombuffer(parts[1], _dtype(parts[0]))[0],
    }
    if code == _FUNCTION:
        return _Function()
    return readers[code](_read(data))


def _dtype(text: str) -> np.dtype[Any]:
    dtype = np.dtype(text)
    if dtype.kind not in "biufc":
        raise NotData(f"an array of {dtype}")
    return dtype


def _filled(value: Any, like: Any) -> Any:
    """The value, with instances of the example's classes."""
    if isinstance(value, _Attributes):
        return _instance(value.state, like)
    if isinstance(value, _Function):
        if not isinstance(like, _FUNCTIONS):
            raise NotData("a function where the example has none")
        return like
    if isinstance(value, tuple) and isinstance(like, tuple) and hasattr(like, "_fields"):
        return type(like)(*_each(value, like))
    if isinstance(value, (list, tuple)):
        return type(value)(_each(value, like))
    if isinstance(value, dict):
        examples = like if isinstance(like, Mapping) else {}
        names = {name: name for name in examples}  # an equal name of the example may have a class of its own
        other = next(reversed([*examples.values()]), None)
        return {names.get(name, name): _filled(element, examples.get(name, other)) for name, element in value.items()}
    return value


def _each(values: Any, like: Any) -> list[Any]:
    examples = like if isinstance(like, (list, tuple)) else ()
    last = len(examples) - 1
    return [_filled(element, examples[min(i, last)] if examples else None) for i, element in enumerate(values)]


def _instance(state: Mapping[str, Any], like: Any) -> Any:
    if like is None or isinstance(like, (int, float, str, bytes, list, tuple, dict, np.ndarray)):
        raise NotData("an instance where the example has none")
    examples = like.__getstate__()
    filled = {name: _filled(element, examples.get(name)) for name, element in state.items()}
    made = object.__new__(type(like))
    if hasattr(made, "__setstate__"):
        made.__setstate__(filled)
    else:
        made.__dict__.update(filled)
    return made


_NAME = "score"


def dump_score(run_tally: RunTally, folder: Path, scenario: Scenario) -> None:
    """Write the tally to a results folder; the file is complete at any moment, and private to this user.

    scenario: that of the shard. The metric of a package whose tally is not data fails, which the tally then says.

    Raises OSError.
    """
    example = _example(scenario)
    for name, tally in run_tally.tallies.items():
        blank = example.tallies[name].watched.of_packages
        for watch, kept in tally.watched.of_packages.items():
            try:
                unpacked(packed(kept), blank[watch])
            except NotData as error:
                kept.fail(
                    f"a shard cannot store its tally ({error}); docs/your-own/metric.md says what a tally may consist of"
                )
    with private_replacement(folder / _NAME) as unfinished:
        world().disk.write(unfinished, packed(run_tally))


def load_score(folder: Path, scenario: Scenario) -> RunTally:
    """Read the tally from a results folder; an empty one if the process that should have written it was killed.

    scenario: that of the shard. Raises RunError if it is damaged.
    """
    try:
        data = (folder / _NAME).read_bytes()
    except OSError:
        return RunTally.nothing(scenario, scenario.trials)
    try:
        run_tally = unpacked(data, _example(scenario))
    except NotData as error:
        raise RunError(f"{folder / _NAME} is damaged ({error}); run again") from error
    if not isinstance(run_tally, RunTally):
        raise RunError(f"{folder / _NAME} is damaged (it is not a tally); run again")
    return run_tally


def _example(scenario: Scenario) -> RunTally:
    """A tally without slots, which has an instance wherever the tally of a run may have one."""
    example = RunTally.from_scenario(scenario, scenario.trials)
    example.begin()
    return example
