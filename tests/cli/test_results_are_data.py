"""Results are data: what only looks at a results folder imports nothing that the folder names."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from evedrop import load_results
from evedrop.cli.commands import MODULES
from evedrop.errors import NotRegistered
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.registry import no_modules
from evedrop.model.schemes import SCHEMES
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import silent
from evedrop.scenario.recorded import recorded
from evedrop.score.sums import SlotSums
from evedrop.show.view.scene_slots import replay
from evedrop.simulate.montecarlo import simulate
from tests.conftest import Evedrop
from tests.examples import mostly_long

SECURITY = Path(__file__).parents[2] / "SECURITY.md"
RUNS = frozenset(
    {"run", "demo", "montecarlo", "test", "compare", "sweep", "check", "design", "cost", "learned", "brief"}
)
"""Commands that run a scenario, or ask its classes: a scenario file is a program for them."""
LOOKS = {
    "view": (["--table"], ["--picture", "picture.png"], ["--video", "film.gif", "--slots", "0:2"]),
    "report": ([],),
    "export": (["run.mcap"],),
    "diff": (["run"],),
    "status": ([],),
    "pause": ([],),
    "resume": ([],),
    "step": (["1"],),
    "link": (["legitimate", "quality=0.5"],),
    "partition": (["legitimate", "smart"],),
    "heal": (["legitimate", "smart"],),
    "links fit": ([],),
    "process fit": ([],),
}
"""Commands that take a folder, and do not run its scenario → the arguments that follow the folder."""
NEITHER = frozenset(
    {"list", "show", "new", "wire", "figures", "paper", "docs", "completion", "selftest", "health", "host"}
    | {"router", "relay", "sensor", "legitimate", "eavesdropper", "controller", "recorder"}
)
"""Commands that take neither a scenario nor a results folder. The process of a run takes a brief, which the launcher wrote."""
EVIL = """from pathlib import Path
Path({mark!r}).touch()
"""


class _Killed(Exception):
    """The writer of results ends where it is."""


def names() -> set[str]:
    """Every command of the registry, as it is typed."""
    modules = [import_module(f"evedrop.cli.commands.{name}") for name in dict.fromkeys(MODULES.values())]
    return {
        command.name if command.group is None else f"{command.group} {command.name}"
        for module in modules
        for command in module.COMMANDS
    }


@pytest.fixture
def mark(evedrop: Evedrop) -> Path:
    """A results folder `run` whose scenario names a class of every kind in a module; the file that its import would make."""
    scenario = load("eavesdroppers", {"slots": 6, "trials": 2, "record_trials": 1, "expect": []})
    simulate(scenario, evedrop.folder / "run", silent)
    named(evedrop.folder / "run", ".")
    return evedrop.folder / "mark"


def named(run: Path, modules: str) -> None:
    """Let the scenario in a results folder name classes of `evil`, which is in a folder that is relative to the run's."""
    mark = run.parent / "mark"
    (run / modules).mkdir(exist_ok=True, parents=True)
    (run / modules / "evil.py").write_text(EVIL.format(mark=str(mark)), encoding="utf-8")
    text = (run / "scenario.toml").read_text(encoding="utf-8")
    text = re.sub("^modules.*\n", "", text, flags=re.MULTILINE)
    text = text.replace('scheme = "innovation"', 'scheme = "evil:S"').replace(
        'strategy = "smart"', 'strategy = "evil:E"'
    )
    own = 'loss = { model = "evil:L" }\ndelay = { model = "evil:D" }'
    text = re.sub("^quality = .*$", own, text, count=1, flags=re.MULTILINE)
    (run / "scenario.toml").write_text(f'modules = "{modules}"\n{text}', encoding="utf-8")
    for kind in ("S", "E", "L", "D"):
        assert f'"evil:{kind}"' in text


def test_every_command_looks_or_runs() -> None:
    """A new command must be sorted; SECURITY.md lists those for which a scenario is a program."""
    assert {*RUNS, *LOOKS, *NEITHER} == names()
    assert len(RUNS) + len(LOOKS) + len(NEITHER) == len(names())
    text = SECURITY.read_text(encoding="utf-8")
    listed = text.partition("A scenario file is a program")[2].partition("\n- ")[0]
    assert {*re.findall("`([a-z]+)`", listed)} == {*RUNS, "pytest"}


@pytest.mark.parametrize("command", mostly_long(LOOKS, {*LOOKS} - {"view"}))
def test_a_command_that_looks_imports_nothing(evedrop: Evedrop, mark: Path, command: str) -> None:
    """In every form; those that show results show what the tables have."""
    for more in LOOKS[command]:
        done = evedrop(*command.split(), "run", *more)
        assert not mark.exists(), done
        if command in {"view", "report", "export", "diff"}:
            assert done.status == 0 or "Vulkan" in done.err, done  # nothing to draw with


@pytest.mark.parametrize("where", ["lib", "../elsewhere", ""])
def test_wherever_the_modules_are(evedrop: Evedrop, mark: Path, where: str) -> None:
    """In a folder relative to the results, in one beside them, and in one by its whole path."""
    (evedrop.folder / "run" / "evil.py").unlink()
    named(evedrop.folder / "run", where or str(evedrop.folder / "whole"))
    for words in (["view", "run", "--table"], ["report", "run"], ["export", "run", "run.mcap"]):
        assert evedrop(*words).status == 0
    assert not mark.exists()


def test_a_run_in_progress_is_only_looked_at(evedrop: Evedrop) -> None:
    """Without metrics its theory would need the classes; a sentence says so. Its tables are shown."""
    run, mark = evedrop.folder / "run", evedrop.folder / "mark"
    run.mkdir(mode=0o700)
    scenario = load("eavesdroppers", {"slots": 12, "trials": 3, "record_trials": 2, "expect": []})
    write_resolved(run, scenario)
    named(run, ".")
    with suppress(_Killed), ResultsWriter(run, scenario) as writer:
        for receiver in scenario.receivers:
            writer.slot_rows(0, receiver, SlotSums(*(np.ones(1) for _ in fields(SlotSums))), np.zeros(1))
        writer.write_rows("slot 1")
        for words in (
            ["view", "run", "--table"],
            ["view", "run"],
            ["diff", "run", "run"],
            ["export", "run", "run.mcap"],
        ):
            done = evedrop(*words)
            assert (done.status, "looking at results imports none" in done.err) == (2, True), done
        raise _Killed
    assert not mark.exists()


def test_a_view_says_what_it_does_not_know(evedrop: Evedrop, mark: Path) -> None:
    """The words are those of the folder; the quality of a link whose loss model is not built in is left out."""
    result = recorded(evedrop.folder / "run")
    assert not result.complete
    assert (result.words["legitimate"], result.words["smart"], result.words["naive"]) == ("evil:S", "evil:E", "naive")
    assert result.unknown_links
    replay(evedrop.folder / "run")
    assert load_results(evedrop.folder / "run").plot() is not None
    assert not mark.exists()


def test_no_registry_imports_a_module_in_the_block() -> None:
    """Neither into this process, nor into one that asks a class."""
    with no_modules():
        for registry in (SCHEMES, STRATEGIES):
            with pytest.raises(NotRegistered, match="only looked at"):
                registry["evil:S"]
        assert SCHEMES["plain"].__name__ == "Plain"
