"""Briefs of scenarios of many kinds, and what their reader says of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from evedrop.errors import BriefError
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol.brief import AnyBrief, Brief, EavesdropperPart, Flow, Model, read_brief
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from tests.builders import listener, scenario_of

BRIEF = Brief(
    run="r01",
    process="eve",
    role="eavesdropper",
    router="tcp/127.0.0.1:17460",
    user="eve",
    password="p",  # noqa: S106 - an example
    slots=10,
    trials=3,
    first_trial=5,
    recorded=1,
    flow=Flow(8, 2),
    model=Model([[1.0, 0.1], [0.0, 1.0]], [[1e-3, 0.0], [0.0, 1e-3]], [[1.0, 0.0], [0.0, 1.0]], 0.5),
    keys={"schedule": "ab" * 32},
    part=EavesdropperPart("smart", {}, 0, []),
    ends_with_stdin=False,
)


def briefed(seed: int = 3, **changes: Any) -> Scenario:
    """A scenario with one eavesdropper of each strategy."""
    tables: dict[str, Any] = {
        "slots": 50,
        "seed": seed,
        "legitimate": {"link": {"quality": 0.8}},
        "eavesdroppers": {
            "naive": listener("naive", 0.8),
            "smart": listener("smart", 0.8),
            "doubtful": listener("suspicious", 0.8, use_state=0.9, use_innovation=0.1),
        },
    }
    return scenario_of(BRIEF.model.process, **{**tables, **changes})


def made(scenario: Scenario) -> dict[str, AnyBrief]:
    """The briefs of a scenario."""
    return briefs_of(scenario, endpoints_at("tcp/127.0.0.1:1"), RecorderTask(Path("nowhere"), False))


_NONE: dict[str, Any] = {}
_AS_THEY_ARE = ("eavesdroppers", "acknowledged", "microgrid", "twin-track", "colluding", "restart", "noise-before")
KINDS = {
    **dict.fromkeys(_AS_THEY_ARE, _NONE),
    "replay-attack": {"integrity.attack": {"model": "replace", "matrix": [[0.8]]}},
}
"""Scenarios → what is changed in them."""


def every_brief() -> dict[str, dict[str, Any]]:
    """Briefs of scenarios of many kinds, as JSON, by scenario and process."""
    briefs = {}
    for name, changes in KINDS.items():
        scenario = load(name, {"slots": 8, "trials": 2, "record_trials": 1, "expect": [], "event": [], **changes})
        for process, brief in made(scenario).items():
            briefs[f"{name}/{process}"] = json.loads(brief.text)
    return briefs


def refusal(brief: dict[str, Any], folder: Path) -> str | None:
    """The message about a brief; None if it can be used."""
    path = folder / "brief.json"
    path.unlink(missing_ok=True)  # a new file: to write over the old one takes ten times as long
    path.write_text(json.dumps(brief))
    path.chmod(0o600)
    try:
        read_brief(path).expect_usable()
    except BriefError as error:
        return str(error)
    return None


BRIEFS = every_brief()
