"""The kernels in numpy: what they must compute, to the bit, and the fallback where no C compiler worked.

What kernels refuse, they refuse in C and in numpy in the same words.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels import elementary, mixtures
from evedrop.model.kernels.elementary import Floats
from evedrop.model.kernels.factored import Factor
from evedrop.model.kernels.mixtures import Leak


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


def expect_room(out: Floats | None, shape: tuple[int, ...]) -> Floats:
    """Where to put numbers: an array of this shape, a new one if none is given. Raises ValueError if it is another one."""
    if out is None:
        return np.empty(shape)
    expect(out, shape)
    if out.dtype != np.float64 or not out.flags.c_contiguous:
        raise ValueError("expected room for doubles in order")
    return out


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


Words = NDArray[np.uint64]
Codes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

_UNUSED_BITS = np.uint64(11)  # of a word for a uniform number
_STATE, _INNOVATION = 1, 2  # `Action` of evedrop.model.receiver


def fill_counters(counters: NDArray[np.uint64], slot: int, first: int) -> None:
    """Fill AES counters (c, m, 2), big-endian: slot, slot + 1, … and in each of them the blocks first … first + m − 1."""
    expect_counters(counters)
    slots, count, _ = counters.shape
    big = counters.view(">u8")
    big[:, :, 0] = np.arange(slot, slot + slots, dtype=np.uint64)[:, None]
    big[:, :, 1] = np.arange(first, first + count, dtype=np.uint64)


def uniforms(words: Words, width: int, out: Floats | None = None) -> Floats:
    """Uniform numbers in [0, 1), multiples of 2⁻⁵³, (c, width, R), from words (c, R, m), m ≥ width; out: where to put them."""
    return _put(fractions(_ordered(words, width)), out)


def fractions(words: Words) -> Floats:
    """A uniform number in [0, 1), a multiple of 2⁻⁵³, for each word."""
    numbers = (words >> _UNUSED_BITS).view(np.int64).astype(np.float64)
    numbers *= 2.0**-53
    return numbers


def normals(words: Words, width: int, out: Floats | None = None) -> Floats:
    """The same for standard normal numbers, by the inverse distribution on an odd grid of 2⁻⁵³."""
    numbers = (_ordered(words, width) >> np.uint64(12)).view(np.int64).astype(np.float64)
    numbers += 0.5
    numbers *= 2.0**-52
    return _put(elementary.normal_quantile(numbers), out)


def _put(numbers: Floats, out: Floats | None) -> Floats:
    if out is None:
        return numbers
    expect_room(out, numbers.shape)[...] = numbers
    return out


def _ordered(words: Words, width: int) -> Words:
    expect_words(words, width)
    return np.ascontiguousarray(words[:, :, :width].transpose(0, 2, 1))


def product(M: Floats, x: Floats) -> Floats:
    """M x of every slot and trial: M (c, m, n), x (c, n, R) → (c, m, R)."""
    slots, _, n = M.shape
    expect(x, (slots, n, x.shape[-1]))
    return elementary.product(M, x)


def carry(A: Floats, P: Floats) -> Floats:
    """A P Aᵀ for every trial: P (n, n, R) → (n, n, R)."""
    left: Floats = A[:, 0, None, None] * P[0]
    for j in range(1, len(A)):
        left += A[:, j, None, None] * P[j]
    result: Floats = left[:, :1] * A[:, 0, None]
    for j in range(1, len(A)):
        result += left[:, j : j + 1] * A[:, j, None]
    return result


def advance(A: Floats, noise: Floats, before: Floats) -> tuple[Floats, Floats]:
    """Predictions A x_{k−1} and states x_k = A x_{k−1} + noise, (c, n, R) each, from noise (c, n, R) and x before (n, R)."""
    _, n, trials = noise.shape
    expect_all((A, (n, n)), (before, (n, trials)))
    predicted, x = np.empty_like(noise), np.empty_like(noise)
    for row, w in enumerate(noise):
        predicted[row] = product(A[None], before[None])[0]
        before = x[row] = predicted[row] + w
    return predicted, x


def encode(nu: Flags, x: Floats, predicted: Floats, chi: Floats) -> Floats:
    """(x − predicted) + χ where ν (c, R), x elsewhere; (c, n, R) each."""
    slots, _, trials = x.shape
    expect_bytes(nu, (slots, trials))
    expect_all((predicted, x.shape), (chi, x.shape))
    return np.where(nu[:, None, :], (x - predicted) + chi, x)


def follow(
    A: Floats,
    Q: Floats,
    before: tuple[Floats, Floats],
    action: Codes,
    z: Floats,
    chi: Floats | None = None,
    initial: bool = False,
) -> tuple[Floats, Floats]:
    """Estimates (c, n, R) and reported covariances (c, n, n, R) after c slots, from those before them.

    action (c, R); z (c, n, R): packets, read where they are used; χ (c, n, R): for a decoder, subtracted from innovations.
    initial: the first slot is slot 0, which is not predicted. The table in `evedrop.model.update` says what is computed.
    """
    slots, n, trials = z.shape
    expect_all((A, (n, n)), (before[0], (n, trials)), (z if chi is None else chi, z.shape))
    expect_bytes(action, (slots, trials))
    x_hat = np.empty(z.shape)
    last = before[0]
    for row, codes in enumerate(action):
        kept = last if initial and row == 0 else product(A[None], last[None])[0]
        if chi is not None:
            kept = np.where(codes == _INNOVATION, kept + (z[row] - chi[row]), kept)
        last = x_hat[row] = np.where(codes == _STATE, z[row], kept)
    return x_hat, follow_covariance(A, Q, before[1], action, initial)


@np.errstate(over="ignore", invalid="ignore")  # as in C: an unstable receiver's covariance may exceed double precision
def follow_covariance(A: Floats, Q: Floats, P: Floats, action: Codes, initial: bool = False) -> Floats:
    """The reported covariances (c, n, n, R) of `follow`, from P (n, n, R) and actions (c, R)."""
    (slots, trials), n = action.shape, len(A)
    expect_all((A, (n, n)), (Q, (n, n)), (P, (n, n, trials)))
    expect_bytes(action, (slots, trials))
    covariances = np.empty((len(action), *P.shape))
    for row, codes in enumerate(action):
        if not (initial and row == 0):
            carried = carry(A, P)
            P = np.where(codes == _INNOVATION, carried, carried + Q[:, :, None])
        P = covariances[row] = np.where(codes == _STATE, 0.0, P)
    return covariances


def records(marks: Flags, a: Floats, P: Floats | None, out: Codes, first: int = 0) -> None:
    """Fill in trials' bytes to digest: for each slot a mark, then its numbers as little-endian float64.

    marks (c, R), a (c, m, R); P (c, n, n, R), whose upper triangle is taken, row by row, or None. out: that of the trials from
    `first` on, (trials, c, 1 + 8 (m + n (n + 1) / 2)).
    """
    expect_records(marks, a, P, out, first)
    some = slice(first, first + len(out))
    columns = [a[:, i, some] for i in range(a.shape[1])]
    if P is not None:
        columns += [P[:, i, j, some] for i in range(P.shape[1]) for j in range(i, P.shape[1])]
    numbers = np.empty((len(out), len(marks), len(columns)), "<f8")
    for i, column in enumerate(columns):
        numbers[:, :, i] = column.T
    out[:, :, 0] = marks[:, some].T
    out[:, :, 1:] = numbers.view(np.uint8).reshape(len(out), len(marks), 8 * len(columns))


def squared_errors(x: Floats, x_hat: Floats) -> Floats:
    """|x − x̂|² of every slot and trial, (c, R), from (c, n, R)."""
    slots, n, trials = x.shape
    expect(x_hat, (slots, n, trials))
    error = x - x_hat
    error *= error
    squared: Floats = error[:, 0].copy()
    for i in range(1, error.shape[1]):
        squared += error[:, i]
    return squared


def traces(P: Floats) -> Floats:
    """Tr P of every slot and trial: P (c, n, n, R) → (c, R)."""
    slots, n, _, trials = P.shape
    expect(P, (slots, n, n, trials))
    trace: Floats = P[:, 0, 0].copy()
    for i in range(1, P.shape[1]):
        trace += P[:, i, i]
    return trace


@np.errstate(over="ignore", invalid="ignore")  # as in C: the square of a large error is infinite
def sums(values: Floats) -> Floats:
    """Sums over trials of values (c, R), and of their squares, (c, 2), in the order of `numpy.sum`."""
    slots, trials = values.shape
    expect(values, (slots, trials))
    values = np.ascontiguousarray(values)
    return np.stack([values.sum(axis=1), (values * values).sum(axis=1)], axis=1)


@np.errstate(over="ignore", invalid="ignore")  # as in C: covariances may exceed double precision
def add_between(sums: Floats, used: Flags, traces: Floats) -> None:
    """Add slots to three sums of each trial, (3, R): of tr P, of tr P up to the last used state, and the squares between states.

    used (c, R): where a state is used; traces (c, R) is then 0. Slot by slot, so that the bits do not depend on how many slots
    are added at a time.
    """
    slots, trials = used.shape
    expect(sums, (3, trials))
    expect_bytes(used, (slots, trials))
    expect(traces, (slots, trials))
    total, mark, squares = sums
    for now, trace in zip(used, traces, strict=True):
        between = (total - mark) * now
        mark += between
        squares += between * between
        total += trace


@np.errstate(over="ignore", invalid="ignore")
def add_leaked(sums: Floats, heard: Flags, nu: Flags, by_type: Floats) -> None:
    """Add slots to two sums of each trial, (2, R): of the bits that packets reveal, and of the packets that reveal everything.

    heard (c, R): whether the packet was received; nu (c, R): its type; by_type (c, 2): the bits of each type, inf for everything.
    """
    slots, trials = heard.shape
    expect(sums, (2, trials))
    expect_bytes(heard, (slots, trials))
    expect_bytes(nu, (slots, trials))
    expect(by_type, (slots, 2))
    bits, clear = sums
    for some, types, (of_state, of_other) in zip(heard, nu, by_type.tolist(), strict=True):
        revealed = np.where(some, np.where(types, of_other, of_state), 0.0)
        everything = np.isinf(revealed)
        bits += np.where(everything, 0.0, revealed)
        clear += everything


def count_codes(codes: Codes, kinds: int) -> NDArray[np.uint32]:
    """How often each code below `kinds` occurs in each slot, (c, kinds), from codes (c, R)."""
    slots, trials = codes.shape
    expect_bytes(codes, (slots, trials))
    return np.stack([(codes == code).sum(axis=1, dtype=np.uint32) for code in range(kinds)], axis=1)


def count_bursts(codes: Codes, lost: int, run: NDArray[np.int64], most: int) -> NDArray[np.uint32]:
    """How many runs of the code `lost` end in codes (c, R), by length: 1, 2, … and `most` or more.

    run (R,): the length of each trial's current run, which is brought up to date.
    """
    slots, trials = codes.shape
    expect_bytes(codes, (slots, trials))
    expect_runs(run, trials)
    counts = np.zeros(most, np.uint32)
    for row in codes:
        going = row == lost
        ended = run[~going & (run > 0)]
        counts += np.bincount(np.minimum(ended, most) - 1, minlength=most).astype(np.uint32)
        run[:] = np.where(going, run + 1, 0)
    return counts


def add_to_histograms(counts: NDArray[np.uint32], values: Floats, shift: int, base: int) -> None:
    """Add each of values (c, R) to a bin of its row of counts (c, bins): its bits shifted right, less base, within the bins."""
    expect_histograms(counts)
    rows, bins = counts.shape
    _, trials = values.shape
    expect(values, (rows, trials))
    bins_of = (np.ascontiguousarray(values).view(np.int64) >> shift) - base
    np.clip(bins_of, 0, bins - 1, out=bins_of)
    bins_of += bins * np.arange(rows)[:, None]
    counts += np.bincount(bins_of.reshape(-1), minlength=rows * bins).reshape(rows, bins).astype(np.uint32)


def scatter(flags: Flags, packed: Floats, n: int) -> Floats:
    """Numbers of all trials, (c, n, R), from those of the flagged ones: 0 in the others.

    flags (c, R); packed (m,): for each slot n rows of as many numbers as it has flags.
    """
    slots, trials = flags.shape
    expect_bytes(flags, (slots, trials))
    expect(packed, (n * int(np.count_nonzero(flags)),))
    z = np.zeros((slots, n, trials))
    at = 0
    for row, some in zip(z, flags, strict=True):
        count = n * int(np.count_nonzero(some))
        row[:, some] = packed[at : at + count].reshape(n, -1)
        at += count
    return z


def gather(flags: Flags, x: Floats) -> Floats:
    """The numbers of x (c, n, R) in the flagged trials, flags (c, R), as `scatter` takes them, (m,)."""
    slots, _, trials = x.shape
    expect_bytes(flags, (slots, trials))
    rows = [of_slot[:, some].ravel() for of_slot, some in zip(x, flags, strict=True)]
    return np.concatenate(rows) if rows else np.empty(0)


def triangular_factors(M: Floats) -> Floats:
    """Lower triangular L (c, n, n) with L Lᵀ = M Mᵀ and a non-negative diagonal, for each of M (c, n, m), m ≥ n."""
    expect_wide(M)
    count, n, _ = M.shape
    return np.array([elementary.triangular_factor(matrix.tolist()) for matrix in M]).reshape(count, n, n)


def carried_factors(A: Floats, G: Floats, carried: Floats, count: int) -> Floats:
    """A L of `count` consecutive slots, (count, n, n): L is the triangular factor of [A L before, G], first of [carried, G]."""
    n = len(A)
    expect_all((A, (n, n)), (G, (n, n)), (carried, (n, n)))
    factors = np.empty((count, *carried.shape))
    for row in range(count):
        carried = factors[row] = product(A[None], triangular_factors(np.concatenate([carried, G], axis=1)[None]))[0]
    return factors


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
    """The Bayesian eavesdropper: estimates (c, n, R), covariances (c, n, n, R), actions (c, R), and the mixture after c slots.

    G (n, n): lower triangular, G Gᵀ = Q; leaks (c, 2n, 2n), see `Leak`; rounding (c, n): the least variance of packets about
    their prediction; before: the mixture before these slots, with at most `capacity` components, see `Mixture`; gamma (c, R);
    z (c, n, R): packets, read where they are received.
    initial: the first slot is slot 0, in which a packet is the state.
    """
    expect_mixture(A, G, leaks, rounding, before, gamma, z, capacity)
    model = mixtures.MixtureModel(A, Factor.of_triangular(G.tolist()), state_probability, capacity)
    mixture, (slots, n, trials) = mixtures.Mixture(*before), z.shape
    x_hat, P, action = np.empty(z.shape), np.empty((slots, n, n, trials)), np.empty((slots, trials), np.uint8)
    for row, heard in enumerate(gamma):
        leak = None if initial and row == 0 else Leak(leaks[row])
        mixture, state = mixtures.step(model, mixture, heard, np.where(heard, z[row], 0.0), leak, rounding[row])
        x_hat[row], P[row] = mixtures.moments(mixture)
        action[row] = np.where(heard, np.where(state > 0.5, np.uint8(_STATE), np.uint8(_INNOVATION)), np.uint8(0))
    return x_hat, P, action, *mixture
