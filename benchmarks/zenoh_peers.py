"""Processes that send and receive messages over Zenoh and note the times, through a plain router of Zenoh or through ours.

They use the packages zenoh and msgpack and nothing of this project. A message is a packet of docs/protocol.md, in its envelope. A
peer declares its publisher or its subscriber, and then its liveliness token: when all tokens are there, the sender may begin.

A peer reads its task, a line of JSON, from its standard input, so that no password is among its arguments.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import IO, Any

import msgpack
import zenoh
from zenoh.handlers import FifoChannel

_PATIENCE = (
    30.0  # seconds for all peers to appear, and for what is sent to arrive in addition to the time it takes to send
)


@dataclass(frozen=True)
class Peer:
    """A sender or a receiver: the key of its messages, its liveliness token, and its name and password, if it needs them."""

    key: str
    token: str
    user: str = ""
    password: str = ""


@dataclass(frozen=True)
class Load:
    """The messages: how many, how many bytes of payload in each, and how many a second (0: as fast as it goes)."""

    slots: int
    size: int
    rate: float = 0.0


@dataclass(frozen=True)
class Times:
    """The times of all messages, by one clock: of the sender, and of each receiver."""

    sent: list[float]
    received: list[list[float]]

    @property
    def slots_per_second(self) -> float:
        """The rate from the first message sent to the last one received."""
        return len(self.sent) / (max(times[-1] for times in self.received) - self.sent[0])

    def delay(self, fraction: float) -> float:
        """A quantile of the one-way latency in microseconds: the largest over receivers."""
        quantiles = []
        for times in self.received:
            delays = sorted(there - here for here, there in zip(self.sent, times, strict=True))
            quantiles.append(delays[min(int(len(delays) * fraction), len(delays) - 1)] * 1e6)
        return max(quantiles)


def session_of(mode: str, endpoint: str, user: str = "", password: str = "") -> zenoh.Session:
    """A session, as `router` that listens or as `client`, without discovery."""
    transport: dict[str, Any] = {
        "link": {"tx": {"queue": {"congestion_control": {"block": {"wait_before_close": 60_000_000}}}}}
    }
    if user:
        transport["auth"] = {"usrpwd": {"user": user, "password": password}}
    config = {
        "mode": mode,
        "listen" if mode == "router" else "connect": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "transport": transport,
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def envelope(key: str, message: dict[str, Any]) -> bytes:
    """A message in its envelope."""
    return bytes(msgpack.packb(key)) + bytes(msgpack.packb(message))


def carry(session: zenoh.Session, endpoint: str, sender: Peer, receivers: Sequence[Peer], load: Load) -> Times:
    """Start a sender and receivers, let them carry the messages, and return the times.

    session: of the caller, which may watch their tokens; endpoint: of the router that they connect to.

    Raises RuntimeError if a peer does not appear or fails, TimeoutExpired if messages do not arrive.
    """
    present = Present(session, [peer.token for peer in (sender, *receivers)])
    patience = _PATIENCE + (load.slots / load.rate if load.rate else load.slots / 100)
    with ExitStack() as stack:
        others = [_started(stack, "receive", endpoint, peer, load) for peer in receivers]
        first = _started(stack, "send", endpoint, sender, load)
        present.wait([first, *others])
        _tell(first.stdin, "go")
        received = [_told(other, patience) for other in others]
        return Times(_told(first, patience), received)


class Present:
    """The liveliness tokens that are on the network."""

    def __init__(self, session: zenoh.Session, tokens: Sequence[str]) -> None:
        self._missing = set(tokens)
        self._all_there = threading.Event()
        live = session.liveliness()
        self._watches = [live.declare_subscriber(token, self._changed, history=True) for token in tokens]

    def _changed(self, sample: zenoh.Sample) -> None:
        self._missing.discard(str(sample.key_expr))
        if not self._missing:
            self._all_there.set()

    def wait(self, processes: Sequence[subprocess.Popen[bytes]]) -> None:
        """Wait for all tokens. Raises RuntimeError, naming the missing ones, when a process has ended, or after some time."""
        deadline = time.monotonic() + _PATIENCE
        while not self._all_there.wait(0.05):
            if time.monotonic() > deadline or any(process.poll() is not None for process in processes):
                raise RuntimeError(f"not on the network: {', '.join(sorted(self._missing))}")


def _started(stack: ExitStack, role: str, endpoint: str, peer: Peer, load: Load) -> subprocess.Popen[bytes]:
    """A peer that is killed when the stack is left, if it is still there."""
    process = subprocess.Popen([sys.executable, __file__, role], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    stack.callback(_ended, process)
    _tell(process.stdin, json.dumps({"endpoint": endpoint, "peer": asdict(peer), "load": asdict(load)}))
    return process


def _ended(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.communicate()


def _tell(stdin: IO[bytes] | None, line: str) -> None:
    assert stdin is not None
    stdin.write(line.encode() + b"\n")
    stdin.flush()


def _told(process: subprocess.Popen[bytes], patience: float) -> list[float]:
    """The times that a peer prints. Raises RuntimeError if it fails."""
    out, _ = process.communicate(timeout=patience)
    if process.returncode:
        raise RuntimeError(f"{' '.join(map(str, process.args[1:]))} ended with status {process.returncode}")  # type: ignore[index]
    times: list[float] = json.loads(out)
    return times


def _send(session: zenoh.Session, peer: Peer, load: Load) -> list[float]:
    publisher = session.declare_publisher(peer.key, congestion_control=zenoh.CongestionControl.BLOCK)
    while not publisher.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool
        time.sleep(0.005)
    token = session.liveliness().declare_token(peer.token)
    sys.stdin.readline()
    payload = bytes(load.size)
    times = []
    start = time.monotonic()
    for k in range(load.slots):
        if load.rate:
            time.sleep(max(0.0, start + k / load.rate - time.monotonic()))
        times.append(time.monotonic())
        publisher.put(envelope(peer.key, {"k": k, "c": 1, "z": payload}))
    sys.stdin.read()  # the session stays open until all messages have arrived
    token.undeclare()
    return times


def _receive(session: zenoh.Session, peer: Peer, load: Load) -> list[float]:
    messages = session.declare_subscriber(peer.key, FifoChannel(65_536))
    token = session.liveliness().declare_token(peer.token)
    times = []
    for k in range(load.slots):
        payload = messages.recv().payload.to_bytes()
        times.append(time.monotonic())
        unpacker = msgpack.Unpacker()
        unpacker.feed(payload)
        unpacker.skip()
        if (received := unpacker.unpack()["k"]) != k:
            raise RuntimeError(f"{peer.key}: slot {received} came where slot {k} was expected")
    token.undeclare()
    return times


def _main(role: Callable[[zenoh.Session, Peer, Load], list[float]]) -> None:
    task = json.loads(sys.stdin.readline())
    peer, load = Peer(**task["peer"]), Load(**task["load"])
    with session_of("client", task["endpoint"], peer.user, peer.password) as session:
        times = role(session, peer, load)
    print(json.dumps(times), flush=True)


if __name__ == "__main__":
    _main({"send": _send, "receive": _receive}[sys.argv[1]])
