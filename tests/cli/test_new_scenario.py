"""The scenario that `evedrop new` writes names every entry that a scenario can have, and everything built in."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import ScenarioError
from evedrop.live.launch.hosts_file import HostsFile
from evedrop.model.acknowledgements import ATTACKS
from evedrop.model.controllers import CONTROLLERS
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.links import LOSS_MODELS
from evedrop.model.metrics import METRICS
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.events import EVENTS
from evedrop.scenario.loading import parse
from evedrop.scenario.table import Table
from evedrop.scenario.tables import Scenario
from evedrop.wire.tables import WireFile
from tests.conftest import LIMIT

NEW = (Path(__file__).parents[2] / "scenarios" / "_new.toml").read_text(encoding="utf-8")
WRITTEN_BY_EVEDROP = {"made_with"}
"""Entries that no author writes."""
SHORT = {"AckChannel": "Acknowledgements", "Correlation": "Legitimate", "Link": "Legitimate", "Program": "Process"}
"""Tables that have no heading, because they are written in a line of another table."""


def sections() -> dict[str, str]:
    """The lines below each heading, in comments or not, by the table's name in lower case; those above the first under ""."""
    headings: dict[str, str] = {"": ""}
    name = ""
    for line in NEW.splitlines():
        heading = re.match(r"(?:# )?\[{1,2}([a-z_]+)(?:\.\w+)?\]{1,2}", line)
        if heading is not None:
            name = heading[1]
        headings[name] = f"{headings.get(name, '')}{line}\n"
    return headings


def has_entry(text: str, entry: str) -> bool:
    """Whether a text has ENTRY = …, or the table of that name."""
    return (
        re.search(rf"(?<![\w.\"]){re.escape(entry)}(?:, [a-z, ]+ or [a-z]+)? = |\[{{1,2}}{entry}[\].]", text)
        is not None
    )


def entries() -> Iterator[tuple[str, str]]:
    """Each table's heading and one of its entries, from the schema and from the tables of applications."""
    schema: Mapping[str, Any] = Scenario.model_json_schema()
    for entry in schema["properties"]:
        yield "", entry
    for title, table in schema["$defs"].items():
        name = title.removesuffix("Table")
        for entry in table["properties"]:
            yield {"Eavesdropper": "eavesdroppers"}.get(name, SHORT.get(name, name).lower()), entry
    for name in APPLICATIONS.names:
        for entry in APPLICATIONS[name].table.model_json_schema(by_alias=True)["properties"]:
            yield name, entry
    for kind in EVENTS.values():
        for entry in kind.own_entries():
            yield "event", entry


@pytest.mark.parametrize(("heading", "entry"), sorted(set(entries())))
def test_every_entry_of_a_scenario_is_in_a_new_one(heading: str, entry: str) -> None:
    """In a comment or not, below the heading of its table."""
    text = NEW if heading == "" else sections()[heading]
    assert has_entry(text, entry) is (entry not in WRITTEN_BY_EVEDROP)


@pytest.mark.parametrize(
    "names",
    [SCHEMES, STRATEGIES, LOSS_MODELS, DELAY_MODELS, CONTROLLERS, SENSOR_ATTACKS, POLICIES, ATTACKS],
    ids=["schemes", "strategies", "losses", "delays", "controllers", "attacks on measurements", "policies", "attacks"],
)
def test_everything_built_in_is_in_a_new_one(names: Iterable[str]) -> None:
    """Each scheme, strategy, model, controller, policy and attack is named."""
    assert [name for name in names if f'"{name}"' not in NEW] == []


def test_every_metric_is_in_a_new_one() -> None:
    """Those that every run has."""
    assert [name for name in METRICS if name not in NEW] == []


def test_an_entry_that_is_missing_is_noticed() -> None:
    """So that the tests above test something."""
    assert not has_entry(sections()["event"], "explode")
    assert not has_entry(sections()["network"], "seed"), "it belongs to other tables"


def test_a_new_scenario_is_written_completely_or_not_at_all(tmp_path: Path) -> None:
    """A disk that is full leaves no empty file, which would be in the way of the next attempt."""
    path = tmp_path / "mine.toml"
    code = f"""if True:
        import resource
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
        from evedrop.cli.main import main
        raise SystemExit(main(["new", {str(path)!r}]))
    """
    # With -B: Python would leave half a .pyc of each module for the next process (before 3.12.8).
    done = subprocess.run(
        [sys.executable, "-B", "-c", code], check=False, capture_output=True, text=True, timeout=LIMIT
    )
    assert done.returncode == 2
    assert "mine.toml cannot be written (File too large); give another place" in done.stderr
    assert not path.exists()


def test_a_scenario_without_entries_says_where_to_start(tmp_path: Path) -> None:
    """An empty file gets one line, not the list of all that is missing."""
    with pytest.raises(ScenarioError) as refused:
        parse("# nothing\n", "mine.toml")
    assert refused.value.mistakes == ["has no entries; `evedrop new FILE` writes a scenario to start from"]


def tables(kind: type[Table]) -> Iterator[type[Table]]:
    """The tables of a kind, and of the kinds made from it."""
    for subclass in kind.__subclasses__():
        yield subclass
        yield from tables(subclass)


def test_an_entry_that_is_required_has_an_example() -> None:
    """So that no message about a missing entry only repeats its name, as "process: is missing; expected process" did."""
    assert {WireFile, HostsFile, Scenario} <= {*tables(Table)}
    bare = [
        f"{table.__name__}.{name}"
        for table in tables(Table)
        for name, field in table.model_fields.items()
        if table.__module__.startswith("evedrop.") and field.is_required() and not field.examples
    ]
    assert bare == []
