"""The scenario as a table: its entries, checks and meaning. Tables with few entries, such as `[encoding]`, are here, too.

Editors and type checkers know only keywords that are written down, so the keywords of `Scenario(...)`, the names of its fields,
stand here again, with the types of the values before the checks.

Source: docs/scenario.md; docs/python.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypedDict, Unpack

from pydantic import AfterValidator, ConfigDict, Field, PlainValidator, SerializeAsAny, model_validator
from pydantic_core import PydanticCustomError, PydanticKnownError

from evedrop.errors import NotRegistered, UsageError
from evedrop.model.acknowledgements import FORGING
from evedrop.model.controllers import Assignment
from evedrop.model.eavesdroppers import REMOTE_CALLS, STRATEGIES
from evedrop.model.energy import EnergyModel
from evedrop.model.plant import Plant
from evedrop.model.registry import asked
from evedrop.model.schedule import StateProbability, mean_of
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.link import LinkSchedule
from evedrop.model.streams import LAST_TRIAL, MOST_SLOTS
from evedrop.names import CONTROLLER, LEGITIMATE
from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.arguments import CHANGES, table_argument
from evedrop.scenario.events.table import AnyEvent, event_table
from evedrop.scenario.expect import ExpectTable
from evedrop.scenario.nemesis import NemesisTable
from evedrop.scenario.plant import ControllerTable, PlantTable, assignment_of, plant_of
from evedrop.scenario.plugins import elsewhere, look_in, trusted_in
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.receivers import (
    AcknowledgementsTable,
    EavesdropperTable,
    LegitimateTable,
    LinkTable,
    WireTable,
    changed_link,
)
from evedrop.scenario.table import (
    MOST_EAVESDROPPERS,
    Mistake,
    ProcessName,
    Table,
    parameter_mistakes,
    refuse,
    registered,
)
from evedrop.scenario.timeline import Timeline
from evedrop.scenario.words import dotted


class EncodingTable(Table):
    """`[encoding]`: the scheme and its parameters."""

    model_config = ConfigDict(extra="allow")

    scheme: Annotated[str, Field(strict=True, examples=["innovation"]), AfterValidator(registered(SCHEMES))]
    """The scheme, which decides what a packet contains. Its parameters are further entries of this table."""

    @classmethod
    def all_entries(cls) -> list[str]:
        """With the parameters of all built-in schemes."""
        return [*cls.entries(), *(name for scheme in SCHEMES.values() for name in scheme.parameters)]

    def mistakes(self) -> Iterator[Mistake]:
        """Missing, unknown and wrong parameters of the scheme."""
        scheme, given = SCHEMES[self.scheme], self.parameters
        yield from parameter_mistakes("scheme", self.scheme, scheme, given)
        yield from asked(scheme, {name: value for name, value in given.items() if name in scheme.parameters})

    @property
    def parameters(self) -> dict[str, Any]:
        """The scheme's parameters."""
        return dict(self.model_extra or {})

    @property
    def spec(self) -> dict[str, Any]:
        """The scheme's description for sensor and legitimate estimator."""
        return {"scheme": self.scheme, **self.parameters}

    @property
    def mu_d(self) -> float:
        """μ_d, or its mean over slots k ≥ 1; 1 for a scheme without `state_probability`."""
        return mean_of(self._mu_d)

    @property
    def state_probabilities(self) -> tuple[float, ...] | None:
        """μ_d(k) for every slot; None if it is the same in all slots."""
        return self._mu_d if isinstance(self._mu_d, tuple) else None

    @property
    def _mu_d(self) -> StateProbability:
        given = self.parameters.get("state_probability", 1.0)
        return tuple(map(float, given)) if isinstance(given, list) else float(given)


Entries = Mapping[str, Any]
"""A table, as a dict."""


class ScenarioEntries(TypedDict, total=False):
    """The entries of a scenario as Python values, for editors and type checkers; docs/scenario.md describes each."""

    title: str
    slots: int
    seed: int
    trials: int
    first_trial: int
    record_trials: int
    shards: int
    pace: float
    longest_outage: float
    slot_seconds: float | None
    secret_file: str | Path | None
    modules: str | Path | None
    process: Entries
    encoding: Entries
    legitimate: Entries
    eavesdroppers: Mapping[str, Entries]
    plant: Entries | None
    controller: Entries | None
    acknowledgements: Entries | None
    energy: Entries | None
    wire: Entries | None
    network: Entries | None
    event: Sequence[Entries]
    nemesis: Entries | None
    expect: Sequence[Entries]


_LOADS = 'Scenario.load("vehicle") reads a built-in scenario, a file or a results folder'
NUMBERS = {"plant": {"disturbance_values"}, "process": {"state_values"}}
"""Entries that may be hundreds of thousands of numbers, and name no class."""
_Energy = Annotated[float, Field(strict=True, ge=0.0, le=1e12)]


class EnergyTable(Table):
    """`[energy]`: what packets cost the sensor, in any unit; it does not change the trials."""

    packet: Annotated[_Energy, Field(examples=[1.0])] = EnergyModel.packet
    """Energy of sending a packet, whatever its size."""
    bit: Annotated[_Energy, Field(examples=[0.01])] = EnergyModel.bit
    """Energy of each bit of payload and header, in addition."""
    encryption: Annotated[_Energy, Field(examples=[0.5])] = EnergyModel.encryption
    """Energy of encrypting a packet, in addition, for schemes that encrypt."""


class NetworkTable(Table):
    """`[network]`: how the processes of a live run are connected; it does not change the trials."""

    routers: Annotated[int, Field(ge=1, le=2, strict=True, examples=[2])] = 1
    """With 2, the sensor connects to the router, and all other processes to a second one, the relay, which is linked to it."""


def _folder(path: str) -> str:
    if not Path(path).is_dir():
        ending = ", which is not a folder; expected the folder that contains the modules"
        raise PydanticCustomError("expected", "one value", {"ending": ending})
    return path


def _application_table(named: tuple[str, Any]) -> Table:
    """The table of an application; named: its name and its entries."""
    name, entries = named
    try:
        application = APPLICATIONS[name]
    except NotRegistered as error:
        if name in APPLICATIONS.names:
            refuse([("", f"is a table{error.why}")])
        raise PydanticKnownError("extra_forbidden") from error
    return application.table.model_validate(entries)


@dataclass(frozen=True)
class Builders:
    """The functions of `evedrop.scenario.loading` that check whole scenarios, which compare the tables, too."""

    build: Callable[[Mapping[str, Any]], Scenario]
    """Takes entries."""
    load: Callable[[str | Path, Mapping[str, Any]], Scenario]
    """Takes a name or file, and changes."""
    change: Callable[[Scenario, Mapping[str, Any]], Scenario]
    """Takes a scenario, and changes."""


class Scenario(Table):
    """A scenario: every entry of docs/scenario.md as an argument; tables are dicts, matrices lists or numpy arrays.

    A class in the place of a name is a scheme, an eavesdropper, a loss model or a delay model of your own.

    `Scenario.read` makes one whose tables are valid by themselves; `evedrop.scenario.loading`, which
    also compares the tables, uses it.

    >>> Scenario(
    ...     title="One eavesdropper",
    ...     slots=500,
    ...     process={"A": [[1.0]], "Q": [[0.1]], "initial_covariance": [[1.0]]},
    ...     encoding={"scheme": "innovation", "state_probability": 0.4},
    ...     legitimate={"link": {"quality": 0.9}},
    ...     eavesdroppers={"antenna": {"strategy": "smart", "link": {"quality": 0.97}}},
    ... )  # doctest: +SKIP
    """

    builders: ClassVar[Builders | None] = None
    """Set by `evedrop.scenario.loading` when it is imported."""

    title: Annotated[str, Field(min_length=1, max_length=200, examples=["Two eavesdroppers near a planar vehicle"])]
    """One line, for tables, reports and the view."""
    slots: Annotated[int, Field(ge=1, le=MOST_SLOTS, strict=True, examples=[2000])]
    """The number of discrete time steps, k = 0 … slots − 1."""
    seed: Annotated[int, Field(ge=0, lt=2**256, strict=True, examples=[7])] = 0
    """The seed of all random numbers: the same seed gives the same digests."""
    trials: Annotated[int, Field(ge=1, le=1_000_000, strict=True, examples=[1])] = 1
    """The number of independent repetitions, computed in one batch."""
    first_trial: Annotated[int, Field(ge=0, le=LAST_TRIAL, strict=True, examples=[0])] = 0
    """The number of the first trial. Trial 17 is the same alone or among a thousand."""
    record_trials: Annotated[int, Field(ge=1, strict=True, examples=[1])] = 1
    """How many trials, from the first on, are recorded slot by slot. At most `trials`."""
    shards: Annotated[int, Field(ge=1, le=64, strict=True, examples=[2])] = 1
    """How many sets of processes share the trials of a live run. At most `trials`; the results do not change."""
    pace: Annotated[float, Field(ge=0.0, le=3600.0, strict=True, examples=[0.02])] = 0.0
    """Seconds per slot of a live run; 0 is as fast as possible."""
    longest_outage: Annotated[float, Field(ge=0.0, le=86400.0, strict=True, examples=[30.0])] = 30.0
    """Seconds for which a process of a live run may be cut off, or silent, before the run is given up."""
    slot_seconds: Annotated[float | None, Field(gt=0.0, le=1e6, strict=True, examples=[0.02])] = None
    """The duration of a slot, for delays in seconds and for time axes. It does not pace the run."""
    secret_file: Annotated[str | None, Field(examples=["secret.bin"])] = None
    """A file of at least 32 random bytes, from which the secret of sensor and estimator is derived; otherwise `seed` is used."""
    modules: Annotated[Annotated[str, AfterValidator(_folder)] | None, Field(strict=True, examples=["."])] = None
    """The folder of your own classes, relative to the scenario's folder, which is the default."""
    process: Annotated[ProcessTable, Field(examples=[{"A": [[1.0]], "Q": [[0.001]], "initial_covariance": [[1.0]]}])]
    """The process model, which everybody knows, and where the true states come from."""
    encoding: Annotated[EncodingTable, Field(examples=[{"scheme": "innovation", "state_probability": 0.6}])]
    """The transmission scheme and its parameters."""
    legitimate: Annotated[LegitimateTable, Field(examples=[{"link": {"quality": 0.9}}])]
    """The legitimate estimator and its link."""
    eavesdroppers: Annotated[
        dict[ProcessName, EavesdropperTable],
        Field(max_length=MOST_EAVESDROPPERS, examples=[{"smart": {"strategy": "smart", "link": {"quality": 0.9}}}]),
    ] = Field(default_factory=dict)
    """The eavesdroppers, each by a name that you choose."""
    plant: Annotated[PlantTable | None, Field(examples=[{"noise": [[1e-6, 0.0], [0.0, 1e-6]]}])] = None
    """Inputs, disturbances and measurements, if more than the process moves or observes the true states."""
    controller: Annotated[ControllerTable | None, Field(examples=[{"strategy": "lqr"}])] = None
    """The controller that decides the inputs of the plant. Required if there are inputs."""
    acknowledgements: Annotated[AcknowledgementsTable | None, Field(examples=[{"link": {"quality": 0.9}}])] = None
    """The channel from the estimator back to the sensor, for schemes that need acknowledgements, and an attack on it."""
    energy: Annotated[EnergyTable | None, Field(examples=[{"packet": 1.0, "encryption": 0.5}])] = None
    """What packets cost the sensor. It does not change the trials."""
    wire: Annotated[
        WireTable | None, Field(examples=[{"seed": 7, "key": "robot/pose", "links": {"legitimate": "radio"}}])
    ] = None
    """Which links draw the random numbers of a wire, so that packets have the fates of its messages."""
    network: Annotated[NetworkTable | None, Field(examples=[{"routers": 2}])] = None
    """How the processes of a live run are connected. It does not change the trials."""
    event: Annotated[list[AnyEvent], Field(max_length=10_000, examples=[[{"at": 400, "cut": "legitimate"}]])] = Field(
        default_factory=list
    )
    """What happens in which slot: faults, attacks and changes of links."""
    nemesis: Annotated[
        NemesisTable | None, Field(examples=[{"faults": ["kill", "cut"], "every": 200, "lasting": 50}])
    ] = None
    """Random faults, which become events before the run."""
    expect: Annotated[
        list[ExpectTable], Field(examples=[[{"metric": "legitimate.mean_squared_error", "below": 0.01}]])
    ] = Field(default_factory=list)
    """Conditions that the run must meet. If one fails, the exit status is 1."""
    made_with: Annotated[dict[str, str], Field(exclude=True)] = Field(default_factory=dict)
    """The versions that made a results folder. Ignored when it is read."""
    __pydantic_extra__: dict[str, Annotated[SerializeAsAny[Table], PlainValidator(_application_table)]]

    model_config = ConfigDict(extra="allow")

    def __init__(self, entries: Mapping[str, Any] | None = None, /, **others: Unpack[ScenarioEntries]) -> None:
        """Check the entries as those of a file are checked; entries: further ones, such as the table of an application.

        Raises ScenarioError with every mistake: its key, what was found, what was expected.
        """
        given = table_argument("entries", entries, f"a dict of entries; {_LOADS}")
        self.__setstate__(_builders().build({**given, **others}).__getstate__())

    # Pydantic calls a model's own constructor for every table that it validates, unless the constructor has this mark.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @classmethod
    def load(cls, source: str | Path, changes: Mapping[str, Any] | None = None, /, **others: Any) -> Scenario:
        """A built-in scenario by its name, or one of a file or a results folder, with changes.

        changes: entries by dotted key, such as `{"eavesdroppers.smart.link.quality": 0.8}`; as keywords they have `__` for the
        dot, such as `legitimate__link__quality=0.8`.

        Raises ScenarioError with every mistake, UsageError if there is no such scenario.
        """
        return _builders().load(source, {**table_argument("changes", changes, CHANGES), **dotted(others)})

    def replace(self, changes: Mapping[str, Any] | None = None, /, **others: Any) -> Scenario:
        """The same scenario with changes, given as for `load`; None removes an entry.

        The faults that a nemesis drew, and matrices that were `"filter"`, stay as they are; `load` with the changes makes new
        ones.

        Raises ScenarioError with every mistake.
        """
        return _builders().change(self, {**table_argument("changes", changes, CHANGES), **dotted(others)})

    def to_toml(self) -> str:
        """The scenario as the text of a file; loading the file gives an equal scenario, which gives equal digests."""
        from evedrop.scenario.words import toml_text  # noqa: PLC0415 - a live run does not wait for it

        made_with = {"made_with": self.made_with} if self.made_with else {}
        return toml_text({**self.as_tables(), **made_with})

    def as_tables(self) -> dict[str, Any]:
        """The tables of its file, with the entries that were given."""
        return self.model_dump(mode="json", exclude_none=True, exclude_unset=True)

    def __repr__(self) -> str:
        from evedrop.scenario.overview import overview  # noqa: PLC0415 - a live run does not need it

        return overview({**self.as_tables(), "seed": self.seed}, len(self.process.A))

    def __str__(self) -> str:
        return repr(self)

    @classmethod
    def read(cls, tables: Mapping[str, Any]) -> Self:
        """The scenario that tables describe. From now on modules are found in its folder of modules. Raises ValidationError.

        This process imports such modules only for schemes and links: see `evedrop.model.eavesdroppers` for eavesdroppers.
        """
        folder = tables.get("modules")
        if isinstance(folder, str) and Path(folder).is_dir():
            REMOTE_CALLS.folder = str(Path(folder).absolute())
            if any(trusted_in(tables)):
                look_in(REMOTE_CALLS.folder)
        return cls.model_validate(tables)

    @classmethod
    def entries(cls) -> list[str]:
        """The names of its entries, those of applications included."""
        return [name for name in super().entries() if name != "made_with"] + APPLICATIONS.names

    @classmethod
    def inner(cls, entry: str) -> type[Table] | None:
        """As in `Table`; knows the tables of applications, and that of events of all kinds, too."""
        if entry == "event":
            return event_table()
        if entry not in cls.model_fields and entry in APPLICATIONS:
            return APPLICATIONS[entry].table
        return super().inner(entry)

    def mistakes(self) -> Iterator[Mistake]:
        """Modules that this process would find elsewhere: each process looks, as it may be on another host."""
        if self.modules is not None:
            tables = self.model_dump(exclude_unset=True, exclude=NUMBERS)
            yield from (("modules", sentence) for sentence in elsewhere(str(Path(self.modules).absolute()), tables))

    @property
    def applications(self) -> Mapping[str, Table]:
        """Application → its table, for those that the scenario uses."""
        return self.model_extra or {}

    @model_validator(mode="before")
    @classmethod
    def _with_names(cls, entries: Any) -> Any:
        """Give each table that is not a field its name, which says whose it is."""
        if not isinstance(entries, Mapping):
            return entries
        return {name: value if name in cls.model_fields else (name, value) for name, value in entries.items()}

    @property
    def forges_acknowledgements(self) -> bool:
        """Whether an attack makes the sensor believe in acknowledgements that nobody has sent."""
        return self.acknowledgements is not None and self.acknowledgements.attack in FORGING

    @property
    def scheme(self) -> type[Scheme]:
        """The scheme's class."""
        return SCHEMES[self.encoding.scheme]

    def make_scheme(self) -> Scheme:
        """The scheme of `[encoding]` for this process."""
        return scheme_of(self.process.process, self.encoding.spec)

    @property
    def links(self) -> dict[str, LinkTable]:
        """Receiver → its link, without receivers whose links are pooled."""
        tables: dict[str, LegitimateTable | EavesdropperTable] = {LEGITIMATE: self.legitimate, **self.eavesdroppers}
        return {name: table.link for name, table in tables.items() if table.link is not None}

    @property
    def relayed(self) -> bool:
        """Whether there are two routers; the second is a relay."""
        return self.network is not None and self.network.routers > 1

    @property
    def receivers(self) -> tuple[str, ...]:
        """All receivers, the legitimate estimator first."""
        return (LEGITIMATE, *self.eavesdroppers)

    @property
    def of_model(self) -> bool:
        """Whether the process is only a model: a plant, a recording or a program moves the true states."""
        return self.plant is not None or self.process.given

    @property
    def driven(self) -> Plant | None:
        """The plant that drives the true states; None if the process alone does."""
        return None if self.plant is None else plant_of(self.plant, self.process.around)

    @property
    def measures(self) -> bool:
        """Whether the sensor measures and sends the estimate of its filter: then errors are against this estimate."""
        return self.plant is not None and self.plant.output_matrix is not None

    @property
    def assignment(self) -> Assignment | None:
        """The controller's assignment; None without a controller."""
        if self.driven is None or self.controller is None:
            return None
        return assignment_of(self.controller, self.process.process, self.driven, self.slot_seconds or 1.0)

    @property
    def digested(self) -> tuple[str, ...]:
        """The processes that have a digest: all receivers, and the controller if there is one."""
        return self.receivers if self.controller is None else (*self.receivers, CONTROLLER)

    @property
    def energy_model(self) -> EnergyModel:
        """What packets cost the sensor."""
        return EnergyModel() if self.energy is None else EnergyModel(**self.energy.model_dump())

    @property
    def quality(self) -> dict[str, float]:
        """Receiver → mean probability that a packet reaches it: μ, μ_e."""
        return {name: self.link(name).model.quality for name in self.receivers}

    @property
    def leaks(self) -> dict[str, int]:
        """Eavesdropper → the slot whose true state is betrayed to it, for eavesdroppers to which one is."""
        slots = {
            name: STRATEGIES[table.strategy].betrayed(table.parameters) for name, table in self.eavesdroppers.items()
        }
        return {name: slot for name, slot in slots.items() if slot is not None}

    def link(self, receiver: str) -> LinkTable:
        """A receiver's link, or its pooled links as one."""
        return self.legitimate.link if receiver == LEGITIMATE else self.eavesdroppers[receiver].pool

    def link_path(self, receiver: str) -> str:
        """The dotted key of a receiver's link."""
        return f"{LEGITIMATE}.link" if receiver == LEGITIMATE else f"eavesdroppers.{receiver}.link"

    def window(self, receiver: str) -> int:
        """The number of slots by which a packet may be late for a receiver."""
        return (self.legitimate if receiver == LEGITIMATE else self.eavesdroppers[receiver]).window

    @cached_property
    def timeline(self) -> Timeline:
        """The order of events and their effects."""
        return Timeline.of(self.event, self.receivers, self._changed_settings)

    def _changed_settings(self, receiver: str, changes: Mapping[str, Any]) -> dict[str, Any]:
        """A link's settings with some entries changed; `changes` includes those of earlier events."""
        link = self.link(receiver)
        # Without changes it is as in the scenario: pooled links are no link that a file could describe.
        return (changed_link(link, changes) if changes else link).settings(self.slot_seconds)

    def schedule(self, receiver: str) -> LinkSchedule:
        """The schedule of a receiver's link: its settings, its changes and the receiver's outages, all known in advance."""
        link = self.link(receiver)
        return LinkSchedule(
            link.settings(self.slot_seconds),
            self.window(receiver),
            self.timeline.changes[receiver],
            self.timeline.outages[receiver],
            None if link.correlation is None else (link.correlation.to, link.correlation.strength),
        )

    def outage_bounds(self, receiver: str) -> list[int]:
        """The slots in which a receiver goes away or comes back: each begins a new block of its digest. None for a controller."""
        if receiver == CONTROLLER:
            return []
        return sorted({slot for outage in self.timeline.outages[receiver] for slot in (outage.start, outage.stop)})


def _builders() -> Builders:
    if Scenario.builders is None:
        raise UsageError("this class only checks single tables; give `from evedrop import Scenario` instead")
    return Scenario.builders
