"""Whether a process is there, asked of the router of a run under way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from evedrop.cli import main as cli
from evedrop.live.network.operator import is_there
from tests.live.network.bench import Bench, bench_of, small_network

EVE = "eve"


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is not let in gives up soon."""
    monkeypatch.setattr("evedrop.live.network.operator._CONNECT_SECONDS", 0.3)


@pytest.mark.thorough
@pytest.mark.usefixtures("impatient")
def test_who_is_ready_is_there_and_who_left_is_not(bench: Callable[..., Bench]) -> None:
    """By its token at the router, not by its process or its connection."""
    stage = bench()
    brief = stage.briefs[EVE]
    assert not is_there(brief)
    token = stage.sessions[EVE].liveliness().declare_token(stage.keys.alive(EVE))
    assert stage.tokens.hear() == (stage.keys.alive(EVE), b"")
    assert is_there(brief)
    assert not is_there(stage.briefs["mallory"])
    assert not is_there(replace(brief, password="of another run"))  # noqa: S106 - that is the point
    token.undeclare()
    assert stage.tokens.hear() == (f"deleted {stage.keys.alive(EVE)}", b"")
    assert not is_there(brief)


def test_the_router_is_asked_for_itself(bench: Callable[..., Bench]) -> None:
    """It is ready once it has found the others; no other process has its credentials."""
    assert is_there(bench().briefs["router"])


def test_behind_certificates_it_is_no_different(tmp_path: Path) -> None:
    """A router that listens everywhere is asked where it is found from its own machine, and has no name there."""
    with bench_of(small_network(), tmp_path, protocol="tls") as stage:
        assert is_there(replace(stage.briefs["router"], router=f"tls/0.0.0.0:{stage.briefs['router'].router[-5:]}"))
        assert not is_there(stage.briefs[EVE])


@pytest.mark.thorough
@pytest.mark.usefixtures("impatient")
def test_the_command_says_so(bench: Callable[..., Bench], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In words, and by its status."""
    stage = bench()
    path = stage.briefs["router"].write(tmp_path)
    assert cli.main(["health", str(path)]) == 0
    assert capsys.readouterr().out == f"router is on the network of {stage.keys.run}\n"
    nowhere = replace(stage.briefs[EVE], router="tcp/127.0.0.1:9").write(tmp_path)
    assert cli.main(["health", str(nowhere)]) == 1
    assert capsys.readouterr().out == f"eve is not on the network of {stage.keys.run}\n"
