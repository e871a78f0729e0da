"""Metrics as text: with their standard errors, and only the digits that these leave significant.

Such a text knows its value: a table on the terminal shows the text, a file of the table has the value.
"""

from __future__ import annotations

import math
from typing import Self, final


@final
class ShownNumber(str):
    """The text of a number, such as `0.0123 ± 0.0004 Wh`; its value and standard error go where a text is formatted again."""

    value: float | None
    """At full precision; None: there is no number, and the text is a dash."""
    error: float | None
    """The standard error; None: there is none."""
    after: str
    """What follows the number, such as its unit."""

    def __new__(cls, text: str, value: float | None, error: float | None = None, after: str = "") -> Self:
        """text: what is shown."""
        number = super().__new__(cls, text)
        number.value, number.error, number.after = value, error, after
        return number

    def __add__(self, after: str) -> ShownNumber:
        """The same number with a unit or a mark after it."""
        return ShownNumber(f"{self}{after}", self.value, self.error, self.after + after)

    def __getnewargs__(self) -> tuple[str, float | None, float | None, str]:  # type: ignore[override]  # that of a plain text
        """What a copy is made from."""
        return str(self), self.value, self.error, self.after


_SMALL_NUMBER, _LARGE_NUMBER, _LEAST_PLACE, _LAST_PLACE = 0.01, 1e5, -4, -6  # beyond them estimates have exponents
_ROUNDING = 1e-12  # a standard error below this part of the estimate comes from the rounding of equal trials
_MOST_DIGITS = 8  # significant digits of an estimate
_LARGE_COUNT, _NEARLY_ALL, _LARGE_SHORT = 1e7, 0.99, 1e4
_WHOLE = 99.5  # from here on two digits would be the whole number, or have an exponent
_LEAST_PLAIN, _LARGE_PLAIN = 1e-4, 999_500  # beyond them two digits have an exponent


def number_text(value: float | None, how: str = ".4g") -> ShownNumber:
    """A metric of the summary as text; a dash for None. One that rounds to 0 has no minus."""
    text = "–" if value is None else format(value, how)
    return ShownNumber(
        format(0.0, how) if value is not None and text.startswith("-") and not float(text) else text, value
    )


def short_text(value: float | None) -> str:
    """A number for a narrow place: 2.3, 57, 3.4e5; a dash for None."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return "∞"
    rounded = float(f"{value:.0f}" if value >= _WHOLE else f"{value:.2g}")
    if rounded == 0.0 or _SMALL_NUMBER <= rounded < _LARGE_SHORT:
        return f"{rounded:.0f}" if rounded >= 100 else f"{rounded:.2g}"
    return _scientific(value, 1)


def two_digits(value: float) -> str:
    """A number with two digits for a sentence: 0.32, 17, 9,800, 4.8e9; ∞ for one that is not finite."""
    if not math.isfinite(value):
        return "∞"
    digits = f"{value:.2g}"
    if "e" not in digits:
        return digits
    if _LEAST_PLAIN <= abs(value) < _LARGE_PLAIN:
        return f"{float(digits):,.0f}" if abs(value) >= 1 else f"{float(digits):f}".rstrip("0")
    return _scientific(value, 0 if float(digits) == float(f"{value:.0e}") else 1)


def finite_text(value: float, how: str = ".4g") -> ShownNumber:
    """A number as text; ∞ for one that is not finite."""
    return ShownNumber(format(value, how) if math.isfinite(value) else "∞", value)


def count_text(number: float) -> str:
    """A large number of trials as text: 12,345, or 1.2e12."""
    return f"{number:,.0f}" if number < _LARGE_COUNT else _scientific(number, 1)


def fraction_text(fraction: float) -> str:
    """A fraction as a percentage of two digits; one that is nearly everything is more than 99 %."""
    return f"{100 * fraction:.2g} %" if fraction < _NEARLY_ALL else "more than 99 %"


def percent_text(fraction: float) -> str:
    """A fraction as a percentage with one decimal; only nothing is 0.0%, and only everything 100.0%."""
    text = f"{fraction:.1%}"
    if text == "100.0%" and fraction < 1.0:
        return "more than 99.9%"
    return "less than 0.1%" if text == "0.0%" and fraction > 0.0 else text


def estimate(value: float | None, error: float | None, how: str = ".4g") -> ShownNumber:
    """An estimate with its standard error, to the place of that error's first digit: 0.0123 ± 0.0004. how: without an error.

    An error of the size of rounding, which trials with equal outcomes have, counts as none.
    """
    return ShownNumber(_estimate(value, error, how), value, error)


def percent_estimate(fraction: float | None, error: float | None, how: str = ".2g") -> ShownNumber:
    """A fraction in per cent, as `estimate` has it: 12.3 ± 0.4 %."""
    value, scatter = (None if each is None else 100.0 * each for each in (fraction, error))
    return estimate(value, scatter, how) + " %"


def _estimate(value: float | None, error: float | None, how: str) -> str:
    if value is None or not error or not math.isfinite(value) or math.isnan(error) or error <= _ROUNDING * abs(value):
        return number_text(value, how)
    if math.isinf(error):
        return f"{number_text(value, how)} ± ∞"
    place = int(f"{error:.0e}".partition("e")[2])
    if value and math.floor(math.log10(abs(value))) - place >= _MOST_DIGITS:
        return f"{value:.{_MOST_DIGITS}g} ± {_scientific(error, 0)}"
    if max(abs(value), error) < _LARGE_NUMBER and place >= (
        _LEAST_PLACE if abs(value) < _SMALL_NUMBER else _LAST_PLACE
    ):
        places = max(0, -place)
        return f"{number_text(value, f'.{places}f')} ± {error:.{places}f}"
    return _scientific_estimate(value, error)


def scientific(value: float, error: float | None) -> str:
    """An estimate to the place of its standard error's first digit, or a number with four digits, with an exponent."""
    if not math.isfinite(value) or (error is not None and not math.isfinite(error)):
        return _estimate(value, error, ".4g")
    if not error or error <= _ROUNDING * abs(value):
        return _scientific(value, 3) if value else "0"
    return _scientific_estimate(value, error)


def _scientific_estimate(value: float, error: float) -> str:
    place = int(f"{error:.0e}".partition("e")[2])
    digits = max(0, math.floor(math.log10(abs(value))) - place) if value else 0
    return f"{_scientific(value, min(digits, _MOST_DIGITS))} ± {_scientific(error, 0)}"


def _scientific(value: float, digits: int) -> str:
    """A number with this many decimal digits and a short exponent: 2.3e-4."""
    mantissa, exponent = f"{value:.{digits}e}".split("e")
    return f"{mantissa}e{int(exponent)}"
