"""`link = {…}` of a scenario file: its entries, their checks and their meaning.

Source: docs/scenario.md, links.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from evedrop.model.delays import DELAY_MODELS
from evedrop.model.links import LOSS_MODELS, loss_of, pooled_spec
from evedrop.model.links.loss_model import LossModel
from evedrop.scenario.table import Found, Probability, Table, model_mistakes, refuse
from evedrop.scenario.words import as_toml, listed
from evedrop.system.hints import near

_QUEUE = 100  # default for the packets that wait before a link of limited rate


class CorrelationTable(Table):
    """`correlation = {…}`: the link whose losses this link's are tied to, and how strongly."""

    to: Annotated[str, Field(strict=True, alias="with", examples=["legitimate"])]
    strength: Annotated[Probability, Field(examples=[0.5])]


def _loss(loss: dict[str, Any]) -> dict[str, Any]:
    refuse(model_mistakes(loss, LOSS_MODELS))
    return loss


def _delay(delay: dict[str, Any]) -> dict[str, Any]:
    mistakes = model_mistakes({name: value for name, value in delay.items() if name != "unit"}, DELAY_MODELS)
    if delay.get("unit", "slots") not in ("slots", "seconds"):
        mistakes.append(("unit", f'is {as_toml(delay["unit"])}; expected "slots" or "seconds"'))
    refuse(mistakes)
    return delay


class LinkTable(Table):
    """`link = {…}`: how packets travel from the router to one receiver."""

    may_be_perfect: ClassVar[bool] = False
    """Whether a link without losses needs neither a quality nor a loss model."""

    quality: Annotated[Probability | None, Field(examples=[0.9])] = None
    loss: Annotated[
        Annotated[dict[str, Any], AfterValidator(_loss)] | None,
        Field(examples=[{"model": "gilbert-elliott", "p": 0.05, "r": 0.5}]),
    ] = None
    correlation: Annotated[CorrelationTable | None, Field(examples=[{"with": "legitimate", "strength": 0.5}])] = None
    delay: Annotated[
        Annotated[dict[str, Any], AfterValidator(_delay)] | None, Field(examples=[{"model": "constant", "value": 2.0}])
    ] = None
    reorder: Annotated[Probability, Field(examples=[0.1])] = 0.0
    duplicate: Annotated[Probability, Field(examples=[0.05])] = 0.0
    corrupt: Annotated[Probability, Field(examples=[0.01])] = 0.0
    rate: Annotated[float | None, Field(strict=True, gt=0.0, le=1e6, examples=[0.9])] = None
    queue: Annotated[int | None, Field(strict=True, ge=0, le=1_000_000, examples=[100])] = None

    def mistakes(self) -> Iterator[Found]:
        """Mistakes unless there is one of quality and loss, and no entry is pointless."""
        if self.quality is None and self.loss is None and not self.may_be_perfect:
            yield "quality", "is missing; expected quality = 0.9, or a loss model"
        elif self.quality is not None and self.loss is not None:
            yield "quality", "is given together with loss, whose short form it is; expected one of them"
        if self.reorder and self.delay is None:
            yield "reorder", "is given without a delay, so that nothing can overtake; expected a delay as well"
        if self.queue is not None and self.rate is None:
            yield "queue", "is given without a rate, so that nothing queues; expected a rate as well"

    @classmethod
    def pooled(cls, links: list[LinkTable]) -> LinkTable:
        """Several links that end at one receiver, as one link: the receiver gets every packet that any of them delivers."""
        return cls.model_construct(loss=pooled_spec([link.loss_spec for link in links]))

    @property
    def loss_spec(self) -> dict[str, Any]:
        """The loss model and its parameters."""
        return {"model": "bernoulli", "quality": self.quality} if self.loss is None else self.loss

    @property
    def model(self) -> LossModel:
        """A new instance of the loss model."""
        return loss_of(self.loss_spec)

    @property
    def in_seconds(self) -> bool:
        """Whether the link's delays are in seconds."""
        return self.delay is not None and self.delay.get("unit") == "seconds"

    def settings(self, slot_seconds: float | None) -> dict[str, Any]:
        """The settings for `LinkSchedule.settings`, with delays in slots."""
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
                        [delay_ / slot_seconds for delay_ in value] if isinstance(value, list) else value / slot_seconds
                    )
            made["delay"] = delay
        return made


CHANGEABLE = tuple(entry for entry in LinkTable.model_fields if entry != "correlation")
"""The entries of a link that an event can change."""
OTHER_MODEL = (
    "loss.model: differs from the first one, but the link's losses are tied to another link's; expected the same model"
)
"""The mistake of a change that gives a correlated link another loss model."""
LinkField = Annotated[LinkTable, Field(examples=[{"quality": 0.9}])]
WindowField = Annotated[int, Field(strict=True, ge=0, le=10_000, examples=[8])]


def unchangeable(changes: Mapping[str, Any]) -> Iterator[str]:
    """Mistakes for all entries that an event cannot change."""
    for entry in changes:
        if entry not in CHANGEABLE:
            yield f"{entry}: is not a link setting that can be changed; expected {listed(CHANGEABLE)}{near(entry, CHANGEABLE)}"


def changed_link(link: LinkTable, changes: Mapping[str, Any]) -> LinkTable:
    """A link with some entries changed. Raises ValidationError if the result is not a valid link."""
    entries = link.model_dump(exclude_unset=True)
    if "quality" in changes:
        entries.pop("loss", None)
    if "loss" in changes:
        entries.pop("quality", None)
    return LinkTable.model_validate({**entries, **changes})
