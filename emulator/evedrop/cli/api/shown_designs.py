"""Designs that Python and a notebook show as the command prints them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from evedrop.cli.words import WIDTH
from evedrop.model.theory.design import Design
from evedrop.model.theory.schedules import ScheduleDesign
from evedrop.scenario.designs import BudgetDesign, PolicyDesign


@dataclass(frozen=True, repr=False)
class ShownDesign(Design):
    """A design of μ_d."""

    def __repr__(self) -> str:
        from evedrop.cli.design_report import print_design  # a program that shows nothing needs no tables

        return _printed(print_design, self)


@dataclass(frozen=True, repr=False)
class ShownScheduleDesign(ScheduleDesign):
    """A design of a μ_d for each slot."""

    def __repr__(self) -> str:
        from evedrop.cli.design_report import print_schedules  # as above

        return _printed(print_schedules, self)


@dataclass(frozen=True, repr=False)
class ShownPolicyDesign(PolicyDesign):
    """A design of when to send."""

    def __repr__(self) -> str:
        from evedrop.cli.design_report import print_policies  # as above

        return _printed(print_policies, self)


@dataclass(frozen=True, repr=False)
class ShownBudgetDesign(BudgetDesign):
    """A design of when to encrypt."""

    def __repr__(self) -> str:
        from evedrop.cli.design_report import print_budget  # as above

        return _printed(print_budget, self)


_Shown = TypeVar("_Shown")


def shown_as(kind: type[_Shown], design: Any) -> _Shown:
    """A design as an object of a kind that shows itself."""
    return kind(**vars(design))


def _printed(show: Callable[..., None], design: object) -> str:
    from evedrop.cli.report import printed  # as above

    return printed(lambda console: show(design, console), WIDTH)
