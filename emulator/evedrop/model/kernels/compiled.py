"""The kernels in C: the twins of `reference.py`, which says what each computes.

Every argument is brought into the shape and the order that C reads, and refused with ValueError if it has another shape.
C runs without the interpreter's lock. Importing this module raises ImportError where the kernels are not built.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.choice import EXTENSION
from evedrop.model.kernels.elementary import Floats
from evedrop.model.kernels.reference import (
    Codes,
    Flags,
    Words,
    expect,
    expect_bytes,
    expect_counters,
    expect_histograms,
    expect_mixture,
    expect_records,
    expect_room,
    expect_runs,
    expect_wide,
    expect_words,
)

_module = importlib.import_module(EXTENSION)
_lib, _buffer, _NULL = _module.lib, _module.ffi.from_buffer, _module.ffi.NULL


def _doubles(array: Any, shape: tuple[int, ...]) -> Any:
    """A pointer to an array's numbers, which keeps them alive."""
    ordered = np.ascontiguousarray(array, np.float64)
    expect(ordered, shape)
    return _buffer("double[]", ordered)


def _bytes(array: Any, shape: tuple[int, ...]) -> Any:
    """The same for codes or flags."""
    ordered = np.ascontiguousarray(array)
    expect_bytes(ordered, shape)
    return _buffer("uint8_t[]", ordered)


def _words(words: Words, width: int) -> Any:
    """The same for words (c, R, m), m ≥ width."""
    ordered = np.ascontiguousarray(words, np.uint64)
    expect_words(ordered, width)
    return _buffer("uint64_t[]", ordered)


def fill_counters(counters: NDArray[np.uint64], slot: int, first: int) -> None:
    """As `reference.fill_counters`."""
    expect_counters(counters)
    slots, count, _ = counters.shape
    out = _buffer("uint64_t[]", counters.view(np.uint64), require_writable=True)
    _lib.kernels_counters(slots, count, slot, first, out)


def uniforms(words: Words, width: int, out: Floats | None = None) -> Floats:
    """As `reference.uniforms`."""
    slots, trials, stride = words.shape
    out = expect_room(out, (slots, width, trials))
    numbers = _buffer("double[]", out, require_writable=True)
    _lib.kernels_uniforms(slots, trials, stride, width, _words(words, width), numbers)
    return out


def normals(words: Words, width: int, out: Floats | None = None) -> Floats:
    """As `reference.normals`."""
    slots, trials, stride = words.shape
    out = expect_room(out, (slots, width, trials))
    numbers = _buffer("double[]", out, require_writable=True)
    _lib.kernels_normals(slots, trials, stride, width, _words(words, width), numbers)
    return out


def product(M: Floats, x: Floats) -> Floats:
    """As `reference.product`."""
    slots, m, n = M.shape
    trials = x.shape[-1]
    out = np.empty((slots, m, trials))
    _lib.kernels_product(
        slots, m, n, trials, _doubles(M, (slots, m, n)), _doubles(x, (slots, n, trials)), _buffer("double[]", out)
    )
    return out


def advance(A: Floats, noise: Floats, before: Floats) -> tuple[Floats, Floats]:
    """As `reference.advance`."""
    slots, n, trials = noise.shape
    predicted, x = np.empty(noise.shape), np.empty(noise.shape)
    _lib.kernels_advance(
        slots,
        n,
        trials,
        _doubles(A, (n, n)),
        _doubles(noise, noise.shape),
        _doubles(before, (n, trials)),
        _buffer("double[]", predicted),
        _buffer("double[]", x),
    )
    return predicted, x


def encode(nu: Flags, x: Floats, predicted: Floats, chi: Floats) -> Floats:
    """As `reference.encode`."""
    slots, n, trials = shape = x.shape
    z = np.empty(shape)
    _lib.kernels_encode(
        slots,
        n,
        trials,
        _bytes(nu, (slots, trials)),
        _doubles(x, shape),
        _doubles(predicted, shape),
        _doubles(chi, shape),
        _buffer("double[]", z),
    )
    return z


def follow(
    A: Floats,
    Q: Floats,
    before: tuple[Floats, Floats],
    action: Codes,
    z: Floats,
    chi: Floats | None = None,
    initial: bool = False,
) -> tuple[Floats, Floats]:
    """As `reference.follow`."""
    slots, n, trials = shape = z.shape
    x_hat, P = np.empty(shape), np.empty((slots, n, n, trials))
    numbers = (
        _doubles(before[0], (n, trials)),
        _doubles(before[1], (n, n, trials)),
        _bytes(action, (slots, trials)),
        _doubles(z, shape),
        _NULL if chi is None else _doubles(chi, shape),
        _buffer("double[]", x_hat),
        _buffer("double[]", P),
    )
    _follow(A, Q, (slots, n, trials), initial, *numbers)
    return x_hat, P


def follow_covariance(A: Floats, Q: Floats, P: Floats, action: Codes, initial: bool = False) -> Floats:
    """As `reference.follow_covariance`."""
    (slots, trials), n = action.shape, len(A)
    covariances = np.empty((slots, n, n, trials))
    before, codes = _doubles(P, (n, n, trials)), _bytes(action, (slots, trials))
    out = _buffer("double[]", covariances)
    _follow(A, Q, (slots, n, trials), initial, _NULL, before, codes, _NULL, _NULL, _NULL, out)
    return covariances


def _follow(A: Floats, Q: Floats, sizes: tuple[int, int, int], initial: bool, *arrays: Any) -> None:
    n = sizes[1]
    if _lib.kernels_follow(*sizes, initial, _doubles(A, (n, n)), _doubles(Q, (n, n)), *arrays):
        raise MemoryError(f"no memory for the covariances of {n} states")


def records(marks: Flags, a: Floats, P: Floats | None, out: Codes, first: int = 0) -> None:
    """As `reference.records`."""
    expect_records(marks, a, P, out, first)
    (slots, trials), count, width = marks.shape, len(out), a.shape[1]
    n = 0 if P is None else P.shape[1]
    _lib.kernels_records(
        slots,
        trials,
        first,
        count,
        _bytes(marks, marks.shape),
        width,
        _doubles(a, (slots, width, trials)),
        n,
        _NULL if P is None else _doubles(P, (slots, n, n, trials)),
        _buffer("uint8_t[]", out, require_writable=True),
    )


def squared_errors(x: Floats, x_hat: Floats) -> Floats:
    """As `reference.squared_errors`."""
    slots, n, trials = shape = x.shape
    out = np.empty((slots, trials))
    _lib.kernels_squared_errors(slots, n, trials, _doubles(x, shape), _doubles(x_hat, shape), _buffer("double[]", out))
    return out


def traces(P: Floats) -> Floats:
    """As `reference.traces`."""
    slots, n, _, trials = P.shape
    out = np.empty((slots, trials))
    _lib.kernels_traces(slots, n, trials, _doubles(P, (slots, n, n, trials)), _buffer("double[]", out))
    return out


def sums(values: Floats) -> Floats:
    """As `reference.sums`."""
    slots, trials = values.shape
    out = np.empty((slots, 2))
    _lib.kernels_sums(slots, trials, _doubles(values, (slots, trials)), _buffer("double[]", out))
    return out


def add_between(sums: Floats, used: Flags, traces: Floats) -> None:
    """As `reference.add_between`."""
    slots, trials = used.shape
    expect(sums, (3, trials))
    rows = [_buffer("double[]", row, require_writable=True) for row in sums]
    _lib.kernels_add_between(slots, trials, _bytes(used, used.shape), _doubles(traces, used.shape), *rows)


def add_leaked(sums: Floats, heard: Flags, nu: Flags, by_type: Floats) -> None:
    """As `reference.add_leaked`."""
    slots, trials = heard.shape
    expect(sums, (2, trials))
    rows = [_buffer("double[]", row, require_writable=True) for row in sums]
    flags = _bytes(heard, heard.shape), _bytes(nu, heard.shape)
    _lib.kernels_add_leaked(slots, trials, *flags, _doubles(by_type, (slots, 2)), *rows)


def count_codes(codes: Codes, kinds: int) -> NDArray[np.uint32]:
    """As `reference.count_codes`."""
    slots, trials = codes.shape
    counts = np.zeros((slots, kinds), np.uint32)
    _lib.kernels_count_codes(slots, trials, _bytes(codes, codes.shape), kinds, _buffer("uint32_t[]", counts))
    return counts


def count_bursts(codes: Codes, lost: int, run: NDArray[np.int64], most: int) -> NDArray[np.uint32]:
    """As `reference.count_bursts`."""
    slots, trials = codes.shape
    expect_runs(run, trials)
    counts = np.zeros(most, np.uint32)
    _lib.kernels_bursts(
        slots,
        trials,
        _bytes(codes, codes.shape),
        lost,
        _buffer("int64_t[]", run, require_writable=True),
        most,
        _buffer("uint32_t[]", counts),
    )
    return counts


def add_to_histograms(counts: NDArray[np.uint32], values: Floats, shift: int, base: int) -> None:
    """As `reference.add_to_histograms`."""
    expect_histograms(counts)
    rows, bins = counts.shape
    _, trials = values.shape
    out = _buffer("uint32_t[]", counts, require_writable=True)
    _lib.kernels_histogram(rows, trials, _doubles(values, (rows, trials)), shift, base, bins, out)


def scatter(flags: Flags, packed: Floats, n: int) -> Floats:
    """As `reference.scatter`."""
    slots, trials = flags.shape
    z = np.empty((slots, n, trials))
    numbers = _doubles(packed, (n * int(np.count_nonzero(flags)),))
    _lib.kernels_scatter(slots, n, trials, _bytes(flags, flags.shape), numbers, _buffer("double[]", z))
    return z


def gather(flags: Flags, x: Floats) -> Floats:
    """As `reference.gather`."""
    slots, n, trials = x.shape
    out = np.empty(n * int(np.count_nonzero(flags)))
    some = _bytes(flags, (slots, trials))
    _lib.kernels_gather(slots, n, trials, some, _doubles(x, x.shape), _buffer("double[]", out))
    return out


def triangular_factors(M: Floats) -> Floats:
    """As `reference.triangular_factors`."""
    expect_wide(M)
    count, n, m = M.shape
    work = np.array(M, np.float64, order="C")
    _check_factor(_lib.kernels_triangularise(count, n, m, _buffer("double[]", work)), n)
    return work[:, :, :n]


def carried_factors(A: Floats, G: Floats, carried: Floats, count: int) -> Floats:
    """As `reference.carried_factors`."""
    n = len(A)
    factors = np.empty((count, n, n))
    numbers = (_doubles(matrix, (n, n)) for matrix in (A, G, carried))
    _check_factor(_lib.kernels_carried_factors(n, count, *numbers, _buffer("double[]", factors)), n)
    return factors


def _check_factor(failed: int, n: int) -> None:
    if failed:
        raise MemoryError(f"no memory for the factors of {n} states")


def follow_mixture(
    A: Floats,
    G: Floats,
    leaks: Floats,
    rounding: Floats,
    before: tuple[Floats, ...],
    gamma: Flags,
    z: Floats,
    state_probability: float,
    capacity: int,
    initial: bool = False,
) -> tuple[Floats, Floats, Codes, Floats, Floats, Floats, Floats]:
    """As `reference.follow_mixture`."""
    expect_mixture(A, G, leaks, rounding, before, gamma, z, capacity)
    (slots, n, trials), places, below = z.shape, len(before[0]), len(A) * (len(A) - 1) // 2
    if not slots:
        weight, mean, lower, diagonal = before
        return z.copy(), np.empty((0, n, n, trials)), np.empty((0, trials), np.uint8), weight, mean, lower, diagonal
    x_hat, P, action = np.empty(z.shape), np.empty((slots, n, n, trials)), np.empty((slots, trials), np.uint8)
    rows = [(), (n,), (below,), (n,)]
    after = [np.empty((*row, capacity, trials)) for row in rows]
    count = _lib.kernels_follow_mixture(
        slots,
        n,
        trials,
        places,
        capacity,
        initial,
        _doubles(A, (n, n)),
        _doubles(G, (n, n)),
        _doubles(leaks, (slots, 2 * n, 2 * n)),
        _doubles(rounding, (slots, n)),
        state_probability,
        *(_doubles(part, (*row, places, trials)) for part, row in zip(before, rows, strict=True)),
        _bytes(gamma, (slots, trials)),
        _doubles(z, z.shape),
        _buffer("double[]", x_hat),
        _buffer("double[]", P),
        _buffer("uint8_t[]", action),
        *(_buffer("double[]", part) for part in after),
    )
    if count < 0:
        raise MemoryError(f"no memory for mixtures of {n} states")
    weight, mean, lower, diagonal = (part[..., :count, :] for part in after)
    return x_hat, P, action, weight, mean, lower, diagonal
