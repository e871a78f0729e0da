"""Designs that Python and a notebook show as the command prints them."""

from __future__ import annotations

from functools import partial
from typing import Any, TypeVar

from evedrop.cli.words import WIDTH
from evedrop.model.theory.design import Design
from evedrop.model.theory.schedules import ScheduleDesign
from evedrop.scenario.designs import BudgetDesign, PolicyDesign


class _Shown:
    def __repr__(self) -> str:
        from evedrop.cli.design_report import print_designed  # a program that shows nothing needs no tables
        from evedrop.cli.report import printed  # the same

        return printed(partial(print_designed, self), WIDTH)


class ShownDesign(_Shown, Design):
    """A design of μ_d."""


class ShownScheduleDesign(_Shown, ScheduleDesign):
    """A design of a μ_d for each slot."""


class ShownPolicyDesign(_Shown, PolicyDesign):
    """A design of when to send."""


class ShownBudgetDesign(_Shown, BudgetDesign):
    """A design of when to encrypt."""


_Kind = TypeVar("_Kind")


def shown_as(kind: type[_Kind], design: Any) -> _Kind:
    """A design as an object of a kind that shows itself."""
    return kind(**vars(design))
