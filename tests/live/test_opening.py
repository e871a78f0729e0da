"""Zenoh cannot begin, because `ZENOH_RUNTIME` is malformed or the machine lacks threads: every command says so in a sentence."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import zenoh

from evedrop.cli.main import main
from evedrop.errors import RunError, UsageError
from evedrop.live.network.connecting import open_session
from evedrop.live.network.control_file import Control
from evedrop.names import OPERATOR
from evedrop.system.environment import check_zenoh_runtime
from tests.conftest import LIMIT

WIRE = """
[side.robot]
[side.base]
[[link]]
from = "robot"
to = "base"
"""
OPENS = """
import json, zenoh
quiet = {"mode": "router", "scouting": {"multicast": {"enabled": False}}, "listen": {"endpoints": []}}
zenoh.open(zenoh.Config.from_json5(json.dumps(quiet))).close()
"""
GOOD = [
    "()",
    "(rx: ())",
    "(rx: (worker_threads: 1,),)",
    " ( rx : ( worker_threads : 2 ), tx:(handover:app, max_blocking_threads:0) ) ",
]
BAD = [
    "nonsense",
    "",
    "(rx: (worker_threads: 1)",
    "(rx: (worker_threads: -1))",
    "(rx: (workers: 1))",
    "(rx: (handover: foo))",
    "(foo: ())",
    "(rx: (), rx: ())",
    "(rx: (worker_threads: 1, worker_threads: 2))",
]


class PanicException(BaseException):
    """As Zenoh raises it; it cannot be imported."""


@pytest.fixture
def without_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """No session can start a thread."""

    def panics(_: object) -> None:
        raise PanicException("OS can't spawn worker thread: Resource temporarily unavailable (os error 11)")

    monkeypatch.setattr(zenoh, "open", panics)


@pytest.mark.parametrize(("given", "good"), [*((text, True) for text in GOOD), *((text, False) for text in BAD)])
def test_a_malformed_runtime_is_refused(given: str, good: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a well-formed one is not."""
    monkeypatch.setenv("ZENOH_RUNTIME", given)
    if good:
        check_zenoh_runtime()
    else:
        with pytest.raises(UsageError, match=r"ZENOH_RUNTIME is .* which Zenoh cannot read; unset it, or give parts"):
            check_zenoh_runtime()


@pytest.mark.long
@pytest.mark.parametrize(("given", "good"), [*((text, True) for text in GOOD), *((text, False) for text in BAD)])
def test_zenoh_reads_what_is_not_refused(given: str, good: bool) -> None:
    """What the sentence says is true."""
    environment = {**os.environ, "ZENOH_RUNTIME": given}
    done = subprocess.run(
        [sys.executable, "-c", OPENS], env=environment, check=False, capture_output=True, timeout=LIMIT
    )
    assert (done.returncode == 0) is good


def commands(folder: Path) -> list[list[str]]:
    """Commands that open sessions, themselves or in their processes."""
    (folder / "w.toml").write_text(WIRE)
    Control("r", "tcp/127.0.0.1:1", OPERATOR, "secret").write(folder)
    return [
        ["wire", str(folder / "w.toml"), "--out", str(folder / "out")],
        ["status", str(folder)],
        ["link", str(folder), "scan", "cut"],
        ["run", "eavesdroppers", "--slots", "5", "--view", "off", "--out", str(folder / "run")],
    ]


@pytest.mark.parametrize("at", range(4), ids=["wire", "status", "link", "run"])
def test_every_command_refuses_a_malformed_runtime(
    at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """With status 2, as a mistake in the command line; and no panic."""
    monkeypatch.setenv("ZENOH_RUNTIME", "nonsense")
    status = main(commands(tmp_path)[at])
    errors = capfd.readouterr().err
    assert (status, "panicked" in errors, "Traceback" in errors) == (2, False, False), errors
    assert 'evedrop: the environment variable ZENOH_RUNTIME is "nonsense", which Zenoh cannot read; ' in errors
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("without_threads")
@pytest.mark.parametrize("at", range(3), ids=["wire", "status", "link"])
def test_every_command_says_that_threads_are_lacking(
    at: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """With status 3."""
    assert main(commands(tmp_path)[at]) == 3
    errors = capfd.readouterr().err
    assert errors.splitlines()[-1].startswith("evedrop: no further process or thread can be started; ")
    assert "Traceback" not in errors


@pytest.mark.usefixtures("without_threads")
def test_a_session_without_threads_is_an_error_of_the_run() -> None:
    """So those who try again after a lost connection do; they handle no panic."""
    with pytest.raises(RunError, match="no further process or thread can be started"):
        open_session({})


@pytest.mark.parametrize("error", [zenoh.ZError("no"), PanicException("other"), KeyboardInterrupt()])
def test_other_errors_of_a_session_stay(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they are."""

    def fails(_: Any) -> None:
        raise error

    monkeypatch.setattr(zenoh, "open", fails)
    with pytest.raises(type(error)):
        open_session({})
