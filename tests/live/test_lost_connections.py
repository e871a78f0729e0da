"""Lost connections and killed routers: the run recovers to the bits of an undisturbed one, and says who was cut off."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from evedrop.live.launch.starter import StartedProcess
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from evedrop.system.ports import free_port
from tests.by_hand import as_if_undisturbed, by_hand
from tests.conftest import Evedrop, Live, wait_until
from tests.disturbed import ACKNOWLEDGED, LOOP, SCHEDULED, disturbed
from tests.proxy import Cable, cable
from tests.steps import stepping

CHANGING = """
[[event]]
at = 300
link = "smart"
set = { loss = { model = "bernoulli", quality = 0.6 } }
[[event]]
from = 500
to = 900
kill = "smart"
state = "last"
"""


def scenario_in(folder: Path, slots: int = 700, longest_outage: float = 30.0, **given: Any) -> tuple[Path, Scenario]:
    """A scenario with losses in bursts, delays and second copies, and its file."""
    path = folder / "disturbed.toml"
    path.write_text(disturbed(slots, entries=f"longest_outage = {longest_outage}", **given))
    return path, load(path)


long = pytest.mark.long

RUNS: dict[str, dict[str, Any]] = {
    "as fast as it goes": {"slots": 1500, "trials": 10, "pace": 0.0},
    "silent and acknowledged": {
        "slots": 1500, "trials": 20, "pace": 0.003, "encoding": SCHEDULED, "strategy": "naive",
        "more": ACKNOWLEDGED,
    },
    "coded and acknowledged": {
        "slots": 1500, "trials": 20, "pace": 0.003, "encoding": 'scheme = "acknowledged"', "strategy": "reference",
        "more": ACKNOWLEDGED,
    },
    "in a loop that is told its inputs": {
        "slots": 900, "more": LOOP.format(""), "more_of_legitimate": "knows_input = true",
    },
    "in a loop over the truth": {"slots": 3000, "more": LOOP.format('period = 7\nacts_on = "truth"')},
    "paced, with events": {"slots": 2000, "more": CHANGING},
}  # fmt: skip


def has_told(live: Live, event: str, times: int) -> bool:
    """Whether a run has told of an event exactly so often."""
    return live.told(event) == times


def has_ended(process: StartedProcess, status: int) -> bool:
    """Whether a process has ended with this status."""
    return process.poll() == status


@long
@pytest.mark.parametrize("case", RUNS)
def test_a_killed_router_costs_nothing_but_time(case: str, evedrop: Evedrop, tmp_path: Path) -> None:
    """Killed twice in a run and started again by the launcher: digests and links are those in memory, and it is listed."""
    path, scenario = scenario_in(tmp_path, **RUNS[case])
    live = evedrop.live(str(path), "--json", "--paused")
    for times in (1, 2):
        with stepping(evedrop, live.folder, 100):
            live.running(more_than=0)
        with stepping(evedrop, live.folder, 300):
            live.kill("router")
            # Losses that overlap are one outage: this one must be over before the next.
            wait_until(partial(has_told, live, "reconnected", times), "a run that continues")
    assert evedrop("resume", str(live.folder)).status == 0
    done = live.end()
    assert done.status == 0, done.err
    live.nothing_left()
    as_if_undisturbed(done.summary, scenario, tmp_path / "memory")
    outages = done.summary["outages"]
    assert [outage["process"] for outage in outages] == ["router"] * 2
    assert all(outage["seconds"] > 0.0 and 0 < outage["slot"] <= outage["until"] for outage in outages)


@pytest.mark.thorough
@pytest.mark.parametrize("name", [pytest.param("router", marks=long), "relay"])
def test_either_of_two_linked_routers_may_be_killed(name: str, evedrop: Evedrop, tmp_path: Path) -> None:
    """With a closed loop over both of them: digests and links are those in memory, and the one that was killed is named."""
    more = LOOP.format("period = 2") + "[network]\nrouters = 2"
    path, scenario = scenario_in(tmp_path, more=more, more_of_legitimate="knows_input = true")
    live = evedrop.live(str(path), "--json", "--paused")
    with stepping(evedrop, live.folder, 600):
        live.running(more_than=100)
        before = live.child(name)
        live.kill(name)
        wait_until(lambda: live.children().get(name) not in {None, before}, f"another {name}")
    assert evedrop("resume", str(live.folder)).status == 0
    done = live.end()
    assert done.status == 0, done.err
    live.nothing_left()
    as_if_undisturbed(done.summary, scenario, tmp_path / "memory")
    assert [outage["process"] for outage in done.summary["outages"]] == [name]


@long
def test_a_relay_gives_up_an_attempt_that_is_not_answered(evedrop: Evedrop, tmp_path: Path) -> None:
    """Whose connection was lost while it was being opened. Zenoh's own limit, ten seconds, is longer than this outage may be."""
    scenario = scenario_in(tmp_path, longest_outage=8.0, more="[network]\nrouters = 2")[1]
    ports = [free_port() for _ in range(2)]
    near, far = (f"tcp/127.0.0.1:{port}" for port in ports)
    with cable(ports[0]) as between, by_hand(scenario, tmp_path, near, relay=far, paused=True) as run:
        run.write(relay=between.endpoint)
        run.start()
        with stepping(evedrop, run.results, 600):
            run.running(more_than=100)
            between.swallow()
            wait_until(lambda: between.swallowed, "an attempt that is not answered")
        assert evedrop("resume", str(run.results)).status == 0
        assert set(run.statuses().values()) == {0}, run.log("recorder").read_text()
        as_if_undisturbed(run.summary, scenario, tmp_path / "memory")
        assert [outage["process"] for outage in run.summary["outages"]] == ["router"]


@pytest.mark.long
def test_what_an_operator_changed_survives_the_router(evedrop: Evedrop, tmp_path: Path) -> None:
    """A router that is started while the run is paused knows the changes that were made; the folder gives the same again."""
    path, _ = scenario_in(tmp_path, slots=1000, more=CHANGING)
    live = evedrop.live(str(path), "--json", "--paused")
    folder = str(live.folder)
    live.held()
    assert evedrop("link", folder, "legitimate", "quality=0.4").status == 0
    assert evedrop("step", folder, "100").status == 0
    assert evedrop("link", folder, "smart", "cut").status == 0
    before = live.child("router")
    live.kill("router")
    wait_until(lambda: live.children().get("router") not in {None, before}, "another router")
    wait_until(lambda: evedrop("step", folder, "100").status == 0, "a router that lets an operator in")
    assert evedrop("link", folder, "smart", "heal").status == 0
    assert evedrop("resume", folder).status == 0
    done = live.end()
    assert done.status == 0, done.err
    assert [outage["process"] for outage in done.summary["outages"]] == ["router"]
    as_if_undisturbed(done.summary, load(live.folder / "scenario.toml"), tmp_path / "memory")


@long
def test_a_router_that_dies_too_often_is_named(evedrop: Evedrop, tmp_path: Path) -> None:
    """The fourth time it is not started again: the run ends with status 3, with what was measured, and nothing is left."""
    path, _ = scenario_in(tmp_path, slots=1_000_000)
    live = evedrop.live(str(path))
    pids: set[int | None] = {None}
    for _ in range(4):
        live.running(more_than=live.done())
        wait_until(lambda: live.children().get("router") not in pids, "another router")
        pids.add(live.child("router"))
        live.kill("router")
    done = live.end()
    assert done.status == 3
    assert "router was ended by signal 9" in done.err
    live.nothing_left()
    assert live.results.slots.num_rows > 0


@long
def test_a_router_that_never_comes_back_ends_the_run(tmp_path: Path) -> None:
    """Of processes that were started by hand each gives up by itself, says why, and ends with status 3."""
    _, scenario = scenario_in(tmp_path, slots=1_000_000, longest_outage=2.0)
    with by_hand(scenario, tmp_path, f"tcp/127.0.0.1:{free_port()}") as run:
        run.write()
        run.start()
        run.running()
        run.kill("router")
        statuses = run.statuses()
        assert statuses.pop("router") == -9
        assert set(statuses.values()) == {3}
        assert "router cut off from the network for 2 s" in run.log("recorder").read_text()
        assert "smart has had no connection with the router at tcp/127.0.0.1" in run.log("smart").read_text()
        assert run.summary["slots"] > 0
        outage = run.summary["outages"][-1]
        assert (outage["process"], outage["until"]) == ("router", None)


@long
def test_a_router_that_is_started_again_by_hand(evedrop: Evedrop, tmp_path: Path) -> None:
    """The same command again, a second later: the run goes on, and all end with status 0."""
    _, scenario = scenario_in(tmp_path)
    with by_hand(scenario, tmp_path, f"tcp/127.0.0.1:{free_port()}", paused=True) as run:
        run.write()
        run.start()
        with stepping(evedrop, run.results, 600):
            run.running()
            run.kill("router")
            time.sleep(1.0)  # how long it is away is what is tested
            run.start("router")
        assert evedrop("resume", str(run.results)).status == 0
        assert set(run.statuses().values()) == {0}
        as_if_undisturbed(run.summary, scenario, tmp_path / "memory")
        (outage,) = run.summary["outages"]
        assert outage["process"] == "router"
        assert outage["seconds"] > 0.0  # from when it was noticed, which on a busy machine is later


def is_taken_up(
    name: str, cut_off: Callable[[Cable], None], scenario: Scenario, evedrop: Evedrop, folder: Path
) -> None:
    """Assert that a run goes on as in memory once a process that was cut off is back, and that it lists the outage."""
    port = free_port()
    with ExitStack() as stack:
        wire: Cable = stack.enter_context(cable(port))
        run = stack.enter_context(by_hand(scenario, folder, f"tcp/127.0.0.1:{port}", paused=True))
        run.write(**{name: wire.endpoint})
        run.start()
        with stepping(evedrop, run.results, 600):
            run.running(more_than=100)
            assert wire.connections
            cut_off(wire)
            wire.heal()
        assert evedrop("resume", str(run.results)).status == 0
        assert set(run.statuses().values()) == {0}
        as_if_undisturbed(run.summary, scenario, folder / "memory")
        assert [outage["process"] for outage in run.summary["outages"]] == [name]


@long
@pytest.mark.parametrize("how", ["closed", "silent"])
@pytest.mark.parametrize("name", ["sensor", "legitimate", "recorder"])
def test_a_cut_connection_costs_nothing_but_time(name: str, how: str, evedrop: Evedrop, tmp_path: Path) -> None:
    """Closed for a second, or without a word for longer than its lease: the outage is listed, and all else is as ever."""
    _, scenario = scenario_in(tmp_path, encoding=SCHEDULED, strategy="naive", more=ACKNOWLEDGED)

    def cut_off(wire: Cable) -> None:
        if how == "closed":
            wire.cut()
            time.sleep(1.0)  # how long it is cut off is what is tested
        else:
            wire.silence()
            time.sleep(7.0)  # the same

    is_taken_up(name, cut_off, scenario, evedrop, tmp_path)


@long
@pytest.mark.parametrize("name", ["controller", "legitimate"])
def test_a_loop_is_taken_up_where_it_was_cut(name: str, evedrop: Evedrop, tmp_path: Path) -> None:
    """Estimates and inputs that were lost on the way are sent again: no process waits forever, and no input changes."""
    _, scenario = scenario_in(tmp_path, more=LOOP.format("period = 5"), more_of_legitimate="knows_input = true")

    def cut_off(wire: Cable) -> None:
        wire.cut()
        time.sleep(1.0)  # how long it is cut off is what is tested

    is_taken_up(name, cut_off, scenario, evedrop, tmp_path)


@pytest.mark.thorough
def test_a_process_that_stays_cut_off_ends_the_run(tmp_path: Path) -> None:
    """Longer than the scenario lets it: the recorder names it, and it ends by itself."""
    _, scenario = scenario_in(tmp_path, slots=1_000_000, longest_outage=2.0)
    port = free_port()
    with ExitStack() as stack:
        wire: Cable = stack.enter_context(cable(port))
        run = stack.enter_context(by_hand(scenario, tmp_path, f"tcp/127.0.0.1:{port}"))
        run.write(smart=wire.endpoint)
        run.start()
        run.running()
        wire.cut()
        for process in ("smart", "recorder"):
            wait_until(partial(has_ended, run.processes[process], 3), f"the end of {process}")
        assert "smart cut off from the network for 2 s" in run.log("recorder").read_text()
