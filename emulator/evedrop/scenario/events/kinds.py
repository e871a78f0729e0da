"""The built-in kinds of event.

`set` changes entries of links, `cut` and `partition` let nothing through, and `heal` ends a cut. `kill` and `restart` end a
receiver's process and start it again, from the prior or from its last belief; `pause` and `resume` stop and continue it, with all
it knew. During `jam` and `spoof` acknowledgements or the sensor's measurements are attacked, as `[acknowledgements]` or an
application's table describes. `note` is a line in the list of events.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field

from evedrop.model.links.loss_model import Fate
from evedrop.names import ProcessAction
from evedrop.scenario.application import APPLICATIONS, applications_in
from evedrop.scenario.events.event import (
    Act,
    Effect,
    EventKind,
    Fault,
    Jamming,
    Leave,
    LinkCut,
    LinkHealed,
    LinkSettings,
    Names,
    Nothing,
    Return,
    Spoofing,
    Surroundings,
)
from evedrop.scenario.table import Mistake, refuse
from evedrop.scenario.words import as_toml


def _spoken(names: Sequence[str]) -> str:
    """Receivers in the line of an act."""
    return ", ".join(names)


def _act(kind: type[EventKind], event: EventKind, at: int, effect: Effect) -> Act:
    """An act on an event's receivers whose line is the name of a kind and the receivers."""
    return Act(at, kind.kind, event.names, f"{kind.kind} {_spoken(event.names)}", effect)


def _some(changes: dict[str, Any]) -> dict[str, Any]:
    if not changes:
        refuse([("", "is empty; expected what changes, such as set = { quality = 0.2 }")])
    return changes


class Set(EventKind):
    """`link` and `set`: entries of the links change. At the end, all changes that events have made to them are undone."""

    link: Annotated[Names, Field(description="the link that is changed", examples=["legitimate"])]
    """The link that `set` changes, or a list of links."""
    set: Annotated[dict[str, Any], AfterValidator(_some), Field(examples=[{"quality": 0.2}])]
    """The changed entries of the link. With `to`, all changes by events are undone at the end."""

    kind = "set"
    does = LinkSettings
    lasts = True
    names_in = "link"
    by_operator = True
    fault = Fault(3, needs={"set": "what changes"})
    alone: ClassVar[Mapping[str, str]] = {
        "link": "is given without set; expected what changes, such as set = { quality = 0.2 }"
    }

    def acts(self) -> Iterator[Act]:
        """The changes, and their end."""
        link = f"link {_spoken(self.names)}"
        in_order = sorted(self.set.items(), key=lambda entry: isinstance(entry[1], Mapping))  # as a TOML file has them
        changes = ", ".join(f"{entry} = {as_toml(value)}" for entry, value in in_order)
        yield self.begin(f"{link}: {changes}", LinkSettings(self.set))
        if self.to is not None:
            yield Act(self.to, self.kind, self.names, f"{link}: as at first", LinkSettings(None))


class CutOff(EventKind):
    """The links of its receivers are cut, and heal when it ends."""

    does = LinkCut
    lasts = True

    def acts(self) -> Iterator[Act]:
        """The cut of each link, and the heal."""
        yield _act(Cut, self, self.first, LinkCut())
        if self.to is not None:
            yield _act(Heal, self, self.to, LinkHealed())


class Cut(CutOff):
    """`cut`: packets that are sent over these links are lost."""

    cut: Annotated[Names, Field(examples=["legitimate"])]
    """Cuts a link, or a list of links: packets sent meanwhile are lost; packets under way arrive."""

    kind = "cut"
    names_in = "cut"
    by_operator = True
    fault = Fault(2)


class Heal(EventKind):
    """`heal`: these links are no longer cut."""

    heal: Annotated[Names, Field(examples=["legitimate"])]
    """Ends the cut of a link, or of a list of links."""

    kind = "heal"
    does = LinkHealed
    names_in = "heal"
    by_operator = True

    def acts(self) -> Iterator[Act]:
        """The heal."""
        yield _act(Heal, self, self.first, LinkHealed())


class Partition(CutOff):
    """`partition`: a list of receivers, whose links are all cut."""

    partition: Annotated[list[str], Field(examples=[["legitimate", "smart"]])]
    """Cuts a list of receivers off together."""

    kind = "partition"
    names_in = "partition"
    fault = Fault(4, together=True)


State = Annotated[Literal["prior", "last"] | None, Field(examples=["last"])]
"""What the receiver knows when it is started again: nothing, or its last estimate."""
_ALONE = {"state": "is given without a restart; remove the line"}


def _restarted(state: str | None) -> Return:
    return Return(Fate.DOWN, ProcessAction.START, Kill.kind, state == "last")


class Kill(EventKind):
    """`kill`: the receiver's process is ended. It comes back at the end of the event, or with a restart."""

    kill: Annotated[str, Field(examples=["legitimate"])]
    """Ends a receiver's process (SIGKILL)."""
    state: State = None
    """The state with which it is restarted: `prior` (default), or its `last` estimate."""

    kind = "kill"
    does = Leave
    lasts = True
    names_in = "kill"
    fault = Fault(0, may_have=("state",))
    alone = _ALONE

    def mistakes(self) -> Iterator[Mistake]:
        """A state without an end, at which the receiver would be restarted."""
        if self.state is not None and self.to is None:
            yield (
                "state",
                "is given, but this event does not restart the receiver; give it with restart, or from and to",
            )

    def acts(self) -> Iterator[Act]:
        """The kill, and the restart."""
        yield _act(Kill, self, self.first, Leave(Fate.DOWN, ProcessAction.END))
        if self.to is not None:
            yield _act(Restart, self, self.to, _restarted(self.state))


class Restart(EventKind):
    """`restart`: the receiver's process is started again."""

    restart: Annotated[str, Field(examples=["legitimate"])]
    """Starts a killed receiver's process again."""
    state: State = None
    """The state with which it begins: `prior` (default), or its `last` estimate."""

    kind = "restart"
    does = Return
    names_in = "restart"
    alone = _ALONE

    def acts(self) -> Iterator[Act]:
        """The restart."""
        yield _act(Restart, self, self.first, _restarted(self.state))


def _continued() -> Return:
    return Return(Fate.PAUSED, ProcessAction.CONTINUE, Pause.kind, keeps_state=True)


class Pause(EventKind):
    """`pause`: the receiver's process is stopped."""

    pause: Annotated[str, Field(examples=["legitimate"])]
    """Stops a receiver's process (SIGSTOP)."""

    kind = "pause"
    does = Leave
    lasts = True
    names_in = "pause"
    fault = Fault(1)

    def acts(self) -> Iterator[Act]:
        """The stop, and the continuation."""
        yield _act(Pause, self, self.first, Leave(Fate.PAUSED, ProcessAction.STOP, keeps_state=True))
        if self.to is not None:
            yield _act(Resume, self, self.to, _continued())


class Resume(EventKind):
    """`resume`: the receiver's process continues."""

    resume: Annotated[str, Field(examples=["legitimate"])]
    """Lets a paused receiver's process continue (SIGCONT), with all it knew."""

    kind = "resume"
    does = Return
    names_in = "resume"

    def acts(self) -> Iterator[Act]:
        """The continuation."""
        yield _act(Resume, self, self.first, _continued())


class Attack(EventKind):
    """The attack lasts only during such events; their main entry is the word for what is attacked."""

    does: ClassVar[type[Jamming] | type[Spoofing]]
    """Its `attacked` is the only value of the main entry."""
    lasts = True

    @abstractmethod
    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless the scenario describes such an attack."""

    def acts(self) -> Iterator[Act]:
        """The attack's beginning and end."""
        yield self.begin(f"{self.does.attacked} are attacked", self.does(on=True))
        if self.to is not None:
            yield Act(self.to, self.kind, (), f"{self.does.attacked} are no longer attacked", self.does(on=False))

    def compared(self, surroundings: Surroundings) -> Iterator[Mistake]:
        """A mistake for another value of the main entry, and those of `undescribed`."""
        given = getattr(self, self.kind)
        if given != self.does.attacked:
            yield self.kind, f"is {as_toml(given)}; expected {as_toml(self.does.attacked)}"
        else:
            yield from ((self.kind, sentence) for sentence in self.undescribed(surroundings))

    @classmethod
    def in_turn(cls, events: Sequence[tuple[int, Self]]) -> Iterator[str]:
        """Mistakes where an attack begins before the previous one has ended."""
        in_order = sorted(events, key=lambda numbered: numbered[1].first)
        for (_, before), (i, event) in pairwise(in_order):
            if before.to is None or before.to > event.first:
                lasting = "while another one lasts; expected that one to end first"
                yield f"event.{i}.{event.kind}: begins in slot {event.first}, {lasting}"


class Jam(Attack):
    """`jam`: the attack lasts only during such events."""

    jam: Annotated[str, Field(examples=["acknowledgements"])]
    """`"acknowledgements"`: the attack that `[acknowledgements]` describes lasts only during such events."""

    kind = "jam"
    does = Jamming

    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless there are acknowledgements and an attack on them."""
        scheme = surroundings.scheme
        if not scheme.needs_acknowledgements:
            name = surroundings.scheme_name
            yield f"the scheme {name} has no acknowledgements that could be jammed; remove the event"
        elif surroundings.attack == "none":
            yield 'no attack is described; expected acknowledgements.attack = "all", or another, as well'


class Spoof(Attack):
    """`spoof`: the attack lasts only during such events."""

    spoof: Annotated[str, Field(examples=["measurements"])]
    """`"measurements"`: the attack that `[integrity]` describes lasts only during such events."""

    kind = "spoof"
    does = Spoofing

    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless an attack on measurements is described."""
        if not surroundings.monitored:
            loaded = applications_in(APPLICATIONS.names).items()
            able = [f"[{name}]" for name, application in loaded if application.has_monitor]
            yield f"no attack is described; expected a table {' or '.join(able)} with an attack as well"


class Note(EventKind):
    """`note`: nothing happens; the text appears in the list of events."""

    note: Annotated[str, Field(examples=["the door is opened"])]
    """A text for the events of the summary. Nothing happens."""

    kind = "note"
    does = Nothing

    def acts(self) -> Iterator[Act]:
        """The line."""
        yield self.begin(self.note, Nothing())
