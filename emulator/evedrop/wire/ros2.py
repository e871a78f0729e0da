"""Reads the metadata of rmw_zenoh, which carries ROS 2 over Zenoh: who sent a message, and who offers a service.

A wire passes ROS 2 on as it passes on everything else. It reads this to name publishers in its journal, to offer the services of
one side on the others, and to wait long enough for their replies. A file beside the journal has the names behind its gids: every
entity of ROS 2 that the wire has seen.

Source: docs/ros2.md, what the wire reads.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from struct import Struct
from typing import Final, final

import zenoh
from xxhash import xxh3_128_intdigest

from evedrop.system.files import LineFile
from evedrop.system.output import warn

_ATTACHMENT = Struct("<q8xB16s")
"""Sequence number, time (skipped), length of the gid, gid."""
_NAMED = Struct("<16sq17s8x11sB16s")
"""The same with their names, as rmw_zenoh wrote it in the first half of 2025."""
_NAMES = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")
_GID_LENGTH = 16
MOST_SENDERS = 65_536
"""The most senders that a reader tells apart; messages of further ones have an unknown sender."""

_TOKENS = "@ros2_lv"
_NODE_PARTS = 9
_ENTITY_PARTS = 13
_KINDS = {"NN": "node", "MP": "publisher", "MS": "subscription", "SS": "service", "SC": "client"}
_SERVICE = "/SS/"
_NUMBER = re.compile("[0-9]{1,20}")
_KEY = re.compile(r"[^/#?$*@]+(/[^/#?$*@]+)*")
"""A Zenoh key without wildcards and verbatim chunks."""
_RELIABILITY = {"": "reliable", "0": "system default", "1": "reliable", "2": "best effort"}
_DURABILITY = {"": "volatile", "0": "system default", "1": "transient local", "2": "volatile"}
_HISTORY = {"": "keep last", "0": "system default", "1": "keep last", "2": "keep all"}
_DEPTH = 42

_HASHES = ("RIHS01_", "TypeHashNotSupported")
_RESULT = "/_action/get_result/"
SERVICE_SECONDS: Final = 600.0
"""For how long a client of rmw_zenoh waits for a service unless it is configured otherwise."""
RESULT_SECONDS: Final = 30 * 86_400.0
"""For how long the wire waits for the result of an action, for which a client waits without limit."""


@final
class SenderReader:
    """Reads who sent a message, and the number that its sender gave it.

    `code` gives the journal's code of a sender's name; it is called once for each sender.
    """

    def __init__(self, code: Callable[[str], int]) -> None:
        self._code = code
        self._codes: dict[bytes | str, int] = {}

    def __call__(self, attachment: zenoh.ZBytes | None, source: zenoh.SourceInfo | None) -> tuple[int, int]:
        """The code of the sender and its number for the message; 0 and -1 if the message has neither.

        The name of a sender is the gid in the attachment of rmw_zenoh, in hexadecimal, or else Zenoh's source info as
        `SESSION/ENTITY`.
        """
        if attachment is not None:
            octets = attachment.to_bytes()
            if len(octets) == _ATTACHMENT.size:
                sequence, length, gid = _ATTACHMENT.unpack(octets)
                if length == _GID_LENGTH:
                    code = self._codes.get(gid)
                    return self._learn(gid) if code is None else code, sequence
            elif len(octets) == _NAMED.size:
                first, sequence, second, third, length, gid = _NAMED.unpack(octets)
                if length == _GID_LENGTH and (first, second, third) == _NAMES:
                    return self._learn(gid), sequence
        if source is not None:
            return self._learn(f"{source.source_id.zid}/{source.source_id.eid}"), source.source_sn
        return 0, -1

    def _learn(self, sender: bytes | str) -> int:
        code = self._codes.get(sender)
        if code is not None:
            return code
        if len(self._codes) >= MOST_SENDERS:
            return 0
        return self._codes.setdefault(sender, self._code(sender if isinstance(sender, str) else sender.hex()))


@dataclass(frozen=True)
class Qos:
    """The quality of service of an entity; what a token leaves out has the default of rmw_zenoh."""

    reliability: str
    """`reliable` or `best effort`."""
    durability: str
    """`volatile` or `transient local`."""
    history: str
    """`keep last` or `keep all`."""
    depth: int


@dataclass(frozen=True)
class Entity:
    """A part of a ROS 2 system as its liveliness token describes it."""

    gid: str
    """What the attachments of its messages contain, in hexadecimal."""
    kind: str
    """`node`, `publisher`, `subscription`, `service` or `client`."""
    domain: int
    """The ROS domain."""
    session: str
    """The Zenoh id of its process."""
    node: str
    """The full name of its node."""
    topic: str | None = None
    """The full name of its topic or service; None for a node."""
    type: str | None = None
    """As in DDS, such as `std_msgs::msg::dds_::String_`."""
    type_hash: str | None = None
    qos: Qos | None = None

    @property
    def key(self) -> str | None:
        """The key of its messages or requests; None for a node."""
        if self.topic is None:
            return None
        return f"{self.domain}/{self.topic.removeprefix('/').removesuffix('/')}/{self.type}/{self.type_hash}"


def read_token(token: str) -> Entity | None:
    """The entity behind a liveliness token of rmw_zenoh; None for any other token, or if it is malformed.

    Parts that rmw_zenoh may add at the end of tokens are ignored.
    """
    parts = token.split("/")
    if len(parts) < _NODE_PARTS or parts[0] != _TOKENS or "" in parts or not _NUMBER.fullmatch(parts[1]):
        return None
    domain, session, kind = int(parts[1]), parts[2], _KINDS.get(parts[5])
    if kind is None:
        return None
    namespace, name = (part.replace("%", "/") for part in parts[7:9])
    gid = xxh3_128_intdigest(token.encode()).to_bytes(_GID_LENGTH, "little").hex()
    entity = Entity(gid, kind, domain, session, f"{namespace.rstrip('/')}/{name}")
    if kind == "node":
        return entity
    if len(parts) < _ENTITY_PARTS or (qos := _read_qos(parts[12])) is None:
        return None
    topic, type_name, type_hash = (part.replace("%", "/") for part in parts[9:12])
    return Entity(gid, kind, domain, session, entity.node, topic, type_name, type_hash, qos)


def _read_qos(text: str) -> Qos | None:
    parts = text.split(":")
    if len(parts) < 3 or "," not in parts[2]:
        return None
    reliability, durability = _RELIABILITY.get(parts[0]), _DURABILITY.get(parts[1])
    history, depth = parts[2].split(",", 1)
    kept = _HISTORY.get(history)
    if reliability is None or durability is None or kept is None or not (depth == "" or _NUMBER.fullmatch(depth)):
        return None
    return Qos(reliability, durability, kept, int(depth) if depth else _DEPTH)


def service_key(token: str) -> str | None:
    """The key of the queryable behind the token of a ROS 2 service; None for all other tokens.

    Clients ask for queryables that are complete for this key, and find no others.
    """
    if not token.startswith(_TOKENS) or _SERVICE not in token:
        return None
    entity = read_token(token)
    key = entity.key if entity is not None and entity.kind == "service" else None
    return key if key is not None and _KEY.fullmatch(key) else None


def reply_seconds(key: str, seconds: float) -> float:
    """For how long a wire that otherwise waits for `seconds` waits for the replies to a query with this key."""
    if not key.rpartition("/")[2].startswith(_HASHES):
        return seconds
    return max(seconds, RESULT_SECONDS if _RESULT in key else SERVICE_SECONDS)


ENTITIES: Final = "ros2.jsonl"
"""The file inside a wire's folder that has a line for each entity: side, gid, kind, node, topic, type and QoS."""
MOST_ENTITIES = 65_536
"""The most lines that one start of a wire writes."""


@final
class EntityLog:
    """Writes down each entity of ROS 2 once, as its liveliness token describes it, when its token first appears.

    A file that cannot be written ends the log with a warning; the wire continues.
    """

    def __init__(self, folder: Path) -> None:
        self._path: Path | None = folder / ENTITIES
        self._known: set[tuple[str, str]] = set()

    def add(self, side: str, token: str) -> None:
        """Note a token of a program at a side; a token that is not of rmw_zenoh is ignored."""
        if self._path is None or (side, token) in self._known or len(self._known) >= MOST_ENTITIES:
            return
        entity = read_token(token)
        if entity is None:
            return
        self._known.add((side, token))
        try:
            with LineFile(self._path) as file:
                file.append({"side": side, **asdict(entity)})
        except OSError as error:
            warn(f"{self._path} lacks entities of ROS 2 from now on ({error.strerror}); the wire and its journal go on")
            self._path = None
