"""Mistakes in links, acknowledgements, strategies and applications that only show when tables are compared.

Source: docs/scenario.md, links and acknowledgements.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.schemes.scheme import Scheme
from evedrop.names import LEGITIMATE
from evedrop.scenario.application import APPLICATIONS, Application, Kind
from evedrop.scenario.event_mistakes import away_in
from evedrop.scenario.link_table import LinkTable
from evedrop.scenario.plant import PlantTable
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.table import Table
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import as_toml, listed


def link_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes in correlations, and delays in seconds without `slot_seconds`."""
    for name, link in scenario.links.items():
        path = f"{LEGITIMATE}.link" if name == LEGITIMATE else f"eavesdroppers.{name}.link"
        if link.in_seconds and scenario.slot_seconds is None:
            yield f"{path}.delay.unit: is seconds; expected slot_seconds = 0.02, the duration of a slot, at the top of the file"
        if link.correlation is not None:
            yield from _correlation_mistakes(f"{path}.correlation.with", name, link, link.correlation.to, scenario)
    for name in () if scenario.wire is None else scenario.wire.links:
        if name not in scenario.receivers:
            yield f"wire.links.{name}: is not a receiver; expected {listed(scenario.receivers)}"
        elif name not in scenario.links:
            yield f"wire.links.{name}: is a receiver with several links; expected one with a single link"


def _correlation_mistakes(entry: str, name: str, link: LinkTable, other: str, scenario: Scenario) -> Iterator[str]:
    links = scenario.links
    if other not in scenario.receivers or other == name:
        others = [receiver for receiver in scenario.receivers if receiver != name]
        yield f"{entry}: is {as_toml(other)}; expected another receiver" + (f": {listed(others)}" if others else "")
    elif other in links and links[other].correlation is not None:
        yield f"{entry}: is {other}, whose own losses are tied to another link's; expected a link without correlation"
    elif other in links and links[other].loss_spec["model"] != link.loss_spec["model"]:
        models = f"{links[other].loss_spec['model']} there and {link.loss_spec['model']} here"
        yield f"{entry}: is {other}, but the loss models differ ({models}); expected the same model on both links"


def encoding_mistakes(scenario: Scenario) -> Iterator[str]:
    """A list of μ_d(k) that does not have one number for each slot."""
    given = scenario.encoding.state_probabilities
    if given is not None and len(given) != scenario.slots:
        yield (
            f"encoding.state_probability: has {len(given)} numbers; expected one number for each of the {scenario.slots} "
            "slots, or a single number for all"
        )


def acknowledgement_mistakes(scenario: Scenario) -> Iterator[str]:
    """Missing or needless acknowledgements, an unknown jammer, and link rates with a scheme that may be silent."""
    encoding, scheme, acknowledgements = scenario.encoding, scenario.scheme, scenario.acknowledgements
    if scheme.needs_acknowledgements and acknowledgements is None:
        yield (
            f"acknowledgements: is missing; the scheme {encoding.scheme} acts on acknowledgements; expected a table "
            "[acknowledgements] with link = { quality = 0.9 }"
        )
    if not scheme.needs_acknowledgements and acknowledgements is not None:
        yield f"acknowledgements: is given, but the scheme {encoding.scheme} needs none; remove the table"
    jammer = None if acknowledgements is None else acknowledgements.jammer
    eavesdroppers = scenario.receivers[1:]
    if jammer is not None and jammer not in eavesdroppers:
        yield f"acknowledgements.jammer: is {as_toml(jammer)}; expected an eavesdropper" + (
            f": {listed(eavesdroppers)}" if eavesdroppers else ", such as smart, in a table of its own"
        )
    if scheme.may_be_silent:
        for receiver, link in scenario.links.items():
            if link.rate is not None:
                path = receiver if receiver == LEGITIMATE else f"eavesdroppers.{receiver}"
                yield (
                    f"{path}.link.rate: is given, but the scheme {encoding.scheme} may stay silent, and a queue counts on a "
                    "packet in every slot; remove the line"
                )


def scheme_mistakes(scenario: Scenario) -> Iterator[str]:
    """Parameters of the scheme that do not fit the process."""
    for entry, sentence in scenario.scheme.mistakes_with(scenario.process.process, scenario.encoding.parameters):
        yield f"encoding.{entry}: {sentence}"


def strategy_mistakes(scenario: Scenario) -> Iterator[str]:
    """Strategies that need a stream the scheme lacks, and leaks in a slot beyond the run or while the eavesdropper is away."""
    for name, table in scenario.eavesdroppers.items():
        strategy, path = STRATEGIES[table.strategy], f"eavesdroppers.{name}"
        lacking = lacking_streams(strategy.streams(table.parameters), scenario.scheme)
        if lacking:
            entry, value = ("reads_as", table.reads_as) if table.reads_as else ("strategy", table.strategy)
            able = [reader for reader in READERS if not READERS[reader].streams({})]
            yield (
                f"{path}.{entry}: is {as_toml(value)}, which is defined by its knowledge of the {listed(lacking)}, and the "
                f"scheme {scenario.encoding.scheme} has none; expected {listed(sorted(able))}"
            )
        betrayed = strategy.betrayed(table.parameters)
        if betrayed is None:
            continue
        if betrayed >= scenario.slots:
            yield f"{path}.learns_at: is {betrayed}; expected a slot of the run, 0 to {scenario.slots - 1}"
        away = away_in(scenario, name, betrayed)
        if away is not None:
            yield f"{path}.learns_at: is {betrayed}, when {away}; expected a slot in which it is present"


def lacking_streams(streams: Iterable[str], scheme: type[Scheme]) -> list[str]:
    """The streams whose keys a strategy needs and a scheme does not have; the strategy's own coin is not among them."""
    return [stream for stream in streams if stream != "coin" and stream not in scheme.secret_streams]


def application_mistakes(scenario: Scenario) -> Iterator[str]:
    """Applications without plant or controller, names that plant and process lack, and eavesdroppers of the same name."""
    for name, table in scenario.applications.items():
        if scenario.plant is None or scenario.controller is None:
            yield f"{name}: is given without a [plant] and a [controller]; expected both, or no table [{name}]"
        else:
            yield from _named_mistakes(name, APPLICATIONS[name], table, scenario.process, scenario.plant)
        if name in scenario.receivers[1:]:
            yield f"eavesdroppers.{name}: is a name that the {name}'s metrics use; expected another"


def _named_mistakes(
    name: str, application: type[Application], table: Table, process: ProcessTable, plant: PlantTable
) -> Iterator[str]:
    names: dict[Kind, list[str]] = {
        "states": process.states or [],
        "inputs": plant.inputs,
        "disturbances": plant.disturbances,
    }
    for entry, kind in application.names.items():
        given, there = getattr(table, entry), names[kind]
        if given is not None and given not in there:
            where = f"process.{kind}" if kind == "states" else f"plant.{kind}"
            choice = f"expected one of {listed(there)}" if there else f"expected {where} = [{as_toml(given)}, …]"
            yield f"{name}.{entry}: is {as_toml(given)}, which is not among {where}; {choice}"
