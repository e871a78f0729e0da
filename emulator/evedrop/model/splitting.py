"""Splitting: populations in which important trials are copied and others dropped, with weights that compensate.

Source: docs/mathematics.md, splitting.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats

_KEPT = 0.99  # the fraction of trials below the value to which larger ones are cut in the floor of the importance
_LEAST = 1e-3


def importance_floor(errors: Floats, scale: float) -> Floats:
    """The amount c_k that the importance of a trial has in addition to its error, (slots,), from trials of their own (slots, R).

    It is the usual error: without it a trial whose error is 0 would be lost, and with it every later error that it has. The
    few largest errors are cut, so that one of them does not decide. scale: a size of errors, above 0, where all are 0.
    """
    usual = np.minimum(errors, np.quantile(errors, _KEPT, axis=1)[:, None]).mean(axis=1)
    return np.asarray(usual + _LEAST * scale, np.float64)


@final
class SplitPopulations:
    """P independent populations of N trials each, that read slots one by one and are split where they are told to.

    With G the importance of a trial and u its weight, the mean of u f over a population has the expectation E f of a single
    trial, for every quantity f of a trial and any number of splits. All arrays are (P, N).
    """

    def __init__(self, populations: int, size: int) -> None:
        self.weight: Floats = np.ones((populations, size))
        """u, which changes in splits only."""
        self._importance: Floats = self.weight

    def means(self, quantity: Floats) -> Floats:
        """The estimate of E f by each population, (P,)."""
        return np.asarray((quantity * self.weight).mean(axis=1), np.float64)

    def weigh(self, importance: Floats) -> Floats:
        """Take the importance G of the slot's trials; the fraction of them that would count in a split, 1/N … 1, (P,)."""
        self._importance = importance
        product = importance * self.weight
        fraction = product / product.max(axis=1, keepdims=True)
        found: Floats = fraction.sum(axis=1) ** 2 / (fraction * fraction).sum(axis=1) / fraction.shape[1]
        return found

    def split(self, uniforms: Floats) -> NDArray[np.intp]:
        """Copy each trial, on average, in proportion to u G within its population; the trials that are copied, (P N,).

        uniforms: one for each population, (P,). Each trial is copied as often as the average, rounded up or down.
        """
        populations, size = self.weight.shape
        product = self._importance * self.weight
        total = product.mean(axis=1)
        cumulated = np.cumsum(product, axis=1)
        marks = (np.arange(size) + uniforms[:, None]) / size * cumulated[:, -1:]
        copied = np.array([np.searchsorted(one, at, side="right") for one, at in zip(cumulated, marks, strict=True)])
        copied = np.minimum(copied, size - 1)
        self.weight = total[:, None] / np.take_along_axis(self._importance, copied, axis=1)
        return np.asarray((copied + size * np.arange(populations)[:, None]).reshape(-1), np.intp)
