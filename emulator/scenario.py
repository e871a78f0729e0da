"""The scenario file: its schema, its checks, and what it means. All mistakes are reported at once.

Source: docs/scenario.md.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import tomli_w
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

from emulator.errors import ScenarioError, UsageError
from emulator.model.eavesdroppers import STRATEGIES
from emulator.model.process import Process, mistakes_of
from emulator.model.schemes import SCHEMES
from emulator.network.access import LEGITIMATE, RESERVED

NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}")
SECRET_BYTES = 32
_SHOWN = 60  # characters of a wrong value that a message repeats


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + (" or " if len(names) > 1 else "") + names[-1]


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
            raise _expected(_listed(sorted(names)))
        return value

    return check


def _process_name(name: str) -> str:
    if name in RESERVED:
        raise _expected(f"any name but {_listed(RESERVED)}, which are reserved")
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
                shape = f"{count} of {_listed([str(n) for n in sorted(lengths)])} numbers" if rows else "no rows"
                found.append(
                    (name, f"has {shape}; expected a square matrix, such as {_toml((field.examples or [0])[0])}")
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
    """`[encoding]`: the scheme, and μ_d for those that mix states and innovations."""

    scheme: Annotated[str, Field(strict=True, examples=["innovation"]), AfterValidator(_one_of(SCHEMES))]
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


class LinkTable(_Table):
    """`link = {…}`: how packets get from the router to one receiver."""

    quality: Annotated[Probability, Field(examples=[0.9])]

    @property
    def spec(self) -> dict[str, Any]:
        """What the router is told."""
        return {"model": "bernoulli", "quality": self.quality}


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
    slots: Annotated[int, Field(ge=1, le=2**32, strict=True, examples=[2000])]
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
        """Receiver → probability that a packet reaches it: μ, μ_e."""
        return {name: self.link(name).quality for name in self.receivers}

    def link(self, receiver: str) -> LinkTable:
        """A receiver's link."""
        return self.legitimate.link if receiver == LEGITIMATE else self.eavesdroppers[receiver].link


def shipped() -> dict[str, Path]:
    """The scenarios inside the package: name → file."""
    folder = Path(str(resources.files("scenarios")))
    return {path.stem: path for path in sorted(folder.glob("[a-z]*.toml"))}


def write_new(path: Path) -> None:
    """Write the commented scenario to start from. Raises UsageError if the file is there or cannot be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(Path(str(resources.files("scenarios"))).joinpath("_new.toml").read_text(encoding="utf-8"))
    except FileExistsError as error:
        raise UsageError(f"{path} is there already; give another name") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); give another place") from error


def load(source: str | Path, changes: Mapping[str, Any] | None = None, *, beyond_horizon: bool = False) -> Scenario:
    """The scenario of a shipped name or a file, with changes by dotted key.

    beyond_horizon: allow more slots than float64 can follow exactly, for what does not follow states.

    Raises ScenarioError with every mistake, UsageError if there is no such scenario.
    """
    return parse(read(source), str(source), changes, beyond_horizon=beyond_horizon)


def read(source: str | Path) -> str:
    """The text of a shipped scenario or a file."""
    path = shipped().get(str(source), Path(source))
    try:
        return path.read_text(encoding="utf-8")
    except IsADirectoryError as error:
        inner = path / "scenario.toml"
        if inner.is_file():
            return inner.read_text(encoding="utf-8")
        raise UsageError(f"{source} is a folder without a scenario.toml; give a scenario's name or file") from error
    except OSError as error:
        near = difflib.get_close_matches(str(source), shipped(), 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise UsageError(
            f"no scenario {source} ({error.strerror}); {hint}`evedrop list` shows the shipped ones"
        ) from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{source} is not text in UTF-8 ({error.reason}); a scenario is a TOML file") from error


def parse(
    text: str, source: str, changes: Mapping[str, Any] | None = None, *, beyond_horizon: bool = False
) -> Scenario:
    """The scenario in a TOML text. Raises ScenarioError with every mistake."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(source, [f"not TOML: {error}"]) from error
    for key, value in (changes or {}).items():
        _set(tables, key, value)
    try:
        scenario = Scenario.model_validate(tables)
    except ValidationError as error:
        raise ScenarioError(source, [*_sentences(error), *_across_tables(tables, beyond_horizon)]) from error
    mistakes = _across_tables(tables, beyond_horizon)
    if mistakes:
        raise ScenarioError(source, mistakes)
    return scenario


def _across_tables(tables: Mapping[str, Any], beyond_horizon: bool) -> list[str]:
    """What only shows across tables, asked as far as a faulty file allows it: horizon, trials, figures."""
    found: list[str] = []
    slots, trials, recorded = (tables.get(name, 1) for name in ("slots", "trials", "record_trials"))
    try:
        process = ProcessTable.model_validate(tables.get("process")).process
    except ValidationError:
        process = None
    if process is not None and not beyond_horizon and type(slots) is int and 1 <= slots <= 2**32:
        found += _horizon_mistakes(process, slots)
    if type(trials) is int and type(recorded) is int and recorded > trials:
        found.append(f"record_trials: is {recorded}; expected at most trials, which is {trials}")
    eavesdroppers, expectations = tables.get("eavesdroppers", {}), tables.get("expect", [])
    if isinstance(eavesdroppers, dict) and isinstance(expectations, list):
        available = [f"{receiver}.{figure}" for receiver in (LEGITIMATE, *eavesdroppers) for figure in FIGURES]
        for i, expectation in enumerate(expectations):
            figure = expectation.get("figure") if isinstance(expectation, dict) else None
            if isinstance(figure, str) and figure not in available:
                near = difflib.get_close_matches(figure, available, 1)
                hint = f"; did you mean {near[0]}?" if near else ""
                names = f"RECEIVER ({', '.join((LEGITIMATE, *eavesdroppers))}).FIGURE ({', '.join(FIGURES)})"
                found.append(f"expect.{i}.figure: is {_toml(figure)}; expected {names}{hint}")
    if isinstance(tables.get("secret_file"), str):
        found += _secret_mistakes(tables["secret_file"])
    return found


def _secret_mistakes(file: str) -> list[str]:
    """Why a file cannot hold a secret."""
    try:
        size = len(Path(file).read_bytes())
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        return [f"secret_file: {file} cannot be read ({why}); expected a file of {SECRET_BYTES} or more random bytes"]
    if size < SECRET_BYTES:
        return [f"secret_file: {file} has {size} bytes; expected {SECRET_BYTES} or more, random ones"]
    return []


def _horizon_mistakes(process: Process, slots: int) -> list[str]:
    """Why so many slots are too many, if they are (docs/mathematics.md, horizon)."""
    last = process.horizon(slots)
    if last is None:
        return []
    return [
        f"slots: is {slots}; this process (spectral radius {process.spectral_radius:.4g}) can be followed up to slot "
        f"{last}: beyond it float64 rounds off more than 1 % of the process noise inside a state this large. Ways out: "
        f"slots = {last + 1} or fewer; a smaller initial_covariance or a larger Q; an A with a smaller spectral radius"
    ]


def _set(tables: dict[str, Any], dotted: str, value: Any) -> None:
    """Put a value at a dotted key: names of tables that may be new, and numbers of list entries, the next one included."""
    names = dotted.split(".")
    inner: Any = tables
    for name, after in pairwise(names):
        new: Any = [] if after == "0" else {}
        if isinstance(inner, dict) and name:
            inner = inner.setdefault(name, new)
        elif isinstance(inner, list) and name.isdecimal() and int(name) <= len(inner):
            if int(name) == len(inner):
                inner.append(new)
            inner = inner[int(name)]
        else:
            raise _no_such_key(dotted, name, inner)
    last = names[-1]
    if isinstance(inner, dict) and last:
        inner[last] = value
    elif isinstance(inner, list) and last.isdecimal() and int(last) <= len(inner):
        inner[int(last) : int(last) + 1] = [value]
    else:
        raise _no_such_key(dotted, last, inner)


def _no_such_key(dotted: str, name: str, inner: Any) -> UsageError:
    if isinstance(inner, list):
        return UsageError(f"--set {dotted}: {name} is no entry of a list of {len(inner)}; give 0 to {len(inner)}")
    if isinstance(inner, dict):
        return UsageError(f"--set {dotted}: it has an empty part; give a dotted key such as legitimate.link.quality")
    return UsageError(f"--set {dotted}: {name} is not in a table or list; give the dotted key of a scenario entry")


def value_of(text: str) -> Any:
    """A value on the command line: as TOML, else as a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


_EXPECTED: Mapping[str, str] = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "a string",
    "string_too_short": "a string of at least one character",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "bool_type": "true or false",
    "finite_number": "a finite number",
}


def _toml(value: Any) -> str:
    """A value as a scenario writes it, cut where it is long."""
    if isinstance(value, dict):
        text = "{ " + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + " }" if value else "{}"
    elif isinstance(value, list):
        text = f"[{', '.join(_toml(inner) for inner in value)}]"
    else:
        text = tomli_w.dumps({"v": value}).removeprefix("v = ").strip()
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _sentences(error: ValidationError) -> list[str]:
    """One line for each mistake: path, found, expected, example."""
    lines = []
    for detail in error.errors(include_url=False):
        path = ".".join(str(part) for part in detail["loc"] if part != "[key]")
        if detail["type"] == "mistakes":
            inner: list[Found] = detail["ctx"]["mistakes"]
            lines += [f"{path}.{name}: {what}" if path else f"{name}: {what}" for name, what in inner]
        else:
            lines.append(f"{path}: {_sentence(detail)}")
    return lines


def _sentence(detail: ErrorDetails) -> str:
    kind, found, context = detail["type"], detail["input"], detail.get("ctx", {})
    table, field = _field(detail["loc"])
    name = str(detail["loc"][-1]) if detail["loc"] else ""
    example = f", such as {_toml(field.examples[0])}" if field is not None and field.examples else ""
    if kind == "missing":
        return f"is missing; expected {name}" + (f" = {_toml(field.examples[0])}" if example else "")
    if kind == "extra_forbidden":
        known = [known for known in table.model_fields if known != "made_with"] if table is not None else []
        near = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}"
        return f"is no entry of this table; {hint}"
    if kind == "expected":
        return f"is {_toml(found)}; expected {context['expected']}{example}"
    if kind in {"greater_than_equal", "less_than_equal", "less_than"}:
        words = {"ge": "at least", "le": "at most", "lt": "less than"}
        bound = " and ".join(f"{words[name]} {context[name]}" for name in words if name in context)
        return f"is {_toml(found)}; expected a number {bound}{example}"
    if kind == "too_long":
        return f"has more than {context['max_length']} entries; expected at most so many"
    expected = _EXPECTED.get(kind, detail["msg"])
    return f"is {_toml(found)}; expected {expected}{example}"


def _field(location: Sequence[int | str]) -> tuple[type[BaseModel] | None, Any]:
    """The table an error is in, and the field's description if it is a field."""
    table: type[BaseModel] | None = Scenario
    field = None
    inner: Mapping[str, type[BaseModel]] = {
        "process": ProcessTable,
        "encoding": EncodingTable,
        "legitimate": LegitimateTable,
        "link": LinkTable,
        "eavesdroppers": EavesdropperTable,
        "expect": ExpectTable,
    }
    for i, part in enumerate(location):
        if table is not None and part in table.model_fields:
            field = table.model_fields[str(part)]
            if part in inner and i < len(location) - 1:
                table, field = inner[str(part)], None
        elif i == len(location) - 1:
            field = None
    return table, field
