"""Wire files: what they mean, what is refused and in which words, and that a resolved file means the same."""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from evedrop import wire
from evedrop.errors import ScenarioError, UsageError
from evedrop.wire.file import load_wire, resolved_wire, wire_of
from evedrop.wire.plan import Side, WireEvent
from evedrop.wire.tables import TlsTable, in_seconds, place_of
from tests.builders import mistakes_of, places_of
from tests.golden.pages import Golden

EXAMPLE = Path(str(resources.files("evedrop.wire"))) / "examples" / "robot.toml"
BASE = """
[side.robot]
listen = "tcp/127.0.0.1:7448"
[side.base]
listen = "tcp/127.0.0.1:7449"
[[link]]
from = "robot"
to = "base"
"""


def of(text: str, folder: Path = Path()) -> Any:
    """The wire in a text."""
    return wire_of(tomllib.loads(text), "wire.toml", folder=folder)


def test_the_example() -> None:
    """It means what its lines say, and its resolved file means the same."""
    plan = load_wire(EXAMPLE)
    assert plan.seed == 7
    assert plan.lossless == ("robot/stop",)
    assert plan.sides["base"] == Side("base", ("tcp/127.0.0.1:7449",))
    assert [link.name for link in plan.links] == ["scan", "radio", "orders", "tap"]
    assert [link.tap for link in plan.links] == [False, False, False, True]
    assert plan.named("scan").settings == {
        "loss": {"model": "gilbert-elliott", "p": 0.01, "r": 0.2},
        "delay": {"model": "normal", "mean": 0.02, "standard_deviation": 0.005},
        "rate": 2e6,
        "queue": 256_000,
    }
    assert plan.events[0] == WireEvent(12.0, 15.0, partition=("robot", "base"))
    assert plan.events[1].settings == {"loss": {"model": "gilbert-elliott", "p": 0.05, "r": 0.2}, "rate": 5e5}
    assert wire_of(tomllib.loads(resolved_wire(plan))) == plan


def test_everything_that_a_file_can_have(tmp_path: Path) -> None:
    """Each entry arrives in the plan, and in the resolved file; files are found relative to the wire file."""
    (tmp_path / "walk.csv").write_text("1\n0\n1\n1\n")
    text = """
    seed = 11
    lossless = "a/**"
    largest = "64 MB"
    query_seconds = "2 s"
    held_messages = 50
    held_bytes = "1 MiB"
    [side.robot]
    listen = ["tls/0.0.0.0:7448", "unixsock-stream//run/robot"]
    tls = { certificate = "robot.pem", key = "robot.key", authority = "ca.pem" }
    users = { ada = "secret" }
    keys = ["robot/**", "@ros2_lv/**"]
    [side.base]
    connect = "tcp/127.0.0.1:7447"
    [side.third]
    [[link]]
    from = "robot"
    to = "base"
    loss = { model = "trace", file = "walk.csv" }
    delay = { model = "trace", values = [0.5, 1.0] }
    reorder = 0.1
    duplicate = 0.2
    corrupt = 0.3
    [[link]]
    from = "robot"
    to = "base"
    keys = "b/**"
    [[link]]
    name = "robot-third"
    from = "robot"
    to = "third"
    loss = { model = "trace", outcomes = "10" }
    correlation = { with = "robot-base", strength = 0.5 }
    [[link]]
    from = "robot"
    to = "third"
    delay = { model = "constant", value = 1, unit = "seconds" }
    rate = "8 Mbit/s"
    [[event]]
    at = 1
    cut = "robot-base-2"
    [[event]]
    at = "1 min"
    link = "robot-third-2"
    set = { quality = 0.5, duplicate = 0.0, delay = { model = "constant", value = "5 ms" } }
    [[event]]
    at = "90 s"
    note = "the robot enters the lift"
    [[event]]
    at = 2.0
    link = "robot-base-2"
    set = { rate = "1 kB/s" }
    """
    plan = of(text, tmp_path)
    assert (plan.seed, plan.largest, plan.query_seconds, plan.held_messages, plan.held_bytes) == (
        11,
        64_000_000,
        2.0,
        50,
        2**20,
    )
    files = [str(tmp_path / name) for name in ("robot.pem", "robot.key", "ca.pem")]
    endpoints = ("tls/0.0.0.0:7448", "unixsock-stream//run/robot")
    tls = TlsTable(certificate=files[0], key=files[1], authority=files[2])
    assert plan.sides["robot"] == Side("robot", endpoints, (), tls, {"ada": "secret"}, ("robot/**", "@ros2_lv/**"))
    assert plan.sides["base"] == Side("base", (), ("tcp/127.0.0.1:7447",))
    assert plan.sides["third"] == Side("third", ("tcp/127.0.0.1:0",))
    assert [link.name for link in plan.links] == ["robot-base", "robot-base-2", "robot-third", "robot-third-2"]
    assert plan.links[0].settings == {
        "loss": {"model": "trace", "outcomes": "1011"},
        "delay": {"model": "trace", "values": [0.5, 1.0]},
        "reorder": 0.1,
        "duplicate": 0.2,
        "corrupt": 0.3,
    }
    assert plan.links[1].settings == {"loss": {"model": "bernoulli", "quality": 1.0}}
    assert plan.links[2].correlation == ("robot-base", 0.5)
    assert plan.links[3].settings["delay"] == {"model": "constant", "value": 1}
    assert (plan.links[3].settings["rate"], plan.links[3].settings["queue"]) == (1e6, 256_000)
    quality = {"model": "bernoulli", "quality": 0.5}
    changed = {"loss": quality, "duplicate": 0.0, "delay": {"model": "constant", "value": 0.005}}
    assert plan.events[1] == WireEvent(60.0, None, link="robot-third-2", settings=changed)
    assert plan.events[2].note == "the robot enters the lift"
    assert plan.events[3].settings == {"rate": 1000.0, "queue": 256_000}
    assert wire_of(tomllib.loads(resolved_wire(plan))) == plan


def test_changes_by_dotted_key(tmp_path: Path) -> None:
    """As with `--set`."""
    (tmp_path / "wire.toml").write_text(BASE)
    plan = load_wire(
        tmp_path / "wire.toml", {"seed": 9, "link.0.quality": 0.5, "link.1.from": "base", "link.1.to": "robot"}
    )
    assert plan.seed == 9
    assert plan.links[0].settings == {"loss": {"model": "bernoulli", "quality": 0.5}}
    assert plan.links[1].name == "base-robot"


RADIO = """
[side.robot]
[side.base]
[[link]]
from = "robot"
to = "base"
quality = 0.5
[[link]]
name = "tele-metry"
from = "base"
to = "robot"
loss = { model = "gilbert-elliott", p = 0.1, r = 0.3 }
"""


@pytest.mark.parametrize("link", ["1", "tele-metry"])
def test_a_quality_replaces_a_loss_and_the_other_way_round(link: str, tmp_path: Path) -> None:
    """By the number of a link or by its name, as it is in the file or as the wire calls it."""
    path = tmp_path / "radio.toml"
    path.write_text(RADIO)
    both = {f"link.{link}.quality": 0.9, "link.robot-base.loss": {"model": "pattern", "outcomes": "10"}}
    plan = load_wire(path, both)
    assert [link.settings["loss"]["model"] for link in plan.links] == ["pattern", "bernoulli"]
    assert plan.links[1].settings["loss"]["quality"] == 0.9
    assert (
        load_wire(path, {f"link.{link}": {"from": "base", "to": "robot"}}).links[1].settings["loss"]["quality"] == 1.0
    )


def test_an_unknown_link_and_a_mistake_in_a_change_are_named(tmp_path: Path) -> None:
    """With the links that there are; a mistake in a changed entry has no line of the file."""
    path = tmp_path / "radio.toml"
    path.write_text(RADIO)
    with pytest.raises(
        UsageError,
        match=r"link\.telemetry\.quality: is .*telemetry.*expected robot-base, tele-metry or a number from 0",
    ):
        load_wire(path, {"link.telemetry.quality": 0.9})
    with pytest.raises(ScenarioError) as caught:
        load_wire(path, {"link.tele-metry.quality": 1.9})
    (line,) = caught.value.mistakes
    assert line.startswith("link.1.quality: is 1.9")
    assert "(line" not in line


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    """It is named, with the way to an example; text that is not TOML is refused."""
    with pytest.raises(UsageError, match=r"wire.toml cannot be read \(No such file.*--example"):
        load_wire(tmp_path / "wire.toml")
    (tmp_path / "wire.toml").write_text("seed =")
    with pytest.raises(ScenarioError, match="not TOML"):
        load_wire(tmp_path / "wire.toml")
    (tmp_path / "wire.toml").write_text(f"{BASE}name = 'a\\u0007b'".replace("'", '"'))
    with pytest.raises(ScenarioError, match=r"U\+0007"):
        load_wire(tmp_path / "wire.toml")


def test_all_mistakes_of_tables_at_once() -> None:
    """They are in one message, with those that only show across tables."""
    mistakes = mistakes_of(
        of,
        """
    lossles = []
    largest = "64 Mb"
    [side.robot]
    listen = "tcp/127.0.0.1:7448"
    [side.base]
    listen = ["tcp/0.0.0.0:7448", "tcp/127.0.0.1"]
    [[link]]
    from = "robto"
    to = "base"
    keys = "a//b"
    quality = 1.5
    [[event]]
    at = "12"
    partition = ["robot", "bsae"]
    """,
    )
    assert mistakes == [
        'side.base.listen.1: is "tcp/127.0.0.1"; expected PROTOCOL/HOST:PORT with the protocol tcp, tls, quic, ws or '
        "unixsock-stream, such as tcp/127.0.0.1:7448",
        "link.0.quality: is 1.5; expected a number from 0 to 1, such as 0.9",
        'link.0.keys: is "a//b", which Zenoh refuses (empty chunks are forbidden, as well as leading and trailing slashes); '
        "expected one such as robot/scan/**",
        'event.0.at: is "12"; expected seconds, or a text such as "20 ms"; the units are us, µs, ms, s, min, h, such as "12 s"',
        'largest: is "64 Mb"; expected bytes, or a text such as "256 kB"; the units are B, kB, MB, GB, KiB, MiB, GiB, such as '
        '"64 MB"',
        "lossles: is not an entry of this table; did you mean lossless?",
        'link.0.from: is "robto"; expected robot or base; did you mean robot?',
        'event.0.partition.1: is "bsae"; expected robot or base; did you mean base?',
    ]


def test_all_mistakes_across_tables_at_once() -> None:
    """Where every table is valid by itself, they are in one message."""
    mistakes = mistakes_of(
        of,
        """
    [side.robot]
    listen = "tcp/127.0.0.1:7448"
    [side.base]
    listen = ["tcp/0.0.0.0:7448"]
    [[link]]
    from = "robto"
    to = "base"
    [[event]]
    at = "12 s"
    partition = ["robot", "bsae"]
    [[expect]]
    link = "scan"
    """,
    )
    assert mistakes == [
        'side.base.listen.0: is "tcp/0.0.0.0:7448", the same place as tcp/127.0.0.1:7448 at which side robot listens; '
        "expected another port",
        'link.0.from: is "robto"; expected robot or base; did you mean robot?',
        'expect.0.link: is "scan", but there is no link scan; expected a metric or the name of robto-base',
        'event.0.partition.1: is "bsae"; expected robot or base; did you mean base?',
    ]


def test_mistakes_across_tables_are_told_with_those_within_them() -> None:
    """Names of sides and links, too, in tables that are wrong otherwise; no hint proposes a name that is made of a mistake."""
    mistakes = mistakes_of(
        of,
        """
    [side.robot]
    listen = "tcp/127.0.0.1:7448"
    [side.base]
    listne = "tcp/127.0.0.1:7449"
    [[link]]
    from = "robot"
    to = "base"
    quality = 2
    [[link]]
    from = "base"
    to = "robots"
    [[event]]
    at = "soon"
    cut = "robot-bse"
    [[event]]
    at = "1 s"
    cut = "base-robot"
    [[expect]]
    link = "robot-bsae"
    """,
    )
    assert [mistake.partition(":")[0] for mistake in mistakes] == [
        "side.base.listne", "link.0.quality", "event.0.at",
        "link.1.to", "expect.0.link", "event.0.cut", "event.1.cut",
    ]  # fmt: skip
    assert [mistake for mistake in mistakes if "robots" in mistake.partition("; ")[2]] == []
    assert 'event.0.cut: is "robot-bse"; expected robot-base; did you mean robot-base?' in mistakes


def test_a_change_of_a_link_that_is_not_there_is_a_mistake_of_the_wire(tmp_path: Path) -> None:
    """From Python, too, and its sentence ends with the hint."""
    (tmp_path / "radio.toml").write_text(BASE)
    with pytest.raises(ScenarioError) as caught:
        wire(tmp_path / "radio.toml", link__robot_bse__quality=0.5)
    (mistake,) = caught.value.mistakes
    assert (
        mistake
        == 'link.robot_bse.quality: is "robot_bse"; expected robot-base or a number from 0; did you mean robot-base?'
    )


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("", "side"),
        ("[side.robot]", "side"),
        ("side = 3", "side"),
        (f"{BASE}keys = 'a/**/**'", "link.0.keys"),
        (BASE.replace('"base"', '"robot"'), "link.0.to"),
        (BASE.replace("7449", "7448"), "side.base.listen"),
        (BASE.replace("tcp/127.0.0.1:7449", "udp/127.0.0.1:7449"), "side.base.listen.0"),
        (BASE.replace("tcp/127.0.0.1:7449", "tls/127.0.0.1:7449"), "side.base.tls"),
        (BASE.replace("[side.base]", "[side.base]\ntls = { certificate = 'a', key = 'b' }"),
         "side.base.tls"),
        (BASE.replace("[side.base]", "[side.base]\nconnect = 'tcp/localhost:7448'"), "side.base.connect"),
        ("[side.a]\nconnect = 'tcp/h:1'\n[side.b]\nconnect = ['tcp/h:1']", "side.b.connect.0"),
        ("[side.a]\nconnect = ['tcp/h:1', 'tcp/h:1']\n[side.b]", "side.a.connect.1"),
        (BASE.replace("side.base", "side.Base")
         .replace('"base"', '"Base"'),
         "side.Base"),
        (BASE.replace("[side.base]", "[side.base]\nusers = { 'a:b' = 'c' }"), "side.base.users.a:b"),
        (f"{BASE}name = 'Scan'", "link.0.name"),
        (f"{BASE}name = 'x'\n[[link]]\nname = 'x'\nfrom = 'base'\nto = 'robot'", "link.1.name"),
        (f"{BASE}rate = '2 MB'", "link.0.rate"),
        (f"{BASE}queue = 1000", "link.0.queue"),
        (f"{BASE}ordered = true\nreorder = 0.1\ndelay = {{ model = \"constant\", value = 1 }}",
         "link.0.reorder"),
        (f"{BASE}reorder = 0.1", "link.0.reorder"),
        (f"{BASE}quality = 0.5\nloss = {{ model = 'bernoulli', quality = 0.5 }}", "link.0.quality"),
        (f"{BASE}loss = {{ model = 'gilbert' }}", None),
        (f"{BASE}loss = {{ model = 'trace', outcomes = '10', once = true }}", "link.0.loss.once"),
        (f"{BASE}loss = {{ model = 'trace', file = 'none.csv' }}", None),
        (f"{BASE}delay = {{ model = 'constant', value = '2 slots' }}", "link.0.delay.value"),
        (f"{BASE}delay = {{ model = 'constant', value = 2, unit = 'slots' }}", "link.0.delay.unit"),
        (f"{BASE}correlation = {{ with = 'scan', strength = 0.5 }}", "link.0.correlation.with"),
        (f"{BASE}correlation = {{ with = 'x', strength = 0.5 }}\n[[link]]\nname = 'x'\nfrom = 'base'\nto = 'robot'\ncorrelation "
         "= { with = 'robot-base', strength = 0.5 }", None),
        (f"{BASE}correlation = {{ with = 'x', strength = 0.5 }}\n[[link]]\nname = 'x'\nfrom = 'base'\nto = 'robot'\nloss = "
         "{ model = 'pattern', outcomes = '10' }", "link.0.correlation.with"),
        (f"{BASE}[[event]]\nat = 1", "event.0.event"),
        (f"{BASE}[[event]]\nat = 1\ncut = 'robot-base'\nnote = 'x'", "event.0.event"),
        (f"{BASE}[[event]]\nat = 1\ncut = 'robot-bsae'", "event.0.cut"),
        (f"{BASE}[[event]]\nat = 1\npartition = ['robot', 'robot']", "event.0.partition"),
        (f"{BASE}[[event]]\ncut = 'robot-base'", "event.0.at"),
        (f"{BASE}[[event]]\nat = 1\nfrom = 2\ncut = 'robot-base'", "event.0.at"),
        (f"{BASE}[[event]]\nat = 1\nto = 2\ncut = 'robot-base'", "event.0.to"),
        (f"{BASE}[[event]]\nfrom = '3 s'\nto = '2000 ms'\ncut = 'robot-base'", "event.0.to"),
        (f"{BASE}[[event]]\nat = 1\nset = {{}}\nlink = 'robot-base'", "event.0.set"),
        (f"{BASE}[[event]]\nat = 1\nset = {{ quality = 0.1 }}", "event.0.link"),
        (f"{BASE}[[event]]\nat = 1\nnote = 'x'\nlink = 'robot-base'", "event.0.set"),
        (f"{BASE}[[event]]\nat = 1\nlink = 'robot-base'\nset = {{ qualty = 0.1 }}", "event.0.set.qualty"),
        (f"{BASE}[[event]]\nat = 1\nlink = 'robot-base'\nset = {{ quality = 2 }}", "event.0.set.quality"),
        (f"{BASE}quality = 3\n[[event]]\nat = 1\nlink = 'robot-base'\nset = {{ quality = 0.5 }}", "link.0.quality"),
    ],
)  # fmt: skip
def test_one_mistake(text: str, place: str | None, golden: Golden) -> None:
    """It is the only one that is reported, in words that say what to do. None: only that there is one."""
    mistakes = mistakes_of(of, text)
    assert place is None or places_of(mistakes) == [place]
    golden("wire", mistakes)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("largest = 0\n" + BASE, "largest"),
        ("held_bytes = 0\n" + BASE, "held_bytes"),
        (BASE.replace("[side.base]", "[side.base]\nkeys = []"), "side.base.keys"),
        (BASE.replace("[side.base]", '[side.base]\nusers = { ada = "a\\nb:c" }'), "side.base.users.ada"),
        (BASE.replace("[side.base]", '[side.base]\nusers = { "a\\tb" = "c" }'), "side.base.users.a\tb"),
        (BASE.replace("[side.base]", '[side.base]\nusers = { ada = " a b " }'), "side.base.users.ada"),
        (BASE.replace("[side.base]", '[side.base]\nusers = { "ada " = "b" }'), "side.base.users.ada "),
        (f"{BASE}ordered = true\ndelay = {{ model = 'constant', value = 1 }}\n"
         "[[event]]\nat = 1\nlink = 'robot-base'\nset = { reorder = 0.5 }", "event.0.set.reorder"),
    ],
)  # fmt: skip
def test_a_value_with_which_a_wire_would_not_work(text: str, place: str) -> None:
    """Nothing would cross, a user's line would become two, or messages would overtake each other although they must not."""
    assert places_of(mistakes_of(of, text)) == [place]


def test_a_side_without_key_expressions_is_told_what_is_expected() -> None:
    """As the one that all messages match."""
    assert mistakes_of(of, BASE.replace("[side.base]", "[side.base]\nkeys = []")) == [
        'side.base.keys: is empty; expected key expressions, such as ["**"]'
    ]


@pytest.mark.parametrize(
    ("link", "tie"),
    [
        ("robot-base", "its losses are tied to those of x"),
        ("x", "the losses of robot-base are tied to its losses"),
    ],
)
def test_correlated_links_keep_their_model(link: str, tie: str) -> None:
    """The uniform numbers of one are the other's, and each model uses them in its own way."""
    mistakes = mistakes_of(
        of,
        f"""{BASE}correlation = {{ with = "x", strength = 0.5 }}
    [[link]]
    name = "x"
    from = "base"
    to = "robot"
    [[event]]
    at = 1
    link = "{link}"
    set = {{ loss = {{ model = "pattern", outcomes = "10" }} }}
    """,
    )
    assert mistakes == [f"event.0.set.loss.model: gives {link} another loss model, but {tie}; expected the same model"]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("20 ms", 0.02),
        ("9 ms", 0.009),
        ("20 us", 2e-5),
        ("20ms", 0.02),
        ("1.5 s", 1.5),
        ("2 min", 120.0),
        ("1 h", 3600.0),
        ("3 µs", 3e-6),
        ("1e3 us", 1e-3),
    ],
)
def test_lengths_of_time(text: str, seconds: float) -> None:
    """They are the numbers that a file without units would have."""
    assert in_seconds(text) == seconds


@pytest.mark.parametrize("text", ["", "ms", "20", "-1 s", "20 sec", "1 2 s", "nan s", "inf s"])
def test_what_is_not_a_length_of_time(text: str) -> None:
    """It has no meaning."""
    assert in_seconds(text) is None


@pytest.mark.parametrize(
    ("one_place", "other", "overlap"),
    [
        ("tcp/127.0.0.1:7", "tcp/127.0.0.1:7", True),
        ("tcp/127.0.0.1:7", "ws/localhost:7#a=b", True),
        ("tcp/127.0.0.1:7", "tcp/127.0.0.2:7", False),
        ("tcp/[::]:7", "tcp/127.0.0.2:7?x", True),
        ("tcp/127.0.0.1:7", "quic/127.0.0.1:7", False),
        ("tcp/127.0.0.1:0", "tcp/127.0.0.1:0", False),
        ("unixsock-stream//a", "unixsock-stream//a", True),
        ("unixsock-stream//a", "tcp/127.0.0.1:7", False),
    ],
)
def test_places(one_place: str, other: str, overlap: bool) -> None:
    """Two endpoints overlap if nothing can listen on both."""
    first, second = place_of(one_place), place_of(other)
    assert first is not None
    assert second is not None
    assert first.overlaps(second) == second.overlaps(first) == overlap


@pytest.mark.parametrize("endpoint", ["tcp/h:65536", "tcp/h", "tcp", "serial/x:1", "h:1", "tcp/a:b:1", "tcp/:1"])
def test_malformed_endpoints(endpoint: str) -> None:
    """They are not places."""
    assert place_of(endpoint) is None
