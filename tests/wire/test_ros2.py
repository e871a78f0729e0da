"""What the wire reads from ROS 2 over Zenoh: attachments, liveliness tokens, keys of services.

References: tokens as rmw_zenoh documents them, and attachments by the serializer of Zenoh that rmw_zenoh uses.
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from xxhash import xxh3_128_hexdigest
from zenoh import ext

from evedrop.cli import main as cli
from evedrop.wire import ros2
from evedrop.wire.file import load_wire
from evedrop.wire.ros2 import Entity, EntityLog, Qos, SenderReader, read_token, reply_seconds, service_key

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
NODE = "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
SUBSCRIPTION = (
    "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/"
    f"std_msgs::msg::dds_::String_/{HASH}/::,10:,:,:,,"
)
SERVICE = (
    "@ros2_lv/7/aac3178e146ba6f1fc6e6a4085e77f21/0/11/SS/%/%robot%arm/adder/%robot%add_two_ints/"
    f"example_interfaces::srv::dds_::AddTwoInts_/{HASH}/::,10:,:,:,,"
)
GID = bytes(range(16))


def attachment(sequence: int, gid: bytes = GID, named: bool = False) -> zenoh.ZBytes:
    """The attachment that rmw_zenoh adds to a message, now or in the first half of 2025."""
    number, time = ext.Int64(sequence), ext.Int64(1_700_000_000_000_000_000)
    names = ("sequence_number", number, "source_timestamp", time, "source_gid", gid)
    return ext.z_serialize(names if named else (number, time, gid))


class Codes:
    """Stands for the journal's table of senders, and counts how often it is asked."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def __call__(self, name: str) -> int:
        """The code of a name, from 1."""
        self.names.append(name)
        return len(self.names)


@pytest.mark.parametrize("named", [False, True])
def test_a_message_is_known_by_gid_and_sequence_number(named: bool) -> None:
    """Both forms of the attachment give the sender's gid and its number; a sender is looked up once."""
    codes = Codes()
    read = SenderReader(codes)
    other = bytes(reversed(GID))
    numbers = [read(attachment(n, gid, named), None) for n, gid in [(1, GID), (2, GID), (2**62, other), (3, GID)]]
    assert numbers == [(1, 1), (1, 2), (2, 2**62), (1, 3)]
    assert codes.names == [GID.hex(), other.hex()]


@given(st.binary(max_size=90))
def test_no_attachment_confuses_the_reader(octets: bytes) -> None:
    """For any attachment of a program, the reader names a sender or none."""
    code, sequence = SenderReader(Codes())(zenoh.ZBytes(octets), None)
    assert (code, sequence) == (0, -1) or (code == 1 and len(octets) in {33, 77})


@pytest.mark.parametrize("octets", [b"\0" * 33, b"\0" * 77, attachment(1, named=True).to_bytes()[:60] + b"\x08" + GID])
def test_an_attachment_of_the_right_length_only_is_none_of_rmw_zenoh(octets: bytes) -> None:
    """The length of the gid and the names of the fields must be there, too."""
    assert SenderReader(Codes())(zenoh.ZBytes(octets), None) == (0, -1)


def test_without_an_attachment_zenoh_says_who_sent_a_message() -> None:
    """The source info of Zenoh names a publisher that is not of ROS; a message with neither has no sender."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    codes = Codes()
    read = SenderReader(codes)
    with zenoh.open(config) as session:
        publisher = session.declare_publisher("a")
        info = zenoh.SourceInfo(publisher.id, 41)
        assert read(None, info) == (1, 41)
        assert read(zenoh.ZBytes(b"mine"), info) == (1, 41)
        assert codes.names == [f"{session.zid()}/{publisher.id.eid}"]
    assert read(None, None) == (0, -1)


def test_senders_beyond_the_limit_are_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that shows a new gid with every message does not fill the wire's memory; known senders stay known."""
    monkeypatch.setattr(ros2, "MOST_SENDERS", 3)
    codes = Codes()
    read = SenderReader(codes)
    gids = [bytes([n] * 16) for n in range(5)]
    assert [read(attachment(n, gid), None) for n, gid in enumerate(gids)] == [(1, 0), (2, 1), (3, 2), (0, 3), (0, 4)]
    assert read(attachment(9, gids[2]), None) == (3, 9)
    assert len(codes.names) == 3


def test_a_token_says_what_its_entity_is() -> None:
    """Node, subscription and service, with names, types and QoS."""
    assert read_token(NODE) == Entity(gid_of(NODE), "node", 0, "aac3178e146ba6f1fc6e6a4085e77f21", "/listener")
    subscription = read_token(SUBSCRIPTION)
    assert subscription is not None
    assert (subscription.kind, subscription.node, subscription.topic) == ("subscription", "/listener", "/chatter")
    assert subscription.qos == Qos("reliable", "volatile", "keep last", 10)
    service = read_token(SERVICE)
    assert service is not None
    assert (service.kind, service.domain, service.node) == ("service", 7, "/robot/arm/adder")


def gid_of(token: str) -> str:
    """The gid of rmw_zenoh: the lower, then the higher half of the hash, each with its lowest byte first."""
    digest = bytes.fromhex(xxh3_128_hexdigest(token.encode()))
    return (digest[8:][::-1] + digest[:8][::-1]).hex()


def test_the_key_of_a_service_is_that_of_its_requests() -> None:
    """Domain, name, type and hash, with the slashes of the name."""
    assert service_key(SERVICE) == f"7/robot/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{HASH}"


@pytest.mark.parametrize(
    ("text", "qos"),
    [
        ("::,:,:,:,,", Qos("reliable", "volatile", "keep last", 42)),
        ("2::,7:,:,:,,", Qos("best effort", "volatile", "keep last", 7)),
        ("1:1:2,1:5,0:,:1,2,3", Qos("reliable", "transient local", "keep all", 1)),
    ],
)
def test_qos_of_a_token(text: str, qos: Qos) -> None:
    """Entries that a token leaves out have the default of rmw_zenoh; deadline, lifespan and liveliness are not read."""
    entity = read_token(SUBSCRIPTION.rpartition("/")[0] + "/" + text)
    assert entity is not None
    assert entity.qos == qos


def test_parts_that_later_versions_add_to_a_token_are_ignored() -> None:
    """Rolling adds the backends of buffers at the end; the key stays the same, and the gid covers the whole token."""
    longer = SUBSCRIPTION + "/cpu:"
    entity, plain = read_token(longer), read_token(SUBSCRIPTION)
    assert entity is not None
    assert plain is not None
    assert entity.key == plain.key
    assert entity.gid == gid_of(longer) != plain.gid


@pytest.mark.parametrize(
    "token",
    [
        "a/b",
        "",
        "@ros2_lv",
        NODE.replace("/NN/", "/XX/"),
        NODE.replace("@ros2_lv/0", "@ros2_lv/x"),
        NODE.replace("@ros2_lv/0", "@ros2_lv/" + "9" * 5000),
        NODE.replace("/%/%/", "//%/"),
        SERVICE.rpartition("/")[0],
        SERVICE.replace("::,10:", "5::,10:"),
        SERVICE.replace("::,10:", ":9:,10:"),
        SERVICE.replace("::,10:", "::8,10:"),
        SERVICE.replace("::,10:", "::,x:"),
        SERVICE.replace("::,10:,:,:,,", "::10:,:"),
        SERVICE.replace("::,10:,:,:,,", ":"),
        SERVICE.replace("@ros2_lv", "ros2_lv"),
    ],
)
def test_a_malformed_token_is_no_entity(token: str) -> None:
    """A program may declare any token: one that is not of rmw_zenoh is none, and offers no service."""
    assert read_token(token) is None
    assert service_key(token) is None


def test_only_services_need_a_complete_queryable() -> None:
    """Nodes, publishers, subscriptions and clients have none, even if one of their names is SS."""
    assert service_key(NODE) is None
    assert service_key(SUBSCRIPTION) is None
    assert service_key(SERVICE.replace("/SS/", "/SC/")) is None
    assert service_key(NODE.replace("/%/%/listener", "/SS/%/listener")) is None


@pytest.mark.parametrize("name", ["%", "%%add", "%robot%%add", "%**", "%a$*b", "%@adv%x"])
def test_a_service_whose_name_is_no_key_is_not_offered(name: str) -> None:
    """A token can be valid, and the key of its service not, or have wildcards that would take the queries of others."""
    assert service_key(SERVICE.replace("%robot%add_two_ints", name)) is None


@pytest.mark.parametrize(
    ("key", "seconds"),
    [
        ("demo/example", 10.0),
        (f"0/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{HASH}", ros2.SERVICE_SECONDS),
        ("0/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/TypeHashNotSupported", ros2.SERVICE_SECONDS),
        (f"0/drive/_action/get_result/x::action::dds_::Drive_GetResult_/{HASH}", ros2.RESULT_SECONDS),
        (f"0/tf_static/tf2_msgs::msg::dds_::TFMessage_/{HASH}/@adv/**", 10.0),
    ],
)
def test_services_and_actions_have_time_to_reply(key: str, seconds: float) -> None:
    """A wire that gave up sooner than the client would turn a slow service into a lost call."""
    assert reply_seconds(key, 10.0) == seconds
    assert reply_seconds(key, 10 * ros2.RESULT_SECONDS) == 10 * ros2.RESULT_SECONDS


def test_each_entity_is_written_down_once(tmp_path: Path) -> None:
    """A line for each entity that a side shows, however often its token comes; other tokens are not entities."""
    log = EntityLog(tmp_path)
    for token in [NODE, SERVICE, NODE, "other/token", SERVICE]:
        log.add("robot", token)
    log.add("base", NODE)
    lines = [json.loads(line) for line in (tmp_path / "ros2.jsonl").read_text().splitlines()]
    assert [(line["side"], line["kind"], line["node"]) for line in lines] == [
        ("robot", "node", "/listener"),
        ("robot", "service", "/robot/arm/adder"),
        ("base", "node", "/listener"),
    ]
    assert lines[1]["gid"] == gid_of(SERVICE)
    assert lines[1]["topic"] == "/robot/add_two_ints"
    assert lines[1]["qos"]["depth"] == 10


def test_a_log_that_cannot_be_written_is_reported_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The wire goes on without it."""
    log = EntityLog(tmp_path / "gone")
    log.add("robot", NODE)
    log.add("robot", SERVICE)
    errors = capsys.readouterr().err
    assert errors.count("lacks entities of ROS 2 from now on (No such file or directory)") == 1


def test_a_log_does_not_grow_without_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that declares ever new tokens fills no disk."""
    monkeypatch.setattr(ros2, "MOST_ENTITIES", 2)
    log = EntityLog(tmp_path)
    for n in range(4):
        log.add("robot", f"{NODE}{n}")
    assert len((tmp_path / "ros2.jsonl").read_text().splitlines()) == 2


def test_the_launch_file_starts_its_wire_and_puts_nodes_on_its_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    """The endpoints of the launch file are those of the wire file, which is valid; stand-ins take the place of ROS."""
    folder = Path(__file__).parents[2] / "docs" / "ros2"
    plan = load_wire(folder / "robot.toml")

    def keep(**fields: Any) -> dict[str, Any]:
        return fields

    stands: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"ExecuteProcess": keep},
        "launch_ros": {},
        "launch_ros.actions": {"Node": keep},
    }
    for name, members in stands.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    launched = runpy.run_path(str(folder / "robot.launch.py"))
    wire, talker, listener = launched["generate_launch_description"]()
    assert wire["cmd"][:3] == ["evedrop", "wire", str(folder / "robot.toml")]
    assert cli.parser_of().parse_args(wire["cmd"][1:]).command is not None
    for node, side in ((talker, "robot"), (listener, "base")):
        override = node["additional_env"]["ZENOH_CONFIG_OVERRIDE"]
        config = zenoh.Config()
        for entry in override.split(";"):
            config.insert_json5(*entry.split("=", 1))
        assert json.loads(config.get_json("mode")) == "client"
        assert tuple(json.loads(config.get_json("connect/endpoints"))) == plan.sides[side].listen
    assert plan.is_lossless(zenoh.KeyExpr("0/tf_static/T/H"))
    assert plan.is_lossless(zenoh.KeyExpr("0/tf_static/T/H/@adv/pub/1/2/_"))
    assert not plan.is_lossless(zenoh.KeyExpr("0/map/T/H/@adv/**"))
