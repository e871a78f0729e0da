"""What the pages say that eavesdroppers are granted is what their classes ask for."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper

ROOT = Path(__file__).parents[2]
OWN_STREAM = "coin"
"""The only stream of an eavesdropper that is not part of the secret."""


def built_in() -> dict[str, tuple[type[Eavesdropper], dict[str, Any]]]:
    """Each built-in strategy: its class, and parameters with which it reads as a strategy that is granted nothing."""
    return {
        name: (cls, {**cls.parameters, **({"reads_as": "naive"} if "reads_as" in cls.parameters else {})})
        for name, cls in ((name, STRATEGIES[name]) for name in STRATEGIES.names)
    }


def with_streams_of_the_secret() -> dict[str, set[str]]:
    """Strategy → the streams of the secret that it is granted by itself, for those that are granted any."""
    asked = {name: set(cls.streams(parameters)) - {OWN_STREAM} for name, (cls, parameters) in built_in().items()}
    return {name: streams for name, streams in asked.items() if streams}


def listed(names: list[str]) -> str:
    """Names in a sentence."""
    quoted = [f"`{name}`" for name in names]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} and {quoted[-1]}"


def strategies(names: list[str], message: str) -> str:
    """A sentence about strategies."""
    several = len(names) > 1
    return (
        f"The {'strategies' if several else 'strategy'} {listed(names)} {'are' if several else 'is'} granted {message}."
    )


def test_the_strategies_that_are_granted_something_are_named() -> None:
    """Those with the schedule, those with a true state, and those that have what another strategy has."""
    text = re.sub(r"\s+", " ", (ROOT / "docs" / "who-may-know-what.md").read_text(encoding="utf-8"))
    granted = with_streams_of_the_secret()
    assert set().union(*granted.values()) == {"schedule"}
    betrayed = [name for name, (cls, given) in built_in().items() if cls.betrayed(given) is not None]
    reading_as = [name for name, (cls, _) in built_in().items() if "reads_as" in cls.parameters]
    order = ["suspicious", "smart", "genie"]
    assert set(granted) == set(order)
    assert strategies(order, "the schedule, which is part of the secret") in text
    assert strategies(betrayed, "one true state") in text
    assert strategies(reading_as, "what the strategy that they read as is granted") in text


def test_the_table_of_strategies_says_what_each_knows() -> None:
    """The column `knows` of docs/eavesdroppers.md."""
    page = (ROOT / "docs" / "eavesdroppers.md").read_text(encoding="utf-8")
    begin = page.index("| strategy | what it does | knows | theory |")
    _, _, *rows = page[begin : page.index("\n\n", begin)].splitlines()
    knows = dict(re.findall(r"^\| `([\w-]+)` \|[^|]*\| ([^|]*) \|", "\n".join(rows), re.MULTILINE))
    granted = with_streams_of_the_secret()

    def of(name: str, cls: type[Eavesdropper]) -> str:
        if "reads_as" in cls.parameters:
            return "as `reads_as`"
        if "knows" in cls.parameters:
            return "nothing, or what `knows` names"
        return "the schedule" if name in granted else "nothing"

    assert knows == {name: of(name, cls) for name, (cls, _) in built_in().items()}


def test_the_protocol_lists_the_keys_of_each_strategy() -> None:
    """The row of the eavesdropper in the table of roles of docs/protocol.md."""
    page = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| `eavesdropper` \| (smart[^|]*) \|", page, re.MULTILINE)
    granted: dict[str, set[str]] = {}
    for part in row.split("; "):
        names, _, keys = part.partition(": ")
        for name in re.split(r", | and ", names):
            if name in STRATEGIES.names and keys.startswith("`"):
                granted[name] = set(re.findall(r"`(\w+)`", keys))
    asked = {name: set(cls.streams(given)) for name, (cls, given) in built_in().items()}
    assert granted == {name: streams for name, streams in asked.items() if streams}


def test_pages_that_name_the_rule_lead_to_the_exceptions() -> None:
    """What an eavesdropper cannot obtain is qualified wherever it is claimed."""
    for page in ("README.md", "SECURITY.md"):
        (claim,) = re.findall(
            r"^- An eavesdropper's process gets .*?(?=^- )", (ROOT / page).read_text("utf-8"), re.M | re.S
        )
        assert "(docs/who-may-know-what.md)" in claim
