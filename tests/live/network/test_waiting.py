"""A process that waits for its router says so."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from evedrop.errors import RunError
from evedrop.live.launch.briefs import ObserverTask, briefs_of
from evedrop.live.network import connecting
from evedrop.live.network.session import Session
from evedrop.ports import free_port
from tests.live.network.bench import scenario_of


def test_a_process_says_that_it_waits_for_its_router(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Every few seconds, on standard error: who waits, for which router, for how long, and what came of the last attempt."""
    monkeypatch.setattr(connecting, "WAITING_SECONDS", 0.3)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    brief = briefs_of(scenario_of(), endpoint, ObserverTask(tmp_path, False), ends_with_stdin=False)["eve"]
    with pytest.raises(RunError, match="no router answered"):
        Session(replace(brief, patience=1))
    said = capfd.readouterr().err.splitlines()
    line = rf"evedrop: eve: waiting for the router at {endpoint}: no answer yet \((0|1) s; Connection refused\)"
    assert [bool(re.fullmatch(line, one)) for one in said] == [True] * len(said)
    assert 2 <= len(said) <= 4
