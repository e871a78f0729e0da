"""A wire is steered while it runs, by the commands that people type."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from evedrop.cli.main import main
from evedrop.live.network.control_file import read_control
from evedrop.live.network.operator import ask
from evedrop.live.protocol.codec import enclosed
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.requests import OperatorRequest
from evedrop.names import RECORDER
from evedrop.wire.scorekeeper import WireScorekeeper
from evedrop.wire.steering import WireConductor, WireControl
from tests.conftest import LIMIT, wait_until
from tests.wire.wire_at_work import LOSSY, WireAtWork, at_work, both_ways, program


@contextlib.contextmanager
def steered(folder: Path) -> Iterator[WireAtWork]:
    """A wire that can be steered."""
    plan = both_ways(LOSSY)
    events: list[str] = []
    with at_work(plan, folder) as wire:
        keeper = WireScorekeeper(plan, wire.journal)
        with (
            WireConductor(plan, wire.relay, events.append) as conductor,
            WireControl(folder, wire.relay, conductor, keeper, wire.journal, events),
        ):
            yield wire


def test_a_wire_is_steered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its links are changed, cut and healed, its sides partitioned and joined, and its status tells so."""

    def command(*words: str) -> str:
        status = main([words[0], str(tmp_path), *words[1:]])
        out, err = capsys.readouterr()
        return f"{status} {out or err}".strip()

    with steered(tmp_path) as wire, wire.program("robot") as sender:
        assert (
            command("link", "robot-base", "quality=0.9")
            == '0 link robot-base: loss = { model = "bernoulli", quality = 0.9 }'
        )
        assert wire.journal.history.changes_of("robot-base", "new", "put")[-1].settings["loss"]["quality"] == 0.9  # type: ignore[index]
        assert command("link", "robot-base", "cut") == "0 cut robot-base"
        assert wire.relay.links["robot-base"].cut
        assert command("partition", "robot", "base") == "0 partition robot, base"
        assert command("link", "base-robot", "cut") == "0 cut base-robot"
        assert command("link", "robot-base", "heal") == "0 heal robot-base"
        wait_until(lambda: sender.put("a", b"") or len(wire.rows), "a message is heard")
        status = command("status").splitlines()
        assert status[0].endswith(" s, journal complete")
        assert status[1] == f"side robot: {wire.relay.endpoints['robot'][0]}"
        assert any(line.startswith("link robot-base: 0 of ") and line.endswith("cut") for line in status)
        assert status[-1].endswith(" s: heal robot-base")
        assert command("heal", "base", "robot") == "0 heal robot, base"
        assert not wire.relay.links["robot-base"].cut
        assert wire.relay.links["base-robot"].cut
        assert command("link", "base-robot", "heal") == "0 heal base-robot"
        answer = json.loads(command("status", "--json").removeprefix("0 "))
        assert answer["links"]["base-robot"] == {"heard": 0, "delivered": 0, "cut": False}
    assert not (tmp_path / "control.json").exists()
    assert command("status").startswith("2 evedrop: no run is going on in")


class NoEvent(OperatorRequest, frozen=True, tag="link"):
    """A change without an event."""


def test_what_cannot_be_done_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every mistake has a line, exit status 2, and nothing is changed; commands without the password get no answer."""

    def refused(*words: str) -> str:
        assert main([words[0], str(tmp_path), *words[1:]]) == 2
        return capsys.readouterr().err

    with steered(tmp_path) as wire:
        assert "programs that know nothing of a wire do not wait for it" in refused("pause")
        assert "a wire cannot be held" in refused("step", "5")
        assert "robot-bose" in refused("link", "robot-bose", "cut")
        assert "set.quality" in refused("link", "robot-base", "quality=1.2")
        assert "are not partitioned" in refused("heal", "robot", "base")
        assert "rabot" in refused("partition", "rabot", "base")
        control = read_control(tmp_path)
        answer = ask(control, NoEvent(), LIMIT)
        assert answer is not None
        assert answer.refused
        key = RunKeys(control.run).control(RECORDER)
        with pytest.raises(zenoh.ZError):
            program([control.router])
        other = program(
            [control.router], transport={"auth": {"usrpwd": {"user": control.user, "password": control.password}}}
        )
        with other:
            assert not list(other.get(key, payload=b"nonsense", timeout=5.0))
            told = [
                reply.ok.payload.to_bytes()
                for reply in other.get(key, payload=enclosed(key, b"\xc1"), timeout=LIMIT)
                if reply.ok
            ]
            assert len(told) == 1
            assert b"malformed" in told[0]
        assert not wire.relay.links["robot-base"].cut
