"""Classes that break rules: how they are made, and how they are reported."""

from __future__ import annotations

from typing import Any

from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.schemes.plain import Plain, PlainEncoder, PlainEstimator
from evedrop.model.schemes.scheme import NoInnovations, Scheme
from evedrop.scenario.conformance.eavesdroppers import EavesdropperChecks
from evedrop.scenario.conformance.problems import small
from evedrop.scenario.conformance.rules import RuleVerdict, how_broken
from evedrop.scenario.conformance.schemes import SchemeChecks


def plain_with(encoder: Any = PlainEncoder, estimator: Any = PlainEstimator, **entries: Any) -> type[Scheme]:
    """The plain scheme with one side replaced."""

    def shared(self: Plain, keys: Any, batch: Any) -> NoInnovations:
        del keys
        return NoInnovations(self.process, batch.trials, encoder, lambda: estimator(self.process, batch.trials))

    return type("Mine", (Plain,), {"shared": shared, **entries})


def broken(verdicts: list[RuleVerdict]) -> dict[str, str]:
    """Rule → how it is broken, of those that are."""
    return {verdict.rule: verdict.broken for verdict in verdicts if verdict.broken is not None}


def checks_of(kind: type[Eavesdropper], name: str = "naive") -> EavesdropperChecks:
    """An eavesdropper of a class, with the examples of its parameters, that hears the paper's scheme."""
    return EavesdropperChecks(name, kind, dict(kind.parameters), Innovation, {"state_probability": 0.6})


def blocks_of_scheme(kind: type[Scheme]) -> str | None:
    """How a scheme breaks the rule for many slots at once on the first problem that shows it; its single slots are right."""
    return _first(SchemeChecks(kind, kind.parameters))


def blocks_of_eavesdropper(kind: type[Eavesdropper]) -> str | None:
    """The same of an eavesdropper."""
    return _first(checks_of(kind))


def _first(checks: SchemeChecks | EavesdropperChecks) -> str | None:
    for problem in small():
        assert how_broken(checks.shapes, problem) is None
        broken = how_broken(checks.blocks, problem)
        if broken is not None:
            return broken
    return None
