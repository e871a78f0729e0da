"""The tables of receivers: the legitimate estimator and the eavesdroppers.

Source: docs/scenario.md, legitimate and eavesdroppers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field

from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.registry import asked
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

    def mistakes(self) -> Iterator[Found]:
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
        for name, field in fields.items():
            if name in wanted and name not in given:
                of = "" if name == "link" else f"the strategy {self.strategy} needs it; "
                yield name, f"is missing; {of}expected {name} = {as_toml((field.examples or [0])[0])}"
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
        return {name: getattr(self, name) for name in names}

    @property
    def pool(self) -> LinkTable:
        """Its link, or its pooled links as one."""
        return LinkTable.pooled(self.links or []) if self.link is None else self.link
