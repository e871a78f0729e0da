"""Ways past a wire: programs in mode peer and joined sides are noticed at once, and leave the wire without a verdict."""

from __future__ import annotations

import re
import sys
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from evedrop import wire
from evedrop.show.report.wire import wire_outcome
from evedrop.system.ports import free_port
from evedrop.wire import neighbours as bypasses_module
from evedrop.wire.departures import MOST
from evedrop.wire.file import resolved_wire, wire_lines, wire_of
from evedrop.wire.neighbours import Bypasses
from evedrop.wire.plan import Side
from evedrop.wire.running import ExpectationFailed
from tests.conftest import wait_until
from tests.pages import checked
from tests.wire.wire_at_work import ANYWHERE, WireAtWork, at_work, both_ways, program

PAGE = Path(__file__).parents[2] / "docs" / "wire" / "semantics.md"
LINK = {"name": "scan", "from": "robot", "to": "base", "quality": 0.6}


@pytest.fixture(autouse=True)
def multicast(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The multicast by which wires scout for a second, as entries of Zenoh's configuration: on this machine alone."""
    made = {"enabled": True, "interface": "lo", "address": f"224.0.0.229:{free_port()}"}
    monkeypatch.setattr(bypasses_module, "_MULTICAST", made)
    monkeypatch.setattr(bypasses_module, "_SCOUT_SECONDS", 1.0)
    return made


def bypasses(at: WireAtWork) -> list[str]:
    """The ways past the wire that its journal has."""
    return [event.line for event in at.journal.history.events if event.bypass]


def told(at: WireAtWork, beginning: str) -> bool:
    """Whether the latest way past the wire begins with these words."""
    return any(line.startswith(beginning) for line in bypasses(at)[-1:])


def test_a_program_in_mode_peer_is_reported_once(tmp_path: Path) -> None:
    """With its id, its side and the remedy, on the terminal and in the journal, even if it only connects for a moment."""
    with at_work(both_ways(), tmp_path) as at:
        with at.program("robot"), at.program("base"):
            pass  # clients are no bypass: what follows is all
        with at.program("base", mode="peer") as peer:
            zid = str(peer.zid())
            wait_until(peer.info.routers_zid, "it is connected")  # a program in mode peer does not wait for it
        wait_until(lambda: at.told, "it is reported")
        with at.program("robot", mode="peer"):
            wait_until(lambda: len(at.told) > 1, "the other one is reported")
        assert at.told == bypasses(at)
        assert at.told[0].startswith(f"the program {zid} at side base is in mode peer: ")
        assert 'connect it with mode "client"' in at.told[0]
        assert "side.base.peers = true" in at.told[0]


def test_a_program_that_waits_for_the_wire_is_reported(tmp_path: Path) -> None:
    """It may connect before the wire listens for such programs."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    waiting = {"endpoints": [endpoint], "timeout_ms": -1, "exit_on_failure": False, "retry": {"period_init_ms": 50}}
    plan = both_ways(sides={"base": Side("base", (endpoint,))})
    with program([], mode="peer", connect=waiting), at_work(plan, tmp_path) as at:
        wait_until(lambda: bypasses(at), "it is reported")


def test_a_side_may_allow_mode_peer(tmp_path: Path) -> None:
    """Its programs are not reported, and those of other sides are; the file and `--check` have the entry."""
    plan = wire_of({"side": {"robot": {"peers": True}, "base": {}}, "link": [LINK]})
    assert wire_of(tomllib.loads(resolved_wire(plan))) == plan
    assert [line.endswith("(mode peer allowed)") for line in wire_lines(plan)][:2] == [True, False]
    with at_work(plan, tmp_path) as at, at.program("robot", mode="peer"), at.program("base", mode="peer") as other:
        wait_until(lambda: at.told, "it is reported")
        assert [str(other.zid()) in line for line in at.told] == [True]


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform != "linux", reason="multicast over the loopback interface lo")
def test_a_program_that_scouts_by_multicast_is_reported_where_mode_peer_is_allowed(
    tmp_path: Path, multicast: dict[str, Any]
) -> None:
    """The wire scouts when such a program connects, and again when another one does; one that does not scout is no bypass."""
    silent = {"mode": "peer", "listen": {"endpoints": ["tcp/127.0.0.1:0"]}}
    plan = both_ways(sides={"base": Side("base", (ANYWHERE,), peers=True)})
    with at_work(plan, tmp_path) as at, at.program("base", **silent):
        for _ in range(2):
            with at.program("base", **silent, scouting={"multicast": multicast}) as peer:
                beginning = f"the program {peer.zid()} at side base answers multicast scouting, although"
                wait_until(partial(told, at, beginning), "it is reported")
        assert at.told == bypasses(at)


def test_programs_that_connect_again_and_again_do_not_fill_the_journal() -> None:
    """After some, one line says that there are more."""
    lines: list[str] = []
    ways = Bypasses(lines.append)
    for number in range(3 * MOST):
        ways.add(f"way {number}")
    assert lines[:MOST] == [f"way {number}" for number in range(MOST)]
    assert [re.search(r"more than (\d+) ways", line) is not None for line in lines[MOST:]] == [True]


def test_a_wire_past_which_programs_could_speak_has_no_verdict(tmp_path: Path) -> None:
    """An expectation that would hold fails; status, summary, page and the `with` statement say why."""
    expectation: dict[str, Any] = {"metric": "scan.heard", "below": 1}
    running = wire(side=["robot", "base"], link=[LINK], expect=[expectation], out=tmp_path / "wire")

    def use() -> None:
        running.expect(**expectation)
        with program([running.endpoint("base")], mode="peer"):
            wait_until(lambda: running.status().bypasses, "it is in the status")
        assert any(line.startswith("no verdict: the program ") for line in running.status().lines)
        with pytest.raises(
            ExpectationFailed, match=r"FAILED, programs could speak past the wire, found 0; .*\nthe program "
        ):
            running.expect(**expectation)

    with pytest.raises(ExpectationFailed, match=r"heard below 1: FAILED.*\nno verdict: .*is in mode peer"), running:
        use()
    summary = running.typed_summary()
    assert [bypass.event.split()[0] for bypass in summary.bypasses] == ["the"]
    assert [(judged.held, judged.why) for judged in summary.expectations] == [
        (None, "programs could speak past the wire")
    ]
    assert wire_outcome(summary) == (
        "no verdict, because programs could speak past the wire; 1 of 1 expectations FAILED",
        False,
    )
    page = checked(tmp_path / "wire")
    assert {f"no verdict: {summary.bypasses[0].event}", wire_outcome(summary)[0]} <= set(page.texts)


@pytest.mark.thorough
def test_a_wire_without_expectations_fails_too(tmp_path: Path) -> None:
    """The exit status is 1, which the `with` statement raises as a failure."""
    running = wire(side=["robot", "base"], link=[LINK], out=tmp_path / "wire")

    def use() -> None:
        with program([running.endpoint("base")], mode="peer"):
            wait_until(lambda: running.status().bypasses, "it is noticed")

    with pytest.raises(ExpectationFailed, match="is in mode peer"), running:
        use()


def test_the_first_section_of_the_page_says_what_programs_need() -> None:
    """And what for: other programs find each other by multicast, unless they are told not to."""
    _, title, section, *_ = re.split(r"^## (.*)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert title == "What programs need"
    assert section.lstrip().startswith("**Each program connects to one side, in Zenoh's mode `client`**")
    assert "multicast" in section
