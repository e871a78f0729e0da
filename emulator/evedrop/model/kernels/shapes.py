"""What the kernels in C and in numpy refuse, in the same words.

Of an array of another shape, C would read or write beyond the end, and numpy would repeat it or leave some of it out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def expect(array: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Raise ValueError if an array has another shape."""
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape}; expected {shape}")


def expect_all(*expected: tuple[NDArray[Any], tuple[int, ...]]) -> None:
    """Raise ValueError if one of several arrays has another shape."""
    for array, shape in expected:
        expect(array, shape)


def expect_bytes(array: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Raise ValueError if these are not codes or flags, or have another shape."""
    if array.shape != shape or array.itemsize != 1:
        raise ValueError(f"{array.dtype} of shape {array.shape}; expected codes or flags of shape {shape}")


def expect_words(words: NDArray[Any], width: int) -> None:
    """Raise ValueError if words (c, R, m) are fewer than `width` for each slot and trial."""
    if words.ndim != 3 or words.shape[2] < width:
        raise ValueError(f"words of shape {words.shape}; expected at least {width} for each slot and trial")


def expect_counters(counters: NDArray[Any]) -> None:
    """Raise ValueError if these are not AES counters (c, m, 2)."""
    if counters.ndim != 3 or counters.shape[2] != 2 or counters.itemsize != 8:
        raise ValueError(
            f"counters of shape {counters.shape} and type {counters.dtype}; expected pairs of 64-bit words"
        )


def expect_records(marks: NDArray[Any], a: NDArray[Any], P: NDArray[Any] | None, out: NDArray[Any], first: int) -> None:
    """Raise ValueError if arguments of `records` do not fit each other."""
    (slots, trials), (count, places, size), (_, width, _) = marks.shape, out.shape, a.shape
    _, n, _, _ = (0, 0, 0, 0) if P is None else P.shape
    if out.dtype != np.uint8 or (places, size) != (slots, 1 + 8 * (width + n * (n + 1) // 2)):
        raise ValueError(f"records {out.dtype} of shape {out.shape} for {slots} slots, {width} numbers and {n} states")
    if not 0 <= first <= trials - count:
        raise ValueError(f"{count} of {trials} trials from {first} on")
    expect_bytes(marks, (slots, trials))
    expect(a, (slots, width, trials))
    if P is not None:
        expect(P, (slots, n, n, trials))


def expect_runs(run: NDArray[Any], trials: int) -> None:
    """Raise ValueError if these are not lengths of the current runs of this number of trials."""
    if run.shape != (trials,) or run.dtype != np.int64:
        raise ValueError(f"runs of shape {run.shape} and type {run.dtype}; expected int64 of shape {(trials,)}")


def expect_histograms(counts: NDArray[Any]) -> None:
    """Raise ValueError if these are not counts (c, bins) of at least one bin."""
    if counts.dtype != np.uint32 or counts.ndim != 2 or not counts.shape[1]:
        raise ValueError(f"counts {counts.dtype} of shape {counts.shape}; expected uint32 with at least one bin a row")


def expect_wide(matrices: NDArray[Any]) -> None:
    """Raise ValueError if matrices (c, n, m) have no rows, or fewer columns than rows."""
    if matrices.ndim != 3 or not 0 < matrices.shape[1] <= matrices.shape[2]:
        raise ValueError(f"matrices of shape {matrices.shape[1:]}; expected at least as many columns as rows")


def expect_mixture(
    A: NDArray[Any],
    G: NDArray[Any],
    leaks: NDArray[Any],
    rounding: NDArray[Any],
    before: tuple[NDArray[Any], ...],
    gamma: NDArray[Any],
    z: NDArray[Any],
    capacity: int,
) -> None:
    """Raise ValueError if arguments of `follow_mixture` do not fit each other."""
    (slots, n, trials), places = z.shape, len(before[0])
    if places > capacity:
        raise ValueError(f"a mixture with {places} places; expected at most {capacity}")
    expect_all((A, (n, n)), (G, (n, n)), (leaks, (slots, 2 * n, 2 * n)), (rounding, (slots, n)))
    for part, row in zip(before, [(), (n,), (n * (n - 1) // 2,), (n,)], strict=True):
        expect(part, (*row, places, trials))
    expect_bytes(gamma, (slots, trials))
