"""The recursions of the theory in exact fractions, from docs/mathematics/ and not from the code under test.

Values are rounded to 400 bits after each slot, which keeps them short, and is far more than any condition number needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import Any

Matrix = list[list[Fraction]]

_BITS = 400


def exact(M: Any) -> Matrix:
    """The fractions that the doubles of a matrix are."""
    return [[Fraction(float(value)) for value in row] for row in M]


def identity(n: int) -> Matrix:
    """The identity."""
    return [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]


def times(*factors: Matrix) -> Matrix:
    """The product of matrices."""
    left, *more = factors
    for right in more:
        columns = list(zip(*right, strict=True))
        left = [
            [sum((a * b for a, b in zip(row, column, strict=True)), Fraction(0)) for column in columns] for row in left
        ]
    return left


def transposed(M: Matrix) -> Matrix:
    """Mᵀ."""
    return [list(row) for row in zip(*M, strict=True)]


def combined(*terms: tuple[Fraction | int, Matrix]) -> Matrix:
    """The sum of factor times matrix."""
    rows = zip(*(M for _, M in terms), strict=True)
    factors = [factor for factor, _ in terms]
    return [
        [sum((f * v for f, v in zip(factors, values, strict=True)), Fraction(0)) for values in zip(*row, strict=True)]
        for row in rows
    ]


def inverted(M: Matrix) -> Matrix:
    """M⁻¹."""
    n = len(M)
    rows = [[*row, *unit] for row, unit in zip(M, identity(n), strict=True)]
    for c in range(n):
        pivot = next(i for i in range(c, n) if rows[i][c])
        rows[c], rows[pivot] = rows[pivot], rows[c]
        rows[c] = [value / rows[c][c] for value in rows[c]]
        for i in range(n):
            if i != c and rows[i][c]:
                rows[i] = [a - rows[i][c] * b for a, b in zip(rows[i], rows[c], strict=True)]
    return [row[n:] for row in rows]


def determinant(M: Matrix) -> Fraction:
    """Det M of a matrix whose leading minors are not 0, as those of a covariance."""
    rows, product = [list(row) for row in M], Fraction(1)
    for c, row in enumerate(rows):
        product *= row[c]
        for other in rows[c + 1 :]:
            factor = other[c] / row[c]
            other[c:] = [a - factor * b for a, b in zip(other[c:], row[c:], strict=True)]
    return product


def trace(M: Matrix) -> Fraction:
    """The sum of the diagonal."""
    return sum((row[i] for i, row in enumerate(M)), Fraction(0))


def congruent(A: Matrix, P: Matrix) -> Matrix:
    """A P Aᵀ."""
    return times(A, P, transposed(A))


def rounded(M: Matrix, bits: int = _BITS) -> Matrix:
    """Each entry, rounded to this number of bits."""
    return [[_short(value, bits) for value in row] for row in M]


def _short(value: Fraction, bits: int) -> Fraction:
    if not value:
        return value
    shift = bits - (value.numerator.bit_length() - value.denominator.bit_length())
    scale = Fraction(2) ** shift
    return Fraction(round(value * scale)) / scale


def remaining(Q: Matrix, sigma: Matrix) -> Matrix:
    """Q − QΣ⁻¹Q."""
    return combined((1, Q), (-1, times(Q, inverted(sigma), Q)))


def state_covariances(A: Matrix, Q: Matrix, initial: Matrix, bits: int = _BITS) -> Iterator[Matrix]:
    """Σ_0, Σ_1 and so on, rounded to this number of bits."""
    sigma = initial
    while True:
        yield sigma
        sigma = rounded(combined((1, congruent(A, sigma)), (1, Q)), bits)


def expectations(A: Matrix, Q: Matrix, initial: Matrix, odds: Callable[[str], Fraction], slots: int) -> list[Matrix]:
    """E P_k of a receiver; odds: name of an outcome → its probability."""
    sigmas = state_covariances(A, Q, initial)
    before = next(sigmas)
    E = combined((odds("initial"), initial))
    expected = [E]
    kept = odds("predicted") + odds("decoded") + odds("leaked")
    for sigma in sigmas:
        if len(expected) == slots:
            return expected
        terms = [(kept, congruent(A, E)), (odds("predicted"), Q), (2 * odds("misled"), congruent(A, before))]
        if odds("leaked"):
            terms.append((odds("leaked"), remaining(Q, sigma)))
        E = rounded(combined(*terms))
        expected.append(E)
        before = sigma
    raise AssertionError  # the states go on


def behind_a_chain(
    A: Matrix,
    Q: Matrix,
    initial: Matrix,
    transitions: Matrix,
    distribution: Sequence[Fraction],
    odds: Sequence[Callable[[str], Fraction]],
    slots: int,
) -> list[Fraction]:
    """Tr E P_k of a receiver behind a link that follows a Markov chain, by its states; odds: of every state."""
    sigmas = state_covariances(A, Q, initial)
    before = next(sigmas)
    parts = [combined((chance("initial") * p, initial)) for chance, p in zip(odds, distribution, strict=True)]
    traces = [sum((trace(part) for part in parts), Fraction(0))]
    while len(traces) < slots:
        sigma = next(sigmas)
        after = []
        for s, (chance, p) in enumerate(zip(odds, distribution, strict=True)):
            mixed = combined(*((transitions[r][s], part) for r, part in enumerate(parts)))
            kept = chance("predicted") + chance("decoded") + chance("leaked")
            terms = [
                (kept, congruent(A, mixed)),
                (p * chance("predicted"), Q),
                (2 * p * chance("misled"), congruent(A, before)),
            ]
            if chance("leaked"):
                terms.append((p * chance("leaked"), remaining(Q, sigma)))
            after.append(rounded(combined(*terms)))
        parts, before = after, sigma
        traces.append(sum((trace(part) for part in parts), Fraction(0)))
    return traces


def fixed_point(A: Matrix, kept: Fraction, source: Matrix) -> Matrix:
    """S = kept A S Aᵀ + source, as n² linear equations."""
    n = len(A)
    places = [(i, j) for i in range(n) for j in range(n)]
    equations = [[Fraction(int((i, j) == (r, c))) - kept * A[i][r] * A[j][c] for r, c in places] for i, j in places]
    values = [row[0] for row in times(inverted(equations), [[source[i][j]] for i, j in places])]
    return [values[i * n : (i + 1) * n] for i in range(n)]
