"""The view of a wire shows what its messages tell, live and from the journal, and cannot hold up the wire."""

from __future__ import annotations

import csv
import threading
import weakref
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

from evedrop.cli.main import main
from evedrop.errors import UsageError
from evedrop.results.wire_summary import WireSummary
from evedrop.show.view import recording
from evedrop.system.waiting import SteadyClock
from evedrop.system.world import world
from evedrop.wire.journal import WireJournal
from evedrop.wire.panels import Pace
from evedrop.wire.plan import WireEvent
from evedrop.wire.recording import WireView, replay_wire
from evedrop.wire.records import Kind, WireFate
from evedrop.wire.run import live_view, run_wire
from evedrop.wire.time_steps import LaneState
from tests.conftest import LIMIT, wait_until
from tests.wire.wire_at_work import LOSSY, both_ways, sending
from tests.wire.wire_recordings import CUT, RATES, SECONDS, shown, texts
from tests.wire.wire_rows import START, robot_plan, traffic


class Text(str):
    """A text to which there can be a weak reference."""


class Clock:
    """The clock of a wire, as a test sets it."""

    def __init__(self) -> None:
        self._now = START
        self._calls = 0

    def __call__(self) -> float:
        """The time that it shows."""
        self._calls += 1
        return self._now

    def wait_for_rounds(self, count: int) -> None:
        """Wait until the thread of a view, which looks once in each round, has looked so often from now on.

        After the second look it has all messages from before, and it has shown the time of the first.
        """
        last = self._calls + count
        wait_until(lambda: self._calls >= last, "the thread looks at the clock")

    def advance(self, by: float) -> None:
        """Let the time go on."""
        self._now += by


def states(rrd: Path, lane: str, step: float, steps: int) -> list[str]:
    """The lane's word in each step."""
    changes = shown(rrd, f"links/{lane}", "StateChange:state")
    words = []
    for k in range(steps):
        words.append([state for seconds, state in changes if seconds <= (k + 0.5) * step][-1][0])
    return words


@pytest.fixture(scope="module")
def rows() -> NDArray[Any]:
    """Messages of a robot, its base and a listener; robot and base are apart for a while."""
    return traffic(robot_plan(), SECONDS, RATES, CUT)


@pytest.fixture(scope="module", autouse=True)
def unhurried() -> Any:
    """However busy the machine is, it gets the time to finish the file of a recording."""
    with patch.object(recording, "FILE_TIMEOUT", LIMIT):
        yield


@pytest.fixture(scope="module")
def rrd(rows: NDArray[Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Their recording, as made while the wire ran."""
    path, clock = tmp_path_factory.mktemp("wire_view") / "recording.rrd", Clock()
    view = WireView(path, robot_plan(), "wire", START, Pace(0.2, SECONDS, True), clock)
    view.note(START + 6.0, "WARN", "a note")
    for block in np.array_split(rows, 30):
        view.add(block)
    clock.advance(SECONDS)
    assert view.close()
    assert view.failure is None
    return path


def test_lanes_say_what_became_of_messages(rows: NDArray[Any], rrd: Path) -> None:
    """Each lane has in each step the word for the messages of its link, and the first lane says what is cut."""
    for link, name in enumerate(RATES):
        at = np.floor((rows["time"] - START) / 0.2).astype(int)
        words = []
        for k in range(60):
            fates = rows[(at == k) & (rows["link"] == link)]["fate"]
            lost = np.mean(fates != 0)
            word = "all delivered" if not lost else "some lost" if lost < 0.5 else "most lost"
            words.append("cut" if (fates == WireFate.CUT).any() else word)
        assert states(rrd, f"{link + 1}_{name}", 0.2, 60) == words
        assert set(words) >= ({"all delivered", "some lost", "cut"} if link == 0 else {"some lost"})
        assert shown(rrd, f"links/{link + 1}_{name}", "StateChange:state")[-1][1] == ["no message"]
    assert states(rrd, "0_cut", 0.2, 60) == [*["–"] * 30, *["robot|base"] * 10, *["–"] * 20]


def test_rates_and_delays_are_those_of_the_messages(rows: NDArray[Any], rrd: Path) -> None:
    """Heard and delivered messages per second, and the median and 99 % of the delays, over 0.6 seconds that end then."""
    rates, delays = shown(rrd, "rates", "Scalars:scalars"), shown(rrd, "delays", "Scalars:scalars")
    assert [round(seconds, 6) for seconds, _ in rates] == [round(0.2 * k, 6) for k in range(3, 61)]
    for (end, rate), (_, delay) in zip(rates, delays, strict=True):
        recent = rows[(rows["time"] - START >= end - 0.6) & (rows["time"] - START < end)]
        for link in range(3):
            of = recent[recent["link"] == link]
            there = of[of["fate"] == WireFate.DELIVERED]
            np.testing.assert_allclose([rate[3 + link], rate[link]], np.array([len(of), len(there)]) / 0.6)
            if not len(there):
                assert np.isnan([delay[link], delay[3 + link]]).all()
            elif link < 2:
                expected = [
                    1e3 * np.quantile(there["delay"], fraction, method="inverted_cdf") for fraction in (0.99, 0.5)
                ]
                np.testing.assert_allclose([delay[3 + link], delay[link]], expected, rtol=0.04)


def test_graph_and_table_state_the_losses(rows: NDArray[Any], rrd: Path) -> None:
    """At the end, they have what became of all messages of each link, and the table says why."""
    label = shown(rrd, "graph", "GraphNodes:labels")[-1][1]
    table = shown(rrd, "table", "TextDocument:text")[-1][1][0]
    assert label[:3] == ["robot", "base", "listener"]
    for link, name in enumerate(RATES):
        fates = rows[rows["link"] == link]["fate"]
        cut, lost = int(np.sum(fates == WireFate.CUT)), int(np.sum(fates == WireFate.LOST))
        assert label[3 + link] == f"{name}: {100 * (cut + lost) / len(fates):.0f} % lost"
        (line,) = [line for line in table.splitlines() if line.startswith(f"| {name} ")]
        assert f"| {len(fates):,} |" in line
        assert f"{lost:,} lost" in line
        assert (f"{cut:,} cut" in line) == (link < 2)


def test_events_tell_of_stretches_and_notes(rrd: Path) -> None:
    """A line for the note, one when nothing has come for a while, and one when messages arrive again."""
    lines = texts(rrd)
    assert lines[0] == (0.0, "a wire of 3 sides and 3 links, seed 7")
    assert (6.0, "a note") in lines
    assert (6.6, "scan: nothing arrives for 0.6 s (60 cut)") in lines
    assert (8.0, "scan: messages arrive again after 2.0 s (200 cut)") in lines
    assert not [text for _, text in lines if text.startswith("listener")]


def test_time_goes_on_without_messages(tmp_path: Path) -> None:
    """A live view shows a silence as it lasts, and no rate from before it."""
    clock = Clock()
    view = WireView(tmp_path / "r.rrd", robot_plan(), "wire", START, None, clock)
    view.add(traffic(robot_plan(), 2.0, RATES))
    clock.advance(2.0)
    for _ in range(6):
        clock.advance(1.0)
        clock.wait_for_rounds(1)
    assert view.close()
    rates = shown(tmp_path / "r.rrd", "rates", "Scalars:scalars")
    assert rates[-1][0] > 6.0
    assert {tuple(rate) for seconds, rate in rates if seconds > 3.0} == {(0.0,) * 6}
    changes = shown(tmp_path / "r.rrd", "links/1_scan", "StateChange:state")
    assert next(state for seconds, state in changes if seconds >= 2.0) == ["no message"]


@pytest.mark.parametrize("by", [3600.0, -3600.0])
def test_a_clock_that_is_set_does_not_stop_the_view(by: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system's clock is set after 2 of 4 seconds: the view goes on as if it had not been."""
    passed, set_by, shown_time = [0.0], [0.0], Clock()
    monkeypatch.setattr(world(), "monotonic", lambda: passed[0])
    monkeypatch.setattr(world(), "time", lambda: START + passed[0] + set_by[0])
    view = WireView(tmp_path / "r.rrd", robot_plan(), "wire", START, clock=shown_time)
    with WireJournal(tmp_path, robot_plan()) as journal:
        view.follow(journal)
        key = journal.words.key_code("scan")
        for n in range(400):
            at = journal.place.clock.time()
            journal.records.record(at, n, -1, 0.0, key, 0, 1, 0, Kind.PUT, WireFate.DELIVERED)
            passed[0] = (n + 1) / 100
            set_by[0] = by if n >= 200 else 0.0
        journal.note("an event")
    shown_time.advance(4.0)
    assert view.close()
    rates = shown(tmp_path / "r.rrd", "rates", "Scalars:scalars")
    assert abs(rates[-1][0] - 4.0) < 0.3
    assert all(rate[3] == pytest.approx(100.0, abs=4.0) for _, rate in rates)
    assert [(round(seconds, 6), text) for seconds, text in texts(tmp_path / "r.rrd")][1:] == [(4.0, "an event")]


@pytest.mark.parametrize("pause", [0.0, 100.0])
def test_the_graph_of_a_running_wire_forgets_what_is_old(pause: float, tmp_path: Path) -> None:
    """It shows the losses in its window of time, also after a silence; the table counts from the start."""
    clock, path = Clock(), tmp_path / "r.rrd"
    rows = traffic(robot_plan(), 6.0, {"scan": 100.0})
    early, late = rows[:300], rows[300:]
    early["fate"], late["fate"] = WireFate.LOST, WireFate.DELIVERED
    late["time"] += pause
    if pause:  # so that only the silence is longer than the window
        late = late[:50]
    view = WireView(path, robot_plan(), "wire", START, Pace(0.2, 2.0), clock)
    for part in (early, late):
        view.add(part)
        clock.advance(float(part["time"][-1]) - clock() + 0.01)
        clock.wait_for_rounds(2)
    assert view.close()
    assert shown(path, "graph", "GraphNodes:labels")[-1][1][3] == "scan: 0 % lost"
    assert "300 lost" in shown(path, "table", "TextDocument:text")[-1][1][0]


def test_a_disk_that_takes_nothing_harms_only_the_view(tmp_path: Path, rows: NDArray[Any]) -> None:
    """No method raises, nothing that is added is kept in memory, and the reason is kept."""
    view = WireView(tmp_path / "nowhere" / "r.rrd", robot_plan(), "wire", START)
    added, amended, note = rows.copy(), rows[:1].copy(), Text("a note")
    kept = [weakref.ref(thing) for thing in (added, amended, note)]
    view.add(added)
    view.amend(amended, WireFate.UNDERWAY)
    view.note(START, "INFO", note)
    del added, amended, note
    assert [reference() for reference in kept] == [None] * 3
    assert not view.close()
    assert "the recording is incomplete" in str(view.failure)


def test_a_view_that_is_far_behind_gives_up(tmp_path: Path, rows: NDArray[Any]) -> None:
    """Instead of taking ever more memory, or holding up the wire."""
    looking, going_on = threading.Event(), threading.Event()

    def clock() -> float:
        if threading.current_thread() is not threading.main_thread():
            looking.set()
            assert going_on.wait(LIMIT)
        return START

    view = WireView(tmp_path / "r.rrd", robot_plan(), "wire", START, None, clock, most_rows=5000)
    assert looking.wait(LIMIT)  # the thread stands still
    blocks = [rows.copy() for _ in range(10)]
    kept = [weakref.ref(block) for block in blocks]
    while blocks:
        view.add(blocks.pop())
    assert 0 < sum(reference() is not None for reference in kept) <= 5000 // len(rows) + 2
    assert "did not keep up" in str(view.failure)
    going_on.set()
    view.close()


def test_amended_fates_are_in_the_table(tmp_path: Path) -> None:
    """A message that was still delayed when the wire ended is not shown as delivered."""
    clock, rows = Clock(), traffic(robot_plan(), 1.0, {"scan": 100.0})
    view = WireView(tmp_path / "r.rrd", robot_plan(), "wire", START, None, clock)
    clock.advance(1.0)
    view.add(rows)
    for row in np.flatnonzero(rows["fate"] == 0)[-5:]:
        view.amend(rows[row : row + 1], WireFate.UNDERWAY)
    assert view.close()
    table = shown(tmp_path / "r.rrd", "table", "TextDocument:text")[-1][1][0]
    assert "5 underway" in table


def test_fates_that_change_are_in_their_steps(tmp_path: Path) -> None:
    """In those of their messages, although these were counted before."""
    clock, rows = Clock(), traffic(robot_plan(), 2.0, {"scan": 100.0})
    view = WireView(tmp_path / "r.rrd", robot_plan(), "wire", START, None, clock)
    view.add(rows)
    clock.advance(2.0)
    clock.wait_for_rounds(2)
    view.amend(rows[(rows["fate"] == 0) & (rows["time"] >= START + 1.8)], WireFate.CONGESTED)
    assert view.close()
    assert shown(tmp_path / "r.rrd", "rates", "Scalars:scalars")[-1][0] < 2.1
    assert states(tmp_path / "r.rrd", "1_scan", 0.2, 10)[-1] == LaneState.OWN.word


@pytest.mark.thorough
def test_a_view_follows_a_running_wire(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """With `--view FILE.rrd`, the file has what crossed and the events; the journal, too, keeps the events."""
    plan = both_ways(LOSSY, events=(WireEvent(0.5, None, partition=("robot", "base")),))
    out, path = tmp_path / "out", tmp_path / "wire.rrd"
    messages: list[str] = []
    with sending(messages):
        assert run_wire(plan, out, seconds=1.5, say=messages.append, view=str(path)) == 0
    table = shown(path, "table", "TextDocument:text")[-1][1][0]
    assert "cut" in table
    assert "partition robot, base" in [text for _, text in texts(path)]
    capfd.readouterr()
    files = tmp_path / "t.csv", tmp_path / "t.tex"
    assert main(["view", str(out), "--table", "--csv", str(files[0]), "--latex", str(files[1])]) == 0
    heads, *rows = csv.reader(files[0].read_text().splitlines())
    links = WireSummary.read(out / "summary.json").links
    assert [(row[0], int(row[heads.index("heard")])) for row in rows] == [
        (name, link.heard) for name, link in links.items()
    ]
    rates = ["" if link.rate is None else repr(link.rate) for link in links.values()]
    assert [row[heads.index("rate")] for row in rows] == rates
    assert "tabular" in files[1].read_text()
    printed = capfd.readouterr().out
    assert printed.strip() == "\n".join(messages[-1 - printed.count("\n") : -1]).strip()
    replayed = replay_wire(out, tmp_path / "replayed.rrd")
    assert "partition robot, base" in [text for _, text in texts(replayed)]
    assert shown(replayed, "table", "TextDocument:text")[-1][1][0] == table


def test_a_word_that_is_not_a_view_is_refused(tmp_path: Path) -> None:
    """Before the wire starts."""
    with (
        pytest.raises(UsageError, match="is not a way to view"),
        live_view(robot_plan(), tmp_path, "pdf", print, SteadyClock()),
    ):
        pass
    with live_view(robot_plan(), tmp_path, "off", print, SteadyClock()) as view:
        assert view is None
    assert not [*tmp_path.iterdir()]


def test_a_second_wire_in_a_folder_leaves_the_recording_of_the_first(tmp_path: Path) -> None:
    """It is refused before it writes anything."""
    path = tmp_path / "wire.rrd"
    path.write_bytes(b"of the first")
    with WireJournal(tmp_path / "out", both_ways()), pytest.raises(UsageError, match="another wire"):
        run_wire(both_ways(), tmp_path / "out", seconds=0.1, view=str(path))
    assert path.read_bytes() == b"of the first"
    with pytest.raises(UsageError, match="is not a way to view"):
        run_wire(both_ways(), tmp_path / "new", seconds=0.1, view="pdf")
    assert not (tmp_path / "new").exists()
