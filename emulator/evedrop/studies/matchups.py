"""The matches of a comparison: from one scenario, a scenario for every scheme, and one for each attack on the scheme.

An adversary is either a strategy, by its name, or an attack on the acknowledgements combined with the best strategy against
the scheme.

Source: docs/compare.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from evedrop.errors import NotRegistered, ScenarioError, UsageError
from evedrop.model.acknowledgements import OVERHEARING
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.readers import RESERVED
from evedrop.model.registry import Registry
from evedrop.model.schemes import SCHEMES
from evedrop.names import LEGITIMATE
from evedrop.results.comparison import Match, receiver_name
from evedrop.scenario.across import lacking_streams
from evedrop.scenario.events.event import EventKind, Jamming
from evedrop.scenario.loading import checked
from evedrop.scenario.process_noise import unsuited
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import listed
from evedrop.system.hints import near

ATTACKERS: Mapping[str, str] = {
    "blocks-critical": "critical",
    "blocks-all": "all",
    "forges": "forge",
    "flips": "flip",
    "hijacks": "hijack",
}
"""Adversary → its attack on acknowledgements."""

_FLIP = 0.1
"""The probability with which `flips` flips an acknowledgement, unless the scenario has one."""

_LONGEST_TITLE = 200  # of a scenario
_ACK_CHANNEL = {"link": {"quality": 1.0}}

Tables = dict[str, Any]


@dataclass(frozen=True)
class Group:
    """The matches of one simulation: one scheme, under one attack or none."""

    scenario: Scenario
    matches: tuple[Match, ...]

    @property
    def scheme(self) -> str:
        """The scheme of all its matches."""
        return self.scenario.encoding.scheme

    @property
    def name(self) -> str:
        """Name of its scenario's file."""
        attacker = next((match.adversary for match in self.matches if match.attack != "none"), None)
        scheme = self.scheme.replace(":", ".")
        return scheme if attacker is None else f"{scheme}-{attacker}"


@dataclass(frozen=True)
class Matchups:
    """All matches of a comparison, and those that are not defined."""

    schemes: tuple[str, ...]
    adversaries: tuple[str, ...]
    groups: tuple[Group, ...]
    """In order of schemes; for each scheme, the group without an attack comes first."""
    undefined: tuple[Match, ...]
    left_out: Mapping[str, tuple[str, ...]]
    """Scheme that cannot be used with this process → why not, in lines."""


def adversaries_of() -> tuple[str, ...]:
    """The names of all adversaries."""
    return (*STRATEGIES, *ATTACKERS)


def usual_adversaries(scenario: Scenario) -> tuple[str, ...]:
    """The names of all adversaries but those that are costly and not in the scenario."""
    own = {table.strategy for table in scenario.eavesdroppers.values()}
    return tuple(name for name in adversaries_of() if name in ATTACKERS or name in own or not STRATEGIES[name].costly)


def matchups_of(
    scenario: Scenario,
    schemes: Sequence[str] | None = None,
    adversaries: Sequence[str] | None = None,
    parameters: Mapping[str, Any] | None = None,
) -> Matchups:
    """The matches of schemes and adversaries, by name; by default all that the sensor can use and that are not costly.

    parameters: SCHEME.PARAMETER → value.

    Raises UsageError with every unknown name. Raises ScenarioError if a scheme that is named, or has such a parameter, cannot be
    used with this process, if none can, and if the adversaries of a scheme cannot.
    """
    if adversaries is None:
        adversaries = usual_adversaries(scenario)
    chosen = _chosen(schemes, adversaries, parameters or {})
    groups: list[Group] = []
    undefined: list[Match] = []
    mistakes: dict[str, None] = {}
    left_out: dict[str, tuple[str, ...]] = {}
    for scheme in chosen[0]:
        matches = [_match(scenario, scheme, name) for name in chosen[1]]
        encoding = _encoding(scenario, scheme, parameters or {})
        for attack in ("none", *ATTACKERS.values()):
            some = tuple(pair for pair in matches if pair.not_defined is None and pair.attack == attack)
            if not some and attack != "none":
                continue
            try:
                groups.append(Group(with_encoding(scenario, encoding, attack, some), some))
            except ScenarioError as error:
                unusable = _unusable(scenario, encoding)
                if unusable:
                    left_out[scheme] = unusable
                    break
                mistakes.update(dict.fromkeys(_with_scheme(scheme, error.mistakes)))
        else:
            undefined += [match for match in matches if match.not_defined is not None]
    meant = {key.rpartition(".")[0] for key in parameters or {}} if schemes is None else set(schemes)
    for scheme, why in left_out.items():
        if scheme in meant or not groups:
            mistakes.update(dict.fromkeys(_with_scheme(scheme, why)))
    if mistakes:
        raise ScenarioError(scenario.title, list(mistakes))
    usable = tuple(scheme for scheme in chosen[0] if scheme not in left_out)
    return Matchups(usable, chosen[1], tuple(groups), tuple(undefined), left_out)


def _with_scheme(scheme: str, mistakes: Iterable[str]) -> list[str]:
    return [f"with the scheme {scheme}: {line}" for line in mistakes]


def _unusable(scenario: Scenario, encoding: Tables) -> tuple[str, ...]:
    """Why a scheme cannot be used with this process, whatever the adversaries, in lines; empty if it can."""
    try:
        with_encoding(scenario, encoding)
    except ScenarioError as error:
        return tuple(error.mistakes)
    return ()


def _chosen(
    schemes: Sequence[str] | None, adversaries: Sequence[str] | None, parameters: Mapping[str, Any]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    mistakes: list[str] = []
    chosen = []
    for kind, names, available in (("scheme", schemes, tuple(SCHEMES)), ("adversary", adversaries, adversaries_of())):
        wanted = available if names is None else tuple(dict.fromkeys(names))
        mistakes += _strange(kind, wanted, available, SCHEMES if kind == "scheme" else STRATEGIES)
        if not wanted:
            mistakes.append(f"no {kind} is named; expected {listed(available)}")
        chosen.append(wanted)
    receivers = {name: receiver_name(name) for name in chosen[1]}
    for name, receiver in receivers.items():
        other = next(name for name, its in receivers.items() if its == receiver)
        if other != name:
            mistakes.append(
                f"{name} and {other} would both be called {receiver} in a scenario; compare them one after the other"
            )
    entries = {scheme: SCHEMES[scheme].parameters for scheme in (*SCHEMES, *chosen[0]) if scheme in SCHEMES}
    for key in parameters:
        scheme, _, name = key.rpartition(".")
        if name not in entries.get(scheme, ()):
            parts = [f"{scheme}.{entry}" for scheme, available in entries.items() for entry in available]
            mistakes.append(f"{key} is not a parameter of a scheme; expected {listed(parts)}{near(key, parts)}")
        elif scheme not in chosen[0]:
            mistakes.append(f"{key}: {scheme} is not among the schemes that are compared; add it, or leave this out")
    if mistakes:
        raise UsageError("\n  ".join(["nothing was compared:", *mistakes]))
    return chosen[0], chosen[1]


def _strange(kind: str, names: Iterable[str], available: Sequence[str], registry: Registry[Any]) -> list[str]:
    """What is wrong with names of schemes or adversaries; each may be a class of a plug-in."""
    mistakes = []
    for name in names:
        if name in available:
            continue
        try:
            _ = registry[name]
        except NotRegistered as error:
            why = error.why or f"; expected {listed(available)}{near(name, available)}"
            mistakes.append(f"{name or 'nothing'} is not {'an' if kind == 'adversary' else 'a'} {kind}{why}")
    return mistakes


def _match(scenario: Scenario, scheme: str, adversary: str) -> Match:
    attack = ATTACKERS.get(adversary, "none")
    if attack != "none" and not SCHEMES[scheme].needs_acknowledgements:
        return Match(scheme, adversary, not_defined="there are no acknowledgements to attack")
    strategy = adversary if attack == "none" else SCHEMES[scheme].best_reader
    where, why = STRATEGIES[strategy].only_against or (scheme, "")
    if scheme not in ((where,) if isinstance(where, str) else where):
        return Match(scheme, adversary, not_defined=why)
    table = _eavesdropper(scenario, scheme, strategy)
    parameters = {name: value for name, value in table.items() if name not in ("strategy", "link", "links", "window")}
    for class_name in (strategy, table.get("reads_as")):
        for reason in () if class_name is None else unsuited(scenario.process, scenario.plant, class_name):
            return Match(scheme, adversary, not_defined=reason.why)
    lacking = lacking_streams(STRATEGIES[strategy].streams(parameters), SCHEMES[scheme])
    if lacking:
        return Match(scheme, adversary, not_defined=f"knows the {listed(lacking)}, and there is none")
    betrayed = STRATEGIES[strategy].betrayed(parameters) is not None
    return Match(scheme, adversary, strategy, attack, betrayed=betrayed)


def _encoding(scenario: Scenario, scheme: str, parameters: Mapping[str, Any]) -> Tables:
    """The scheme's parameters: given ones, else the scenario's own, else the examples of docs/scenario.md."""
    own = scenario.encoding.parameters
    given = {name: parameters.get(f"{scheme}.{name}") for name in SCHEMES[scheme].parameters}
    examples = SCHEMES[scheme].parameters
    return {
        "scheme": scheme,
        **{name: own.get(name, examples[name]) if value is None else value for name, value in given.items()},
    }


def with_encoding(
    scenario: Scenario, encoding: Tables, attack: str = "none", matches: Sequence[Match] = ()
) -> Scenario:
    """The scenario with another encoding, the eavesdroppers of these matches, and no attack but this one.

    Events concern only the legitimate estimator. Raises ScenarioError if the encoding cannot be used.
    """
    tables: Tables = scenario.model_dump(mode="json", exclude_none=True)
    scheme = encoding["scheme"]
    under = "" if attack == "none" else f", acknowledgements attacked: {attack}"
    suffix = f" ({scheme}{under})"
    tables |= {
        "title": scenario.title[: _LONGEST_TITLE - len(suffix)] + suffix,
        "encoding": encoding,
        "eavesdroppers": {match.receiver: _eavesdropper(scenario, scheme, str(match.strategy)) for match in matches},
        "event": list(_events_alone(scenario.event, tables["event"])),
        "expect": [],
        "record_trials": 1,
    }
    tables[LEGITIMATE]["link"].pop("correlation", None)  # with an eavesdropper that may not be in this scenario
    if "wire" in tables:
        tables["wire"] = {**tables["wire"], "links": _wire_links(scenario, matches)}
    ack_channel = tables.pop("acknowledgements", _ACK_CHANNEL)
    if SCHEMES[scheme].needs_acknowledgements:
        flip = ack_channel.get("flip", _FLIP)
        ack_channel = {name: value for name, value in ack_channel.items() if name not in ("attack", "jammer", "flip")}
        more = {"flip": flip} if attack == "flip" else {}
        if attack in OVERHEARING:
            more = {"jammer": matches[0].receiver}
        tables["acknowledgements"] = {**ack_channel, "attack": attack, **more}
    return checked(tables, scenario.title)


def _events_alone(events: Iterable[EventKind], tables: Iterable[Tables]) -> Iterator[Tables]:
    """The tables of events as they concern the legitimate estimator: none names others, or attacks acknowledgements."""
    for event, table in zip(events, tables, strict=True):
        if event.does.attacked == Jamming.attacked:
            continue
        if set(event.names) <= {LEGITIMATE}:
            yield table
        elif LEGITIMATE in event.names:
            yield {**table, str(event.names_in): [LEGITIMATE]}


def _eavesdropper(scenario: Scenario, scheme: str, strategy: str) -> Tables:
    """The scenario's first eavesdropper of that strategy, else one on the link of the scenario's first eavesdropper."""
    tables: dict[str, Tables] = scenario.model_dump(mode="json", exclude_none=True)["eavesdroppers"]
    own = next((table for table in tables.values() if table["strategy"] == strategy), None)
    if own is not None and "reads_as" not in own:
        return _alone(own)
    legitimate = scenario.legitimate.model_dump(mode="json", exclude_none=True)
    donor = tables.get(_link_owner(scenario, strategy), legitimate)
    link = donor.get("link", {})  # none if it pools links: its own table has them
    kind = STRATEGIES[strategy]
    made: Tables = {"strategy": strategy, "window": donor["window"], **(own or {})}
    if kind.pools_links:
        made.setdefault("links", [{name: link[name] for name in ("quality", "loss") if name in link}] * 2)
    else:
        made.setdefault("link", link)
    if "reads_as" in kind.parameters:
        # The best strategy against this scheme: the scenario's own choice is for the scenario's own scheme.
        made = {name: value for name, value in made.items() if name in {*kind.parameters, *RESERVED}}
        made["reads_as"] = SCHEMES[scheme].best_reader
    if "learns_at" in kind.parameters:
        made.setdefault("learns_at", scenario.slots // 2)
    return _alone({**kind.parameters, **made})


def _wire_links(scenario: Scenario, matches: Sequence[Match]) -> dict[str, str]:
    """Receiver → its link of the scenario's wire: an adversary has that of the receiver whose link it has."""
    assert scenario.wire is not None  # noqa: S101 - the caller knows
    links, owners = scenario.wire.links, dict.fromkeys([LEGITIMATE], LEGITIMATE)
    for match in matches:
        if match.strategy is not None and not STRATEGIES[match.strategy].pools_links:
            owners[match.receiver] = _link_owner(scenario, match.strategy)
    return {receiver: links[owner] for receiver, owner in owners.items() if owner in links}


def _link_owner(scenario: Scenario, strategy: str) -> str:
    """The receiver whose link an adversary has: the first of its strategy, else the first eavesdropper with a link."""
    own = (name for name, table in scenario.eavesdroppers.items() if table.strategy == strategy)
    any_ = (name for name, table in scenario.eavesdroppers.items() if table.link is not None)
    return next(own, None) or next(any_, LEGITIMATE)


def _alone(table: Tables) -> Tables:
    """Remove a correlation with the losses of another eavesdropper, which may not be in this scenario."""
    link = table.get("link", {})
    if link.get("correlation", {}).get("with", LEGITIMATE) == LEGITIMATE:
        return table
    return {**table, "link": {name: value for name, value in link.items() if name != "correlation"}}
