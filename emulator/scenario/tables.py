"""The tables of a scenario file: what may stand in them, checked, and what it means.

Source: docs/scenario.md.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from emulator.model.eavesdroppers import STRATEGIES
from emulator.model.links import LOSS_MODELS, loss_of
from emulator.model.links.link import LossModel
from emulator.model.process import Process, mistakes_of
from emulator.model.schemes import SCHEMES
from emulator.network.access import LEGITIMATE, RESERVED
from emulator.scenario.words import as_toml, listed

NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}")
SECRET_BYTES = 32


def _expected(what: str) -> PydanticCustomError:
    """The error of one value: the line will say what was found and that this was expected."""
    return PydanticCustomError("expected", "one value", {"expected": what})


def _probability(value: float) -> float:
    if not 0.0 <= value <= 1.0:
        raise _expected("a number from 0 to 1")
    return value


def _one_of(names: Iterable[str]) -> Callable[[str], str]:
    def check(value: str) -> str:
        if value not in names:
            raise _expected(listed(sorted(names)))
        return value

    return check


def _process_name(name: str) -> str:
    if name in RESERVED:
        raise _expected(f"any name but {listed(RESERVED)}, which are reserved")
    if not NAME.fullmatch(name):
        raise _expected("a name of a lower-case letter, then up to 31 of a-z 0-9 _ -")
    return name


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Probability = Annotated[float, Field(strict=True), AfterValidator(_probability)]
ProcessName = Annotated[str, AfterValidator(_process_name)]
Matrix = list[list[Annotated[float, Field(strict=True)]]]
Found = tuple[str, str]
"""A mistake in a table: the entry, and what is wrong with it."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """What only shows when entries are seen together; entries that are wrong by themselves may be in the table."""
        del table
        return []

    @model_validator(mode="wrap")
    @classmethod
    def _all_at_once(cls, found: Any, check: ModelWrapValidatorHandler[Self]) -> Self:
        """Entries by themselves and together, so that one mistake does not hide another."""
        together = cls.mistakes(found) if isinstance(found, Mapping) else []
        mistakes = PydanticCustomError("mistakes", "several", {"mistakes": together})
        try:
            table = check(found)
        except ValidationError as error:
            if not together:
                raise
            lines = [_again(detail) for detail in error.errors(include_url=False)]
            lines.append(InitErrorDetails(type=mistakes, input=found))
            raise ValidationError.from_exception_data(cls.__name__, lines) from None
        if together:
            raise mistakes
        return table


def _again(detail: ErrorDetails) -> InitErrorDetails:
    """An error that was reported, to be reported once more with others."""
    kind, context = detail["type"], detail.get("ctx", {})
    own = PydanticCustomError(kind, detail["msg"], context) if kind in {"expected", "mistakes"} else kind
    return InitErrorDetails(type=own, loc=detail["loc"], input=detail["input"], ctx=context)


def _numbers(rows: Any) -> bool:
    """Whether these are rows of numbers, of any lengths."""
    return isinstance(rows, list) and all(isinstance(row, list) and all(map(_number, row)) for row in rows)


def _number(value: Any) -> bool:
    return isinstance(value, float) or (type(value) is int and abs(value) <= 2**1023)


class ProcessTable(_Table):
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
            if not _numbers(rows) or rows is None:
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


class EncodingTable(_Table):
    """`[encoding]`: the scheme, and beside it the parameters that this scheme has."""

    model_config = ConfigDict(extra="allow")

    scheme: Annotated[str, Field(strict=True, examples=["innovation"]), AfterValidator(_one_of(SCHEMES))]

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Whether the scheme has all its parameters, no others, and each as it must be."""
        scheme = SCHEMES.get(str(table.get("scheme")))
        given = {name: value for name, value in table.items() if name != "scheme"}
        if scheme is None:
            anywhere = {name for one in SCHEMES.values() for name in one.parameters}
            return [(name, "is no parameter of any scheme; remove the line") for name in given if name not in anywhere]
        found = [
            (name, f"is missing; the scheme {table['scheme']} needs it, such as {name} = {as_toml(example)}")
            for name, example in scheme.parameters.items()
            if name not in given
        ]
        known = f"expected {listed(sorted(scheme.parameters))}" if scheme.parameters else "remove the line"
        what = f"is set, but the scheme {table['scheme']} has no such parameter; {known}"
        found += [(name, what) for name in given if name not in scheme.parameters]
        return found + scheme.mistakes({name: value for name, value in given.items() if name in scheme.parameters})

    @property
    def parameters(self) -> dict[str, Any]:
        """The scheme's parameters."""
        return dict(self.model_extra or {})

    @property
    def spec(self) -> dict[str, Any]:
        """What sensor and legitimate estimator are told."""
        return {"scheme": self.scheme, **self.parameters}

    @property
    def mu_d(self) -> float:
        """μ_d; 1 for a scheme that sends nothing but the state."""
        return float(self.parameters.get("state_probability", 1.0))


class LinkTable(_Table):
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


class LegitimateTable(_Table):
    """`[legitimate]`."""

    link: LinkField


class EavesdropperTable(_Table):
    """`[eavesdroppers.NAME]`: a strategy with its parameters, and a link."""

    strategy: Annotated[str, Field(strict=True, examples=["smart"]), AfterValidator(_one_of(STRATEGIES))]
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


class ExpectTable(_Table):
    """`[[expect]]`: what a figure of the summary must be for the run to pass."""

    figure: Annotated[str, Field(examples=["legitimate.mean_squared_error"])]
    below: Annotated[Number | None, Field(examples=[0.01])] = None
    above: Annotated[Number | None, Field(examples=[0.01])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Whether it says something."""
        if table.get("below") is None and table.get("above") is None:
            return [("below", "and above are both missing; expected at least one, such as below = 0.01")]
        return []

    @property
    def text(self) -> str:
        """As a sentence."""
        bounds = [f"below {self.below:g}"] if self.below is not None else []
        bounds += [f"above {self.above:g}"] if self.above is not None else []
        return f"{self.figure} {' and '.join(bounds)}"

    def holds(self, found: float) -> bool:
        """Whether the figure is within the bounds."""
        return (self.below is None or found < self.below) and (self.above is None or found > self.above)


FIGURES = (
    "mean_squared_error",
    "mean_trace_covariance",
    "expected_trace_covariance",
    "received_fraction",
    "used_fraction",
)


class Scenario(_Table):
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
    ] = {}
    expect: Annotated[
        list[ExpectTable], Field(examples=[[{"figure": "legitimate.mean_squared_error", "below": 0.01}]])
    ] = []
    made_with: Annotated[dict[str, str], Field(exclude=True)] = {}

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
