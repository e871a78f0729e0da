"""Control strategies by their name in a scenario: one file each."""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.controllers.controller import Assignment, Controller
from evedrop.model.controllers.lqr import Lqr
from evedrop.model.controllers.mpc import Mpc

CONTROLLERS: Mapping[str, type[Controller]] = {"lqr": Lqr, "mpc": Mpc}

__all__ = ["CONTROLLERS", "Assignment", "Controller"]
