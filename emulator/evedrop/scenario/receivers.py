"""The tables of receivers: the legitimate estimator and the eavesdroppers.

Source: docs/scenario.md, legitimate and eavesdroppers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field

from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.registry import asked, is_own
from evedrop.scenario.link_table import LinkField, LinkTable, WindowField
from evedrop.scenario.table import Found, Probability, Table, registered
from evedrop.scenario.words import as_toml, listed, no_entry


class LegitimateTable(Table):
    """`[legitimate]`: the legitimate estimator's link and window, and whether it knows the inputs."""

    link: LinkField
    window: WindowField = 0
    knows_input: Annotated[bool, Field(strict=True, examples=[True])] = False


class EavesdropperTable(Table):
    """`[eavesdroppers.NAME]`: a strategy with its parameters, and one link or several."""

    model_config = ConfigDict(extra="allow")

    strategy: Annotated[str, Field(strict=True, examples=["smart"]), AfterValidator(registered(STRATEGIES))]
    link: Annotated[LinkTable | None, Field(examples=[{"quality": 0.9}])] = None
    links: Annotated[
        list[LinkTable] | None, Field(min_length=2, max_length=16, examples=[[{"quality": 0.6}, {"quality": 0.5}]])
    ] = None
    reads_as: Annotated[
        Annotated[str, Field(strict=True), AfterValidator(registered(READERS))] | None, Field(examples=["smart"])
    ] = None
    learns_at: Annotated[int | None, Field(ge=0, strict=True, examples=[40])] = None
    window: WindowField = 0
    use_state: Annotated[Probability | None, Field(examples=[0.8])] = None
    use_innovation: Annotated[Probability | None, Field(examples=[0.2])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Missing, unknown and wrong parameters of the strategy, and a missing link."""
        strategy = STRATEGIES.get(str(table.get("strategy")))
        example = as_toml((cls.model_fields["link"].examples or [0])[0])
        strange = [name for name in table if name not in cls.model_fields]
        if strategy is None:
            lost = table.get("link") is None and table.get("links") is None
            mistakes = [("link", f"is missing; expected link = {example}")] if lost else []
            # Nobody knows which entries a class that cannot be loaded has.
            expected_names = strange if is_own(table.get("strategy")) else []
            return mistakes + [
                (name, no_entry(name, [*cls.model_fields])) for name in strange if name not in expected_names
            ]
        reader = READERS.get(str(table.get("reads_as"))) if "reads_as" in strategy.parameters else None
        parameters = {**strategy.parameters, **(reader.parameters if reader is not None else {})}
        wanted = {"links" if strategy.pools_links else "link", *parameters}
        mistakes = [
            (name, no_entry(name, [*{**cls.model_fields, **parameters}])) for name in strange if name not in wanted
        ]
        mistakes += [
            (name, f"is missing; the strategy {table['strategy']} needs it; expected {name} = {as_toml(parameter)}")
            for name, parameter in parameters.items()
            if name not in cls.model_fields and table.get(name) is None
        ]
        for name, field in cls.model_fields.items():
            given = table.get(name) is not None
            if name in wanted and not given:
                of = "" if name == "link" else f"the strategy {table['strategy']} needs it; "
                mistakes.append((name, f"is missing; {of}expected {name} = {as_toml((field.examples or [0])[0])}"))
            if given and name not in {"strategy", "window", *wanted}:
                instead = "; its entry is links" if name == "link" else ""
                sentence = (
                    f"is set, but the strategy {table['strategy']} has no such parameter{instead}; remove the line"
                )
                mistakes.append((name, sentence))
        for kind in (strategy, reader):
            if kind is not None:
                mistakes += asked(kind, {name: table[name] for name in kind.parameters if table.get(name) is not None})
        for i, link in enumerate(table.get("links") or []) if isinstance(table.get("links"), list) else ():
            entries = {name for name, value in link.items() if value} if isinstance(link, Mapping) else set()
            more = sorted(entries - {"quality", "loss"})
            if more:
                mistakes.append(
                    (f"links.{i}", f"has {listed(more)}; links that are pooled have only a quality or a loss")
                )
        return mistakes

    @property
    def parameters(self) -> dict[str, Any]:
        """The strategy's parameters, and those of the strategy named by `reads_as`."""
        names = [*STRATEGIES[self.strategy].parameters]
        if self.reads_as is not None:
            names += READERS[self.reads_as].parameters
        return {name: getattr(self, name) for name in names}

    @property
    def pool(self) -> LinkTable:
        """Its link, or its pooled links as one."""
        return LinkTable.pooled(self.links or []) if self.link is None else self.link
