"""The tables of a scenario file: what may stand in them, checked, and what it means.

Source: docs/scenario.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field

from emulator.model.acknowledgements import ATTACKS
from emulator.model.delays import DELAY_MODELS
from emulator.model.eavesdroppers import READERS, STRATEGIES
from emulator.model.link import Course
from emulator.model.links import LOSS_MODELS, loss_of
from emulator.model.links.link import LossModel
from emulator.model.process import Process, mistakes_of
from emulator.model.schemes import SCHEMES
from emulator.network.access import LEGITIMATE
from emulator.scenario.events import EventTable
from emulator.scenario.expect import ExpectTable
from emulator.scenario.table import (
    Found,
    Matrix,
    Probability,
    ProcessName,
    Table,
    model_mistakes,
    numbers,
    one_of,
)
from emulator.scenario.timeline import Timeline
from emulator.scenario.words import as_toml, listed

SECRET_BYTES = 32
_QUEUE = 100  # packets that wait before a link of limited rate, if the scenario does not say


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
    """`[encoding]`: the scheme, and beside it the parameters that this scheme has."""

    model_config = ConfigDict(extra="allow")

    scheme: Annotated[str, Field(strict=True, examples=["innovation"]), AfterValidator(one_of(SCHEMES))]

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


class CorrelationTable(Table):
    """`correlation = {…}`: whose losses a link's are tied to, and how strongly."""

    to: Annotated[str, Field(strict=True, alias="with", examples=["legitimate"])]
    strength: Annotated[Probability, Field(examples=[0.5])]


class LinkTable(Table):
    """`link = {…}`: how packets get from the router to one receiver."""

    quality: Annotated[Probability | None, Field(examples=[0.9])] = None
    loss: Annotated[dict[str, Any] | None, Field(examples=[{"model": "gilbert-elliott", "p": 0.05, "r": 0.5}])] = None
    correlation: Annotated[CorrelationTable | None, Field(examples=[{"with": "legitimate", "strength": 0.5}])] = None
    delay: Annotated[dict[str, Any] | None, Field(examples=[{"model": "constant", "value": 2.0}])] = None
    reorder: Annotated[Probability, Field(examples=[0.1])] = 0.0
    duplicate: Annotated[Probability, Field(examples=[0.05])] = 0.0
    corrupt: Annotated[Probability, Field(examples=[0.01])] = 0.0
    rate: Annotated[float | None, Field(strict=True, gt=0.0, le=1e6, examples=[0.9])] = None
    queue: Annotated[int | None, Field(strict=True, ge=0, le=1_000_000, examples=[100])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """One of quality and loss, and models with all they need and nothing else."""
        found: list[Found] = []
        if table.get("quality") is None and table.get("loss") is None:
            found.append(("quality", "is missing; expected quality = 0.9, or a loss model"))
        elif table.get("quality") is not None and table.get("loss") is not None:
            found.append(("quality", "is there beside loss, of which it is the short form; expected one of them"))
        found += model_mistakes("loss", table.get("loss"), LOSS_MODELS)
        delay = table.get("delay")
        if isinstance(delay, Mapping):
            found += model_mistakes("delay", {name: delay[name] for name in delay if name != "unit"}, DELAY_MODELS)
            if delay.get("unit", "slots") not in ("slots", "seconds"):
                found.append(("delay.unit", f'is {as_toml(delay["unit"])}; expected "slots" or "seconds"'))
        elif table.get("reorder"):
            found.append(
                ("reorder", "is there without a delay, so that nothing can overtake; expected a delay beside it")
            )
        if table.get("queue") is not None and table.get("rate") is None:
            found.append(("queue", "is there without a rate, so that nothing queues; expected a rate beside it"))
        return found

    @classmethod
    def pooled(cls, links: list[LinkTable]) -> LinkTable:
        """Several links that end at one receiver, as one: it hears what any of them delivers."""
        return cls.model_construct(loss={"model": "pooled", "links": [link.loss_spec for link in links]})

    @property
    def loss_spec(self) -> dict[str, Any]:
        """Its loss model and parameters."""
        return {"model": "bernoulli", "quality": self.quality} if self.loss is None else self.loss

    @property
    def model(self) -> LossModel:
        """The loss model, fresh."""
        return loss_of(self.loss_spec)

    @property
    def in_seconds(self) -> bool:
        """Whether its delays are in seconds."""
        return self.delay is not None and self.delay.get("unit") == "seconds"

    def settings(self, slot_seconds: float | None) -> dict[str, Any]:
        """As `Course.settings`, delays in slots."""
        made: dict[str, Any] = {"loss": self.loss_spec}
        made |= {name: value for name in ("reorder", "duplicate", "corrupt") if (value := getattr(self, name))}
        if self.rate is not None:
            made |= {"rate": self.rate, "queue": _QUEUE if self.queue is None else self.queue}
        if self.delay is not None:
            delay = {name: value for name, value in self.delay.items() if name != "unit"}
            if self.in_seconds and slot_seconds:
                for name in DELAY_MODELS[delay["model"]].lengths:
                    value = delay[name]
                    delay[name] = (
                        [one / slot_seconds for one in value] if isinstance(value, list) else value / slot_seconds
                    )
            made["delay"] = delay
        return made


LinkField = Annotated[LinkTable, Field(examples=[{"quality": 0.9}])]
WindowField = Annotated[int, Field(strict=True, ge=0, le=10_000, examples=[8])]


class LegitimateTable(Table):
    """`[legitimate]`."""

    link: LinkField
    window: WindowField = 0


class EavesdropperTable(Table):
    """`[eavesdroppers.NAME]`: a strategy with its parameters, and a link, or several."""

    strategy: Annotated[str, Field(strict=True, examples=["smart"]), AfterValidator(one_of(STRATEGIES))]
    link: Annotated[LinkTable | None, Field(examples=[{"quality": 0.9}])] = None
    links: Annotated[
        list[LinkTable] | None, Field(min_length=2, max_length=16, examples=[[{"quality": 0.6}, {"quality": 0.5}]])
    ] = None
    reads_as: Annotated[
        Annotated[str, Field(strict=True), AfterValidator(one_of(READERS))] | None, Field(examples=["smart"])
    ] = None
    learns_at: Annotated[int | None, Field(ge=0, strict=True, examples=[40])] = None
    window: WindowField = 0
    use_state: Annotated[Probability | None, Field(examples=[0.8])] = None
    use_innovation: Annotated[Probability | None, Field(examples=[0.2])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Whether the strategy has all its entries and no others."""
        strategy = STRATEGIES.get(str(table.get("strategy")))
        example = as_toml((cls.model_fields["link"].examples or [0])[0])
        if strategy is None:
            lost = table.get("link") is None and table.get("links") is None
            return [("link", f"is missing; expected link = {example}")] if lost else []
        wanted = {"links" if strategy.pools_links else "link", *strategy.parameters}
        reader = READERS.get(str(table.get("reads_as"))) if "reads_as" in wanted else None
        wanted |= set(reader.parameters if reader is not None else ())
        found = []
        for name, field in cls.model_fields.items():
            given = table.get(name) is not None
            if name in wanted and not given:
                of = "" if name == "link" else f"the strategy {table['strategy']} needs it; "
                found.append((name, f"is missing; {of}expected {name} = {as_toml((field.examples or [0])[0])}"))
            if given and name not in {"strategy", "window", *wanted}:
                instead = "; its entry is links" if name == "link" else ""
                what = f"is set, but the strategy {table['strategy']} has no such parameter{instead}; remove the line"
                found.append((name, what))
        for i, link in enumerate(table.get("links") or []) if isinstance(table.get("links"), list) else ():
            entries = {name for name, value in link.items() if value} if isinstance(link, Mapping) else set()
            more = sorted(entries - {"quality", "loss"})
            if more:
                found.append(
                    (f"links.{i}", f"has {listed(more)}; links that are pooled have a quality or a loss alone")
                )
        return found

    @property
    def parameters(self) -> dict[str, Any]:
        """The strategy's parameters, and those of the one it reads as."""
        names = STRATEGIES[self.strategy].parameters
        if self.reads_as is not None:
            names += READERS[self.reads_as].parameters
        return {name: getattr(self, name) for name in names}

    @property
    def pool(self) -> LinkTable:
        """Its link, or its links as one."""
        return LinkTable.pooled(self.links or []) if self.link is None else self.link


class WayBackTable(Table):
    """`link = {…}` of the acknowledgements: they are lost, each by itself, or arrive at once."""

    quality: Annotated[Probability, Field(examples=[0.9])]


class AcknowledgementsTable(Table):
    """`[acknowledgements]`: their way back to the sensor, for schemes that need them, and an attack on it."""

    link: Annotated[WayBackTable, Field(examples=[{"quality": 0.9}])]
    attack: Annotated[str, Field(strict=True, examples=["critical"]), AfterValidator(one_of(ATTACKS))] = "none"
    jammer: Annotated[str | None, Field(strict=True, examples=["smart"])] = None
    false_alarms: Annotated[float, Field(strict=True, ge=10.0, le=1e9, examples=[1e4])] = 1e4

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Who blocks critical acknowledgements has a link of its own; no other attack asks for one."""
        attack, jammer = table.get("attack", "none"), table.get("jammer")
        if attack == "critical" and jammer is None:
            return [
                ("jammer", "is missing; the attack critical needs the eavesdropper that blocks what it missed itself")
            ]
        if attack != "critical" and jammer is not None:
            return [
                (
                    "jammer",
                    f"is set, but the attack {as_toml(attack)} does not depend on what it hears; remove the line",
                )
            ]
        return []


class Scenario(Table):
    """One scenario, checked."""

    title: Annotated[str, Field(min_length=1, examples=["Two eavesdroppers beside a planar vehicle"])]
    slots: Annotated[int, Field(ge=1, le=100_000_000, strict=True, examples=[2000])]
    seed: Annotated[int, Field(ge=0, lt=2**256, strict=True, examples=[7])] = 0
    trials: Annotated[int, Field(ge=1, le=1_000_000, strict=True, examples=[1])] = 1
    first_trial: Annotated[int, Field(ge=0, le=2**48, strict=True, examples=[0])] = 0
    record_trials: Annotated[int, Field(ge=1, strict=True, examples=[1])] = 1
    pace: Annotated[float, Field(ge=0.0, le=3600.0, strict=True, examples=[0.02])] = 0.0
    longest_outage: Annotated[float, Field(ge=0.0, le=86400.0, strict=True, examples=[30.0])] = 30.0
    slot_seconds: Annotated[float | None, Field(gt=0.0, le=1e6, strict=True, examples=[0.02])] = None
    secret_file: Annotated[str | None, Field(examples=["secret.bin"])] = None
    process: ProcessTable
    encoding: Annotated[EncodingTable, Field(examples=[{"scheme": "innovation", "state_probability": 0.6}])]
    legitimate: Annotated[LegitimateTable, Field(examples=[{"link": {"quality": 0.9}}])]
    eavesdroppers: Annotated[
        dict[ProcessName, EavesdropperTable],
        Field(max_length=64, examples=[{"smart": {"strategy": "smart", "link": {"quality": 0.9}}}]),
    ] = Field(default_factory=dict)
    acknowledgements: Annotated[AcknowledgementsTable | None, Field(examples=[{"link": {"quality": 0.9}}])] = None
    event: Annotated[list[EventTable], Field(max_length=10_000, examples=[[{"at": 400, "cut": "legitimate"}]])] = Field(
        default_factory=list
    )
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

    @property
    def leaks(self) -> dict[str, int]:
        """Eavesdropper → the slot whose true state is betrayed to it, of those who are told one."""
        slots = {name: STRATEGIES[one.strategy].betrayed(one.parameters) for name, one in self.eavesdroppers.items()}
        return {name: slot for name, slot in slots.items() if slot is not None}

    def link(self, receiver: str) -> LinkTable:
        """A receiver's link, or its links as one."""
        return self.legitimate.link if receiver == LEGITIMATE else self.eavesdroppers[receiver].pool

    def window(self, receiver: str) -> int:
        """By how many slots a packet may be late for a receiver."""
        return (self.legitimate if receiver == LEGITIMATE else self.eavesdroppers[receiver]).window

    @cached_property
    def timeline(self) -> Timeline:
        """When what happens, from the events."""
        return Timeline.of(self.event, self.receivers, self._changed_settings)

    def _changed_settings(self, receiver: str, changes: Mapping[str, Any]) -> dict[str, Any]:
        """A link's settings with some entries changed; those of an earlier event are among them already."""
        return changed_link(self.link(receiver), changes).settings(self.slot_seconds)

    def course(self, receiver: str) -> Course:
        """All that is known of a receiver's link in advance."""
        link = self.link(receiver)
        return Course(
            link.settings(self.slot_seconds),
            self.window(receiver),
            self.timeline.changes[receiver],
            self.timeline.outages[receiver],
            None if link.correlation is None else (link.correlation.to, link.correlation.strength),
        )

    def cuts(self, receiver: str) -> list[int]:
        """Slots in which a receiver goes away or is back, with which a block of its digest begins."""
        return sorted({slot for one in self.timeline.outages[receiver] for slot in (one.start, one.stop)})


def changed_link(link: LinkTable, changes: Mapping[str, Any]) -> LinkTable:
    """A link with some entries changed. Raises ValidationError for what is no link then."""
    entries = link.model_dump(exclude_unset=True)
    if "quality" in changes:
        entries.pop("loss", None)
    if "loss" in changes:
        entries.pop("quality", None)
    return LinkTable.model_validate({**entries, **changes})
