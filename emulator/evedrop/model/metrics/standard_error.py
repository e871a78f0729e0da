"""The standard error of a mean over trials, and its distance from theory as a z-score.

Source: docs/metrics.md, standard errors; docs/mathematics/verdicts.md, z-scores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evedrop.model.process import Floats


def standard_error(of_trials: Floats | None) -> float | None:
    """The standard error of the mean of independent trials, (R,): their standard deviation (R − 1 degrees of freedom) over √R.

    None for fewer than two trials, because the slots of a trial depend on each other; None for trials that are not finite.
    """
    if of_trials is None or len(of_trials) < 2 or not np.isfinite(of_trials).all():
        return None
    if (of_trials == of_trials[0]).all():
        return 0.0  # their mean is rounded, and the distance from it is not always 0
    with np.errstate(over="ignore"):
        error = float(np.std(of_trials, ddof=1)) / math.sqrt(len(of_trials))
    return error if math.isfinite(error) else None


def ratio_error(over: Floats, under: Floats) -> float | None:
    """The standard error of the ratio of two means over the same trials, (R,) each, to first order; None as above.

    Source: docs/metrics.md, standard errors.
    """
    mean = float(np.mean(under))
    if not mean > 0.0 or not math.isfinite(mean):
        return None
    return standard_error((over - float(np.mean(over)) / mean * under) / mean)


def z_of(of_trials: Floats | None, expected: float | None) -> float | None:
    """How far the mean of independent trials, (R,), is from its expectation by theory, as a standard normal number.

    It is the distance in standard errors, corrected for what the trials show of their distribution: their skewness and their
    kurtosis, without which a mean that a few trials carry is called improbable far too often.

    None without theory, for fewer than two trials, and for trials that are all equal or not finite.

    Source: docs/mathematics/verdicts.md, z-scores.
    """
    test = None if expected is None else skewed_test(of_trials, expected)
    return None if test is None else test.z


@dataclass(frozen=True)
class MeanTest:
    """A test on the mean of independent trials."""

    statistic: float
    """The distance of the mean from the number it is compared with, in standard errors."""
    freedom: float
    """Degrees of freedom of Student's t that this statistic follows."""

    @property
    def above(self) -> float:
        """The p-value of the hypothesis that the mean is at most the number: small where it is above."""
        return _student(self.freedom, -self.statistic)

    @property
    def below(self) -> float:
        """The p-value of the hypothesis that the mean is at least the number: small where it is below."""
        return _student(self.freedom, self.statistic)

    @property
    def z(self) -> float:
        """The same as a standard normal number."""
        from scipy.special import ndtri  # noqa: PLC0415 - 0.2 s that only a closing report needs

        tail = max(min(self.above, self.below), _LEAST_TAIL)
        return math.copysign(float(ndtri(tail)), self.statistic)


def student_test(of_trials: Floats | None, number: float) -> MeanTest | None:
    """Compare the mean of independent trials, (R,), with a number by Student's t.

    None for fewer than two trials, for trials that are all equal, and for numbers that are not finite.
    """
    error = standard_error(of_trials)
    if of_trials is None or not error:
        return None
    t = (float(np.mean(of_trials)) - number) / error
    return MeanTest(t, len(of_trials) - 1.0) if math.isfinite(t) else None


def skewed_test(of_trials: Floats | None, number: float) -> MeanTest | None:
    """The same for trials whose distribution may be skewed and heavy-tailed, by Hall's transformation of t.

    Source: docs/mathematics/verdicts.md, z-scores.
    """
    test = student_test(of_trials, number)
    if of_trials is None or test is None:
        return None
    t = test.statistic
    count, a = len(of_trials), mean_skewness(of_trials)
    kurtosis = float(np.mean(_standardised(of_trials) ** 4))
    # Hall's transformation: t + a t²/3 + a² t³/27 + a/6, which grows with t.
    statistic = t + a * t * t / 3.0 + a * a * t**3 / 27.0 + a / 6.0
    return MeanTest(statistic, min(test.freedom, 2.0 * count / (max(kurtosis, 3.0) - 1.0)))


def mean_skewness(of_trials: Floats) -> float:
    """The skewness of the mean of independent trials, (R,), estimated from them; 0 for trials that are all equal."""
    return float(np.mean(_standardised(of_trials) ** 3)) / math.sqrt(len(of_trials))


def _standardised(of_trials: Floats) -> Floats:
    """The distance of each trial from the mean in standard deviations, (R,)."""
    mean, standard_deviation = float(np.mean(of_trials)), float(np.std(of_trials))
    return (of_trials - mean) / standard_deviation if standard_deviation > 0.0 else np.zeros(len(of_trials))


def _student(freedom: float, t: float) -> float:
    """The distribution function of Student's t."""
    from scipy.special import stdtr  # noqa: PLC0415 - 0.2 s that only a closing report needs

    return float(stdtr(freedom, t))


_LEAST_TAIL = 1e-300
