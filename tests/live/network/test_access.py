"""What an eavesdropper can get from the network, and do to it, with its own credentials, wrong ones and none.

Each test shows first that the right credentials do get or do what is denied to the attacker. Nothing waits for silence:
what one session puts is dealt with in order, so a message that is let through proves that the earlier ones were not.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from evedrop.live.network.access import Grant, access_control, grants
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import telemetry
from evedrop.live.protocol.codec import enclosed
from evedrop.live.protocol.commands import EndRun, Hold
from evedrop.live.protocol.notices import Progress
from evedrop.live.protocol.packets import read_delivery
from tests.conftest import LIMIT, wait_until
from tests.live.network.bench import Bench, Ear, bench_of, connect, small_network
from tests.messages import packet

EVE = "eve"
PROCESSES = ("sensor", "legitimate", "eve", "mallory", "nadia")
SHAPE = (2, 5)
BATCH = 8
LINKS = 10  # attempts at a link between routers


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """One router for all tests of this file: none of them may leave a trace in it."""
    with bench_of(small_network(slots=100_000), tmp_path_factory.mktemp("access")) as bench:
        yield bench


def flow(stage: Bench) -> None:
    """Let one slot pass: each process gets exactly the messages that it should, and no others came first."""
    k, stage.due = stage.due, stage.due + 1
    stage.put("sensor", stage.keys.uplink, packet(k, stage.packet(k)))
    for name, ear in stage.downlinks.items():
        key, payload = ear.hear()
        arrivals = read_delivery(wire.Reader(key, payload), k, SHAPE)
        assert np.array_equal(arrivals.z[0], np.where(arrivals.gamma[0], stage.packet(k), 0.0)), name
        assert not arrivals.late, name
    if stage.due % BATCH == 0:
        windows, extent = dict.fromkeys(stage.scenario.receivers, 0), telemetry.Extent(100_000, BATCH, *SHAPE)
        journal = telemetry.read_journal(wire.Reader(*stage.journal.hear()), stage.due - BATCH, windows, extent)
        assert journal.count == BATCH


def all_keys(stage: Bench) -> dict[str, str]:
    """Every key of the run, by its kind."""
    keys = stage.keys
    all_keys = {"uplink": keys.uplink, "journal": keys.journal}
    for name in (*PROCESSES, "router", "recorder"):
        for kind in ("telemetry", "progress", "control", "alive"):
            all_keys[f"{kind}/{name}"] = getattr(keys, kind)(name)
    all_keys |= {f"downlink/{name}": keys.downlink(name) for name in PROCESSES[1:]}
    return all_keys


def wildcards(stage: Bench) -> list[str]:
    """What an attacker would ask for without knowing the keys."""
    under = f"evedrop/{stage.keys.run}"
    kinds = ("downlink", "telemetry", "progress", "control", "alive")
    asked = ["**", "evedrop/**", "evedrop/*/uplink", "*/*/*", "*/*/*/*", f"{under}/**", f"{under}/*", f"{under}/*/*"]
    return [*asked, *(f"{under}/{kind}/*" for kind in kinds), f"{under}/downlink/**", "@/**", "@/*/**"]


def talk(stage: Bench) -> None:
    """Everybody says on every key they may write what the others hear: all that an eavesdropper could overhear."""
    for _ in range(BATCH):
        flow(stage)
    for name in PROCESSES:
        stage.settle(name)
        if name != "sensor":
            stage.put(name, stage.keys.progress(name), Progress(1).pack())
            assert stage.progress[name].hear()[1] == Progress(1).pack()
        stage.put("recorder", stage.keys.control(name), Hold().pack())
        assert stage.controls[name].hear()[1] == Hold().pack()
    stage.put("recorder", stage.keys.progress("recorder"), Progress(1).pack())
    assert stage.progress["recorder"].hear()[1] == Progress(1).pack()


MODES: dict[str, dict[str, Any]] = {
    "client": {},
    "peer": {"mode": "peer"},
    "router": {"mode": "router", "listen": {"endpoints": []}},
}


@pytest.mark.parametrize("mode", MODES)
def test_eavesdropper_hears_only_its_own_downlink(mode: str, stage: Bench) -> None:
    """Asking by subscription for all keys and every wildcard, in any mode of Zenoh, it gets its deliveries and control."""
    with attacking(stage, mode) as attacker:
        ears = {key: Ear() for key in (*all_keys(stage).values(), *wildcards(stage))}
        for key, ear in ears.items():
            attacker.declare_subscriber(key, ear)
        own, ears_of_own = stage.keys.downlink(EVE), ears[stage.keys.downlink(EVE)]

        def delivered() -> bool:
            flow(stage)
            return not ears_of_own.messages.empty()

        wait_until(delivered, "a delivery to the attacker")
        first = stage.due
        talk(stage)
        slots = range(first, stage.due)
        while wire.Reader(*ears_of_own.hear()).integer("k") < slots[-1]:
            pass
        # A message let through to one subscription of a session reaches its wildcards too: only that may.
        allowed = {own, stage.keys.control(EVE)}
        for key, ear in ears.items():
            assert {heard for heard, _ in ear.all()} <= allowed, key


@contextmanager
def attacking(stage: Bench, mode: str) -> Iterator[zenoh.Session]:
    """A session of the attacker's whose own telemetry arrives: between routers not every link comes up at once."""
    key = stage.keys.telemetry(EVE)

    def knock(attacker: zenoh.Session) -> bool:
        attacker.put(key, enclosed(key, b"knock"))
        return not stage.telemetry[EVE].messages.empty()

    with ExitStack() as stack:
        for _ in range(LINKS):
            attacker = stack.enter_context(connect(stage.briefs[EVE], **MODES[mode]))
            with suppress(pytest.fail.Exception):
                wait_until(lambda: knock(attacker), "the attacker's own telemetry", 2.0)  # noqa: B023 - used at once
                break
            stack.close()
        assert_heard(stage, attacker)
        yield attacker


def assert_heard(stage: Bench, attacker: zenoh.Session) -> None:
    """A permitted message of the attacker arrives, so the router has handled all its earlier messages and queries."""
    block = zenoh.CongestionControl.BLOCK
    attacker.put(stage.keys.progress(EVE), enclosed(stage.keys.progress(EVE), b"mine"), congestion_control=block)
    attacker.put(stage.keys.telemetry(EVE), enclosed(stage.keys.telemetry(EVE), b"mine"), congestion_control=block)
    assert stage.progress[EVE].hear() == (stage.keys.progress(EVE), b"mine")
    while (message := stage.telemetry[EVE].hear()) != (stage.keys.telemetry(EVE), b"mine"):
        assert message == (stage.keys.telemetry(EVE), b"knock")


@pytest.mark.parametrize("key", ["**", "evedrop/**"])
def test_wildcard_alone_hears_nothing(key: str, stage: Bench) -> None:
    """A session that asks for a wildcard and nothing else gets not even its own deliveries."""
    with connect(stage.briefs[EVE]) as attacker, connect(stage.briefs[EVE]) as control:
        ear, own = Ear(), Ear()
        attacker.declare_subscriber(key, ear)
        control.declare_subscriber(stage.keys.downlink(EVE), own)
        for session in (attacker, control):
            assert_heard(stage, session)
        # A session hears itself: what it has just put.
        assert {ear.hear()[0] for _ in range(2)} == {stage.keys.progress(EVE), stage.keys.telemetry(EVE)}
        talk(stage)
        own.hear()
        assert ear.all() == []


def test_eavesdropper_gets_nothing_by_asking(stage: Bench) -> None:
    """Queries for all keys and every wildcard, the router's own administration too, come back empty."""
    # The recorder answers on each of its keys: the question must not reach it.
    asked: list[str] = []
    for name in PROCESSES:
        stage.sessions["recorder"].declare_queryable(
            stage.keys.telemetry(name), lambda q: asked.append(str(q.key_expr))
        )
    with connect(stage.briefs[EVE]) as attacker:
        for key in [*all_keys(stage).values(), *wildcards(stage)]:
            replies = [str(reply.ok.key_expr) for reply in attacker.get(key, timeout=5.0) if reply.ok is not None]
            # A session may look at itself: its own part of Zenoh's administration tells of no other process.
            assert [reply for reply in replies if not reply.startswith(f"@/{attacker.zid()}/")] == [], key
    talk(stage)
    assert asked == []


def key_of(reply: zenoh.Reply) -> str:
    """The key of a reply that is not an error."""
    assert reply.ok is not None, reply
    return str(reply.ok.key_expr)


def test_eavesdropper_sees_nobody_alive(stage: Bench) -> None:
    """It learns of no token but its own, neither by watching, with history, nor by asking; the recorder sees them."""
    with connect(stage.briefs[EVE]) as attacker, ExitStack() as stack:
        ear, control = Ear(), Ear()
        alive = {name: stage.keys.alive(name) for name in PROCESSES}
        for name in PROCESSES:
            stack.enter_context(stage.sessions[name].liveliness().declare_token(alive[name]))
        for key in (*alive.values(), stage.keys.alive("router"), *wildcards(stage)):
            if key.startswith("@"):
                continue
            attacker.liveliness().declare_subscriber(key, ear, history=True)
            keys = [key_of(reply) for reply in attacker.liveliness().get(key, timeout=5.0)]
            assert keys == ([key] if key == alive[EVE] else [])
        seen = {stage.tokens.hear()[0] for _ in PROCESSES}
        assert seen == set(alive.values())
        attacker.declare_subscriber(stage.keys.downlink(EVE), control)
        assert_heard(stage, attacker)
        flow(stage)
        control.hear()
        assert ear.all() == []
    gone = {stage.tokens.hear()[0] for _ in PROCESSES}
    assert gone == {f"deleted {key}" for key in alive.values()}


@pytest.mark.parametrize("mode", MODES)
def test_eavesdropper_can_write_only_its_telemetry_and_progress(mode: str, stage: Bench) -> None:
    """Its messages on any other key, and all its deletions, reach no process; the run goes on undisturbed."""
    keys = all_keys(stage)
    own = {keys[f"telemetry/{EVE}"], keys[f"progress/{EVE}"]}
    payloads = (packet(stage.due, np.zeros(SHAPE)), EndRun().pack(), Progress(10**9).pack(), b"\xc1")
    block = zenoh.CongestionControl.BLOCK
    with attacking(stage, mode) as attacker:
        for key in [*keys.values(), f"evedrop/{stage.keys.run}/**", "**"]:
            for payload in payloads if key not in own else ():
                attacker.put(key, enclosed(key, payload), congestion_control=block)
            attacker.delete(key, congestion_control=block)
        assert_heard(stage, attacker)
    talk(stage)
    for ears in (stage.downlinks, stage.controls, stage.progress, stage.telemetry):
        assert {name: ear.all() for name, ear in ears.items()} == {name: [] for name in ears}
    assert stage.journal.all() == []
    assert stage.router.poll() is None


def test_eavesdropper_cannot_feign_another_process(stage: Bench) -> None:
    """No process sees a token that it declares for another process, or the withdrawal of such a token."""
    with connect(stage.briefs[EVE]) as attacker:
        tokens = [
            attacker.liveliness().declare_token(stage.keys.alive(name)) for name in (*PROCESSES, "router", "recorder")
        ]
        assert stage.tokens.hear() == (stage.keys.alive(EVE), b"")
        for token in tokens:
            token.undeclare()
        assert stage.tokens.hear() == (f"deleted {stage.keys.alive(EVE)}", b"")
        flow(stage)
        assert stage.tokens.all() == []


def test_eavesdropper_answers_no_question(stage: Bench) -> None:
    """No process, not even the recorder, asks a queryable that it offers for every key."""
    asked: list[str] = []
    with connect(stage.briefs[EVE]) as attacker:
        for key in [*all_keys(stage).values(), "**", "evedrop/**"]:
            attacker.declare_queryable(key, lambda query: asked.append(str(query.key_expr)))
        assert_heard(stage, attacker)
        for name in ("recorder", "sensor", "legitimate"):
            for key in all_keys(stage).values():
                assert list(stage.sessions[name].get(key, timeout=5.0)) == []
    assert asked == []


WRONG = {
    "none": ("", ""),
    "wrong password": ("eve", "guessed"),
    "empty password": ("eve", ""),
    "unknown user": ("trudy", "guessed"),
    "another's name": ("recorder", "guessed"),
    "the operator": ("operator", ""),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("who", WRONG)
def test_no_session_without_credentials(who: str, mode: str, stage: Bench) -> None:
    """Without a user and its password no session is opened, in any mode: nothing can be asked."""
    user, password = WRONG[who]
    brief = replace(stage.briefs[EVE], user=user, password=password)
    auth = {"auth": {"usrpwd": {"user": user, "password": password}}} if user else {}
    connect_once = {"endpoints": [brief.router], "timeout_ms": 0, "exit_on_failure": True}
    with pytest.raises(zenoh.ZError, match=r"Unable to connect|close message"):
        connect(brief, connect=connect_once, transport=auth, **MODES[mode]).close()
    connect(stage.briefs[EVE], connect=connect_once, **MODES[mode]).close()
    flow(stage)


LOOP: dict[str, dict[str, Any]] = {
    "plant": {"inputs": ["u"], "input_matrix": [[0.0], [1.0]]},
    "controller": {"strategy": "lqr", "state_weights": [1.0, 0.0], "input_weights": [1.0]},
}


@pytest.mark.parametrize("acts_on", ["estimate", "truth"])
def test_eavesdropper_has_no_part_in_the_loop(acts_on: str, tmp_path: Path) -> None:
    """It can read neither estimate nor state nor input, nor write any: what the others tell each other stays theirs."""
    tables = {**LOOP, "controller": {**LOOP["controller"], "acts_on": acts_on}}
    link = {"link": {"quality": 0.8}, "knows_input": acts_on == "estimate"}
    with bench_of(small_network(**tables, legitimate=link), tmp_path) as bench, connect(bench.briefs[EVE]) as attacker:
        bench.sessions["controller"] = stack = connect(bench.briefs["controller"])
        keys, loop = bench.keys, (bench.keys.estimate, bench.keys.state, bench.keys.input)
        ears = {key: Ear() for key in (*loop, *wildcards(bench))}
        for key, ear in ears.items():
            attacker.declare_subscriber(key, ear)
        assert_heard(bench, attacker)
        told = [("legitimate", keys.estimate)] if acts_on == "estimate" else [("sensor", keys.state)]
        heard = {name: bench.listen("controller", key) for name, key in told}
        inputs = {name: bench.listen(name, keys.input) for name in ("sensor", "legitimate")}
        for name, key in told:
            bench.put(name, key, b"known")
            assert heard[name].hear() == (key, b"known")
        bench.put("controller", keys.input, b"decided")
        for name in ("sensor", "legitimate") if link["knows_input"] else ("sensor",):
            assert inputs[name].hear() == (keys.input, b"decided")
        for key in (*loop, f"evedrop/{keys.run}/*", "**"):
            attacker.put(key, enclosed(key, b"false"), congestion_control=zenoh.CongestionControl.BLOCK)
        assert_heard(bench, attacker)
        bench.put("controller", keys.input, b"again")
        assert inputs["sensor"].hear() == (keys.input, b"again")
        for name in inputs:
            bench.settle(name)
        assert not any(ear.all() for ear in heard.values())
        payloads = {payload for ear in ears.values() for _, payload in ear.all()}
        assert payloads <= {b"mine", b"false"}, "a session hears what it puts itself, and this one nothing else"
        assert {heard for heard, _ in inputs["legitimate"].all()} <= ({keys.input} if link["knows_input"] else set())
        stack.close()


def test_the_table_grants_nothing_twice_and_no_wildcard() -> None:
    """Every key has one writer, no rule covers more than exact keys, and no eavesdropper may read what is not its own."""
    table = grants("r", ("legitimate", "eve"))
    written = [key for grant in table for key in (*grant.writes, grant.token) if key is not None]
    assert len(written) == len(set(written))
    for rule in access_control(table)["rules"]:
        assert rule["permission"] == "allow"
        assert not [key for key in rule["key_exprs"] if "*" in key or "$" in key]
    eve = next(grant for grant in table if grant.process == "eve")
    own = Grant(
        "eve",
        writes=("evedrop/r/telemetry/eve", "evedrop/r/progress/eve"),
        reads=("evedrop/r/downlink/eve", "evedrop/r/control/eve"),
        token="evedrop/r/alive/eve",  # noqa: S106 - a liveliness token is not secret
        checks=("evedrop/r/alive/eve",),
    )
    assert eve == own
    assert access_control(table)["default_permission"] == "deny"


@pytest.mark.long
def test_a_process_with_a_wrong_brief_says_so(stage: Bench, tmp_path: Path) -> None:
    """An eavesdropper's program whose password is not of this run ends with status 2 and one line."""
    path = replace(stage.briefs[EVE], password="of another run").write(tmp_path)  # noqa: S106 - that is the point
    ended = subprocess.run(
        [sys.executable, "-m", "evedrop", "eavesdropper", str(path)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert line.startswith(f"evedrop: {path}: {stage.briefs[EVE].router} does not let this brief in")
