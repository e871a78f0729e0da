"""The tables of a scenario file: what may stand in them, checked, and what it means.

Source: docs/scenario.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from emulator.model.eavesdroppers import STRATEGIES
from emulator.model.links import LOSS_MODELS, loss_of
from emulator.model.links.link import LossModel
from emulator.model.process import Process, mistakes_of
from emulator.model.schemes import SCHEMES
from emulator.network.access import LEGITIMATE
from emulator.scenario.expect import ExpectTable
from emulator.scenario.table import (
    Found,
    Matrix,
    Probability,
    ProcessName,
    Table,
    numbers,
    one_of,
)
from emulator.scenario.words import as_toml, listed

SECRET_BYTES = 32


class ProcessTable(Table):
    """`[process]`: x_{k+1} = A x_k + w_k, w ~ N(0, Q), x_0 ~ N(0, initial_covariance)."""

    A: Annotated[Matrix, Field(examples=[[[1.0, 0.3], [0.5, 1.001]]])]
    Q: Annotated[Matrix, Field(examples=[[[0.001, 0.0], [0.0, 0.001]]])]
    initial_covariance: Annotated[Matrix, Field(examples=[[[1.0, 0.0], [0.0, 1.0]]])]

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Whether the three are a process; what is missing or no matrix at all is left out of the question."""
        found: list[Found] = []
        matrices: dict[str, NDArray[np.float64]] = {}
        for name, field in cls.model_fields.items():
            rows = table.get(name)
            if not numbers(rows) or rows is None:
                continue
            lengths = {len(row) for row in rows}
            if lengths == {len(rows)} and rows:
                matrices[name] = np.array(rows, np.float64)
            else:
                count = "1 row" if len(rows) == 1 else f"{len(rows)} rows"
                shape = f"{count} of {listed([str(n) for n in sorted(lengths)])} numbers" if rows else "no rows"
                found.append(
                    (name, f"has {shape}; expected a square matrix, such as {as_toml((field.examples or [0])[0])}")
                )
        if matrices:
            known = matrices.get("A", next(iter(matrices.values())))
            stand_in = np.eye(len(known))
            all_three = [matrices.get(name, stand_in) for name in cls.model_fields]
            found += [(name, what) for name, what in mistakes_of(*all_three) if name in matrices]
        return found

    @property
    def process(self) -> Process:
        """The process it describes."""
        return Process(np.array(self.A), np.array(self.Q), np.array(self.initial_covariance))


class EncodingTable(Table):
    """`[encoding]`: the scheme, and μ_d for those that mix states and innovations."""

    scheme: Annotated[str, Field(strict=True, examples=["innovation"]), AfterValidator(one_of(SCHEMES))]
    state_probability: Annotated[Probability | None, Field(examples=[0.6])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Whether μ_d is there for a scheme that has it, and for no other."""
        scheme = SCHEMES.get(str(table.get("scheme")))
        given = table.get("state_probability") is not None
        if scheme is not None and scheme.mixes and not given:
            return [("state_probability", "is missing; expected a number from 0 to 1, such as 0.6")]
        if scheme is not None and not scheme.mixes and given:
            what = f"is set, but the scheme {table['scheme']} sends the state always; remove the line"
            return [("state_probability", what)]
        return []

    @property
    def mu_d(self) -> float:
        """μ_d; 1 for a scheme that always sends the state."""
        return 1.0 if self.state_probability is None else self.state_probability


class LinkTable(Table):
    """`link = {…}`: how packets get from the router to one receiver."""

    quality: Annotated[Probability | None, Field(examples=[0.9])] = None
    loss: Annotated[dict[str, Any] | None, Field(examples=[{"model": "gilbert-elliott", "p": 0.05, "r": 0.5}])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """One of the two, and a loss model with all it needs and nothing else."""
        quality, loss = table.get("quality"), table.get("loss")
        if quality is None and loss is None:
            return [("quality", "is missing; expected quality = 0.9, or a loss model")]
        if quality is not None and loss is not None:
            return [("quality", "is there beside loss, of which it is the short form; expected one of them")]
        if not isinstance(loss, Mapping):
            return []
        model = LOSS_MODELS.get(str(loss.get("model")))
        if model is None:
            return [("loss.model", f"is {as_toml(loss.get('model', ''))}; expected {listed(sorted(LOSS_MODELS))}")]
        given = {name: value for name, value in loss.items() if name != "model"}
        found = [
            (f"loss.{name}", f"is missing; expected {name} = {as_toml(example)}")
            for name, example in model.parameters.items()
            if name not in given and name not in model.optional
        ]
        found += [
            (f"loss.{name}", f"is no parameter of {loss['model']}; expected {listed(sorted(model.parameters))}")
            for name in given
            if name not in model.parameters
        ]
        known = {name: value for name, value in given.items() if name in model.parameters}
        return found + [(f"loss.{name}", what) for name, what in model.mistakes(known)]

    @property
    def spec(self) -> dict[str, Any]:
        """What the router is told."""
        return {"model": "bernoulli", "quality": self.quality} if self.loss is None else self.loss

    @property
    def model(self) -> LossModel:
        """The loss model, fresh."""
        return loss_of(self.spec)


LinkField = Annotated[LinkTable, Field(examples=[{"quality": 0.9}])]


class LegitimateTable(Table):
    """`[legitimate]`."""

    link: LinkField


class EavesdropperTable(Table):
    """`[eavesdroppers.NAME]`: a strategy with its parameters, and a link."""

    strategy: Annotated[str, Field(strict=True, examples=["smart"]), AfterValidator(one_of(STRATEGIES))]
    link: LinkField
    use_state: Annotated[Probability | None, Field(examples=[0.8])] = None
    use_innovation: Annotated[Probability | None, Field(examples=[0.2])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Whether the strategy has all its parameters and no others."""
        strategy = STRATEGIES.get(str(table.get("strategy")))
        if strategy is None:
            return []
        found = []
        for name in ("use_state", "use_innovation"):
            wanted, given = name in strategy.parameters, table.get(name) is not None
            if wanted and not given:
                what = f"is missing; the strategy {table['strategy']} needs a number from 0 to 1, such as 0.5"
                found.append((name, what))
            if given and not wanted:
                what = f"is set, but the strategy {table['strategy']} has no such parameter; remove the line"
                found.append((name, what))
        return found

    @property
    def parameters(self) -> dict[str, float]:
        """The strategy's parameters."""
        return {name: getattr(self, name) for name in STRATEGIES[self.strategy].parameters}


class Scenario(Table):
    """One scenario, checked."""

    title: Annotated[str, Field(min_length=1, examples=["Two eavesdroppers beside a planar vehicle"])]
    slots: Annotated[int, Field(ge=1, le=100_000_000, strict=True, examples=[2000])]
    seed: Annotated[int, Field(ge=0, lt=2**256, strict=True, examples=[7])] = 0
    trials: Annotated[int, Field(ge=1, le=1_000_000, strict=True, examples=[1])] = 1
    first_trial: Annotated[int, Field(ge=0, le=2**48, strict=True, examples=[0])] = 0
    record_trials: Annotated[int, Field(ge=1, strict=True, examples=[1])] = 1
    pace: Annotated[float, Field(ge=0.0, le=3600.0, strict=True, examples=[0.02])] = 0.0
    secret_file: Annotated[str | None, Field(examples=["secret.bin"])] = None
    process: ProcessTable
    encoding: Annotated[EncodingTable, Field(examples=[{"scheme": "innovation", "state_probability": 0.6}])]
    legitimate: Annotated[LegitimateTable, Field(examples=[{"link": {"quality": 0.9}}])]
    eavesdroppers: Annotated[
        dict[ProcessName, EavesdropperTable],
        Field(max_length=64, examples=[{"smart": {"strategy": "smart", "link": {"quality": 0.9}}}]),
    ] = Field(default_factory=dict)
    expect: Annotated[
        list[ExpectTable], Field(examples=[[{"figure": "legitimate.mean_squared_error", "below": 0.01}]])
    ] = Field(default_factory=list)
    made_with: Annotated[dict[str, str], Field(exclude=True)] = Field(default_factory=dict)

    @property
    def receivers(self) -> tuple[str, ...]:
        """All receivers, the legitimate one first."""
        return (LEGITIMATE, *self.eavesdroppers)

    @property
    def quality(self) -> dict[str, float]:
        """Receiver → mean probability that a packet reaches it: μ, μ_e."""
        return {name: self.link(name).model.quality for name in self.receivers}

    def link(self, receiver: str) -> LinkTable:
        """A receiver's link."""
        return self.legitimate.link if receiver == LEGITIMATE else self.eavesdroppers[receiver].link
