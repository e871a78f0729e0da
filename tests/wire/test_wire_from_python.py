"""Wires from Python: in a process of their own, steered, read while they run, and judged when they end."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import zenoh

from evedrop import wire
from evedrop.errors import ScenarioError, UsageError
from evedrop.wire.journal import WireJournal
from evedrop.wire.on_disk import scorekeeper_on_disk
from evedrop.wire.recorded_link import journal_recording
from evedrop.wire.records import AGAIN, Kind, WireFate
from evedrop.wire.running import ExpectationFailed, RunningWire
from evedrop.wire.scorekeeper import WireScorekeeper
from tests.conftest import wait_until
from tests.pages import checked
from tests.wire.wire_plans import wire_plan

FAILING = """
import pytest, time, zenoh

WIRE = {"side": ["robot", "base"], "link": [{"name": "scan", "from": "robot", "to": "base", "quality": 0.0}],
        "expect": [{"metric": "scan.delivery", "above": 0.9}]}


def hear(radio):
    with zenoh.open(radio.config("robot")) as robot:
        while not radio.status().links["scan"].heard:
            robot.put("a", b"")
            time.sleep(0.01)


def test_that_fails(evedrop_wire):
    hear(evedrop_wire(**WIRE))
    raise RuntimeError("the test's own error")


def test_that_expects(evedrop_wire):
    hear(evedrop_wire(**WIRE))


def test_that_is_passed_by(evedrop_wire):
    radio = evedrop_wire(**{**WIRE, "expect": []})
    config = radio.config("robot")
    config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config):
        while not radio.status().bypasses:
            time.sleep(0.01)
"""

LINK = {"name": "scan", "from": "robot", "to": "base", "quality": 0.6}


def heard(running: RunningWire) -> int:
    """The messages of the link so far."""
    return running.status().links["scan"].heard


@pytest.mark.thorough
def test_a_wire_is_opened_steered_read_and_judged(tmp_path: Path) -> None:
    """All in one, because a process takes a second to begin: what programs get is what the journal and the summary say."""
    expectation = {"metric": "scan.delivery", "above": 0.9}
    got: list[int] = []
    running = wire(side=["robot", "base"], link=[LINK], expect=[expectation], seed=7, out=tmp_path / "wire")
    with pytest.raises(ExpectationFailed) as caught, running:
        used(running, got)
    expected, last = str(caught.value).splitlines()
    lost = running.typed_summary().links["scan"].lost_by["loss"]
    assert expected.startswith("expected scan.delivery above 0.9: FAILED, found 0.")
    assert expected.endswith(f"; scan lost {lost} by loss, 2 by cut, of 404 heard")
    assert last == f"results: {tmp_path / 'wire'}"
    assert not running.is_running
    summary = json.loads((tmp_path / "wire" / "summary.json").read_text())
    assert running.summary() == summary
    assert running.typed_summary().links["scan"].delivered == len(got)
    assert summary["links"]["scan"]["delivered"] == len(got)
    page = checked(tmp_path / "wire")
    assert {"1 of 1 expectations FAILED", "partition robot, base", *summary["made_with"].values()} <= set(page.texts)
    assert [event["event"].split()[0] for event in summary["events"]] == ["link", "partition", "heal", "cut", "heal"]
    assert {event["event"] for event in summary["events"]} <= set(page.texts)
    with pytest.raises(UsageError, match="no run is going on"):
        running.cut("scan")


def used(running: RunningWire, got: list[int]) -> None:
    """Send messages over a wire, steer it, and read it; got: for what arrives."""
    assert running.is_running
    with zenoh.open(running.config("robot")) as robot, zenoh.open(running.config("base")) as base:
        kept = (  # declarations end with their objects
            base.declare_subscriber("numbers", lambda sample: got.append(int(sample.payload.to_string()))),
            base.liveliness().declare_token("base-is-there"),
        )
        wait_until(lambda: list(robot.liveliness().get("base-is-there")) != [], "the token crosses")
        numbers = robot.declare_publisher("numbers")
        for n in range(400):
            numbers.put(str(n))
        wait_until(lambda: heard(running) == 400, "the wire hears all")
        running.link("scan", quality=np.float64(1.0))
        numbers.put("400")
        wait_until(lambda: got[-1:] == [400], "a link that loses nothing delivers")
        running.partition("robot", "base")
        numbers.put("401")
        wait_until(lambda: heard(running) == 402, "the wire hears more")
        running.heal("robot", "base")
        running.cut("scan")
        numbers.put("402")
        wait_until(lambda: heard(running) == 403, "the wire hears more")
        running.heal("scan")
        numbers.put("403")
        wait_until(lambda: got[-1:] == [403], "a healed link delivers")
        del kept
    rows = running.rows().to_pylist()
    assert got == [row["n"] for row in rows if row["fate"] == "delivered"]
    assert {row["n"]: row["reason"] for row in rows if row["n"] > 399} == {
        400: None, 401: "cut", 402: "cut", 403: None,
    }  # fmt: skip
    scan = running.summary()["links"]["scan"]
    assert (scan["heard"], scan["delivered"], scan["lost_by"]["cut"]) == (404, len(got), 2)
    running.expect("scan.delivery", above=0.5, below=0.7)
    running.expect(link="scan")
    late = (
        r"(?s)expected 0\.5 quantile of scan\.latency above 1: FAILED, found 0.*scan lost .* by loss.*results: .*wire"
    )
    with pytest.raises(ExpectationFailed, match=late):
        running.expect("scan.latency", quantile=0.5, above=1.0)
    with pytest.raises(ScenarioError, match="there is no link scam"):
        running.expect("scam.delivery", above=0.5)
    with pytest.raises(UsageError, match=r"are not partitioned.*nothing was changed"):
        running.heal("robot", "base")
    with pytest.raises(UsageError, match="expected a side that listens: robot or base"):
        running.endpoint("moon")
    series = journal_recording(running.folder, "scan").series
    assert series.outcomes.tolist() == [int(row["reason"] is None) for row in rows if row["reason"] != "cut"]


@pytest.mark.long
def test_the_fixture_ends_the_wires_of_a_test_that_fails(tmp_path: Path) -> None:
    """In order, and it fails a test whose wire does not meet an expectation, or could be passed by, also in JUnit's report."""
    (tmp_path / "test_radio.py").write_text(FAILING)
    options = [
        "-p",
        "evedrop.cli.pytest_plugin",
        "-p",
        "no:cacheprovider",
        "--junitxml",
        "report.xml",
        "--evedrop-out",
        "art",
    ]
    command = [sys.executable, "-m", "pytest", *options, "."]
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert re.search(r"1 failed, 2 passed, 3 errors", done.stdout), done.stdout
    assert "the test's own error" in done.stdout
    assert "expected scan.delivery above 0.9: FAILED, found 0" in done.stdout
    report = (tmp_path / "report.xml").read_text()
    assert "test_that_is_passed_by" in report
    assert "at side robot is in mode peer" in report
    assert re.search(r"; scan lost \d+ by loss, of \d+ heard", report)
    folders = [tmp_path / "art" / name / "wire-1" for name in ("test_that_fails", "test_that_expects")]
    assert f'name="evedrop_results" value="{folders[1]}"' in report
    assert f"results: {folders[1]}" in done.stdout
    for folder in folders:
        assert (folder / "summary.json").is_file()
        assert not (folder / "control.json").exists()


@pytest.mark.long
def test_the_error_of_the_with_block_comes_first(tmp_path: Path) -> None:
    """An expectation that failed as well does not hide it."""
    expectation = {"metric": "scan.delivery", "above": 0.9}
    entries: dict[str, Any] = {"side": ["robot", "base"], "link": [{**LINK, "quality": 0.0}], "expect": [expectation]}
    running = wire(**entries, out=tmp_path / "wire")

    def fail() -> NoReturn:
        with zenoh.open(running.config("robot")) as robot:
            wait_until(lambda: robot.put("a", b"") or heard(running), "the wire hears a message")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), running:
        fail()
    assert running.summary()["expectations"][0]["held"] is False


def test_every_name_of_the_package_is_loaded_when_it_is_used() -> None:
    """Without an import of its module: `evedrop.wire(...)` works after `import evedrop`."""
    code = "import evedrop; assert all(callable(getattr(evedrop, name)) for name in evedrop.__all__)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)


def test_a_wire_that_cannot_begin_says_why(tmp_path: Path) -> None:
    """With the message of the command."""
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="is not empty"), wire(wire_plan(), out=tmp_path):
        pytest.fail("it has begun")


def test_a_wire_in_the_folder_of_another_is_refused_and_does_not_steer_it(tmp_path: Path) -> None:
    """In the words of the command, although the other one answers there."""
    with wire(wire_plan(), out=tmp_path / "wire") as first:
        second = wire(wire_plan(), out=tmp_path / "wire")
        with pytest.raises(UsageError, match="another wire writes to"), second:
            pytest.fail("it has begun")
        with pytest.raises(UsageError, match=r"this wire does not run; the control\.json in .* is that of another one"):
            second.partition("robot", "base")
        assert first.status().events == []


def test_a_wire_of_a_background_job_is_ended(tmp_path: Path) -> None:
    """In order: all that it starts ignores SIGINT."""
    running = wire(wire_plan(), out=tmp_path / "wire")
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        running.__enter__()
    finally:
        signal.signal(signal.SIGINT, before)
    running.__exit__(None, None, None)
    assert running.typed_summary().state == "ended"


@pytest.mark.parametrize(
    ("arguments", "entries", "error", "message"),
    [
        (("missing.toml",), {}, UsageError, "cannot be read"),
        ((), {"side": ["robot", "desk"], "link": [LINK]}, ScenarioError, 'link.0.to: is "base"'),
        ((wire_plan(),), {"seed": 3}, UsageError, "expected no entries with a plan"),
        ((wire_plan(),), {"seconds": "300 h"}, UsageError, "seconds 300 h: expected more than 0 and at most 1000000 s"),
        ((wire_plan(),), {"seconds": None}, UsageError, "seconds None: expected more than 0 .* such as"),
        ((), {"side": {"robot": 1}.keys(), "link": [LINK]}, ScenarioError, "side: is a dict_keys; expected .* a list"),
        ((), {"side": ["robot", "robot", "base"], "link": [LINK]}, ScenarioError, "side: is .*; expected a table"),
        ((), {"side": ["robot", {"base": {}}], "link": [LINK]}, ScenarioError, "side: is .*; expected a table"),
    ],
)
def test_mistakes_are_said_before_anything_begins(
    arguments: tuple[Any, ...], entries: Mapping[str, Any], error: type[UsageError], message: str, tmp_path: Path
) -> None:
    """By the call, before the `with` statement; no folder is made."""
    with pytest.raises(error, match=message):
        wire(*arguments, **{"out": tmp_path / "wire", **entries})
    assert list(tmp_path.iterdir()) == []


def test_an_entry_of_a_file_is_changed_by_its_dotted_key(tmp_path: Path) -> None:
    """With `__` for the dot."""
    text = 'seed = 7\n[side.robot]\n[side.base]\n[[link]]\nfrom = "robot"\nto = "base"\nquality = 0.5\n'
    (tmp_path / "radio.toml").write_text(text)
    changed = wire(tmp_path / "radio.toml", out=tmp_path / "wire", seed=8, link__0__quality=0.9)
    assert changed.plan.seed == 8
    assert changed.plan.links[0].settings["loss"]["quality"] == 0.9


def test_numbers_of_numpy_are_numbers_and_paths_are_texts(tmp_path: Path) -> None:
    """Also in lists and tables, as for a link that is steered; an entry that is None is not given."""
    loss = {"model": "markov", "transitions": np.full((2, 2), 0.5), "loss": np.array([0, 1])}
    tls = {"certificate": Path("c.pem"), "key": Path("k.pem")}
    entries: dict[str, Any] = {
        "side": {"robot": {"listen": "tls/127.0.0.1:0", "tls": tls}, "base": {}},
        "link": ({"name": "scan", "from": "robot", "to": "base", "loss": loss},),
        "query_seconds": None,
    }
    made = wire(**entries, seed=np.int64(3), out=tmp_path).plan
    assert made.seed == 3
    assert made.links[0].settings["loss"]["transitions"] == [[0.5, 0.5], [0.5, 0.5]]
    assert made.sides["robot"].tls is not None
    assert wire(made, out=tmp_path).plan is made


def test_a_bound_may_be_a_number_of_numpy(tmp_path: Path) -> None:
    """Such as a mean that was computed; what can be no number is refused by its type."""
    plan = wire_plan()
    with WireJournal(tmp_path, plan):
        running = wire(plan, out=tmp_path)
        running.expect("scan.heard", below=np.int64(3), above=None)
        with pytest.raises(ExpectationFailed, match=r"scan\.heard above 3: FAILED"):
            running.expect("scan.heard", above=np.array(3))
        with pytest.raises(ScenarioError, match="above: is a dict_values; expected a number"):
            running.expect("scan.heard", above={"a": 3}.values())


def test_metrics_from_the_disk_are_those_of_the_wire(tmp_path: Path) -> None:
    """Of every kind of message, fate and link, with changed settings, second copies, and fates that were changed later."""
    plan = wire_plan(
        scan={"loss": {"model": "bernoulli", "quality": 0.6}}, rest={"loss": {"model": "bernoulli", "quality": 1.0}}
    )
    with WireJournal(tmp_path, plan) as journal:
        keeper = WireScorekeeper(plan, journal)
        fates = [*WireFate]
        for n in range(600):
            kind = list(Kind)[n % 4] | (AGAIN if n % 7 == 0 and fates[n % 5] == WireFate.DELIVERED else 0)
            key = journal.words.key_code(f"scan/{n % 3}")
            row = journal.records.record(1e9 + n, n // 12, -1, 0.01 * n, key, 0, n, n % 2, kind, fates[n % 5])
            if n == 300:
                journal.change("scan", {"loss": {"model": "bernoulli", "quality": 0.9}}, {("scan/0", "put"): 25})
            if n == 500:
                journal.records.amend(row, WireFate.UNDERWAY)
        journal.flush()
        live, on_disk = keeper.summary(), scorekeeper_on_disk(tmp_path, plan).summary()
        assert on_disk.links == live.links
        assert on_disk.heard == 600
    assert scorekeeper_on_disk(tmp_path, plan).summary().links == keeper.summary().links
    with WireJournal(tmp_path, plan) as journal:
        journal.records.record(
            1e9, 50, -1, 0.0, journal.words.key_code("scan/0"), 0, 64, 0, Kind.PUT, WireFate.DELIVERED
        )
        journal.flush()
        summary = scorekeeper_on_disk(tmp_path, plan).summary()
    assert (summary.start, summary.heard, summary.links["scan"].delivered) == (2, 1, 1)


def test_a_journal_with_two_fates_of_a_message_is_refused(tmp_path: Path) -> None:
    """Its models cannot be compared with it: where the fates of a chain of losses overlapped, this ended in a singular matrix."""
    plan = wire_plan()
    with WireJournal(tmp_path, plan) as journal:
        for n in (4, 5, 4, 6):
            journal.records.record(1e9, n, -1, 0.0, journal.words.key_code("scan/0"), 0, 64, 0, Kind.PUT, WireFate.LOST)
        journal.flush()
        with pytest.raises(UsageError, match="two fates for message 4 of 'scan/0' on the link 'scan'"):
            scorekeeper_on_disk(tmp_path, plan).summary()


def test_the_tutorial_shows_the_programs_of_the_examples() -> None:
    """The copies in the repository and on the page are equal."""
    docs = Path(__file__).parents[2] / "docs"
    tutorial = (docs / "wire" / "tutorial.md").read_text(encoding="utf-8")
    for program in ("talker.py", "listener.py"):
        assert (docs / "examples" / "wire" / program).read_text(encoding="utf-8") in tutorial


def test_the_page_has_every_method() -> None:
    """Of a running wire."""
    page = (Path(__file__).parents[2] / "docs" / "wire" / "python.md").read_text(encoding="utf-8")
    for name in vars(RunningWire):
        if not name.startswith("_") and name not in {"is_running"}:
            assert f"`{name}(" in page
