"""The scenario of a results folder whose classes are not imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tomli_w

from evedrop.scenario.recorded import recorded
from tests.builders import GOOD

SLOW = {"model": "slow:Slow", "value": 1.0}
REORDER = {"at": 20, "link": "smart", "set": {"reorder": 0.2}}


@pytest.mark.parametrize(
    ("link", "events", "kept"),
    [
        ({"quality": 0.9, "delay": SLOW}, [REORDER], []),
        (
            {"quality": 0.9, "delay": SLOW},
            [{**REORDER, "link": ["smart"], "set": {"reorder": 0.2, "quality": 0.5}}],
            [0],
        ),
        ({"loss": {"model": "slow:Lossy"}, "rate": 0.5}, [{**REORDER, "set": {"queue": 3}}], []),
        ({"quality": 0.9}, [{"at": 10, "link": "smart", "set": {"delay": SLOW}}, REORDER], []),
        ({"quality": 0.9, "delay": SLOW}, [{"at": 20, "link": "legitimate", "set": {"corrupt": 0.5}}], [0]),
        ({"quality": 0.9, "delay": SLOW}, [{"at": 20, "cut": "smart"}], [0]),
    ],
)
def test_changes_of_what_is_left_out_of_a_link_are_left_out(
    tmp_path: Path, link: dict[str, Any], events: list[dict[str, Any]], kept: list[int]
) -> None:
    """So that the rest can be looked at."""
    tables = {**GOOD, "eavesdroppers": {"smart": {"strategy": "smart", "link": link}}, "event": events}
    (tmp_path / "scenario.toml").write_text(tomli_w.dumps(tables))
    scenario = recorded(tmp_path).scenario
    assert [act.at for act in scenario.timeline.acts] == [events[i]["at"] for i in kept]
