"""Processes that are started by hand, each where and when its user likes: the same run, and one line for what does not fit.

Addresses of loopback stand for hosts.
"""

from __future__ import annotations

import json
import re
import signal
import socket
from pathlib import Path
from typing import final

import pytest

from evedrop.results.reading import Results
from evedrop.system.ports import free_port
from tests.builders import digests_of
from tests.commands import ForkedCommand
from tests.conftest import LIMIT, Done, Evedrop, Live, wait_until
from tests.examples import mostly_long

ROLES = ("router", "relay", "sensor", "legitimate", "recorder")
SOON = 5.0
"""Seconds within which a mistake is to be said; how long the machine took for all else is not counted."""


def written(evedrop: Evedrop, *options: str, out: str = "briefs", slots: int = 200) -> dict[str, str]:
    """Process name → its brief, as `evedrop brief` wrote it."""
    done = evedrop("brief", "eavesdroppers", "--slots", str(slots), "--out", out, *options)
    assert done.status == 0, done.err
    return {Path(path).stem: path for path in done.out.split()}


def begun(evedrop: Evedrop, name: str, path: str, *options: str, folder: Path | None = None) -> Live:
    """A process of a brief, started by hand, perhaps in another folder."""
    words = (name if name in ROLES else "eavesdropper", path, *options)
    process = ForkedCommand(words, evedrop.environment, folder or evedrop.folder)
    return Live(process, evedrop.temporary, evedrop.folder)


def closing(done: Done) -> list[str]:
    """What a recorder printed after its events, but for the folder's name and how fast it was."""
    events = [line for line in done.out.splitlines() if line.startswith("{")]
    lines = done.out.splitlines()
    assert lines[: len(events)] == events
    assert json.loads(events[-1])["event"] == "ended"
    return comparable(lines[len(events) :])


def comparable(lines: list[str]) -> list[str]:
    """The lines of a closing report but for the folder's name and how fast the run was."""
    assert lines[-2].startswith("results: ")
    assert lines[-1].startswith("report: ")
    return [re.sub(r"[\d,]+ slots/s", "", line).rstrip() for line in lines[:-2]]


TLS = ("--listen", "tls/0.0.0.0:{port}", "--connect", "tls/127.0.0.2:{port}")
NAMED = ("--listen", "tls/localhost:{port}")
CLEAR = ("--listen", "tcp/0.0.0.0:{port}", "--connect", "tcp/127.0.0.3:{port}", "--insecure")
TWO = ("--set", "network.routers=2", "--listen", "tls/127.0.0.2:{port}", "--relay", "tls/127.0.0.3:{port}")
TWO_CLEAR = ("--set", "network.routers=2", "--listen", "tcp/127.0.0.2:{port}", "--relay", "tcp/127.0.0.3:{port}")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "backwards"),
    [
        pytest.param(TLS, False, marks=pytest.mark.long),
        pytest.param(TLS, True, marks=pytest.mark.long),
        pytest.param(NAMED, False, marks=pytest.mark.long),
        (CLEAR, True),
        (TWO, True),
        pytest.param(TWO_CLEAR, False, marks=pytest.mark.long),
    ],
    ids=["tls", "tls, router last", "tls by name", "unencrypted", "two routers", "two routers unencrypted"],
)
def test_started_by_hand_it_is_the_same_run(options: tuple[str, ...], backwards: bool, evedrop: Evedrop) -> None:
    """In whatever order, from two folders that stand for hosts, encrypted or not: the digests of the trials in memory."""
    port = str(free_port())
    briefs = written(evedrop, *(option.format(port=port) for option in options), "--results", "results")
    hosts = [evedrop.folder / "one", evedrop.folder / "two"]
    started = []
    for number, (name, path) in enumerate(
        sorted(briefs.items(), key=lambda at: ROLES.index(at[0]) if at[0] in ROLES else 9)
    ):
        host = hosts[name not in {"router", "sensor"}]
        host.mkdir(exist_ok=True)
        taken = (evedrop.folder / path).rename(host / f"{name}.json")  # as if carried there: no host has another's
        started.append((number, name, taken, host))
    running = []
    for _, name, taken, host in reversed(started) if backwards else started:
        running.append((name, begun(evedrop, name, str(taken), folder=host)))
        if name == "router" and backwards:
            assert running[0][1].process.poll() is None, "everybody waits for the router"
    ended = {name: live.end() for name, live in running}
    assert {name: done.status for name, done in ended.items()} == dict.fromkeys(briefs, 0), ended
    assert {name: done.err for name, done in ended.items()} == dict.fromkeys(briefs, "")
    assert evedrop("montecarlo", "eavesdroppers", "--slots", "200", "--trials", "1", "--out", "memory").status in {0, 1}
    assert digests_of(hosts[1] / "results") == digests_of(evedrop.folder / "memory")


@pytest.mark.long
@pytest.mark.parametrize(
    "below", [pytest.param(1.0, marks=pytest.mark.long, id="held"), pytest.param(0.0, id="failed")]
)
def test_by_hand_the_recorder_prints_and_ends_as_run_does(below: float, evedrop: Evedrop) -> None:
    """The table and the verdict of `evedrop run`, and its exit status, be it that an expectation failed."""
    expect = f"expect=[{{metric='legitimate.mean_squared_error', below={below}}}]"
    launched = evedrop("run", "eavesdroppers", "--slots", "200", "--view", "off", "--set", expect, "--out", "launched")
    assert launched.status == (0 if below else 1)
    briefs = written(evedrop, "--listen", f"tcp/127.0.0.1:{free_port()}", "--set", expect)
    running = {name: begun(evedrop, name, path) for name, path in briefs.items()}
    ended = {name: live.end() for name, live in running.items()}
    assert ended["recorder"].status == launched.status, ended["recorder"].err
    assert {done.status for name, done in ended.items() if name != "recorder"} == {0}
    actual, expected = closing(ended["recorder"]), comparable(launched.out.replace("launched", "results").splitlines())
    assert actual == expected
    assert any("✓ secret" in line for line in actual)


@pytest.mark.long
def test_a_reader_that_leaves_early_changes_no_exit_status(evedrop: Evedrop) -> None:
    """A recorder whose output is no longer read still exits with the status of the run."""
    expect = "expect=[{metric='smart.mean_squared_error', below=0}]"
    briefs = written(evedrop, "--listen", f"tcp/127.0.0.1:{free_port()}", "--set", expect)
    recorder_brief = briefs.pop("recorder")
    running = {name: begun(evedrop, name, path) for name, path in briefs.items()}
    with evedrop.start(["-m", "evedrop"], ("recorder", recorder_brief), {}) as recorder:
        assert recorder.stdout is not None
        recorder.stdout.readline()
        recorder.stdout.close()
        assert recorder.wait(LIMIT) == 1
    assert {live.end().status for live in running.values()} == {0}


@pytest.mark.long
def test_a_run_on_loopback_takes_certificates_too(evedrop: Evedrop) -> None:
    """`evedrop run --listen tls/127.0.0.1:PORT`: the same digests, and a control file with which it can be steered."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    live = evedrop.live("eavesdroppers", "--slots", "100000", "--pace", "0.002", "--listen", endpoint)
    live.running()
    control = json.loads((live.folder / "control.json").read_text())
    assert control["router"] == endpoint
    assert "PRIVATE KEY" in control["identity"]["key"]
    assert evedrop("status", "run").status == 0
    (evedrop.folder / "copy").mkdir()
    (evedrop.folder / "copy" / "control.json").write_text(json.dumps({**control, "user": "recorder"}))
    told(evedrop("status", "copy"), 2, "copy/control.json: identity.certificate is that of operator, not of recorder")
    assert evedrop("pause", "run").out.startswith("held before slot")
    live.process.terminate()
    assert live.end().status == 130
    live.nothing_left()
    assert (
        evedrop("run", "eavesdroppers", "--slots", "200", "--view", "off", "--listen", endpoint, "--out", "a").status
        == 0
    )
    assert evedrop("run", "eavesdroppers", "--slots", "200", "--view", "off", "--out", "b").status == 0
    assert digests_of(evedrop.folder / "a") == digests_of(evedrop.folder / "b")


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["acknowledged", "restart"])
def test_with_two_routers_a_run_is_the_same(scenario: str, evedrop: Evedrop) -> None:
    """Acknowledgements that cross, processes that are started again: the digests of one router, and of memory."""
    small = ("--trials", "1", "--record-trials", "1", "--pace", "0", "--set", "expect=[]")
    two = evedrop("run", scenario, *small, "--view", "off", "--set", "network.routers=2", "--out", "two")
    assert two.status == 0, two.err
    assert evedrop("run", scenario, *small, "--view", "off", "--out", "one").status == 0
    assert evedrop("montecarlo", scenario, *small, "--out", "memory").status == 0
    assert (
        digests_of(evedrop.folder / "two")
        == digests_of(evedrop.folder / "one")
        == digests_of(evedrop.folder / "memory")
    )


@pytest.mark.long
def test_a_run_of_two_routers_is_steered_and_ended_as_any(evedrop: Evedrop) -> None:
    """The operator gets at the recorder through the relay; a signal ends everybody, the relay too."""
    live = evedrop.live("eavesdroppers", "--slots", "100000", "--pace", "0.002", "--set", "network.routers=2")
    live.running()
    assert evedrop("link", "run", "smart", "quality=0.2").out.startswith("from slot")
    status = json.loads(evedrop("status", "run", "--json").out)
    assert status["processes"]["relay"] is True
    live.process.terminate()
    assert live.end().status == 130
    live.nothing_left()


def told(done: Done, status: int, *words: str) -> None:
    """One line, with this status, that has these words in it, the file among them."""
    assert (done.status, done.out) == (status, "")
    (line,) = done.err.splitlines()
    assert line.startswith("evedrop: ")
    for word in words:
        assert word in line


@pytest.mark.parametrize("protocol", mostly_long(["tcp", "tls"], ["tls"]))
def test_a_brief_of_another_run_is_told_apart(protocol: str, evedrop: Evedrop) -> None:
    """Of a process, and of the recorder, which leaves no results: long before anybody's patience ends."""
    endpoint = f"{protocol}/127.0.0.1:{free_port()}"
    ours = written(evedrop, "--listen", endpoint)
    others = written(evedrop, "--listen", endpoint, out="others")
    with Router(evedrop, ours["router"], endpoint) as router:
        runs = {name: json.loads((evedrop.folder / path).read_text())["run"] for name, path in others.items()}
        for name in ("sensor", "smart", "recorder"):
            words = [f"others/{name}.json: ", endpoint, runs[name], "start the router of this run"]
            told(begun(evedrop, name, others[name]).end(), 2, *words)
        assert router.process.poll() is None
    assert list((evedrop.folder / "results").iterdir()) == []


@final
class Router:
    """A router that listens; ended when the block ends."""

    def __init__(self, evedrop: Evedrop, brief: str, endpoint: str) -> None:
        host, _, port = endpoint.partition("/")[2].rpartition(":")
        self._live = begun(evedrop, "router", brief)
        self._address = (host, int(port))

    def _listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(self._address) == 0

    def __enter__(self) -> Live:
        wait_until(self._listens, "a router that listens")
        return self._live

    def __exit__(self, *_: object) -> None:
        self._live.process.kill()
        self._live.process.communicate()


def test_a_port_that_somebody_has_is_said(evedrop: Evedrop) -> None:
    """A second router at the same place: its brief, the place, what to do."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    briefs = written(evedrop, "--listen", endpoint)
    with Router(evedrop, briefs["router"], endpoint):
        done = begun(evedrop, "router", briefs["router"]).end()
    told(done, 2, "briefs/router.json: ", endpoint, "Address already in use", "end the program that does")


def test_an_address_of_another_host_is_said(evedrop: Evedrop) -> None:
    """A router started on a host that does not have the address its brief names."""
    briefs = written(evedrop, "--listen", f"tls/192.0.2.1:{free_port()}")
    told(
        begun(evedrop, "router", briefs["router"]).end(),
        2,
        "router.json: ",
        "of the host that the router is started on",
    )


@pytest.mark.long
@pytest.mark.parametrize("name", mostly_long(["sensor", "recorder", "router"], ["sensor", "router"]))
def test_a_host_that_is_not_known_is_said(name: str, evedrop: Evedrop) -> None:
    """A name that does not resolve, for processes that connect and for the one that listens."""
    briefs = written(evedrop, "--listen", "tls/nowhere.invalid:7447")
    told(begun(evedrop, name, briefs[name]).end(), 2, f"briefs/{name}.json: ", "nowhere.invalid", "/etc/hosts")


def test_a_certificate_of_another_process_is_said(evedrop: Evedrop) -> None:
    """Briefs whose identities were exchanged: both say so before they try anything."""
    briefs = written(evedrop, "--listen", "tls/127.0.0.1:7447")
    contents = {name: json.loads((evedrop.folder / briefs[name]).read_text()) for name in ("smart", "naive")}
    for name, other in (("smart", "naive"), ("naive", "smart")):
        (evedrop.folder / briefs[name]).write_text(
            json.dumps({**contents[name], "identity": contents[other]["identity"]})
        )
        told(begun(evedrop, name, briefs[name]).end(), 2, f"briefs/{name}.json: ", f"is that of {other}, not of {name}")


@pytest.mark.long
def test_who_does_not_come_is_named(evedrop: Evedrop) -> None:
    """After the time that `--wait` gives, the recorder names who is missing; exit 3, and a folder that says so."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    briefs = written(evedrop, "--listen", endpoint, "--wait", "15")
    lives = {name: begun(evedrop, name, path) for name, path in briefs.items() if name != "smart"}
    done = lives["recorder"].end()
    assert done.status == 3
    assert done.err == "evedrop: smart did not appear within 15 s; start it, or look at its log\n"
    assert closing(done)[0] == "smart did not appear within 15 s; start it, or look at its log; the results so far:"
    assert Results.read(evedrop.folder / "results").summary["ended"].startswith("smart did not appear")
    ends = {name: live.end() for name, live in lives.items() if name != "recorder"}
    assert {name: end.status for name, end in ends.items()} == dict.fromkeys(ends, 3)
    for name, end in ends.items():
        assert end.err.startswith(f"evedrop: {name}: the recorder gave the run up: smart did not appear")


@pytest.mark.long
def test_who_ends_the_recorder_ends_the_run(evedrop: Evedrop) -> None:
    """Ctrl-C on its host: what was measured is on disk, and everybody else ends, saying why."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    briefs = written(evedrop, "--listen", endpoint, "--set", "pace=0.002", slots=100_000)
    lives = {name: begun(evedrop, name, path) for name, path in briefs.items()}
    wait_until((evedrop.folder / "results" / "control.json").exists, "a run under way")
    lives["recorder"].process.send_signal(signal.SIGINT)
    ended = {name: live.end() for name, live in lives.items()}
    assert ended["recorder"].status == 130
    assert closing(ended["recorder"])[0] == "interrupted; the results so far:"
    assert Results.read(evedrop.folder / "results").summary["ended"] == "interrupted"
    others = {name: done for name, done in ended.items() if name != "recorder"}
    assert {name: (done.status, done.err) for name, done in others.items()} == {
        name: (3, f"evedrop: {name}: the recorder gave the run up: interrupted\n") for name in others
    }


@pytest.mark.thorough
def test_without_a_router_everybody_says_so(evedrop: Evedrop) -> None:
    """If the router is never started, each process names where it should be, exit 3; the recorder leaves no results."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    briefs = written(evedrop, "--listen", endpoint, "--wait", "1")
    for name in ("sensor", "recorder"):
        told(
            begun(evedrop, name, briefs[name]).end(),
            3,
            f"no router answered at {endpoint} within 1 s",
            "start it there",
        )
    assert list((evedrop.folder / "results").iterdir()) == []


def test_a_folder_that_another_run_takes_meanwhile_is_left_to_it(evedrop: Evedrop) -> None:
    """A recorder that waits for its router looks at its folder again before it writes there."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    briefs = written(evedrop, "--listen", endpoint, "--wait", "30")
    recorder = begun(evedrop, "recorder", briefs["recorder"])
    taken = evedrop.folder / "results" / "scenario.toml"
    wait_until(taken.parent.is_dir, "a recorder that waits")
    taken.write_text("of another run")
    with Router(evedrop, briefs["router"], endpoint):
        told(recorder.end(), 2, "results is not empty")
    assert {path.name: path.read_text() for path in taken.parent.iterdir()} == {taken.name: "of another run"}


@pytest.mark.thorough
def test_the_results_are_where_the_recorder_is_told(evedrop: Evedrop) -> None:
    """Relative to where it is started; --out has the last word; a folder with something in it is refused."""
    briefs = written(evedrop, "--listen", "tcp/127.0.0.1:7447", "--wait", "1", "--results", "there/results")
    (evedrop.folder / "host").mkdir()
    assert begun(evedrop, "recorder", "../briefs/recorder.json", folder=evedrop.folder / "host").end().status == 3
    assert (evedrop.folder / "host" / "there" / "results").is_dir()
    (evedrop.folder / "full").mkdir()
    (evedrop.folder / "full" / "old").touch()
    told(begun(evedrop, "recorder", briefs["recorder"], "--out", "full").end(), 2, "full is not empty")


def test_what_is_refused_leaves_no_folder(evedrop: Evedrop) -> None:
    """Two routers, and a place for one: nothing is written, and the next try finds nothing in its way."""
    done = evedrop(
        "brief", "eavesdroppers", "--out", "b", "--listen", "tcp/127.0.0.1:7447", "--set", "network.routers=2"
    )
    assert done.status == 2
    assert "add --relay" in done.err
    assert not (evedrop.folder / "b").exists()


def test_events_that_need_a_launcher_are_refused(evedrop: Evedrop) -> None:
    """Nobody could kill or pause a process that is started by hand."""
    told(evedrop("brief", "restart", "--out", "b", "--listen", "tcp/127.0.0.1:7447"), 2, "kill", "use `evedrop run`")
    assert not (evedrop.folder / "b").exists()


@pytest.mark.long
def test_when_one_is_killed_nobody_is_left(evedrop: Evedrop) -> None:
    """There is no launcher: the recorder tells the others why the run has failed, and they end, whatever they wait for."""
    briefs = written(
        evedrop, "--listen", f"tcp/127.0.0.1:{free_port()}", "--set", "longest_outage=1.0", slots=10_000_000
    )
    running = {name: begun(evedrop, name, path) for name, path in briefs.items()}
    wait_until((evedrop.folder / "results" / "control.json").is_file, "a run under way")
    running["smart"].process.kill()
    ended = {name: live.end() for name, live in running.items()}
    assert {name: done.status for name, done in ended.items()} == {**dict.fromkeys(briefs, 3), "smart": -9}
    why = "smart cut off from the network for 1 s; look at the logs"
    for name, done in ended.items():
        assert name in {"smart", "recorder"} or f"evedrop: {name}: the recorder gave the run up: {why}" in done.err, (
            name
        )


@pytest.mark.long
def test_when_the_recorder_is_killed_nobody_is_left(evedrop: Evedrop) -> None:
    """Nobody tells the others to end: each notices that its reports are not read, or that its router has left for that."""
    where = [option.format(port=free_port()) for option in TWO]
    briefs = written(evedrop, *where, "--wait", "60", "--set", "longest_outage=1.0", slots=10_000_000)
    running = {name: begun(evedrop, name, path) for name, path in briefs.items()}
    metrics = evedrop.folder / "results" / "unfinished" / "summary.json"
    wait_until(metrics.is_file, "a run under way")
    before = metrics.stat().st_mtime_ns
    wait_until(lambda: metrics.stat().st_mtime_ns > before, "a run that all have seen")
    running.pop("recorder").process.kill()
    ended = {name: live.end() for name, live in running.items()}
    assert {name: done.status for name, done in ended.items()} == dict.fromkeys(running, 3)
    assert "router: the recorder has been gone for 1 s" in ended["router"].err


def test_a_router_whose_recorder_does_not_come_ends(evedrop: Evedrop) -> None:
    """After the time that `--wait` gives."""
    briefs = written(evedrop, "--listen", f"tcp/127.0.0.1:{free_port()}", "--wait", "1")
    told(
        begun(evedrop, "router", briefs["router"]).end(), 3, "router: the recorder did not appear within 1 s; start it"
    )
