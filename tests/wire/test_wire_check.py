"""`evedrop wire --check`: what a file means, which link a key takes, and warnings; and the rest of the command line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from evedrop.cli.main import main
from evedrop.errors import UsageError
from evedrop.wire.file import example_wire, key_lines, warnings_of_wire, wire_lines, wire_of
from evedrop.wire.plan import WirePlan
from tests.golden.pages import Golden


def plan_of(*links: Mapping[str, object], lossless: str = "", **robot: object) -> WirePlan:
    """A wire with these links."""
    sides = {"robot": robot, "base": {}, "third": {}}
    return wire_of({"side": sides, "link": list(links), "lossless": [lossless] if lossless else []})


TO_BASE = {"from": "robot", "to": "base"}


def test_the_example(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command prints the example, and then what that file means, with the link of each key in each direction."""
    assert main(["wire", "--example"]) == 0
    text = capsys.readouterr().out
    assert text == example_wire()
    path = tmp_path / "robot.toml"
    path.write_text(text)
    keys = ["robot/scan/front", "robot/**", "robot/stop", "robot/@config/x"]
    assert main(["wire", "--check", str(path), *keys, "--set", "link.1.quality=0.5"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert printed.out.splitlines() == [
        f"{path}: 3 sides, 4 links, 2 events: no mistakes",
        "  side  robot     tcp/127.0.0.1:7448",
        "  side  base      tcp/127.0.0.1:7449",
        "  side  listener  tcp/127.0.0.1:7450",
        '  link  scan      robot → base  robot/scan/**  loss = { model = "gilbert-elliott", p = 0.01, r = 0.2 }, '
        'rate = 2000000.0, queue = 256000, delay = { model = "normal", mean = 0.02, standard_deviation = 0.005 }, '
        "loses 4.76 % on average, in bursts of 5 messages",
        '  link  radio     robot → base  **  loss = { model = "bernoulli", quality = 0.5 }, '
        'delay = { model = "constant", value = 0.01 }',
        '  link  orders    base → robot  **  loss = { model = "bernoulli", quality = 0.99 }',
        '  link  tap       robot → listener (tap)  **  loss = { model = "bernoulli", quality = 0.6 }',
        "  never lost  robot/stop",
        "  key  robot/scan/front",
        "    robot → base  scan",
        "    robot → listener  tap (a copy of publications, no queries)",
        "    base → robot  orders",
        "  key  robot/**",
        "    robot → base  scan (which takes only some of these keys)",
        "    robot → listener  tap (a copy of publications, no queries)",
        "    base → robot  orders",
        "  key  robot/stop  (never lost)",
        "    robot → base  radio",
        "    robot → listener  tap (a copy of publications, no queries)",
        "    base → robot  orders",
        "  key  robot/@config/x",
        "    robot → base  no link takes it",
        "    robot → listener  no link takes it",
        "    base → robot  no link takes it",
        "    wildcards do not match the parts of a key that begin with @: name them in a link's keys",
    ]


def test_what_a_side_asks_for_and_a_link_without_faults() -> None:
    """Users, certificates and keys are told; correlation too."""
    tls = {"certificate": "a", "key": "b", "authority": "c"}
    guarded: dict[str, Any] = {
        "listen": "tls/127.0.0.1:7",
        "tls": tls,
        "users": {"ada": "x"},
        "keys": "a/**",
        "connect": "tls/h:8",
    }
    tied = {**TO_BASE, "keys": "b", "correlation": {"with": "robot-base", "strength": 0.5}}
    assert list(wire_lines(plan_of(TO_BASE, tied, **guarded))) == [
        "side  robot         tls/127.0.0.1:7, connects to tls/h:8  (users ada; certificates required; only a/**)",
        "side  base          tcp/127.0.0.1:0",
        "side  third         tcp/127.0.0.1:0",
        "link  robot-base    robot → base  **  no faults",
        "link  robot-base-2  robot → base  b  losses tied to robot-base with strength 0.5",
    ]


def test_warnings(golden: Golden) -> None:
    """Links that never take a key, sides without a link, links without a way back, and sides open to other machines."""
    plan = plan_of(TO_BASE, {**TO_BASE, "keys": "a/**"}, listen=["tcp/0.0.0.0:7", "tcp/127.0.0.1:8"])
    warnings = list(warnings_of_wire(plan))
    assert len(warnings) == 4
    golden("wire", warnings)
    tls = {"certificate": "a", "key": "b", "authority": "c"}
    mixed = plan_of(TO_BASE, listen=["tls/0.0.0.0:6", "tcp/0.0.0.0:7"], tls=tls)
    assert [warning for warning in warnings_of_wire(mixed) if "tls/" in warning] == []
    assert warnings[1] in warnings_of_wire(mixed), "nobody shows a certificate at tcp/"
    assert "certificates required" not in "".join(wire_lines(mixed))
    copies = {**TO_BASE, "tap": True}
    for first, second, none in ((copies, TO_BASE, "publication"), (TO_BASE, copies, "key"), (copies, copies, "key")):
        assert f"link robot-base-2 takes no {none}: robot-base, which" in "".join(
            warnings_of_wire(plan_of(first, second))
        )
    back = {"from": "base", "to": "robot"}
    tap = {"from": "robot", "to": "third", "tap": True}
    assert not list(
        warnings_of_wire(plan_of({**TO_BASE, "keys": "a/**"}, TO_BASE, back, tap, listen="tls/[::]:7", tls=tls))
    )


def test_keys_that_zenoh_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str], golden: Golden) -> None:
    """All of them are named."""
    path = tmp_path / "wire.toml"
    path.write_text(example_wire())
    assert main(["wire", "--check", str(path), "a//b", "a/b", "a/**/**"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert re.findall(r'key "(.*?)"', printed.err) == ["a//b", "a/**/**"]
    golden("wire", printed.err)


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--example", "FILE"],
        ["FILE", "a/b"],
        ["FILE", "--for", "60 sec"],
        ["FILE", "--for", "0"],
        ["FILE", "--for", "1e9 h"],
        ["none.toml"],
        ["FILE", "--set", "seed=-1"],
    ],
    ids=str,
)
def test_what_the_command_refuses(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], golden: Golden
) -> None:
    """Before it starts anything, with what was expected."""
    path = tmp_path / "wire.toml"
    path.write_text(example_wire())
    assert main(["wire", *(str(path) if word == "FILE" else word for word in words)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    golden("wire", printed.err)


def test_a_key_without_any_link() -> None:
    """Where there are no links, a key takes none."""
    assert list(key_lines(plan_of(), ["a/b"])) == ["key  a/b"]


def test_the_history_of_a_key() -> None:
    """It takes the link of its key."""
    plan = plan_of({**TO_BASE, "keys": "a/*"})
    assert list(key_lines(plan, ["a/b/@adv/pub/1"]))[1] == "  robot → base  robot-base"
    assert list(key_lines(plan, ["b/@adv/pub/1"]))[1] == "  robot → base  no link takes it"
    named = plan_of({**TO_BASE, "keys": "a/b/@adv/**"})
    assert list(key_lines(named, ["a/b/@adv/pub/1"]))[1] == "  robot → base  robot-base"
    assert "only some of these keys" in list(key_lines(named, ["a/*/@adv/**"]))[1]


def test_the_page_shows_what_the_command_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """docs/wire/file.md shows the example file, and the answer of `--check` about a key, as they are printed."""
    page = (Path(__file__).parents[2] / "docs" / "wire" / "file.md").read_text(encoding="utf-8")
    assert f"```toml\n{example_wire()}```" in page
    path = tmp_path / "robot.toml"
    path.write_text(example_wire())
    assert main(["wire", "--check", str(path), "robot/scan/front"]) == 0
    _, word, keys = capsys.readouterr().out.partition("  key  robot/scan/front\n")
    assert f"…\n{word}{keys}```" in page


def test_the_command_runs_a_wire(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It prints the endpoint of each side and each event, warns, and ends after the given time."""
    path = tmp_path / "wire.toml"
    link, event = 'from = "robot"\nto = "base"', 'at = 0.01\ncut = "robot-base"\n[[event]]\nat = 0\nnote = "off we go"'
    path.write_text(f"[side.robot]\n[side.base]\n[[link]]\n{link}\n[[event]]\n{event}\n")
    assert main(["wire", str(path), "--for", "100 ms", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    endpoints = dict(line.split() for line in printed.out.splitlines()[:2])
    assert endpoints.keys() == {"robot", "base"}
    assert all(re.fullmatch(r"tcp/127\.0\.0\.1:[1-9]\d*", endpoint) for endpoint in endpoints.values())
    assert [line for line in printed.out.splitlines() if " s: " in line] == [
        "0.0 s: off we go",
        "0.0 s: cut robot-base",
    ]
    assert printed.err == "evedrop: warning: no link leads from base back to robot: queries from robot get no replies\n"
    assert (tmp_path / "out" / "summary.json").is_file()
    assert main(["wire", str(path), "--for", "10 ms", "--out", str(tmp_path / "again"), "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_keys_may_follow_the_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As the usage line says; argparse takes the keys before an option for all of them. Unknown options are still refused."""
    path = tmp_path / "robot.toml"
    path.write_text(example_wire())
    shown = []
    for words in (["--check", str(path), "robot/stop"], [str(path), "--check", "robot/stop"]):
        assert main(["wire", *words]) == 0
        shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1]
    assert "key  robot/stop" in shown[0]
    assert main(["wire", str(path), "--check", "robot/stop", "--chekc"]) == 2
    assert "unknown option --chekc" in capsys.readouterr().err


def test_one_of_a_kind_is_not_several(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And a link that loses in bursts says how much, as its parameters do not."""
    path = tmp_path / "radio.toml"
    path.write_text(
        """
        side = { robot = {}, base = {} }
        link = [{ from = "robot", to = "base", loss = { model = "gilbert-elliott", p = 0.0278, r = 0.25 } }]
        event = [{ at = "1 s", note = "the lift" }]
        """
    )
    assert main(["wire", "--check", str(path)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"{path}: 2 sides, 1 link, 1 event: no mistakes\n")
    assert ", loses 10 % on average, in bursts of 4 messages\n" in printed
    assert main(["wire", "--check", str(path), "/robot/scan"]) == UsageError.exit_status
    assert "; the ROS 2 topic /robot/scan has the keys */robot/scan/**" in capsys.readouterr().err
