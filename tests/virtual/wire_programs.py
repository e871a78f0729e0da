"""Programs at the sides of a simulated wire: they publish, delete, ask, answer, and say that they are alive.

What they sent and got is in a `Course`. The bytes of a message, with its attachment, are its number, so the journal tells which
message a row is about. All messages of a case have different numbers.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import json
import struct
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, NamedTuple, final

import zenoh

from evedrop.system.world import world
from evedrop.virtual.processes import VirtualProcess
from evedrop.wire.records import Kind
from evedrop.wire.ros2 import read_token

PAUSE = 0.1
"""The mean time between two turns of a program."""
USER = {"ada": "a long password"}
"""The only user of a side that has users."""
ANSWERS = ("value", "error", "delete", "nothing", "twice", "late")
"""How a program may answer."""
_PATIENCE = 30.0
_LATE_TURNS = 5
_OFTEN, _LARGE = 8, 4096
_QUERY_ATTACHMENT = b"who"
_GID = struct.Struct("<qqB16s")
_ROLES = {"ros": "MP", "serve": "SS"}
_TIMEOUT = b"Timeout"


class Message(NamedTuple):
    """A message, as the journal tells it from others."""

    kind: str
    """`put`, which a delete is as well, `query` or `reply`."""
    side: str
    """At which it arrives."""
    key: str
    size: int


class Content(NamedTuple):
    """What a publication consists of."""

    deletes: bool
    payload: int
    """Bytes."""
    attachment: int


@dataclass
class Course:
    """What the programs of a wire saw."""

    sent: set[tuple[str, str, int]] = field(default_factory=set)
    """Kind, key and size of what was sent."""
    contents: dict[tuple[str, int], Content] = field(default_factory=dict)
    """Key and size of each publication → its content."""
    arrived: list[tuple[float, Message, Content]] = field(default_factory=list)
    """When each publication arrived, in virtual seconds, and what it consisted of."""
    got: Counter[Message] = field(default_factory=Counter)
    begun: list[float] = field(default_factory=list)
    """When each start of the wire began, in virtual seconds."""
    ended: list[float] = field(default_factory=list)
    """When each of them was over."""
    dropped: list[float] = field(default_factory=list)
    """When Zenoh dropped a message for which a connection had no room: it tells nobody, not even the wire."""
    processes: list[VirtualProcess] = field(default_factory=list)
    """Of the wire's starts."""
    here: list[tuple[WireProgram, float, list[float]]] = field(default_factory=list)
    """From when to when each program was there, which is empty if it was there at the end."""
    alive: set[tuple[str, str]] = field(default_factory=set)
    """The tokens that were seen at each side, as side and token."""
    typed: list[tuple[str, int]] = field(default_factory=list)
    """Commands of operators, and how they ended."""
    doubts: list[str] = field(default_factory=list)
    """What a program that opened the wire expected in vain."""
    damaged: list[str] = field(default_factory=list)
    """What is wrong with what starts in damaged copies of the folder said."""
    read: list[tuple[str, int, str]] = field(default_factory=list)
    """Commands that read the folder afterwards, how they ended, and what they printed."""


@final
@dataclass(frozen=True)
class WireProgram:
    """A program at a side.

    What it does is told by words: `publish KEY`, `often KEY`, `many KEY`, `large KEY`, `delete KEY`, `ros TOPIC`, `named KEY`
    (the publisher and its number as rmw_zenoh once wrote them) and `vary KEY` (with source information, now and then express)
    in each turn; `ask KEY` and `call TOPIC` in each turn; `answer KEY HOW` and `serve TOPIC HOW`; `alive TOKEN`, `odd SIDE`
    (tokens that few understand), `blink TOKEN`, `watch TOKENS`, `listen KEYS`; `leave` closes its session at its end;
    `peer quiet` is in mode peer, and `peer heard` also answers multicast scouting.
    """

    side: str
    does: tuple[str, ...]
    after: float = 0.0
    """Seconds after its start, until it connects."""
    until: float | None = None
    """Seconds from then on, after which it ends."""

    def __str__(self) -> str:
        times = "" if (self.after, self.until) == (0.0, None) else f" from {self.after:g} s for {self.until} s"
        return f"{self.side}{times}: {', '.join(self.does) or 'nothing'}"

    def objects(self, *verbs: str) -> list[str]:
        """What follows these verbs in its words."""
        return [
            rest.partition(" ")[0] for verb, _, rest in (words.partition(" ") for words in self.does) if verb in verbs
        ]

    def tokens(self) -> list[str]:
        """The liveliness tokens that it holds all the time."""
        ros = [ros_token(self.side, topic, _ROLES[verb]) for verb in _ROLES for topic in self.objects(verb)]
        return [*self.objects("alive"), *ros, *(token for side in self.objects("odd") for token in odd_tokens(side))]

    def answered(self) -> list[str]:
        """The keys at which it answers."""
        return [*self.objects("answer"), *(service(topic) for topic in self.objects("serve"))]


def ros_token(side: str, topic: str, kind: str) -> str:
    """The liveliness token of a publisher or a service of rmw_zenoh."""
    return f"@ros2_lv/0/{side}/0/1/{kind}/%/%/node/%{topic}/{_TYPE}/{_HASH}/::,:,:,:,,"


def odd_tokens(side: str) -> list[str]:
    """Tokens of a node, of an entity of an unknown kind, and malformed ones."""
    endpoint = f"MP/%/%/node/%odd/{_TYPE}/{_HASH}"
    ends = (
        "NN/%/%/node",
        "XX/%/%/node",
        "MP/%/%/node/%odd",
        f"{endpoint}/:",
        f"{endpoint}/::x",
        f"{endpoint}/9::,:,:,:,,",
    )
    return [f"@ros2_lv/0/{side}/0/{number}/{end}" for number, end in enumerate(ends, 7)]


_TYPE, _HASH = "std_msgs::msg::dds_::String_", "RIHS01_5a"


def ros_key(topic: str) -> str:
    """The key of a topic or service of ROS 2."""
    return f"0/{topic}/{_TYPE}/{_HASH}"


service = ros_key


def gid_of(token: str) -> str:
    """What the messages of the publisher behind a token contain."""
    entity = read_token(token)
    assert entity is not None
    return entity.gid


def connected(endpoint: str, users: Mapping[str, str] | None = None, peer: str | None = None) -> Any:
    """A session at an endpoint, once somebody listens there; peer: `quiet` or `heard`, as in the words of a program."""
    settings: dict[str, Any] = {"mode": "client", "connect": {"endpoints": [endpoint]}}
    if peer is not None:
        settings |= {"mode": "peer", "scouting": {"multicast": {"enabled": peer == "heard"}}}
    for user, password in (users or {}).items():
        settings["transport"] = {"auth": {"usrpwd": {"user": user, "password": password}}}
    config = zenoh.Config.from_json5(json.dumps(settings))
    while True:
        try:
            return world().zenoh.open(config)
        except zenoh.ZError:
            world().sleep(PAUSE)


@final
class ProgramAtWork:
    """A program in its process."""

    def __init__(self, program: WireProgram, place: int, numbers: Iterator[int], course: Course) -> None:
        """place: of its side, among all; numbers: of its next messages."""
        self._program, self._place, self._numbers, self._course = program, place, numbers, course
        self._side = program.side
        self._turns: list[Callable[[], object]] = []
        self._late: deque[tuple[int, Callable[[], object]]] = deque()
        self._turn = 0
        self._own = {
            *program.objects("publish", "often", "large", "delete", "named", "vary"),
            *map(ros_key, program.objects("ros")),
        }

    def run(self, endpoint: str, users: Mapping[str, str] | None, epoch: float) -> int:
        """Work until its end; epoch: when the world began, in seconds since 1970."""
        program, self._epoch = self._program, epoch
        world().sleep(program.after)
        self._session = session = connected(endpoint, users, next(iter(program.objects("peer")), None))
        for words in program.does:
            verb, *objects = words.split(" ")
            if verb not in {"leave", "peer"}:
                getattr(self, f"_{verb}")(*objects)
        begun, end = world().monotonic(), list[float]()
        self._course.here.append((program, world().time() - epoch, end))
        while program.until is None or world().monotonic() < begun + program.until:
            for turn in self._turns:
                turn()
            self._turn += 1
            while self._late and self._late[0][0] <= self._turn:
                self._late.popleft()[1]()
            world().sleep(2.0 * PAUSE * world().token(1)[0] / 256.0 if self._turns else 10.0 * PAUSE)
        end.append(world().time() - epoch)
        if "leave" in program.does:
            session.close()
        return 0

    def _say(self, key: str, extra: int = 0, attachment: bytes = b"", *, delete: bool = False, **details: Any) -> None:
        size = next(self._numbers) + extra
        how: dict[str, Any] = {"congestion_control": zenoh.CongestionControl.BLOCK, **details}
        if delete:
            attachment = bytes(size)
        whole = size if delete else size + len(attachment)
        self._course.sent.add(("put", key, whole))
        self._course.contents[key, whole] = Content(delete, 0 if delete else size, len(attachment))
        if attachment:
            how["attachment"] = attachment
        if delete:
            self._session.delete(key, **how)
        else:
            self._session.put(key, bytes(size), **how)

    def _publish(self, key: str) -> None:
        self._turns.append(lambda: self._say(key))

    def _often(self, key: str) -> None:
        self._turns += [lambda: self._say(key)] * _OFTEN

    def _large(self, key: str) -> None:
        self._turns.append(lambda: self._say(key, _LARGE))

    def _delete(self, key: str) -> None:
        self._turns.append(lambda: self._say(key, delete=True))

    def _many(self, key: str) -> None:
        self._turns.append(lambda: self._say(f"{key}/{self._turn}"))

    def _ros(self, topic: str) -> None:
        token = ros_token(self._side, topic, "MP")
        gid = bytes.fromhex(gid_of(token))
        self._alive(token)
        self._turns.append(lambda: self._say(ros_key(topic), attachment=_GID.pack(self._turn, 0, len(gid), gid)))

    def _named(self, key: str) -> None:
        gid = self._side.encode().ljust(16, b"\0")
        before, time, after = b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid"

        def say() -> None:
            number = struct.pack("<q", self._turn)
            self._say(key, attachment=before + number + time + bytes(8) + after + bytes([len(gid)]) + gid)

        self._turns.append(say)

    def _vary(self, key: str) -> None:
        source_id = SimpleNamespace(zid=self._session.info.zid(), eid=1)

        def say() -> None:
            source = SimpleNamespace(source_id=source_id, source_sn=self._turn)
            self._say(key, express=self._turn % _OFTEN == 0, source_info=source)

        self._turns += [say] * 2

    def _alive(self, token: str) -> None:
        self._session.liveliness().declare_token(token)

    def _odd(self, side: str) -> None:
        for token in odd_tokens(side):
            self._alive(token)

    def _blink(self, token: str) -> None:
        held: list[Any] = []

        def blink() -> None:
            if self._turn % _OFTEN == 0:
                held.append(self._session.liveliness().declare_token(token))
            elif self._turn % _OFTEN == _OFTEN // 2:
                held.pop().undeclare()

        self._turns.append(blink)

    def _watch(self, tokens: str) -> None:
        def seen(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                self._course.alive.add((self._side, str(sample.key_expr)))

        self._session.liveliness().declare_subscriber(tokens, seen, history=True)

    def _listen(self, keys: str) -> None:
        self._session.declare_subscriber(keys, lambda sample: self._hear("put", sample))

    def _hear(self, kind: str, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if kind != "put" or not (key in self._own or key.rpartition("/")[0] in self._program.objects("many")):
            payload, attachment = len(sample.payload), len(sample.attachment or b"")
            message = Message(kind, self._side, key, payload + attachment)
            self._course.got[message] += 1
            if kind == "put":
                content = Content(sample.kind == zenoh.SampleKind.DELETE, payload, attachment)
                self._course.arrived.append((world().time() - self._epoch, message, content))

    def _ask(self, key: str) -> None:
        querier = self._session.declare_querier(
            key, target=zenoh.QueryTarget.ALL, timeout=_PATIENCE, consolidation=zenoh.ConsolidationMode.NONE
        )

        def heard(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._hear("reply", reply.ok)
            elif reply.err is not None and reply.err.payload.to_bytes() != _TIMEOUT:
                self._course.got[Message("reply", self._side, key, len(reply.err.payload))] += 1

        def ask() -> None:
            number = next(self._numbers)
            self._course.sent.add(("query", key, number + len(_QUERY_ATTACHMENT)))
            handler = world().zenoh.handlers.Callback(heard, lambda: None)
            querier.get(handler, payload=bytes(number), attachment=_QUERY_ATTACHMENT)

        self._turns.append(ask)

    def _call(self, topic: str) -> None:
        self._ask(service(topic))

    def _serve(self, topic: str, how: str) -> None:
        self._alive(ros_token(self._side, topic, "SS"))
        self._answer(service(topic), how, complete=True)

    def _answer(self, key: str, how: str, *, complete: bool = False) -> None:
        def answer(query: zenoh.Query) -> None:
            size = len(query.payload or b"") + len(query.attachment or b"")
            self._course.got[Message("query", self._side, str(query.key_expr), size)] += 1
            if how == "late":
                self._late.append((self._turn + _LATE_TURNS, lambda: self._reply(query, size, how)))
            else:
                self._reply(query, size, how)

        self._session.declare_queryable(key, answer, complete=complete)

    def _reply(self, query: zenoh.Query, size: int, how: str) -> None:
        """Answer: the size of the answer tells which of the programs gave it."""
        key = str(query.key_expr).replace("*", self._side)
        for part in {"nothing": (), "twice": (0, 4)}.get(how, (0,)):
            number = 8 * size + self._place + part
            self._course.sent.add(("reply", str(query.key_expr) if how == "error" else key, number))
            if how == "error":
                query.reply_err(bytes(number))
            elif how == "delete":
                query.reply_del(key, attachment=bytes(number))
            else:
                query.reply(key, bytes(number))
        query.drop()


def stream_of(kind: str) -> str:
    """The kind of a row of the journal, as programs tell messages from each other."""
    return Kind[kind.upper()].stream


def programs_of(described: Sequence[Mapping[str, Any]]) -> tuple[WireProgram, ...]:
    """The programs that `described` has written."""
    return tuple(
        WireProgram(entry["side"], tuple(entry["does"]), entry.get("after", 0.0), entry.get("until"))
        for entry in described
    )
