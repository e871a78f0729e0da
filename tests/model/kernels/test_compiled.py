"""Every kernel in C against the same in numpy, to the bit, for each instruction set of this processor."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import isfunction, signature
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.kernels import reference
from evedrop.model.kernels.choice import EXTENSION, KERNELS
from tests.examples import examples

library = pytest.importorskip(EXTENSION, reason="the C kernels are not built: no compiler worked").lib

from evedrop.model.kernels import compiled  # noqa: E402 - only where they are built

SETS = range(library.kernels_best() + 1)
ODD = np.array(
    [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, -5e-324, 2.2250738585072014e-308, 1.7e308, -1.7e308, 1e-200, 1.0, -1.0]
)
"""Zeros, not a number, infinities, subnormal numbers, and others whose products leave a double's range."""
Floats = np.ndarray[Any, np.dtype[np.float64]]

SIZES = st.one_of(
    st.tuples(st.integers(0, 5), st.integers(1, 8), st.integers(0, 20)),
    st.tuples(st.just(2), st.sampled_from([13, 17]), st.sampled_from([1, 9, 33])),
    st.tuples(st.just(1), st.just(2), st.sampled_from([600, 1027])),
)
"""Slots, states and trials: none, one and several; fewer and more than the processor takes at once."""
RANDOM = st.builds(np.random.default_rng, st.integers(0, 2**32))


TWINS = sorted(name for name in vars(compiled) if isfunction(getattr(compiled, name)) and not name.startswith("_"))


def test_twins_have_the_same_signature() -> None:
    """Callers are checked against the kernels in numpy, and may get those in C."""
    assert len(TWINS) > 10
    for name in TWINS:
        assert signature(getattr(compiled, name)) == signature(getattr(reference, name)), name


@pytest.fixture(autouse=True, params=SETS, ids=["baseline", "avx2", "avx512"][: len(SETS)])
def instruction_set(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let the kernels use one instruction set after the other."""
    library.kernels_use(request.param)
    yield
    library.kernels_use(max(SETS))


def numbers(random: np.random.Generator, *shape: int) -> Floats:
    """Numbers of all sizes, in one array in two with some odd ones."""
    numbers = random.standard_normal(shape) * 10.0 ** random.integers(-5, 6, shape)
    if random.random() < 0.5:
        odd = random.random(shape) < random.random() ** 2
        numbers[odd] = random.choice(ODD, int(odd.sum()))
    return numbers


def codes(random: np.random.Generator, *shape: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Codes of actions or fates, in one array in two all alike."""
    codes_ = random.integers(0, 4, shape, np.uint8)
    return codes_ if random.random() < 0.7 else np.full(shape, random.integers(0, 4), np.uint8)


def same(value: Any, other: Any) -> None:
    """Expect equal types, shapes and bits; a NaN equals any NaN, because IEEE 754 leaves open which one a sum returns."""
    assert value.dtype == other.dtype
    assert value.shape == other.shape
    if value.dtype == np.float64:
        assert np.array_equal(np.isnan(value), np.isnan(other))
        numeric = ~np.isnan(value)
        value, other = value[numeric].view(np.uint64), other[numeric].view(np.uint64)
    assert np.array_equal(value, other)


def twins(name: str, *arguments: Any) -> None:
    """Expect a kernel to return the same in C and in numpy."""
    with np.errstate(all="ignore"):
        expected = getattr(reference, name)(*arguments)
    actual = getattr(compiled, name)(*arguments)
    pairs = zip(actual, expected, strict=True) if isinstance(expected, tuple) else [(actual, expected)]
    for value, other in pairs:
        same(value, other)


QUICK = settings(max_examples=examples(60), deadline=None)


@QUICK
@given(RANDOM, SIZES, st.integers(1, 3), st.booleans())
def test_words_become_the_same_numbers(
    random: np.random.Generator, sizes: tuple[int, int, int], spare: int, extreme: bool
) -> None:
    """Uniform and normal numbers, far tails and the ends of the range included."""
    slots, width, trials = sizes
    words = random.integers(0, 2**64, (slots, trials, width + spare - 1), np.uint64)
    if extreme:
        words >>= random.integers(0, 64, words.shape).astype(np.uint64)
        words = np.where(random.random(words.shape) < 0.5, words, ~words)
    for name in ("uniforms", "normals"):
        twins(name, words, width)


@QUICK
@given(RANDOM, st.integers(0, 5), st.integers(0, 9), st.integers(0, 2**40))
def test_counters_are_the_same(random: np.random.Generator, slots: int, count: int, slot: int) -> None:
    """Slots and blocks in the byte order of AES."""
    made = [np.zeros((slots, count, 2), np.uint64) for _ in range(2)]
    first = int(random.integers(0, 2**50))
    compiled.fill_counters(made[0], slot, first)
    reference.fill_counters(made[1], slot, first)
    same(made[0], made[1])


@QUICK
@given(RANDOM, SIZES, st.integers(1, 4))
def test_products_are_the_same(random: np.random.Generator, sizes: tuple[int, int, int], m: int) -> None:
    """Matrices of any shape."""
    slots, n, trials = sizes
    twins("product", numbers(random, slots, m, n), numbers(random, slots, n, trials))


@QUICK
@given(RANDOM, SIZES)
def test_states_and_packets_are_the_same(random: np.random.Generator, sizes: tuple[int, int, int]) -> None:
    """The sensor's slots."""
    _, n, trials = sizes
    x, predicted, chi = (numbers(random, *sizes) for _ in range(3))
    twins("advance", numbers(random, n, n), x, numbers(random, n, trials))
    twins("encode", random.random((sizes[0], trials)) < 0.5, x, predicted, chi)


@QUICK
@given(RANDOM, SIZES, st.sampled_from([0.0, 0.1, 0.6, 1.0]))
def test_packed_trials_are_the_same(random: np.random.Generator, sizes: tuple[int, int, int], share: float) -> None:
    """The numbers of some trials are taken out of all, and put back."""
    slots, n, trials = sizes
    flags, x = random.random((slots, trials)) < share, numbers(random, *sizes)
    twins("gather", flags, x)
    packed = reference.gather(flags, x)
    twins("scatter", flags, packed, n)
    assert np.array_equal(reference.scatter(flags, packed, n), np.where(flags[:, None, :], x, 0.0), equal_nan=True)


@QUICK
@given(RANDOM, SIZES, st.booleans(), st.booleans())
def test_beliefs_are_the_same(
    random: np.random.Generator, sizes: tuple[int, int, int], decodes: bool, initial: bool
) -> None:
    """A receiver's slots, with and without the secret, from slot 0 on and later."""
    slots, n, trials = sizes
    before = numbers(random, n, trials), numbers(random, n, n, trials)
    action, z = codes(random, slots, trials), numbers(random, *sizes)
    chi = numbers(random, *sizes) if decodes else None
    A, Q = numbers(random, n, n), numbers(random, n, n)
    twins("follow", A, Q, before, action, z, chi, initial)
    twins("follow_covariance", A, Q, before[1], action, initial)


@QUICK
@given(RANDOM, SIZES, st.integers(0, 5), st.booleans(), st.data())
def test_records_are_the_same(
    random: np.random.Generator, sizes: tuple[int, int, int], width: int, with_P: bool, data: st.DataObject
) -> None:
    """The bytes to digest, of some of the trials, with covariances and without."""
    slots, n, trials = sizes
    first = data.draw(st.integers(0, trials))
    count = data.draw(st.integers(0, trials - first))
    a, P = numbers(random, slots, width, trials), numbers(random, slots, n, n, trials) if with_P else None
    size = 1 + 8 * (width + (n * (n + 1) // 2 if with_P else 0))
    outs = [np.full((count, slots, size), 7, np.uint8) for _ in range(2)]
    marks = random.random((slots, trials)) < 0.5
    compiled.records(marks, a, P, outs[0], first)
    reference.records(marks, a, P, outs[1], first)
    same(*outs)


def test_records_for_another_number_of_states_are_refused() -> None:
    """C would write beyond their end."""
    marks, a, P = np.ones((3, 4), bool), np.zeros((3, 2, 4)), np.zeros((3, 2, 2, 4))
    for shape in ((4, 3, 49), (4, 2, 41), (5, 3, 41)):
        with pytest.raises(ValueError, match=r"records uint8 of shape|5 of 4 trials"):
            compiled.records(marks, a, P, np.zeros(shape, np.uint8))


@QUICK
@given(RANDOM, SIZES)
def test_scores_are_the_same(random: np.random.Generator, sizes: tuple[int, int, int]) -> None:
    """Squared errors and traces."""
    slots, n, trials = sizes
    twins("squared_errors", numbers(random, *sizes), numbers(random, *sizes))
    twins("traces", numbers(random, slots, n, n, trials))


@QUICK
@given(RANDOM, st.integers(0, 6), st.integers(0, 300), st.integers(1, 5))
def test_counts_are_the_same(random: np.random.Generator, slots: int, trials: int, most: int) -> None:
    """Codes, bursts with what they leave behind, and histograms of numbers that are not negative."""
    result = codes(random, slots, trials)
    twins("count_codes", result, 3)
    runs = [random.integers(0, 7, trials)] * 2
    runs = [run.copy() for run in runs]
    same(compiled.count_bursts(result, 1, runs[0], most), reference.count_bursts(result, 1, runs[1], most))
    same(*runs)
    values, bins = np.abs(numbers(random, slots, trials)), int(random.integers(1, 300))
    twins("sums", values)
    counts = [np.full((slots, bins), 3, np.uint32) for _ in range(2)]
    base = int(np.float64(1e-3).view(np.int64)) >> 50
    compiled.add_to_histograms(counts[0], values, 50, base)
    reference.add_to_histograms(counts[1], values, 50, base)
    same(*counts)
    flags, types = random.random((2, slots, trials)) < 0.5
    by_type = random.choice([0.0, 1.5, np.inf], (slots, 2))
    between, leaked = ([sums, sums.copy()] for sums in (numbers(random, 3, trials), np.abs(numbers(random, 2, trials))))
    for kernels, *sums in zip((compiled, reference), between, leaked, strict=True):
        kernels.add_between(sums[0], flags, values)
        kernels.add_leaked(sums[1], flags, types, by_type)
    same(*between)
    same(*leaked)


@pytest.mark.parametrize("trials", [7, 8, 129, 500, 999, 2000, 8193])
def test_sums_of_many_trials_are_those_of_numpy(trials: int) -> None:
    """To the bit, of numbers that differ by many powers of ten; of some columns of a larger array, too."""
    random = np.random.default_rng(trials)
    values = random.standard_normal((3, trials + 5)) * np.exp(20.0 * random.standard_normal((3, trials + 5)))
    for some in (values, values[:, 2:-3]):
        expected = np.stack([some.sum(axis=1), (some * some).sum(axis=1)], axis=1)
        same(compiled.sums(some), expected)
        same(reference.sums(some), expected)


@QUICK
@given(RANDOM, st.integers(0, 3), st.one_of(st.integers(1, 8), st.just(21)), st.integers(0, 9))
def test_triangular_factors_are_the_same(random: np.random.Generator, count: int, n: int, more: int) -> None:
    """Any matrices with at least as many columns as rows."""
    M = numbers(random, count, n, n + more)
    same(compiled.triangular_factors(M), reference.triangular_factors(M))


@QUICK
@given(RANDOM, st.integers(1, 6), st.integers(0, 9))
def test_factors_of_consecutive_slots_are_the_same(random: np.random.Generator, n: int, count: int) -> None:
    """Each is carried on from the one before, also where squares are too small for a double."""
    A, G, carried = (random.standard_normal((n, n)) * 10.0 ** random.integers(-160, 3) for _ in range(3))
    twins("carried_factors", A, G, carried, count)


def entries(random: np.random.Generator, *shape: int) -> Floats:
    """Numbers of size 1, many of them 0, -0 or 1, for which the kernels have ways of their own."""
    return np.where(
        random.random(shape) < random.random(),
        random.choice([0.0, -0.0, 1.0], shape, p=[0.6, 0.1, 0.3]),
        random.standard_normal(shape),
    )


def mixture(random: np.random.Generator, places: int, n: int, trials: int) -> tuple[Floats, ...]:
    """A mixture of normal distributions; some places are empty, and hold 0."""
    weight = random.random((places, trials)) * 10.0 ** random.integers(-13, 1, (places, trials))
    if random.random() < 0.3:
        weight = random.choice([1e-3, 1.0], weight.shape)
    weight[random.random(weight.shape) < random.random()] = 0.0
    rows = (entries(random, count, places, trials) for count in (n, n * (n - 1) // 2, n))
    mean, lower, diagonal = (np.where(weight != 0.0, row, 0.0) for row in rows)
    return weight, mean, lower, np.abs(diagonal)


def posterior_arguments(
    random: np.random.Generator, sizes: tuple[int, int, int], capacity: int, odd: bool
) -> list[Any]:
    """A, G, leaks, rounding, a mixture, γ and packets, at which types are in doubt; odd: some numbers are of any size."""
    slots, n, trials = sizes
    A, before = entries(random, n, n), mixture(random, int(random.integers(0, capacity + 1)), n, trials)
    G, leaks = np.tril(entries(random, n, n)), np.tril(entries(random, slots, 2 * n, 2 * n))
    rounding = np.abs(entries(random, slots, n)) * 10.0 ** random.integers(-340, 1, (slots, n))
    z = entries(random, *sizes) * 10.0 ** random.uniform(-1, 2)
    gamma = random.random((slots, trials)) < random.random() * 1.3
    if odd:
        z, leaks = (
            np.where(random.random(array.shape) < 0.2, numbers(random, *array.shape), array) for array in (z, leaks)
        )
        before = tuple(
            np.where(random.random(array.shape) < 0.1, numbers(random, *array.shape), array) for array in before
        )
    else:
        for L in (G, *leaks):
            np.fill_diagonal(L, np.exp(random.standard_normal(len(L))))
    return [A, G, leaks, rounding, before, gamma, z]


@settings(max_examples=examples(150), deadline=None)
@given(RANDOM, SIZES, st.integers(1, 13), st.sampled_from([0.0, 0.1, 0.7, 1.0]), st.booleans(), st.booleans())
def test_posteriors_are_the_same(
    random: np.random.Generator, sizes: tuple[int, int, int], capacity: int, mu_d: float, initial: bool, odd: bool
) -> None:
    """Mixtures with room for another component and without, to the bit."""
    twins("follow_mixture", *posterior_arguments(random, sizes, capacity, odd), mu_d, capacity, initial)


def test_places_that_become_empty_are_left_out() -> None:
    """An infinite weight leaves nothing for the other component, whose place is dropped."""
    random = np.random.default_rng(1)
    A, G, leaks, rounding, _, gamma, z = posterior_arguments(random, (1, 2, 5), 4, odd=False)
    _, *parts = mixture(random, 2, 2, 5)
    weight = np.array([[np.inf], [0.5]]) * np.ones(5)
    arguments = (A, G, leaks, rounding, (weight, *parts), gamma & False, z, 0.5, 4)
    assert compiled.follow_mixture(*arguments)[3].shape == (1, 5)
    twins("follow_mixture", *arguments)


def test_a_mixture_with_too_many_places_is_refused() -> None:
    """C has no room for more than the capacity."""
    random = np.random.default_rng(1)
    with pytest.raises(ValueError, match="3 places; expected at most 2"):
        compiled.follow_mixture(
            np.eye(2), np.eye(2), np.zeros((1, 4, 4)), np.zeros((1, 2)), mixture(random, 3, 2, 1),
            np.ones((1, 1), np.bool_), np.zeros((1, 2, 1)), 0.5, 2,
        )  # fmt: skip


def test_arrays_of_other_shapes_are_refused() -> None:
    """C would read beyond their ends."""
    x, z = np.zeros((2, 3)), np.zeros((1, 2, 4))
    with pytest.raises(ValueError, match=r"shape \(2, 3\); expected \(2, 4\)"):
        compiled.follow(np.eye(2), np.eye(2), (x, np.zeros((2, 2, 4))), np.zeros((1, 4), np.uint8), z)
    with pytest.raises(ValueError, match="int64 of shape"):
        compiled.count_bursts(np.zeros((1, 4), np.uint8), 1, np.zeros(3, np.int64), 5)
    with pytest.raises(ValueError, match="expected codes or flags"):
        compiled.encode(np.zeros((1, 3), np.bool_), z, z, z)


def test_views_of_arrays_are_read_in_their_order() -> None:
    """Transposed arrays and slices of arrays are brought into order before C reads them."""
    random = np.random.default_rng(1)
    x = random.standard_normal((6, 4, 10)).transpose(1, 0, 2)[::2, ::3, 1:]
    twins("squared_errors", x, x[:, ::-1])
    twins("traces", random.standard_normal((3, 3, 2, 8)).transpose(2, 0, 1, 3)[..., ::2])


def test_the_kernels_in_use_are_named() -> None:
    """In the words that `evedrop selftest` prints."""
    assert KERNELS.startswith(("C (", "numpy"))
