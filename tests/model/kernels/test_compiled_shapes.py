"""Arguments that do not fit each other: a kernel in C refuses those that its twin in numpy refuses, and no others."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import isfunction
from typing import Any

import numpy as np
import pytest

from evedrop.model.kernels import reference
from evedrop.model.kernels.choice import EXTENSION

Array = np.ndarray[Any, Any]
SLOTS, STATES, TRIALS = 3, 2, 4


def ones(*shape: int) -> Array:
    """Numbers."""
    return np.ones(shape)


def flags(*shape: int) -> Array:
    """Flags."""
    return np.ones(shape, np.bool_)


def codes(*shape: int) -> Array:
    """Codes, words of 64 bits or counts of 32 bits: small whole numbers."""
    return np.ones(shape, np.uint8)


PACKETS, SQUARE = (SLOTS, STATES, TRIALS), (STATES, STATES)
COVARIANCES = (SLOTS, *SQUARE, TRIALS)
MIXTURE = ones(3, TRIALS), ones(STATES, 3, TRIALS), ones(1, 3, TRIALS), ones(STATES, 3, TRIALS)
FIT: dict[str, tuple[Any, ...]] = {
    "fill_counters": (np.zeros((SLOTS, 5, 2), np.uint64), 1, 2),
    "uniforms": (codes(SLOTS, TRIALS, 3).astype(np.uint64), 2),
    "normals": (codes(SLOTS, TRIALS, 3).astype(np.uint64), 2),
    "product": (ones(SLOTS, 3, STATES), ones(*PACKETS)),
    "advance": (ones(*SQUARE), ones(*PACKETS), ones(STATES, TRIALS)),
    "encode": (flags(SLOTS, TRIALS), ones(*PACKETS), ones(*PACKETS), ones(*PACKETS)),
    "follow": (
        *(ones(*SQUARE), ones(*SQUARE), (ones(STATES, TRIALS), ones(*SQUARE, TRIALS))),
        *(codes(SLOTS, TRIALS), ones(*PACKETS), ones(*PACKETS)),
    ),
    "follow_covariance": (ones(*SQUARE), ones(*SQUARE), ones(*SQUARE, TRIALS), codes(SLOTS, TRIALS)),
    "records": (flags(SLOTS, TRIALS), ones(*PACKETS), ones(*COVARIANCES), codes(TRIALS, SLOTS, 41)),
    "squared_errors": (ones(*PACKETS), ones(*PACKETS)),
    "traces": (ones(*COVARIANCES),),
    "sums": (ones(SLOTS, TRIALS),),
    "count_codes": (codes(SLOTS, TRIALS), 3),
    "count_bursts": (codes(SLOTS, TRIALS), 1, np.zeros(TRIALS, np.int64), 4),
    "add_between": (ones(3, TRIALS), flags(SLOTS, TRIALS), ones(SLOTS, TRIALS)),
    "add_leaked": (ones(2, TRIALS), flags(SLOTS, TRIALS), flags(SLOTS, TRIALS), ones(SLOTS, 2)),
    "add_to_histograms": (np.zeros((SLOTS, 9), np.uint32), ones(SLOTS, TRIALS), 50, 1000),
    "scatter": (flags(SLOTS, TRIALS), ones(STATES * SLOTS * TRIALS), STATES),
    "gather": (flags(SLOTS, TRIALS), ones(*PACKETS)),
    "triangular_factors": (ones(SLOTS, STATES, 3),),
    "carried_factors": (ones(*SQUARE), ones(*SQUARE), ones(*SQUARE), 3),
    "follow_mixture": (
        *(np.eye(STATES), np.eye(STATES), np.stack([np.eye(2 * STATES)] * SLOTS), ones(SLOTS, STATES), MIXTURE),
        *(flags(SLOTS, TRIALS), ones(*PACKETS), 0.5, 5),
    ),
}
"""Kernel → arguments that fit each other."""


def others(arguments: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    """The arguments with one array of another shape or, if it holds bytes, of wider numbers."""
    for i, argument in enumerate(arguments):
        if isinstance(argument, tuple):
            changes: Iterator[Any] = others(argument)
        elif isinstance(argument, np.ndarray):
            changes = misshapen(argument)
        else:
            continue
        for change in changes:
            yield (*arguments[:i], change, *arguments[i + 1 :])


def misshapen(array: Array) -> Iterator[Array]:
    """Shorter, longer and empty along each axis, and with an axis more or less."""
    for axis, length in enumerate(array.shape):
        for other in sorted({0, 1, length - 1, length + 1} - {length}):
            yield np.ones((*array.shape[:axis], other, *array.shape[axis + 1 :]), array.dtype)
    yield from (array[None], array[0])
    if array.itemsize == 1:
        yield array.astype(np.int64)


def outcome(module: Any, name: str, arguments: tuple[Any, ...]) -> Any:
    """ValueError, or the bytes that a kernel returns and those of its arguments, some of which it changes."""
    own = copied(arguments)
    try:
        with np.errstate(all="ignore"):
            result = getattr(module, name)(*own)
    except ValueError:
        return ValueError
    return contents((result, own))


def copied(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Copies of all arrays."""
    return tuple(
        copied(argument)
        if isinstance(argument, tuple)
        else argument.copy()
        if isinstance(argument, np.ndarray)
        else argument
        for argument in arguments
    )


def contents(value: Any) -> Any:
    """Type, shape and bytes of all arrays."""
    if isinstance(value, tuple):
        return [contents(part) for part in value]
    return (value.dtype, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


def test_every_kernel_is_here() -> None:
    """A new one needs arguments above."""
    in_c = pytest.importorskip(
        "evedrop.model.kernels.compiled", reason="the C kernels are not built", exc_type=ImportError
    )
    named = {name for name in vars(in_c) if isfunction(getattr(in_c, name)) and not name.startswith("_")}
    assert {name for name in named if not name.startswith("expect")} == FIT.keys()


@pytest.mark.parametrize("name", FIT)
def test_numpy_refuses_arguments_that_do_not_fit(name: str) -> None:
    """With ValueError, as callers expect; with no other error."""
    assert outcome(reference, name, FIT[name]) is not ValueError
    refused = [outcome(reference, name, arguments) is ValueError for arguments in others(FIT[name])]
    assert any(refused)


@pytest.mark.parametrize("name", FIT)
def test_twins_refuse_the_same_arguments(name: str) -> None:
    """And return the same for all others."""
    pytest.importorskip(EXTENSION, reason="the C kernels are not built: no compiler worked")
    from evedrop.model.kernels import compiled

    for arguments in (FIT[name], *others(FIT[name])):
        expected = outcome(reference, name, arguments)
        shapes = [argument.shape if isinstance(argument, np.ndarray) else argument for argument in arguments]
        assert outcome(compiled, name, arguments) == expected, shapes
