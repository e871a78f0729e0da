"""What an event is: the base class of its kinds, with its time and acts, and the effects that acts can have.

The code that carries out effects on links, receivers and processes knows neither the kinds of event nor those of effect: it asks
an effect what it does.

Source: docs/architecture.md, events; docs/scenario.md, events; docs/your-own/event.md.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, Field, model_validator

from evedrop.errors import NoAnswer
from evedrop.model.links.loss_model import Fate
from evedrop.model.registry import CLASS_ERRORS, answered, place_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.streams import MOST_SLOTS
from evedrop.names import ProcessAction
from evedrop.scenario.table import Mistake, Table, expected, refuse


class Effect:
    """The base class of effects, with the values of an effect that changes nothing."""

    needs_receivers: ClassVar[bool] = True
    """Whether its act must name at least one receiver."""
    one_receiver: ClassVar[bool] = False
    """Whether its act must name exactly one."""
    changes_settings: ClassVar[bool] = False
    """Whether it changes the settings of links; see `entries`."""
    cuts: ClassVar[bool | None] = None
    """Whether links are cut from now on (true) or no longer (false); None if it leaves that as it is."""
    present: ClassVar[bool | None] = None
    """Whether a receiver is back from now on (true) or away (false); None if it leaves that as it is."""
    attacked: ClassVar[str | None] = None
    """What an attack that it begins or ends is on."""
    on: bool = False
    """Whether it begins that attack; otherwise it ends it."""
    entries: Mapping[str, Any] | None = None
    """The changed entries of a link's table, in addition to earlier changes; None restores the link as it was at first."""
    reason: Fate = Fate.LOST
    """The fate of packets during the cut or absence that it begins or ends."""
    action: ProcessAction | None = None
    """What the launcher does to the receiver's process; None for nothing."""
    keeps_state: bool = False
    """Whether the receiver continues from its last belief; otherwise from the prior."""
    after: str = ""
    """The entry of the event that must have begun the absence that it ends."""

    @property
    def loses(self) -> bool | None:
        """Whether packets are lost for its `reason` from now on (true) or no longer (false); None if it leaves that as it is."""
        return self.cuts if self.present is None else not self.present


@dataclass(frozen=True)
class Nothing(Effect):
    """No effect but the event's line."""

    needs_receivers = False


@dataclass(frozen=True)
class LinkSettings(Effect):
    """A link has other settings from now on."""

    entries: Mapping[str, Any] | None = field()

    changes_settings = True


@dataclass(frozen=True)
class LinkCut(Effect):
    """Packets that are sent over a link are lost from now on."""

    cuts = True
    reason = Fate.CUT


@dataclass(frozen=True)
class LinkHealed(Effect):
    """A link is no longer cut."""

    cuts = False
    reason = Fate.CUT


@dataclass(frozen=True)
class Jamming(Effect):
    """Acknowledgements are attacked from now on, or no longer."""

    on: bool = field()

    needs_receivers = False
    attacked: ClassVar[str] = "acknowledgements"


@dataclass(frozen=True)
class Spoofing(Effect):
    """The sensor's measurements are attacked from now on, or no longer."""

    on: bool = field()

    needs_receivers = False
    attacked: ClassVar[str] = "measurements"


@dataclass(frozen=True)
class Leave(Effect):
    """A receiver is away from now on."""

    reason: Fate = field()
    action: ProcessAction = field()
    keeps_state: bool = False
    """Whether its belief continues from its last one while it is away, as for a paused process; otherwise from the prior."""

    one_receiver = True
    present = False


@dataclass(frozen=True)
class Return(Effect):
    """A receiver is back."""

    reason: Fate = field()
    action: ProcessAction = field()
    after: str = field()
    keeps_state: bool = False
    """Whether it continues from its last belief; otherwise from the prior of the slot in which it went away."""

    one_receiver = True
    present = True


def _names(value: Any) -> Any:
    if isinstance(value, str) or (isinstance(value, list) and all(isinstance(name, str) for name in value)):
        return value
    raise expected("a receiver, or a list of receivers")


Names = Annotated[str | list[str], BeforeValidator(_names)]
Slot = Annotated[int, Field(strict=True, ge=0, le=MOST_SLOTS, examples=[400])]


@dataclass(frozen=True)
class Act:
    """One thing done at one slot."""

    at: int
    entry: str
    """The entry of the event that messages about a mistake in this act name."""
    names: tuple[str, ...]
    """The receivers it concerns."""
    text: str
    """Its line in the list of events."""
    effect: Effect


@dataclass(frozen=True)
class Fault:
    """How a nemesis draws events of a kind."""

    place: int
    """Its place among the kinds that a draw chooses from; another place would change the faults of every seed."""
    together: bool = False
    """Whether one event hits several receivers; a coin decides for each of them."""
    needs: Mapping[str, str] = field(default_factory=dict)
    """Entry of `[nemesis]` that the event needs → a description for the message if it is missing."""
    may_have: tuple[str, ...] = ()
    """Entries of `[nemesis]` that the event takes over if they are given."""

    @property
    def entries(self) -> tuple[str, ...]:
        """The entries of `[nemesis]` that go into the event."""
        return (*self.needs, *self.may_have)


@dataclass(frozen=True)
class Surroundings:
    """The parts of a scenario that a single event is compared with."""

    scheme: type[Scheme]
    scheme_name: str
    attack: str
    """The attack on acknowledgements; `none` if there is none."""
    monitored: bool = False
    """Whether the scenario has an application that can attack measurements, and detect it."""


class When(Table):
    """The slots of an event."""

    at: Slot | None = None
    """The slot in which it happens."""
    start: Annotated[Slot | None, Field(alias="from")] = None
    """The first slot in which it lasts."""
    to: Slot | None = None
    """The first slot in which it is over."""


class EventKind(When):
    """`[[event]]`: one thing that happens `at` a slot, or lasts `from` one slot `to` another. A class for each kind."""

    kind: ClassVar[str]
    """Its name in the registry, and its main entry."""
    does: ClassVar[type[Effect]]
    """What it does when it begins."""
    lasts: ClassVar[bool] = False
    """Whether it can last `from` one slot `to` another."""
    names_in: ClassVar[str | None] = None
    """The entry with the receivers it happens to; None if it happens to none."""
    by_operator: ClassVar[bool] = False
    """Whether an operator can cause it during a run. Only for built-in kinds that change links."""
    fault: ClassVar[Fault | None] = None
    """How a nemesis draws it; None if it does not."""
    alone: ClassVar[Mapping[str, str]] = {}
    """Entry besides `kind` → the mistake if it is given without a kind that has it."""

    @abstractmethod
    def acts(self) -> Iterator[Act]:
        """The beginning of the event, and its end if it lasts."""

    @model_validator(mode="after")
    def _as_a_whole(self) -> Self:
        """Refuse an event with mistakes, or one that cannot be checked: its class may come from a package."""
        refuse(answered(type(self), self.kind, lambda: list(self.mistakes())))
        return self

    @model_validator(mode="after")
    def _acts_are_usable(self) -> Self:
        """Refuse an event whose acts cannot be carried out: its class may come from a package."""
        try:
            _expect_acts(list(self.acts()))
        except CLASS_ERRORS as error:
            reason = str(error) if isinstance(error, NoAnswer) else f"acts() raised {place_of(error)}"
            refuse([(self.kind, f"is an event that cannot be carried out: {reason}")])
        return self

    def compared(self, surroundings: Surroundings) -> Iterator[Mistake]:
        """Mistakes that only show with other tables. Slots, receivers and changed links are checked elsewhere, for every kind."""
        del surroundings
        yield from ()

    @classmethod
    def in_turn(cls, events: Sequence[tuple[int, Self]]) -> Iterator[str]:
        """Mistakes that only show when all events of this kind are compared; events: each with its number."""
        del events
        yield from ()

    @classmethod
    def own_entries(cls) -> list[str]:
        """Its entries besides the slots."""
        return [name for name in cls.model_fields if name not in When.model_fields]

    @property
    def names(self) -> tuple[str, ...]:
        """The receivers it happens to."""
        value: Any = () if self.names_in is None else getattr(self, self.names_in)
        return (value,) if isinstance(value, str) else tuple(value)

    @property
    def first(self) -> int:
        """The slot in which it begins."""
        slot = self.at if self.at is not None else self.start
        assert slot is not None  # noqa: S101 - checked when it was made
        return slot

    def begin(self, words: str, effect: Effect) -> Act:
        """The act with which it begins."""
        return Act(self.first, self.kind, self.names, words, effect)


def _expect_acts(acts: Sequence[object]) -> None:
    """Raise NoAnswer unless these are acts, at least one, each at a slot, with as many names as its effect needs."""
    if not acts:
        raise NoAnswer("acts() gave none; expected an Act, or several")
    for act in acts:
        if not isinstance(act, Act) or not isinstance(act.effect, Effect):
            raise NoAnswer(f"acts() gave {act!r:.60}; expected an Act with an effect")
        if type(act.at) is not int or not 0 <= act.at <= MOST_SLOTS:
            raise NoAnswer(f"acts() gave an act at {act.at!r:.60}; expected a slot, 0 to {MOST_SLOTS}")
        if isinstance(act.names, str) or not all(isinstance(name, str) for name in act.names):
            raise NoAnswer(f"acts() gave an act with the names {act.names!r:.60}; expected a tuple of receivers")
        if not isinstance(act.effect.entries, Mapping | None):
            raise NoAnswer(f"acts() gave an act that changes {act.effect.entries!r:.60}; expected a dict of entries")
        if not act.names and act.effect.needs_receivers:
            raise NoAnswer("it names no receiver; expected one, or several")
        if len(act.names) != 1 and act.effect.one_receiver:
            raise NoAnswer("it names several receivers; expected one")
