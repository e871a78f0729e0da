"""The receivers of a scenario, the legitimate estimator and the eavesdroppers, and the links over which packets reach them.

`link = {…}` is such a link. `[acknowledgements]` is the channel from the legitimate estimator back to the sensor, and an attack
on it. `[wire]` names receivers whose links draw their random numbers as the links of a wire do, so that packets have the same
fates.

Source: docs/scenario.md, links, legitimate and eavesdroppers, acknowledgements, and wire; docs/links.md, the links of a wire.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, ConfigDict, Field

from evedrop.model.acknowledgements import ATTACKS, OVERHEARING
from evedrop.model.checks import is_number
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.links import LOSS_MODELS, loss_of, pooled_spec
from evedrop.model.links.loss_model import LossModel
from evedrop.model.registry import asked
from evedrop.model.slot.link import MOST_QUEUED, MOST_RATE
from evedrop.model.streams import root_of_seed, stream_key
from evedrop.scenario.table import Mistake, Probability, Table, model_mistakes, one_of, refuse, registered
from evedrop.scenario.words import as_toml, listed, no_entry
from evedrop.system.hints import near

_QUEUE = 100  # default for the packets that wait before a link of limited rate


class CorrelationTable(Table):
    """`correlation = {…}`: the link whose losses this link's are tied to, and how strongly."""

    to: Annotated[str, Field(strict=True, alias="with", examples=["legitimate"])]
    """The receiver with whose link the losses are correlated. Its loss model must be the same."""
    strength: Annotated[Probability, Field(examples=[0.5])]
    """The probability that both links have the same cause in a slot: 0 is independent; at 1, equal links lose the same
    packets."""


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
    """The arrival probability of a packet, independent in every slot and trial: μ, or μ_e. Short for the loss model
    `bernoulli`."""
    loss: Annotated[
        Annotated[dict[str, Any], AfterValidator(_loss)] | None,
        Field(examples=[{"model": "gilbert-elliott", "p": 0.05, "r": 0.5}]),
    ] = None
    """A loss model as `model`, with its parameters, in place of `quality`."""
    correlation: Annotated[CorrelationTable | None, Field(examples=[{"with": "legitimate", "strength": 0.5}])] = None
    """Correlates the losses with those of another receiver's link."""
    delay: Annotated[
        Annotated[dict[str, Any], AfterValidator(_delay)] | None, Field(examples=[{"model": "constant", "value": 2.0}])
    ] = None
    """A delay model as `model`, its parameters, and `unit`: `slots`, the default, or `seconds`, which needs `slot_seconds`."""
    reorder: Annotated[Probability, Field(examples=[0.1])] = 0.0
    """The probability that a packet is not delayed, and so overtakes others. Needs `delay`."""
    duplicate: Annotated[Probability, Field(examples=[0.05])] = 0.0
    """The probability that a packet arrives twice. Receivers recognise it, so estimates do not change."""
    corrupt: Annotated[Probability, Field(examples=[0.01])] = 0.0
    """The probability that a packet is damaged. Its checksum shows it, and it counts as lost."""
    rate: Annotated[float | None, Field(strict=True, gt=0.0, le=MOST_RATE, examples=[0.9])] = None
    """The capacity of the link, in packets a slot. Below 1, the queue fills."""
    queue: Annotated[int | None, Field(strict=True, ge=0, le=MOST_QUEUED, examples=[100])] = None
    """How many packets wait before a link of limited rate; 100 by default. Further ones are lost."""

    def mistakes(self) -> Iterator[Mistake]:
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
            lengths = DELAY_MODELS[self.delay["model"]].lengths if self.in_seconds and slot_seconds else ()
            made["delay"] = {
                name: _in_slots(value, slot_seconds or 1.0) if name in lengths else value
                for name, value in self.delay.items()
                if name != "unit"
            }
        return made

    def delay_mistakes(self, slot_seconds: float | None) -> Iterator[str]:
        """Mistakes in a delay in seconds: no `slot_seconds`, or too many slots."""
        if not self.in_seconds:
            return
        if slot_seconds is None:
            yield "delay.unit: is seconds; expected slot_seconds = 0.02, the duration of a slot, at the top of the file"
            return
        delay = self.settings(slot_seconds)["delay"]
        in_slots = {name: value for name, value in delay.items() if name != "model"}
        for entry, sentence in asked(DELAY_MODELS[delay["model"]], in_slots):
            yield f"delay.{entry}: in slots, it {sentence}"


def _in_slots(value: Any, slot_seconds: float) -> Any:
    """A length of time, or a list of them, in slots; what is no number stays, for the class of a user to refuse."""
    if isinstance(value, list):
        return [_in_slots(inner, slot_seconds) for inner in value]
    return value / slot_seconds if is_number(value) else value


CHANGEABLE = tuple(entry for entry in LinkTable.model_fields if entry != "correlation")
"""The entries of a link that an event can change."""
LinkField = Annotated[LinkTable, Field(examples=[{"quality": 0.9}])]
WindowField = Annotated[int, Field(strict=True, ge=0, le=10_000, examples=[8])]


def unchangeable(changes: Mapping[str, Any]) -> Iterator[str]:
    """Mistakes for all entries that an event cannot change."""
    for entry in changes:
        if entry not in CHANGEABLE:
            yield f"{entry}: is not a link setting that can be changed; expected {listed(CHANGEABLE)}{near(entry, CHANGEABLE)}"


SHORT_FORMS = {"quality": "loss", "loss": "quality"}
"""Entry of a link → the other form of it, which a change replaces."""


def entries_after(entries: Mapping[str, Any], changes: Mapping[str, Any] | None) -> dict[str, Any]:
    """The entries of a link after changes; None undoes all earlier ones.

    A quality removes an earlier loss, and a loss an earlier quality.
    """
    if changes is None:
        return {}
    gone = {SHORT_FORMS[name] for name in changes if name in SHORT_FORMS}
    return {**{name: value for name, value in entries.items() if name not in gone}, **changes}


def changed_link(link: LinkTable, changes: Mapping[str, Any]) -> LinkTable:
    """A link with some entries changed. Raises ValidationError if the result is not a valid link."""
    return LinkTable.model_validate(entries_after(link.model_dump(exclude_unset=True), changes))


def tie_of(name: str, ties: Mapping[str, str]) -> str | None:
    """How the losses of a link and another's are tied, in words; None if they are not.

    ties: link → the one to whose losses its own are tied.
    """
    if name in ties:
        return f"its losses are tied to those of {ties[name]}"
    tied = [link for link, other in ties.items() if other == name]
    return f"the losses of {', '.join(tied)} are tied to its losses" if tied else None


def other_model(name: str, changes: Mapping[str, Any], tie: str) -> str:
    """The mistake of changes that give a link another loss model although there is a tie, as from `tie_of`."""
    entry = "loss.model" if "loss" in changes else "quality"
    return f"{entry}: gives {name} another loss model, but {tie}; expected the same model"


class AckChannelTable(Table):
    """`link = {…}` of the acknowledgements: each is lost independently or arrives at once."""

    quality: Annotated[Probability, Field(examples=[0.9])]
    """The probability that an acknowledgement reaches the sensor."""


class AcknowledgementsTable(Table):
    """`[acknowledgements]`: their channel to the sensor, for schemes that need them, and an attack on it."""

    link: Annotated[AckChannelTable, Field(examples=[{"quality": 0.9}])]
    """The channel of the acknowledgements."""
    attack: Annotated[str, Field(strict=True, examples=["critical"]), AfterValidator(one_of(ATTACKS))] = "none"
    """Blocks all (`all`) or those of packets that the jammer missed (`critical`), sends one for every packet (`forge`), flips
    some (`flip`), or makes the sensor heed first those of packets that the jammer heard (`hijack`). It lasts for the whole run,
    or only during events `jam`."""
    jammer: Annotated[str | None, Field(strict=True, examples=["smart"])] = None
    """The eavesdropper by whose link the attacks `critical` and `hijack` decide. They need it; others refuse it."""
    flip: Annotated[Probability | None, Field(examples=[0.1])] = None
    """The probability with which the attack `flip` inverts an acknowledgement. It needs it; others refuse it."""
    false_alarms: Annotated[float, Field(strict=True, ge=10.0, le=1e9, examples=[1e4])] = 1e4
    """The mean number of packets between false alarms of the sensor's detector."""

    def mistakes(self) -> Iterator[Mistake]:
        """Mistakes in the entries of attacks: two need a jammer with a link of its own, `flip` a probability."""
        if self.attack == "flip" and self.flip is None:
            yield (
                "flip",
                "is missing; the attack flip needs the probability of flipping an acknowledgement, such as flip = 0.1",
            )
        elif self.attack != "flip" and self.flip is not None:
            yield "flip", f"is set, but the attack {as_toml(self.attack)} flips nothing; remove the line"
        elif self.attack in OVERHEARING and self.jammer is None:
            yield (
                "jammer",
                f"is missing; the attack {self.attack} needs the eavesdropper that it serves, by what that hears",
            )
        elif self.attack not in OVERHEARING and self.jammer is not None:
            yield (
                "jammer",
                f"is set, but the attack {as_toml(self.attack)} does not depend on what it hears; remove the line",
            )


PUT = "put"
"""The kind of a published message, among the kinds that draw numbers of their own."""


def wire_stream(stream: str, kind: str, key: str) -> str:
    """The name of the random stream of a Zenoh key's messages on a link of a wire, under the root of the wire's seed.

    stream: as in `streams_of`, with the name of the link; kind: of the messages.
    """
    return f"wire/{stream}/{kind}/{key}"


def wire_stream_key(root: bytes, stream: str, kind: str, key: str) -> bytes:
    """The key of the random numbers of `wire_stream`."""
    return stream_key(root, wire_stream(stream, kind, key))


class WireTable(Table):
    """`[wire]`: the packet of slot k has the fate of the k-th message that is published on a key."""

    seed: Annotated[int, Field(ge=0, lt=2**256, strict=True, examples=[7])]
    """The seed of the wire."""
    key: Annotated[str, Field(strict=True, min_length=1, examples=["robot/pose"])]
    """The Zenoh key of its messages."""
    links: Annotated[
        dict[str, Annotated[str, Field(strict=True, min_length=1)]], Field(examples=[{"legitimate": "radio"}])
    ]
    """Receiver → the name of the wire's link whose random numbers its link draws."""

    def stream_keys(self, streams: tuple[str, ...]) -> Mapping[str, bytes]:
        """Stream → its key, for those streams of receivers' links that are a wire's."""
        root = root_of_seed(self.seed)
        keys_ = {}
        for stream in streams:
            kind, _, receiver = stream.partition("/")
            if receiver in self.links:
                keys_[stream] = wire_stream_key(root, f"{kind}/{self.links[receiver]}", PUT, self.key)
        return keys_


class LegitimateTable(Table):
    """`[legitimate]`: the legitimate estimator's link and window, and whether it knows the inputs."""

    link: LinkField
    """The link from the router to the legitimate estimator."""
    window: WindowField = 0
    """By how many slots a packet may be late and still be used. With 0, late packets are lost."""
    knows_input: Annotated[bool, Field(strict=True, examples=[True])] = False
    """Whether it is told the controller's decisions, and predicts A x̂ + B u in place of A x̂."""


class EavesdropperTable(Table):
    """`[eavesdroppers.NAME]`: a strategy with its parameters, and one link or several."""

    model_config = ConfigDict(extra="allow")

    strategy: Annotated[str, Field(strict=True, examples=["smart"]), AfterValidator(registered(STRATEGIES))]
    """How the eavesdropper reads packets. Some strategies have parameters, which are further entries."""
    link: Annotated[LinkTable | None, Field(examples=[{"quality": 0.9}])] = None
    """The link from the router to it. Every strategy but `colluding` needs one."""
    links: Annotated[
        list[LinkTable] | None, Field(min_length=2, max_length=16, examples=[[{"quality": 0.6}, {"quality": 0.5}]])
    ] = None
    """The links that `colluding` pools, each with only a `quality` or a `loss`."""
    reads_as: Annotated[
        Annotated[str, Field(strict=True), AfterValidator(registered(READERS))] | None, Field(examples=["smart"])
    ] = None
    """The strategy as which `colluding` and `replay-informed` read packets. Its parameters are given as well."""
    learns_at: Annotated[int | None, Field(ge=0, strict=True, examples=[40])] = None
    """The slot whose true state `replay-informed` is told."""
    window: WindowField = 0
    """By how many slots a packet may be late and still be used. With 0, late packets are lost."""
    use_state: Annotated[Probability | None, Field(examples=[0.8])] = None
    """The probability μ_b that `suspicious` uses a state which it received."""
    use_innovation: Annotated[Probability | None, Field(examples=[0.2])] = None
    """The probability that `suspicious` takes an innovation for the state."""

    def mistakes(self) -> Iterator[Mistake]:
        """Missing, unknown and wrong parameters of the strategy, and a missing link."""
        strategy, fields = STRATEGIES[self.strategy], type(self).model_fields
        reader = None if self.reads_as is None or "reads_as" not in strategy.parameters else READERS[self.reads_as]
        parameters = {**strategy.parameters, **(reader.parameters if reader is not None else {})}
        wanted = {"links" if strategy.pools_links else "link", *parameters}
        given = {name: value for name, value in self if value is not None}
        for name in given:
            if name not in fields and name not in wanted:
                yield name, no_entry(name, [*{**fields, **parameters}])
        for name, example in parameters.items():
            if name not in fields and name not in given:
                yield name, f"is missing; the strategy {self.strategy} needs it; expected {name} = {as_toml(example)}"
        for name in fields:
            if name in wanted and name not in given:
                of = "" if name == "link" else f"the strategy {self.strategy} needs it; "
                yield name, f"is missing; {of}expected {name} = {self._example(name)}"
            if name in given and name not in {"strategy", "window", *wanted}:
                instead = "; its entry is links" if name == "link" else ""
                yield name, f"is set, but the strategy {self.strategy} has no such parameter{instead}; remove the line"
        for kind in (strategy, reader):
            if kind is not None:
                yield from asked(kind, {name: given[name] for name in kind.parameters if name in given})
        for i, link in enumerate(self.links or []):
            entries = {name for name, value in link.model_dump(exclude_unset=True).items() if value}
            if more := sorted(entries - {"quality", "loss"}):
                yield f"links.{i}", f"has {listed(more)}; links that are pooled have only a quality or a loss"

    @property
    def parameters(self) -> dict[str, Any]:
        """The strategy's parameters, and those of the strategy named by `reads_as`."""
        names = [*STRATEGIES[self.strategy].parameters]
        if self.reads_as is not None:
            names += READERS[self.reads_as].parameters
        given = dict(self)  # not attributes: a parameter may have the name of a method
        return {name: given[name] for name in names}

    @property
    def pool(self) -> LinkTable:
        """Its link, or its pooled links as one."""
        return LinkTable.pooled(self.links or []) if self.link is None else self.link
