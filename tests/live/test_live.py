"""A real run under attack: every process as `evedrop run` starts it, packets flowing, and an eavesdropper that tries all.

The attacker has the credentials of the real eavesdropper `eve`, which takes part in the run all the while.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import zenoh

from evedrop import montecarlo
from evedrop.live.protocol.brief import AnyBrief, read_brief
from evedrop.live.protocol.codec import enclosed
from evedrop.live.protocol.commands import EndRun
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.notices import Progress
from evedrop.model.streams import stream_key
from evedrop.names import RECORDER
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import Scenario
from tests.conftest import LIMIT, wait_until
from tests.live.network.bench import Ear, connect
from tests.messages import packet
from tests.processes import descendants, parent_of, words_of

SCENARIO = """
title = "Under attack"
slots = 60000
seed = 918273645546372819
trials = 3
pace = 0.002
[process]
A = [[1.0, 0.05], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-4]]
initial_covariance = [[1.0, 0.0], [0.0, 0.01]]
[encoding]
scheme = "innovation"
state_probability = 0.4
[legitimate]
link = { quality = 0.8 }
[eavesdroppers.eve]
strategy = "smart"
link = { quality = 0.7 }
[eavesdroppers.mallory]
strategy = "suspicious"
use_state = 0.8
use_innovation = 0.2
link = { quality = 0.6 }
[eavesdroppers.nadia]
strategy = "naive"
link = { quality = 0.9 }
"""
KEEPING_BRIEFS = """
import sys
from pathlib import Path
from evedrop.live.protocol.brief import Brief, read_brief
from evedrop.cli.main import main
write = Brief.write
Brief.write = lambda brief, folder: write(brief, Path(sys.argv[1])) and write(brief, folder)
raise SystemExit(main(sys.argv[2:]))
"""  # a run as it is, and a copy of every brief it writes
PROCESSES = ("sensor", "legitimate", "eve", "mallory", "nadia")
EVERYBODY = (*PROCESSES, "router", "recorder")
SERVERS = ("server of recorders", "server of others")
TOKEN = "only-the-launcher-has-this"  # noqa: S105 - an example
ENOUGH = 20  # messages on each of the keys that are meant to be heard


@dataclass
class Evidence:
    """The outcome of the attack."""

    scenario: Scenario
    folder: Path
    briefs: dict[str, AnyBrief]
    left_behind: dict[str, dict[str, bytes]]
    """Process → where → all that a process was given or wrote."""
    overheard: dict[str, set[str]]
    """How it was asked → the keys of what came."""
    heard: dict[str, int]
    """Key → messages that the one who may read it got meanwhile."""
    refused: list[str]
    """Credentials with which no session could be opened."""
    status: int
    output: str


def asked_for(keys: RunKeys) -> list[str]:
    """Every key of the run, and the wildcards over them."""
    named = [getattr(keys, kind)(name) for kind in ("telemetry", "progress", "control", "alive") for name in EVERYBODY]
    downlinks = [keys.downlink(name) for name in ("legitimate", "mallory", "nadia")]
    under = f"evedrop/{keys.run}"
    wide = ["**", "evedrop/**", "evedrop/*/uplink", "*/*/*/*", f"{under}/**", f"{under}/*", f"{under}/*/*"]
    return [keys.uplink, keys.journal, *named, *downlinks, *wide, f"{under}/alive/*", f"{under}/downlink/*"]


def listen(eve: AnyBrief, keys: RunKeys, stack: ExitStack) -> dict[str, Ear]:
    """Ask in every way to be told: by subscription, by watching tokens."""
    attacker = stack.enter_context(connect(eve))
    ears = {}
    for key in asked_for(keys):
        ears[f"subscribed to {key}"] = ear = Ear()
        attacker.declare_subscriber(key, ear)
        ears[f"watched {key}"] = watching = Ear()
        attacker.liveliness().declare_subscriber(key, watching, history=True)
    return ears


def ask(eve: AnyBrief, keys: RunKeys) -> dict[str, set[str]]:
    """Ask in every way to be answered: by query, and for tokens."""
    with connect(eve) as attacker:
        own = f"@/{attacker.zid()}/"
        answers = {}
        for key in (*asked_for(keys), "@/**"):
            heard = {str(reply.ok.key_expr) for reply in attacker.get(key, timeout=5.0) if reply.ok is not None}
            answers[f"asked for {key}"] = {key for key in heard if not key.startswith(own)}
            if not key.startswith("@"):
                replies = attacker.liveliness().get(key, timeout=5.0)
                answers[f"asked who is alive at {key}"] = {str(reply.ok.key_expr) for reply in replies if reply.ok}
    return answers


def disturb(eve: AnyBrief, keys: RunKeys) -> None:
    """Put what would wreck the run on every key that is not its own, delete everything, feign tokens, offer answers."""
    own = {keys.telemetry("eve"), keys.progress("eve"), keys.alive("eve")}
    with connect(eve) as attacker:
        for key in asked_for(keys):
            if key in own:
                continue
            attacker.declare_queryable(key, lambda query: query.reply(query.key_expr, b"\xc1"))
            for payload in (EndRun().pack(), Progress(10**9).pack(), packet(0, np.zeros((2, 3))), b"\xc1"):
                attacker.put(key, enclosed(key, payload), congestion_control=zenoh.CongestionControl.BLOCK)
            attacker.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
            if key.rpartition("/")[2] in PROCESSES and "/alive/" in key:
                attacker.liveliness().declare_token(key).undeclare()


def processes_of(pid: int) -> dict[str, int]:
    """Process name → pid, of the processes that a launcher has started, and of its fork servers."""
    processes = {}
    for child in descendants(pid):
        *options, last = words_of(child)
        if "evedrop" in options and last.endswith(".json"):
            processes[Path(last).stem] = child
        elif "evedrop.fork_server" in options:
            processes[SERVERS["evedrop.fork_server" not in words_of(parent_of(child))]] = (
                child  # that of recorders is a fork
            )
    return processes


def attack(folder: Path) -> Evidence:
    """The whole story: start, attack, stop by SIGTERM."""
    path, out, kept = folder / "attack.toml", folder / "out", folder / "kept"
    kept.mkdir()
    path.write_text(SCENARIO)
    scenario = load(path)
    options = ["run", str(path), "--view", "off", "--out", str(out)]
    command = [sys.executable, "-c", KEEPING_BRIEFS, str(kept), *options]
    environment = {**os.environ, "ACCESS_TOKEN": TOKEN}
    with ExitStack() as stack:
        run = stack.enter_context(
            subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
        )
        stack.callback(run.kill)
        result = wait_until(
            lambda: (here := processes_of(run.pid)).keys() == {*EVERYBODY, *SERVERS} and here, "all processes"
        )
        servers = [result.pop(server) for server in SERVERS]
        briefs = {name: read_brief(kept / f"{name}.json") for name in EVERYBODY}
        keys, eve = RunKeys(briefs["eve"].run), briefs["eve"]
        meant = {keys.downlink(name): name for name in PROCESSES[1:]}
        meant |= {keys.telemetry(name): "recorder" for name in PROCESSES} | {keys.journal: "recorder"}
        meant |= {keys.progress(name): "sensor" for name in (*PROCESSES[1:], "recorder")}
        counts = {key: Ear() for key in meant}
        for key, name in meant.items():
            stack.enter_context(connect(briefs[name])).declare_subscriber(key, counts[key])
        wait_until(lambda: all(not ear.messages.empty() for ear in counts.values()), "the run to flow")
        refused = []
        for name, user, password in (("none", "", ""), ("wrong password", "eve", "guess"), ("no user", "trudy", "x")):
            auth = {"auth": {"usrpwd": {"user": user, "password": password}}} if user else {}
            once = {"endpoints": [eve.router], "timeout_ms": 0, "exit_on_failure": True}
            try:
                connect(replace(eve, user=user, password=password), connect=once, transport=auth).close()
            except zenoh.ZError:
                refused.append(name)
        ears = listen(eve, keys, stack)
        overheard = ask(eve, keys)
        disturb(eve, keys)
        sizes = {key: ear.messages.qsize() for key, ear in counts.items()}
        wait_until(
            lambda: all(ear.messages.qsize() >= sizes[key] + ENOUGH for key, ear in counts.items()), "the run to go on"
        )
        heard = {key: ear.messages.qsize() for key, ear in counts.items()}
        overheard |= {how: {key for key, _ in ear.all()} for how, ear in ears.items()}
        traces = {
            name: {
                "brief": (kept / f"{name}.json").read_bytes(),
                # The system shows the environment of a fork's server as the fork's.
                "environment": Path(f"/proc/{servers[name != RECORDER]}/environ").read_bytes(),
                "arguments": Path(f"/proc/{pid}/cmdline").read_bytes(),
            }
            for name, pid in result.items()
        }
        run.send_signal(signal.SIGTERM)
        output, _ = run.communicate(timeout=LIMIT)
    for name, trace in traces.items():
        trace["log"] = (out / "logs" / f"{name}.log").read_bytes()
    return Evidence(scenario, out, briefs, traces, overheard, heard, refused, run.returncode, output)


@pytest.fixture(scope="module")
def evidence(tmp_path_factory: pytest.TempPathFactory) -> Evidence:
    """One attack, on which all tests of this file look."""
    return attack(tmp_path_factory.mktemp("live"))


def test_those_who_may_hear_did(evidence: Evidence) -> None:
    """Deliveries, telemetry, journal and progress flowed to those they are for, all through the attack."""
    assert min(evidence.heard.values()) > ENOUGH
    assert len(evidence.heard) == 4 + 5 + 1 + 5


def test_the_attacker_heard_nothing(evidence: Evidence) -> None:
    """No subscription, query, watch or question for tokens brought anything but what is its own."""
    run = evidence.briefs["eve"].run
    own = {f"evedrop/{run}/control/eve", f"evedrop/{run}/alive/eve"}
    assert {how: keys - own for how, keys in evidence.overheard.items() if keys - own} == {}
    assert len(evidence.overheard) > 100


def test_without_credentials_there_is_no_session(evidence: Evidence) -> None:
    """Nobody connects without a user and its password."""
    assert evidence.refused == ["none", "wrong password", "no user"]


def test_the_attack_left_no_trace_in_the_run(evidence: Evidence, tmp_path: Path) -> None:
    """The run went on until its user ended it, and everything recorded is what the trials give in memory, to the bit."""
    assert evidence.status == 130, evidence.output
    results = Results.read(evidence.folder)
    assert results.summary["ended"] == "interrupted"
    assert {link["unexplained"] for link in results.summary["links"].values()} == {0}
    rows = results.trials.to_pylist()
    slots = 1 + max(row["slot"] for row in rows)
    assert slots > 5 * ENOUGH
    memory = montecarlo(evidence.scenario, trials=3, slots=slots, out=tmp_path / "memory").trials.to_pylist()
    expected = {(row["peer"], row["slot"]): row["x_hat"] for row in memory}
    estimates = {(row["peer"], row["slot"]): row["x_hat"] for row in rows}
    assert len(expected) == 4 * slots
    assert estimates == expected


def secrets_of(scenario: Scenario) -> dict[str, bytes]:
    """Every piece of key material of a scenario, by name."""
    keys = StreamKeys.from_scenario(scenario)
    secrets = {"seed's root": keys.seed_root, "secret's root": keys.secret_root, "process": keys.process}
    secrets |= keys.links({name: scenario.schedule(name) for name in scenario.receivers})
    secrets |= {f"coin/{name}": stream_key(keys.seed_root, f"coin/{name}") for name in scenario.eavesdroppers}
    return secrets | keys.secret(("schedule", "noise"))


MAY_KNOW = {
    "sensor": {"process", "schedule", "noise"},
    "legitimate": {"schedule", "noise"},
    "router": {f"{what}/{name}" for what in ("link", "delay", "fate") for name in PROCESSES[1:]},
    "eve": {"schedule"},
    "mallory": {"schedule", "coin/mallory"},
    "nadia": set(),
}


@pytest.mark.parametrize("name", MAY_KNOW)
def test_a_process_is_given_its_own_keys_and_no_others(name: str, evidence: Evidence) -> None:
    """Brief, environment, arguments and log of a process hold, in hex or raw, exactly the keys it must have."""
    traces = evidence.left_behind[name]
    for secret, key in secrets_of(evidence.scenario).items():
        places = {
            where
            for where, trace in traces.items()
            if key.hex().encode() in trace.lower() or key in trace or key.rstrip(b"\0") in trace
        }
        assert places == ({"brief"} if secret in MAY_KNOW[name] else set()), secret


@pytest.mark.parametrize("name", MAY_KNOW)
def test_a_process_is_told_neither_seed_nor_others_passwords(name: str, evidence: Evidence) -> None:
    """The seed, in decimal or hex, is nowhere near a peer; nor is any password but its own, the router apart."""
    seed = evidence.scenario.seed
    everything = b"\n".join(evidence.left_behind[name].values())
    assert str(seed).encode() not in everything
    assert f"{seed:x}".encode() not in everything
    others = {other: brief.password for other, brief in evidence.briefs.items() if other not in {name, "router"}}
    readable = {other for other, password in others.items() if password.encode() in everything}
    assert readable == (set(others) if name == "router" else set())


@pytest.mark.parametrize("name", EVERYBODY)
def test_a_process_is_given_nothing_else_of_the_launchers_environment(name: str, evidence: Evidence) -> None:
    """A token in the launcher's environment reaches no process; the paths of programs and libraries reach all."""
    traces = evidence.left_behind[name]
    assert TOKEN.encode() not in b"\n".join(traces.values())
    given = {entry.partition(b"=")[0] for entry in traces["environment"].split(b"\0") if entry}
    assert b"PATH" in given
    named = {b"PATH", b"HOME", b"LANG", b"LANGUAGE", b"TZ", b"TMPDIR", b"VIRTUAL_ENV", b"LD_LIBRARY_PATH"}
    named.add(b"EVEDROP_KERNELS")  # which the tests may have been started with
    kinds = (b"LC_", b"PYTHON", b"ZENOH", b"RUST_", b"OMP_", b"OPENBLAS_")
    assert {entry for entry in given - named if not entry.startswith(kinds)} == set()


@pytest.mark.parametrize("name", ["eve", "mallory", "nadia"])
def test_an_eavesdropper_is_told_no_truth(name: str, evidence: Evidence) -> None:
    """No state, schedule or scenario is in its brief; what it wrote is empty; other receivers are not even named."""
    brief = evidence.briefs[name]
    part = json.loads(brief.text)["part"]
    assert set(part) == {"strategy", "parameters", "window", "outages"}
    assert part["outages"] == []
    assert evidence.left_behind[name]["log"] == b""
    for other in {"legitimate", "eve", "mallory", "nadia"} - {name}:
        # The path of the router's socket names Evedrop, whose name contains one of theirs.
        assert other.encode() not in evidence.left_behind[name]["brief"].replace(b"evedrop", b"")
