"""The briefs of a run, which hold keys: on disk until their processes have read them, and no longer."""

from __future__ import annotations

import contextlib
import json
import sys
from pathlib import Path

import pytest

from evedrop.live.launch.briefs import ObserverTask, briefs_of
from evedrop.live.launch.children import Children
from evedrop.results.folder import new_folder
from evedrop.results.held_folder import HeldFolder
from tests.conftest import wait_until
from tests.live.network.bench import scenario_of


def test_a_brief_stays_until_the_process_that_was_started_again_has_joined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """News of an earlier restart may still be under way when the router is started again, which must find its brief."""
    says, program = tmp_path / "says", tmp_path / "program"
    program.write_text(
        f"#!/bin/sh\ncase $5 in *observer.json) cat {says};; esac\n"
    )  # instead of -P -m evedrop ROLE BRIEF
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))
    private, results = tmp_path / "private", new_folder(tmp_path / "run")
    private.mkdir()
    (results / "logs").mkdir(exist_ok=True)
    briefs = briefs_of(scenario_of(), "tcp/127.0.0.1:1", ObserverTask(results, False))
    told: list[object] = []
    with contextlib.closing(HeldFolder(results)) as folder, Children(folder, private) as children:

        def tell(event: str) -> bool:
            """Let the observer tell of an event; whether the router's brief is there afterwards."""
            lines = [{"event": event}, {"event": "progress", "done": len(told)}]
            says.write_text("".join(json.dumps(line) + "\n" for line in lines))
            children.start(briefs["observer"])
            wait_until(lambda: children.news(0.1) == lines[-1], "the observer's news")
            told.append(event)
            return (private / "router.json").exists()

        children.start(briefs["router"])
        assert not tell("started")
        children.start(briefs["router"], again=True)
        children.start(briefs["router"], again=True)
        assert tell("reconnected")
        assert not tell("reconnected")
