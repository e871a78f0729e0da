"""One behaviour of Zenoh, played twice: with the real Zenoh, and with the simulated one, in virtual time and in several orders.

A test is a function of a network: it opens routers and clients there and uses their sessions, which have the same methods on
both sides. Clients live in this process; children, which can be killed and suspended, in processes of their own.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, final

import pytest
import zenoh

from evedrop.system.world import world
from evedrop.virtual.processes import VirtualProcess
from evedrop.virtual.run import SimulatedWorld
from evedrop.virtual.scheduler import Ended, VirtualEvent
from tests.conftest import wait_until
from tests.proxy import Cable
from tests.virtual.zenoh_child import declare

Config = dict[str, Any]
Grants = Mapping[str, Sequence[tuple[str, str, str]]]
"""User → flow, message and key of all that it may do."""
SEEDS = range(5)
"""The orders in which the simulated Zenoh plays each behaviour."""
RIGHT, WRONG = "right", "wrong"
"""The password of every user, and another one."""
_NEVER_MS = 86_400_000
_OFTEN_MS = 50
_LIMIT = 60.0
_POLL_SECONDS = 5e-3
_VIRTUAL_LIMIT = 10_000.0
_ROOT = Path(__file__).parents[2]


def behaviour(body: Callable[[Network], None]) -> Any:
    """A test that plays this body on a network of the real Zenoh, and on several of the simulated one."""

    def test(kind: str) -> None:
        if kind == "real":
            with real_network() as network:
                body(network)
        else:
            for seed in SEEDS:
                play_simulated(seed, body)

    test.__name__, test.__doc__, test.__module__ = body.__name__, body.__doc__, body.__module__
    return pytest.mark.parametrize("kind", ["real", "simulated"])(test)


def granted(grants: Grants, zids: Mapping[str, str] | None = None) -> Config:
    """Access control that denies everything else; zids: of routers, which have no user name."""
    known = zids or {}
    rules = [
        {
            "id": f"{user}-{number}",
            "permission": "allow",
            "flows": [flow],
            "messages": [message],
            "key_exprs": [key],
        }
        for user, rights in grants.items()
        for number, (flow, message, key) in enumerate(rights)
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {"id": user, **({"zids": [known[user]]} if user in known else {"usernames": [user]})} for user in grants
        ],
        "policies": [
            {"subjects": [user], "rules": [f"{user}-{number}" for number, _ in enumerate(rights)]}
            for user, rights in grants.items()
            if rights
        ],
    }


WRITES, READS = (
    (("ingress", "put"), ("egress", "declare_subscriber")),
    (("ingress", "declare_subscriber"), ("egress", "put")),
)
TOKEN = (("ingress", "liveliness_token"),)
WATCHES = (("ingress", "declare_liveliness_subscriber"), ("egress", "liveliness_token"))
CHECKS = (("ingress", "liveliness_query"), ("egress", "liveliness_token"))
ANSWERS = (("ingress", "declare_queryable"), ("egress", "query"), ("ingress", "reply"))
ASKS = (("ingress", "query"), ("egress", "reply"))


def rights(kind: tuple[tuple[str, str], ...], *keys: str) -> list[tuple[str, str, str]]:
    """What a kind of use needs at these keys."""
    return [(flow, message, key) for flow, message in kind for key in keys]


class DeliberateError(Exception):
    """What the callback of a test raises."""


class Network(ABC):
    """Where a behaviour is played."""

    zenoh: Any
    """The module `zenoh`, or what stands for it."""

    def __init__(self, folder: Path) -> None:
        """folder: for sockets and files of users."""
        self._folder = folder
        self.kept: list[object] = []
        """What is declared: the real Zenoh withdraws what nobody refers to."""

    def router(self, name: str = "router", **settings: Any) -> Any:
        """Open a router's session; settings as in `config`."""
        return self._open(name, self.config(name, router=True, **settings), None)

    def client(self, name: str, router: str = "router", *, cable: bool = False, **settings: Any) -> Any:
        """Open a client's session, which is connected with a router. cable: by a connection that can be cut."""
        return self._open(name, self.config(name, to=router, **settings), router if cable else None)

    def child(
        self,
        name: str,
        does: Sequence[tuple[str, str]],
        *,
        router: bool = False,
        to: str | None = "router",
        **settings: Any,
    ) -> None:
        """Start a process that declares these things, each a kind and a key, as `declare` says. router: whether it is one."""
        self._start(name, self.config(name, router=router, to=to, **settings), does)

    def config(
        self,
        name: str,
        *,
        router: bool = False,
        to: str | None = None,
        users: Collection[str] | None = None,
        access: Config | None = None,
        limits: Sequence[Config] = (),
        user: str | None = None,
        secret: str = RIGHT,
        retry: bool = False,
        patience: float = 60.0,
        lease: float = 10.0,
        zid: str | None = None,
        timeout_ms: int = 0,
        peer: bool = False,
    ) -> Config:
        """A configuration of Zenoh.

        to: the router that it connects with. retry: whether it connects again by itself. patience: how many seconds it waits
        for room before it closes a connection. lease: after how many seconds of silence the other end takes it for gone.
        peer: whether it is one.
        """
        retries = _OFTEN_MS if retry or router else _NEVER_MS
        auth: Config = {}
        if users is not None:
            file = self._folder / f"users of {name}"
            file.write_text("".join(f"{one}:{RIGHT}\n" for one in users))
            auth["dictionary_file"] = str(file)
        if user is not None:
            auth |= {"user": user, "password": secret}
        return {
            "mode": "router" if router else "peer" if peer else "client",
            **({"listen": {"endpoints": [self.place(name)], "exit_on_failure": True}} if router else {}),
            **({"id": zid} if zid else {}),
            "connect": {
                "endpoints": [] if to is None else [self.place(to)],
                "timeout_ms": -1 if router else timeout_ms,
                "exit_on_failure": not router,
                "retry": {"period_init_ms": retries, "period_max_ms": retries, "period_increase_factor": 1.0},
            },
            "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "transport": {
                "link": {
                    "tx": {
                        "lease": int(lease * 1e3),
                        "queue": {"congestion_control": {"block": {"wait_before_close": int(patience * 1e6)}}},
                    }
                },
                "shared_memory": {"enabled": False},
                **({"auth": {"usrpwd": auth}} if auth else {}),
            },
            **({"access_control": access} if access is not None else {}),
            **({"low_pass_filter": [*limits]} if limits else {}),
        }

    def place(self, name: str) -> str:
        """The endpoint of a router."""
        return f"unixsock-stream/{self._folder / name}"

    @abstractmethod
    def _open(self, name: str, config: Config, cable: str | None) -> Any:
        """Open a session. cable: the router to which it is connected by a cable."""

    @abstractmethod
    def _start(self, name: str, config: Config, does: Sequence[tuple[str, str]]) -> None:
        """Start a process; return once it has declared everything."""

    @abstractmethod
    def until(
        self, condition: Callable[[], Any], awaited: str = "what the behaviour promises", limit: float = _LIMIT
    ) -> Any:
        """Wait for a condition, for so many seconds at most; returns its value."""

    @abstractmethod
    def thread(self, work: Callable[[], object]) -> Any:
        """Start a thread; it can be joined."""

    @abstractmethod
    def event(self) -> Any:
        """An event for which threads can wait."""

    @abstractmethod
    def pause(self, seconds: float) -> None:
        """Let time pass."""

    @abstractmethod
    def now(self) -> float:
        """Seconds."""

    @abstractmethod
    def send(self, child: str, number: signal.Signals) -> None:
        """Send a signal to a child."""

    @abstractmethod
    def cut(self, client: str) -> None:
        """Cut the connection of a client, which cannot be made again."""

    @abstractmethod
    def flap(self, client: str) -> None:
        """Cut the connection of a client, which can be made again at once."""

    @abstractmethod
    def make_stale(self, client: str) -> None:
        """Make it possible that a message to a client comes to the wrong subscriber."""

    @abstractmethod
    def silence(self, client: str) -> None:
        """Let nothing through the connection of a client."""

    @abstractmethod
    def heal(self, client: str) -> None:
        """Let a client whose connection was cut connect again."""

    def kill(self, child: str) -> None:
        """End a child without a warning."""
        self.send(child, signal.SIGKILL)

    def suspend(self, child: str) -> None:
        """Suspend a child."""
        self.send(child, signal.SIGSTOP)

    def resume(self, child: str) -> None:
        """Let a child go on."""
        self.send(child, signal.SIGCONT)


# With the real Zenoh


@final
class RealNetwork(Network):
    """A network of the real Zenoh."""

    zenoh = zenoh

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._sessions: list[zenoh.Session] = []
        self._cables: dict[str, Cable] = {}
        self._children: dict[str, subprocess.Popen[str]] = {}

    def _open(self, name: str, config: Config, cable: str | None) -> Any:
        if cable is not None:
            if name in self._cables:
                self._cables[name].close()
            self._cables[name] = Cable(str(self._folder / cable))
            config["connect"]["endpoints"] = [self._cables[name].endpoint]
        self._sessions.append(session := zenoh.open(zenoh.Config.from_json5(json.dumps(config))))
        return session

    def _start(self, name: str, config: Config, does: Sequence[tuple[str, str]]) -> None:
        words = [sys.executable, "-m", "tests.virtual.zenoh_child", json.dumps({"config": config, "does": [*does]})]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=_ROOT)
        self._children[name] = process
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"

    def until(
        self, condition: Callable[[], Any], awaited: str = "what the behaviour promises", limit: float = _LIMIT
    ) -> Any:
        """Wait for a condition; returns its value."""
        return wait_until(condition, awaited, limit)

    def thread(self, work: Callable[[], object]) -> threading.Thread:
        """Start a thread."""
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        return thread

    def event(self) -> threading.Event:
        """An event."""
        return threading.Event()

    def pause(self, seconds: float) -> None:
        """Let time pass."""
        threading.Event().wait(seconds)

    def now(self) -> float:
        """Seconds."""
        return world().monotonic()

    def send(self, child: str, number: signal.Signals) -> None:
        """Send a signal to a child."""
        self._children[child].send_signal(number)
        if number == signal.SIGKILL:
            self._children[child].communicate(timeout=_LIMIT)

    def cut(self, client: str) -> None:
        """Cut a client off."""
        self._cables[client].cut()

    def flap(self, client: str) -> None:
        """Cut a client off for a moment."""
        self._cables[client].flap()

    def make_stale(self, client: str) -> None:
        """Zenoh keeps numbers of keys from before a connection was made again."""
        self.flap(client)

    def silence(self, client: str) -> None:
        """Let nothing through."""
        self._cables[client].silence()

    def heal(self, client: str) -> None:
        """Let it connect again."""
        self._cables[client].heal()

    def close(self) -> None:
        """End everything."""
        for process in self._children.values():
            if process.poll() is None:
                process.kill()
                process.communicate(timeout=_LIMIT)
        for session in reversed(self._sessions):
            with suppress(zenoh.ZError):
                session.close()
        for cable in self._cables.values():
            cable.close()


@contextmanager
def real_network() -> Iterator[RealNetwork]:
    """A network of the real Zenoh."""
    zenoh.init_log_from_env_or("off")
    folder = Path(tempfile.mkdtemp(prefix="zenoh"))  # a short path: those of sockets end at 108 bytes
    network = RealNetwork(folder)
    try:
        yield network
    finally:
        network.close()
        shutil.rmtree(folder)


# With the simulated Zenoh


@final
class SimulatedNetwork(Network):
    """A network of the simulated Zenoh, in which each session has a process of its own."""

    def __init__(self, folder: Path, simulated: SimulatedWorld) -> None:
        super().__init__(folder)
        self._world, self._scheduler = simulated, simulated.scheduler
        self.zenoh = simulated.zenoh
        self._processes: dict[str, VirtualProcess] = {}

    def _open(self, name: str, config: Config, cable: str | None) -> Any:
        del cable
        return self._begin(name, config, ())

    def _start(self, name: str, config: Config, does: Sequence[tuple[str, str]]) -> None:
        self._begin(name, config, does)

    def _begin(self, name: str, config: Config, does: Sequence[tuple[str, str]]) -> Any:
        """Start a process; returns its session once it has declared everything."""
        opened = VirtualEvent(self._scheduler)
        result: list[Any] = []
        kept: list[object] = []

        def work() -> int:
            try:
                session = self.zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
                kept.extend(declare(self.zenoh, session, kind, key) for kind, key in does)
                result.append(session)
            except zenoh.ZError as error:
                result.append(error)
            opened.set()
            VirtualEvent(self._scheduler).wait(_VIRTUAL_LIMIT)
            return 0

        self._processes[name] = self._world.machine.begin(name, work)
        opened.wait(_VIRTUAL_LIMIT)
        if isinstance(result[0], zenoh.ZError):
            raise result[0]
        return result[0]

    def until(
        self, condition: Callable[[], Any], awaited: str = "what the behaviour promises", limit: float = _LIMIT
    ) -> Any:
        """Wait for a condition; returns its value."""
        deadline = self._scheduler.now + limit
        while not (result := condition()):
            assert self._scheduler.now < deadline, f"within {limit:g} s: {awaited}"
            self._scheduler.sleep(_POLL_SECONDS)
        return result

    def thread(self, work: Callable[[], object]) -> Any:
        """Start a thread."""
        thread = self._scheduler.thread("of the test", work)
        thread.start()
        return thread

    def event(self) -> VirtualEvent:
        """An event."""
        return VirtualEvent(self._scheduler)

    def pause(self, seconds: float) -> None:
        """Let time pass."""
        self._scheduler.sleep(seconds)

    def now(self) -> float:
        """Virtual seconds."""
        return self._scheduler.now

    def send(self, child: str, number: signal.Signals) -> None:
        """Send a signal to a child."""
        self._processes[child].signal(number)

    def cut(self, client: str) -> None:
        """Cut a client off."""
        self.zenoh.cut(client, None)

    def flap(self, client: str) -> None:
        """Cut a client off for a moment."""
        self.zenoh.cut(client, 0.0)

    def make_stale(self, client: str) -> None:
        """What flapping does now and then is done by itself here."""
        self.zenoh.confuse(client)

    def silence(self, client: str) -> None:
        """Let nothing through."""
        self.zenoh.freeze(client, None)

    def heal(self, client: str) -> None:
        """Let it connect again."""
        self.zenoh.heal(client)


def play_simulated(seed: int, body: Callable[[Network], None]) -> None:
    """Play a behaviour with the simulated Zenoh, in the order that a seed decides. Raises what the body raises."""
    raised: list[BaseException] = []

    def test() -> int:
        try:
            body(network)
        except Ended:
            raise
        except BaseException as error:
            raised.append(error)
        return 0

    with tempfile.TemporaryDirectory(prefix="zenoh") as folder:
        simulated = SimulatedWorld(seed, lambda _: 1, Path(folder))
        network = SimulatedNetwork(Path(folder), simulated)
        with simulated.entered():
            process = simulated.machine.begin("test", test)
            simulated.scheduler.run(_VIRTUAL_LIMIT, lambda: not process.task.alive)
    if raised:
        raised[0].add_note(f"with the seed {seed}")
        raise raised[0]
    unexpected = [error for _, error in simulated.scheduler.errors if not isinstance(error, DeliberateError)]
    if unexpected:
        raise unexpected[0]
