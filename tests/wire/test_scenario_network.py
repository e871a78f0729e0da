"""A wire as the network of a run: the packets have the fates that a program's messages have on the wire."""

from __future__ import annotations

import subprocess
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from evedrop.cli.api import montecarlo, run
from evedrop.cli.main import main
from evedrop.errors import ScenarioError, UsageError
from evedrop.model.links.loss_model import Fate
from evedrop.results.diff import difference
from evedrop.results.reading import Results
from evedrop.scenario.loading import checked, load
from evedrop.scenario.tables import Scenario
from evedrop.simulate.montecarlo import Plan
from evedrop.wire.file import wire_of
from evedrop.wire.plan import WirePlan
from evedrop.wire.scenario_network import over_wire
from evedrop.wire.timeline import moments
from tests.builders import MARGINAL, listener, places_of, process_table, scenario_of
from tests.conftest import wait_until
from tests.golden.pages import Golden
from tests.wire.wire_at_work import at_work
from tests.wire.wire_links import key_fates

PLAYER = Path(__file__).parents[2] / "docs" / "examples" / "csv_player.py"
KEY = "robot/pose"
SIDES = {"sensor": "robot", "legitimate": "base", "eve": "listener"}
BURSTS = {"model": "gilbert-elliott", "p": 0.1, "r": 0.4}
SECONDS = 0.05


def over_the_air(slots: int = 300, **more: Any) -> Scenario:
    """A scenario with one eavesdropper, whose links are replaced."""
    tables = {
        "slots": slots,
        "slot_seconds": SECONDS,
        "encoding": {"scheme": "innovation", "state_probability": 0.4},
        "legitimate": {"window": 3, "link": {"quality": 1.0}},
        "eavesdroppers": {"eve": listener("smart", 1.0)},
        **more,
    }
    return scenario_of(MARGINAL, **{name: value for name, value in tables.items() if value is not None})


def wire(**more: Any) -> WirePlan:
    """A wire from a robot to its base and, as a tap, to a listener."""
    radio = {"name": "radio", "from": "robot", "to": "base", "keys": "robot/**", "loss": BURSTS}
    tap = {"name": "tap", "from": "robot", "to": "listener", "tap": True, "loss": {**BURSTS, "r": 0.3}}
    sides: dict[str, Any] = {"robot": {}, "base": {}, "listener": {}}
    return wire_of(
        {"seed": 11, "side": sides, "link": [radio | more.pop("radio", {}), tap | more.pop("tap", {})], **more}
    )


def replaced(plan: WirePlan, scenario: Scenario | None = None) -> Scenario:
    """The scenario over the wire."""
    before = over_the_air() if scenario is None else scenario
    return checked(before.model_dump(mode="json", exclude_none=True), "wire", over_wire(before, plan, KEY, SIDES))


def delivered(results: Results, receiver: str) -> list[bool]:
    """Whether the packet of each slot was delivered in its own slot, in the only trial."""
    return [row["action"] != "dropped" for row in results.trials.to_pylist() if row["peer"] == receiver]


def fates_on(plan: WirePlan, name: str, slots: int) -> list[bool]:
    """The same of messages that a program publishes, one in each slot, by the wire's own fates."""
    link = next(link for link in plan.links if link.name == name)
    fates, fates_of, before = key_fates(link, KEY, "put", plan.seed), [], link.settings
    for k in range(slots):
        now = [moment for moment in moments(plan) if moment.time <= k * SECONDS + 1e-9][-1]
        if now.settings[name] != before:
            before = now.settings[name]
            fates.change(before)
        code, delay, _ = fates.next()
        fates_of.append(code == Fate.DELIVERED and name not in now.cut and delay < SECONDS)
    return fates_of


EVENTS = [
    {"from": "2 s", "to": "3.26 s", "partition": ["robot", "base"]},
    {"from": "5 s", "to": "9 s", "link": "tap", "set": {"loss": {**BURSTS, "p": 0.3}}},
    {"from": "7 s", "to": "8 s", "link": "tap", "set": {"delay": {"model": "constant", "value": "150 ms"}}},
    {"at": "12 s", "cut": "tap"},
    {"at": "40 s", "note": "too late for this run"},
]


@pytest.mark.thorough
def test_packets_have_the_fates_of_messages(tmp_path: Path) -> None:
    """With delays, faults, correlation, cuts and changes; live as in memory, and the results folder repeats the run."""
    delay = {"model": "normal", "mean": "40 ms", "standard_deviation": "30 ms"}
    plan = wire(
        radio={"delay": delay, "duplicate": 0.05, "corrupt": 0.02, "reorder": 0.1},
        tap={"correlation": {"with": "radio", "strength": 0.5}},
        event=EVENTS,
    )
    scenario = replaced(plan)
    memory = montecarlo(scenario, trials=1, out=tmp_path / "memory", plan=Plan(workers=1))
    for receiver, name in (("legitimate", "radio"), ("eve", "tap")):
        result = delivered(memory, receiver)
        assert result == fates_on(plan, name, 300)
        assert 0 < sum(result) < 300
    live = run(scenario, out=tmp_path / "live")
    again = montecarlo(tmp_path / "live", trials=1, out=tmp_path / "again", plan=Plan(workers=1))
    assert difference(live, memory).same
    assert difference(live, again).same


def hear(numbers: set[int], sample: zenoh.Sample) -> None:
    """Keep the number that a message is."""
    numbers.add(int(sample.payload.to_bytes()))


def matched(publisher: zenoh.Publisher) -> bool:
    """Whether a publisher has a subscriber."""
    status: Any = publisher.matching_status
    return bool(status.matching)


def test_a_program_on_the_wire_loses_what_the_run_loses(tmp_path: Path) -> None:
    """A real wire between a real publisher and two subscribers."""
    plan, heard = wire(), {"base": set[int](), "listener": set[int]()}
    with ExitStack() as stack:
        work = stack.enter_context(at_work(plan, tmp_path / "wire"))
        robot, base, listener = (stack.enter_context(work.program(side)) for side in ("robot", "base", "listener"))
        for side, session in (("base", base), ("listener", listener)):
            session.declare_subscriber(KEY, partial(hear, heard[side]))
        publisher = robot.declare_publisher(KEY)
        wait_until(lambda: matched(publisher), "the wire subscribes")
        for k in range(200):
            publisher.put(str(k).encode())
        fates = work.when_heard(400)
        expected = sum(fate == 0 for fate in fates)
        wait_until(lambda: sum(map(len, heard.values())) == expected, "all messages arrive")
    result = montecarlo(replaced(plan, over_the_air(200)), trials=1, out=tmp_path / "run", plan=Plan(workers=1))
    for receiver, side in (("legitimate", "base"), ("eve", "listener")):
        assert {k for k, fate in enumerate(delivered(result, receiver)) if fate} == heard[side]


@pytest.mark.thorough
def test_states_may_cross_a_wire(tmp_path: Path) -> None:
    """A player on one side, the sensor on another: the run takes the states that the wire lets through."""
    plan, path = wire(), tmp_path / "pose.csv"
    path.write_text("\n".join(["x,v", *(f"{k},0.5" for k in range(20_000))]))
    with at_work(plan, tmp_path / "wire") as work:
        (robot,), (base,) = work.relay.endpoints["robot"], work.relay.endpoints["base"]
        command = [sys.executable, str(PLAYER), str(path), KEY, "--connect", robot, "--every", "0.002"]
        process = {
            **process_table(MARGINAL),
            "states": ["x", "v"],
            "source": "zenoh",
            "zenoh": {"key": KEY, "connect": base},
        }
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as player:
            try:
                assert run(over_the_air(40, process=process), out=tmp_path / "run").summary["ended"] == "complete"
            finally:
                player.kill()
    lines = (tmp_path / "run" / "states.csv").read_text().splitlines()[1:]
    taken = [int(float(line.partition(",")[0])) for line in lines]
    through = [k for k, fate in enumerate(fates_on(plan, "radio", taken[-1] + 1)) if fate]
    assert taken == through[-40:]
    assert taken[-1] - taken[0] > 39


def test_a_key_that_is_never_lost(tmp_path: Path) -> None:
    """Neither losses nor events of the wire concern it."""
    scenario = replaced(wire(lossless=["robot/pose"], event=EVENTS))
    assert scenario.wire is None
    assert not scenario.event
    assert {scenario.link(name).model.quality for name in scenario.receivers} == {1.0}
    assert montecarlo(scenario, trials=1, out=tmp_path / "run").summary["links"]["eve"]["delivered"] == 300


def refusal(plan: WirePlan, scenario: Scenario, key: str | None = KEY, **sides: str) -> str:
    """Why the scenario cannot have this wire."""
    with pytest.raises(UsageError) as caught:
        over_wire(scenario, plan, key, {**SIDES, **sides})
    return str(caught.value)


def test_what_a_run_cannot_have_is_refused(golden: Golden) -> None:
    """Each with the receiver and the link."""
    ordered = wire(radio={"ordered": True, "delay": {"model": "constant", "value": 0.1}})
    apart = [{"at": "1 s", "partition": ["robot", "base"]}]
    several = {"eve": {"strategy": "colluding", "reads_as": "smart", "links": [{"quality": 0.5}, {"quality": 0.5}]}}
    for text, name in (
        (refusal(wire(), over_the_air(), None), "key"),
        (refusal(wire(), over_the_air(), "robot/*"), "robot/*"),
        (refusal(wire(), over_the_air(), "/robot"), "/robot"),
        (refusal(wire(), over_the_air(), eve="x"), "eve"),
        (refusal(wire(), over_the_air(), mallory="base"), "mallory"),
        (refusal(wire(), over_the_air(), eve="robot"), "eve"),
        (refusal(wire(radio={"rate": "1 kB/s"}), over_the_air()), "radio"),
        (refusal(ordered, over_the_air()), "radio"),
        (refusal(wire(event=apart), over_the_air(slot_seconds=None)), "slot_seconds"),
        (refusal(tied_to_a_third(), over_the_air()), "tap"),
        (refusal(wire(), over_the_air(eavesdroppers=several)), "eve"),
    ):
        assert name in text
        golden("run", text)


def tied_to_a_third() -> WirePlan:
    """A wire whose tap is tied to a link that takes no packets of the run."""
    half = {"loss": {"model": "bernoulli", "quality": 0.5}}
    radio = {"name": "radio", "from": "robot", "to": "base", "keys": "robot/**", **half}
    tap = {"name": "tap", "from": "robot", "to": "listener", "correlation": {"with": "third", "strength": 0.5}, **half}
    third = {"name": "third", "from": "robot", "to": "base", **half}
    return wire_of({"side": {"robot": {}, "base": {}, "listener": {}}, "link": [radio, tap, third]})


def test_the_key_of_the_program_is_the_default() -> None:
    """A run whose states come from a program knows the key already."""
    program = {"source": "zenoh", "zenoh": {"key": "robot/scan", "connect": "tcp/127.0.0.1:1"}, "states": ["x", "v"]}
    scenario = over_the_air(process={**process_table(MARGINAL), **program})
    assert over_wire(scenario, wire(), None, SIDES)["wire"]["key"] == "robot/scan"


def test_wires_in_scenarios_are_checked(golden: Golden) -> None:
    """Names that are not receivers, and receivers with several links."""
    several = {"eve": {"strategy": "colluding", "reads_as": "smart", "links": [{"quality": 0.5}, {"quality": 0.5}]}}
    links = {"mallory": "tap", "eve": "tap"}
    with pytest.raises(ScenarioError) as caught:
        over_the_air(eavesdroppers=several, wire={"seed": 1, "key": KEY, "links": links})
    assert places_of(caught.value.mistakes) == ["wire.links.mallory", "wire.links.eve"]
    golden("check", caught.value.mistakes)


def test_the_command_takes_a_wire(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The results folder has the links of the wire, and does not need its file."""
    file, out = tmp_path / "radio.toml", tmp_path / "out"
    file.write_text(
        '[side.sensor]\n[side.base]\n[[link]]\nname = "radio"\nfrom = "sensor"\nto = "base"\nquality = 0.25\n'
    )
    sides = [
        word for name in ("legitimate", "smart", "naive", "suspicious") for word in ("--wire-side", f"{name}=base")
    ]
    rest = ["--wire-key", KEY, *sides, "--slots", "40", "--trials", "2", "--out", str(out), "--set", "expect=[]"]
    assert main(["montecarlo", "eavesdroppers", "--wire", str(file), *rest]) == 0
    scenario = load(out)
    assert scenario.wire is not None
    assert scenario.wire.links == dict.fromkeys(scenario.receivers, "radio")
    assert set(scenario.quality.values()) == {0.25}
    assert main(["montecarlo", "eavesdroppers", "--wire-key", KEY]) == 2
    assert main(["montecarlo", "eavesdroppers", "--wire", str(file), "--wire-side", "eve"]) == 2
    assert main(["montecarlo", "eavesdroppers", "--wire", str(tmp_path / "none.toml")]) == 2
    errors = capsys.readouterr().err
    assert "give --wire FILE as well" in errors
    assert "--wire-side eve: expected PROCESS=SIDE" in errors
