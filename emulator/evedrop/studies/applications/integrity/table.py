"""`[integrity]`: the watermark, the policy with its thresholds, and the attack on the measurements.

Source: docs/scenario.md, integrity.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field

from evedrop.model.checks import is_number
from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.kernels.elementary import semidefinite_factor
from evedrop.model.process import Floats
from evedrop.scenario.table import Found, Matrix, Table, numbers, one_of
from evedrop.scenario.words import as_toml, listed
from evedrop.system.hints import near

MODEL = "model"


class IntegrityTable(Table):
    """`[integrity]`: the policy's parameters are further entries."""

    model_config = ConfigDict(extra="allow")

    policy: Annotated[str, Field(strict=True, examples=["always"]), AfterValidator(one_of(POLICIES))]
    watermark: Annotated[Matrix | None, Field(examples=[[[0.3]]])] = None
    attack: Annotated[dict[str, Any] | None, Field(examples=[{MODEL: "replay", "recorded": 100}])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Mistakes in the policy's parameters, in the covariance of the watermark, and in the attack."""
        return [*_policy_mistakes(table, cls.model_fields), *_watermark_mistakes(table), *_attack_mistakes(table)]

    @property
    def parameters(self) -> dict[str, float]:
        """The policy's parameters."""
        return {name: float(value) for name, value in (self.model_extra or {}).items()}

    @property
    def described_attack(self) -> tuple[str, Mapping[str, Any]] | None:
        """The attack's name and entries; None if nobody attacks."""
        if self.attack is None:
            return None
        return self.attack[MODEL], {name: value for name, value in self.attack.items() if name != MODEL}

    def covariance(self, inputs: int) -> Floats:
        """Σ_e, (m, m), for m inputs; 0 without a watermark."""
        return np.zeros((inputs, inputs)) if self.watermark is None else np.array(self.watermark, np.float64)


def _policy_mistakes(table: Mapping[str, Any], own: Mapping[str, Any]) -> list[Found]:
    policy = POLICIES.get(str(table.get("policy")))
    if policy is None:
        return []
    given = {name: value for name, value in table.items() if name not in own}
    mistakes = [
        (name, f"is missing; the policy {table['policy']} needs it, such as {name} = {as_toml(example)}")
        for name, example in policy.parameters.items()
        if name not in given
    ]
    expected = f"expected {listed(sorted(policy.parameters))}"
    sentence = f"is set, but the policy {table['policy']} has no such parameter; {expected}"
    mistakes += [(name, sentence) for name in given if name not in policy.parameters]
    mistakes += [
        (name, f"is {as_toml(value)}; expected a number, such as {name} = {as_toml(policy.parameters[name])}")
        for name, value in given.items()
        if name in policy.parameters and not is_number(value)
    ]
    return mistakes or policy.mistakes({name: float(value) for name, value in given.items()})


def _watermark_mistakes(table: Mapping[str, Any]) -> list[Found]:
    rows = table.get("watermark")
    if rows is None or not numbers(rows):
        return []
    m = len(rows)
    if m == 0 or any(len(row) != m for row in rows):
        return [("watermark", "is not a square matrix; expected the covariance of the watermark, such as [[0.3]]")]
    covariance = np.array(rows, np.float64)
    if not np.isfinite(covariance).all() or not np.array_equal(covariance, covariance.T):
        return [("watermark", "is not symmetric and finite; expected the covariance of the watermark, such as [[0.3]]")]
    try:
        semidefinite_factor(covariance)
    except ValueError:
        least = float(np.linalg.eigvalsh(covariance)[0])
        return [("watermark", f"has the eigenvalue {least:.3g}, below 0; expected a covariance, such as [[0.3]]")]
    return []


def _attack_mistakes(table: Mapping[str, Any]) -> list[Found]:
    entries = table.get("attack")
    if not isinstance(entries, Mapping):
        return []
    name = entries.get(MODEL)
    attack = SENSOR_ATTACKS.get(str(name))
    choice = f"expected {listed(sorted(SENSOR_ATTACKS))}"
    if attack is None:
        problem = "is missing" if name is None else f"is {as_toml(name)}"
        return [(f"attack.{MODEL}", f"{problem}; {choice}{near(str(name), SENSOR_ATTACKS)}")]
    mistakes = [
        (f"attack.{entry}", f"is missing; the attack {name} needs it, such as {entry} = {as_toml(example)}")
        for entry, example in attack.parameters.items()
        if entry not in entries and entry not in attack.optional
    ]
    for entry, value in entries.items():
        if entry == MODEL:
            continue
        if entry not in attack.parameters:
            expected = f"expected {listed(sorted(attack.parameters))}"
            mistakes.append((f"attack.{entry}", f"is not a parameter of the attack {name}; {expected}"))
            continue
        example = attack.parameters[entry]
        if isinstance(example, list) and not (
            numbers(value) and value and all(np.isfinite(row).all() for row in value)
        ):
            mistakes.append((f"attack.{entry}", f"is {as_toml(value)}; expected a matrix, such as {as_toml(example)}"))
        elif isinstance(example, int) and not (type(value) is int and 1 <= value <= 1_000_000):
            mistakes.append((f"attack.{entry}", f"is {as_toml(value)}; expected a whole number from 1 to 1000000"))
    return mistakes
