"""ROS 2 nodes without ROS: they use Zenoh as rmw_zenoh does, call for call.

Keys are made by pamoja-ros2, type hashes and payloads by rosbags, attachments by the serializer of Zenoh. Which entity is
declared first, with what options, and what is attached was read from rmw_zenoh's branches humble, jazzy and rolling.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

import zenoh
from pamoja import ros2 as pamoja
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from xxhash import xxh3_128_intdigest
from zenoh import ext

STRING = "std_msgs/msg/String"
ADD = "example_interfaces/srv/AddTwoInts"
REQUEST, RESPONSE = (
    "example_interfaces/msg/AddTwoInts_Request",
    "example_interfaces/msg/AddTwoInts_Response",
)  # as rosbags has it
TYPES = get_typestore(Stores.ROS2_JAZZY)
TYPES.register(get_types_from_msg("int64 a\nint64 b", REQUEST))
TYPES.register(get_types_from_msg("int64 sum", RESPONSE))
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
HEARTBEAT = 0.5
"""Seconds between the heartbeats of a reliable publisher whose messages are kept."""


@contextmanager
def ros_context(endpoint: str) -> Iterator[zenoh.Session]:
    """A session as rmw_zenoh opens one for a process, with its defaults and the two lines of docs/ros2.md."""
    config = zenoh.Config()
    defaults = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "listen/endpoints": ["tcp/localhost:0"],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": {"router": True, "peer": True, "client": True},
        "queries_default_timeout": 600_000,
        "transport/shared_memory/enabled": False,
    }
    for name, value in defaults.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


class ReceivedMessage(NamedTuple):
    """A message that a subscription, a client or a service took."""

    sequence: int
    gid: str
    text: Any


def attach(sequence: int, gid: bytes) -> zenoh.ZBytes:
    """Sequence number, time in nanoseconds, gid."""
    return ext.z_serialize((ext.Int64(sequence), ext.Int64(time.time_ns()), gid))


def detach(attachment: zenoh.ZBytes | None) -> tuple[int, str]:
    """Sequence number and gid; rmw_zenoh refuses a message without."""
    assert attachment is not None
    sequence, _, gid = ext.z_deserialize(tuple[ext.Int64, ext.Int64, bytes], attachment)
    return int(sequence), gid.hex()


@dataclass
class Node:
    """A node, and everything that it declares until its session ends."""

    session: zenoh.Session
    name: str
    namespace: str = "/"
    domain: int = 0
    _ids: Iterator[int] = field(default_factory=count)
    _held: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Declare the node's token, and follow the graph."""
        self.graph: dict[str, bool] = {}
        self.changed = threading.Event()
        """Set whenever the graph changes."""
        self._id = next(self._ids)
        self._held.append(self.session.liveliness().declare_token(self._token(self._id, "NN")))
        everything = f"@ros2_lv/{self.domain}/**"
        for reply in self.session.liveliness().get(everything, zenoh.handlers.FifoChannel(10_000), timeout=10.0):
            if reply.ok is not None:
                self.graph[str(reply.ok.key_expr)] = True

        def changed(sample: zenoh.Sample) -> None:
            self.graph[str(sample.key_expr)] = sample.kind == zenoh.SampleKind.PUT
            self.changed.set()

        self._held.append(self.session.liveliness().declare_subscriber(everything, changed, history=True))

    def sees(self, kind: str, topic: str) -> int:
        """How many entities of a kind there are in the graph for a topic."""
        name = pamoja.percent_mangle(topic)
        return sum(alive and f"/{kind}/" in token and f"/{name}/" in token for token, alive in self.graph.items())

    def publisher(self, topic: str, kept: int = 0, depth: int = 10, reliable: bool = True) -> Callable[[str], int]:
        """A publisher of strings; `kept` messages are for late joiners. Returns what publishes, and gives the sequence number."""
        key, token = self._entity("MP", topic, STRING, string_hash(), kept, depth, reliable)
        self._held.append(self.session.liveliness().declare_token(token))
        publisher = ext.declare_advanced_publisher(
            self.session,
            key,
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
            cache=ext.CacheConfig(kept) if kept else None,
            publisher_detection=bool(kept),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT)
            if kept and reliable
            else None,
        )
        self._held.append(publisher)
        gid, numbers = gid_of(token), count(1)

        def publish(text: str) -> int:
            sequence = next(numbers)
            publisher.put(to_cdr(STRING, data=text), attachment=attach(sequence, gid))
            return sequence

        return publish

    def subscription(self, topic: str, kept: int = 0, depth: int = 10, reliable: bool = True) -> list[ReceivedMessage]:
        """A subscription to strings; returns the list to which it adds them."""
        key, token = self._entity("MS", topic, STRING, string_hash(), kept, depth, reliable)
        heard: list[ReceivedMessage] = []

        def take(sample: zenoh.Sample) -> None:
            heard.append(ReceivedMessage(*detach(sample.attachment), from_cdr(STRING, sample.payload).data))

        self._held.append(
            ext.declare_advanced_subscriber(
                self.session,
                key,
                take,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=kept) if kept else None,
                recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if kept and reliable else None,
                subscriber_detection=bool(kept),
            )
        )
        self._held.append(self.session.liveliness().declare_token(token))
        return heard

    def service(self, name: str) -> list[ReceivedMessage]:
        """A service that adds two numbers; returns the list of the requests that it took."""
        key, token = self._entity("SS", name, ADD, ADD_HASH)
        taken: list[ReceivedMessage] = []

        def answer(query: zenoh.Query) -> None:
            assert query.payload is not None
            sequence, gid = detach(query.attachment)
            request = from_cdr(REQUEST, query.payload)
            taken.append(ReceivedMessage(sequence, gid, (request.a, request.b)))
            reply = to_cdr(RESPONSE, sum=request.a + request.b)
            query.reply(key, reply, attachment=attach(sequence, bytes.fromhex(gid)))
            query.drop()

        self._held.append(self.session.declare_queryable(key, answer, complete=True))
        self._held.append(self.session.liveliness().declare_token(token))
        return taken

    def client(self, name: str) -> tuple[Callable[[int, int], int], list[ReceivedMessage]]:
        """A client of such a service: what sends a request and gives its sequence number, and the list of the responses."""
        key, token = self._entity("SC", name, ADD, ADD_HASH)
        querier = self.session.declare_querier(
            key, target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE
        )
        self._held.append(querier)
        self._held.append(self.session.liveliness().declare_token(token))
        gid, numbers, heard = gid_of(token), count(1), list[ReceivedMessage]()

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                heard.append(ReceivedMessage(*detach(reply.ok.attachment), from_cdr(RESPONSE, reply.ok.payload).sum))

        def send(a: int, b: int) -> int:
            sequence = next(numbers)
            querier.get(take, payload=to_cdr(REQUEST, a=a, b=b), attachment=attach(sequence, gid))
            return sequence

        return send, heard

    def _entity(
        self,
        kind: str,
        topic: str,
        type_name: str,
        type_hash: str,
        kept: int = 0,
        depth: int = 10,
        reliable: bool = True,
    ) -> tuple[str, str]:
        key = pamoja.entity_key(self.domain, topic, type_name, type_hash)
        assert key is not None
        dds = pamoja.dds_type_name(type_name)
        qos = f"{'' if reliable else 2}:{1 if kept else ''}:,{kept or depth}:,:,:,,"
        described = f"{pamoja.percent_mangle(topic)}/{dds}/{type_hash}/{qos}"
        return key, f"{self._token(next(self._ids), kind)}/{described}"

    def _token(self, number: int, kind: str) -> str:
        place = f"@ros2_lv/{self.domain}/{self.session.zid()}/{self._id}/{number}/{kind}"
        return f"{place}/%/{pamoja.percent_mangle(self.namespace)}/{self.name}"


def gid_of(token: str) -> bytes:
    """What rmw_zenoh attaches to the messages of an entity."""
    return xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def string_hash() -> str:
    """The type hash of a string."""
    return str(TYPES.hash_rihs01(STRING))


def to_cdr(type_name: str, **fields: Any) -> bytes:
    """A message in CDR."""
    return bytes(TYPES.serialize_cdr(TYPES.types[type_name](**fields), type_name))


def from_cdr(type_name: str, payload: zenoh.ZBytes) -> Any:
    """A message from CDR."""
    return TYPES.deserialize_cdr(payload.to_bytes(), type_name)
