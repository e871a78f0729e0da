"""Mistakes in links, acknowledgements, strategies and applications that only show when tables are compared.

Source: docs/scenario.md, links and acknowledgements.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.schemes.scheme import Scheme
from evedrop.names import LEGITIMATE
from evedrop.scenario.application import Application, Kind
from evedrop.scenario.event_mistakes import away_in
from evedrop.scenario.link_table import LinkTable
from evedrop.scenario.table import Table
from evedrop.scenario.valid import ValidTables
from evedrop.scenario.words import as_toml, listed


def link_mistakes(tables: ValidTables) -> Iterator[str]:
    """Mistakes in correlations, and delays in seconds without `slot_seconds`."""
    for name, link in tables.links.items():
        path = f"{LEGITIMATE}.link" if name == LEGITIMATE else f"eavesdroppers.{name}.link"
        if link.in_seconds and "slot_seconds" not in tables.given:
            yield f"{path}.delay.unit: is seconds; expected slot_seconds = 0.02, the duration of a slot, at the top of the file"
        if link.correlation is not None:
            yield from _correlation_mistakes(f"{path}.correlation.with", name, link, link.correlation.to, tables)
    for name in () if tables.wire is None else tables.wire.links:
        if name not in tables.receivers:
            yield f"wire.links.{name}: is not a receiver; expected {listed(tables.receivers)}"
        elif name not in tables.links and tables.scenario is not None:
            yield f"wire.links.{name}: is a receiver with several links; expected one with a single link"


def _correlation_mistakes(entry: str, name: str, link: LinkTable, other: str, tables: ValidTables) -> Iterator[str]:
    links = tables.links
    if other not in tables.receivers or other == name:
        others = [receiver for receiver in tables.receivers if receiver != name]
        yield f"{entry}: is {as_toml(other)}; expected another receiver" + (f": {listed(others)}" if others else "")
    elif other in links and links[other].correlation is not None:
        yield f"{entry}: is {other}, whose own losses are tied to another link's; expected a link without correlation"
    elif other in links and links[other].loss_spec["model"] != link.loss_spec["model"]:
        models = f"{links[other].loss_spec['model']} there and {link.loss_spec['model']} here"
        yield f"{entry}: is {other}, but the loss models differ ({models}); expected the same model on both links"


def encoding_mistakes(tables: ValidTables) -> Iterator[str]:
    """A list of μ_d(k) that does not have one number for each slot."""
    given = None if tables.encoding is None else tables.encoding.state_probabilities
    if given is not None and tables.slots is not None and len(given) != tables.slots:
        yield (
            f"encoding.state_probability: has {len(given)} numbers; expected one number for each of the {tables.slots} "
            "slots, or a single number for all"
        )


def acknowledgement_mistakes(tables: ValidTables) -> Iterator[str]:
    """Missing or needless acknowledgements, an unknown jammer, and link rates with a scheme that may be silent."""
    encoding, scheme, given = tables.encoding, tables.scheme, "acknowledgements" in tables.given
    if encoding is not None and scheme is not None and scheme.needs_acknowledgements and not given:
        yield (
            f"acknowledgements: is missing; the scheme {encoding.scheme} acts on acknowledgements; expected a table "
            "[acknowledgements] with link = { quality = 0.9 }"
        )
    if encoding is not None and scheme is not None and not scheme.needs_acknowledgements and given:
        yield f"acknowledgements: is given, but the scheme {encoding.scheme} needs none; remove the table"
    jammer = None if tables.acknowledgements is None else tables.acknowledgements.jammer
    eavesdroppers = tables.receivers[1:]
    if jammer is not None and jammer not in eavesdroppers:
        yield f"acknowledgements.jammer: is {as_toml(jammer)}; expected an eavesdropper" + (
            f": {listed(eavesdroppers)}" if eavesdroppers else ", such as smart, in a table of its own"
        )
    if encoding is not None and scheme is not None and scheme.may_be_silent:
        for receiver, link in tables.links.items():
            if link.rate is not None:
                path = receiver if receiver == LEGITIMATE else f"eavesdroppers.{receiver}"
                yield (
                    f"{path}.link.rate: is given, but the scheme {encoding.scheme} may stay silent, and a queue counts on a "
                    "packet in every slot; remove the line"
                )


def scheme_mistakes(tables: ValidTables) -> Iterator[str]:
    """Parameters of the scheme that do not fit the process."""
    if tables.process is not None and tables.encoding is not None and tables.scheme is not None:
        for entry, sentence in tables.scheme.mistakes_with(tables.process.process, tables.encoding.parameters):
            yield f"encoding.{entry}: {sentence}"


def strategy_mistakes(tables: ValidTables) -> Iterator[str]:
    """Strategies that need a stream the scheme lacks, and leaks in a slot beyond the run or while the eavesdropper is away."""
    for name, table in tables.eavesdroppers.items():
        strategy, path = STRATEGIES[table.strategy], f"eavesdroppers.{name}"
        lacking = [] if tables.scheme is None else lacking_streams(strategy.streams(table.parameters), tables.scheme)
        if lacking and tables.encoding is not None:
            entry, value = ("reads_as", table.reads_as) if table.reads_as else ("strategy", table.strategy)
            able = [reader for reader in READERS if not READERS[reader].streams({})]
            yield (
                f"{path}.{entry}: is {as_toml(value)}, which is defined by its knowledge of the {listed(lacking)}, and the "
                f"scheme {tables.encoding.scheme} has none; expected {listed(sorted(able))}"
            )
        betrayed = strategy.betrayed(table.parameters)
        if betrayed is None:
            continue
        if tables.slots is not None and betrayed >= tables.slots:
            yield f"{path}.learns_at: is {betrayed}; expected a slot of the run, 0 to {tables.slots - 1}"
        away = away_in(tables, name, betrayed)
        if away is not None:
            yield f"{path}.learns_at: is {betrayed}, when {away}; expected a slot in which it is present"


def lacking_streams(streams: Iterable[str], scheme: type[Scheme]) -> list[str]:
    """The streams whose keys a strategy needs and a scheme does not have; the strategy's own coin is not among them."""
    return [stream for stream in streams if stream != "coin" and stream not in scheme.secret_streams]


def application_mistakes(tables: ValidTables) -> Iterator[str]:
    """Applications without plant or controller, names that plant and process lack, and eavesdroppers of the same name."""
    for name, application in tables.applications.items():
        if not {"plant", "controller"} <= {*tables.given}:
            yield f"{name}: is given without a [plant] and a [controller]; expected both, or no table [{name}]"
        elif name in tables.application_tables:
            yield from _named_mistakes(name, application, tables.application_tables[name], tables)
        if name in tables.receivers[1:]:
            yield f"eavesdroppers.{name}: is a name that the {name}'s metrics use; expected another"


def _named_mistakes(name: str, application: type[Application], table: Table, tables: ValidTables) -> Iterator[str]:
    process, plant = tables.process, tables.plant
    names: dict[Kind, list[str]] = {} if process is None else {"states": process.states or []}
    names |= {} if plant is None else {"inputs": plant.inputs, "disturbances": plant.disturbances}
    for entry, kind in application.names.items():
        given, there = getattr(table, entry), names.get(kind)
        if given is not None and there is not None and given not in there:
            where = f"process.{kind}" if kind == "states" else f"plant.{kind}"
            choice = f"expected one of {listed(there)}" if there else f"expected {where} = [{as_toml(given)}, …]"
            yield f"{name}.{entry}: is {as_toml(given)}, which is not among {where}; {choice}"
